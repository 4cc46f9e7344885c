"""Procedural cars, in metres: the measures of each kind of body, and what is fitted to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh

from learn3d.make_data.shapes.car_body import Body, hull, road_wheel
from learn3d.make_data.shapes.car_open import cabin, jeep_parts, racer, vintage
from learn3d.make_data.shapes.parts import (
    Solid,
    assemble,
    bar,
    both_sides,
    box,
    rectangle,
    rounded_path,
    slab,
    tube,
    wing,
)
from learn3d.make_data.shapes.sampling import maybe, pick


def make_car(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random car."""
    kind = pick(
        rng,
        {
            "sedan": 2.5,
            "hatchback": 2,
            "wagon": 1.2,
            "coupe": 1.6,
            "suv": 1.8,
            "van": 1.2,
            "minivan": 0.8,
            "pickup": 1.4,
        }
        | {"convertible": 1.0, "jeep": 0.8, "vintage": 0.8, "racer": 0.5},
    )
    if kind == "racer":
        return assemble(racer(rng))
    if kind == "vintage":
        return assemble(vintage(rng))
    body = _measures(rng, kind)
    solids = [hull(body), *_wheels(rng, body)]
    solids += _mirrors(rng, body)
    if kind == "jeep":
        solids += jeep_parts(rng, body)
    elif kind == "convertible":
        solids += cabin(rng, body)
    solids += _extras(rng, body, kind)
    return assemble(solids)


def _measures(rng: np.random.Generator, kind: str) -> Body:
    """Random measures of a body of the given kind."""
    u = rng.uniform
    length, width, height, wheel, clearance = {
        "sedan": (u(4.2, 5.2), u(1.7, 1.92), u(1.38, 1.52), u(0.3, 0.35), u(0.14, 0.2)),
        "hatchback": (u(3.3, 4.3), u(1.58, 1.8), u(1.4, 1.6), u(0.28, 0.34), u(0.15, 0.2)),
        "wagon": (u(4.3, 5.0), u(1.7, 1.9), u(1.42, 1.58), u(0.3, 0.35), u(0.15, 0.22)),
        "coupe": (u(4.0, 4.7), u(1.78, 2.0), u(1.1, 1.34), u(0.31, 0.36), u(0.1, 0.15)),
        "suv": (u(4.1, 5.1), u(1.78, 2.02), u(1.62, 1.95), u(0.36, 0.43), u(0.22, 0.3)),
        "van": (u(4.4, 6.0), u(1.8, 2.05), u(1.9, 2.6), u(0.32, 0.37), u(0.18, 0.25)),
        "minivan": (u(4.2, 5.1), u(1.75, 1.98), u(1.6, 1.85), u(0.3, 0.35), u(0.16, 0.2)),
        "pickup": (u(4.8, 5.9), u(1.75, 2.05), u(1.6, 1.95), u(0.36, 0.44), u(0.24, 0.34)),
        "convertible": (u(3.8, 4.6), u(1.65, 1.9), u(1.15, 1.3), u(0.3, 0.35), u(0.12, 0.17)),
        "jeep": (u(3.4, 4.3), u(1.6, 1.85), u(1.65, 1.9), u(0.36, 0.43), u(0.26, 0.34)),
    }[kind]
    gap = wheel + 0.06
    front = gap + u(0.3, 0.5) + (0.1 if kind in ("sedan", "coupe") else 0.0)
    rear = length - gap - u(0.25, 0.5)
    least = wheel + gap + 0.09  # the shoulder stays above the arches
    belt = max(least, u(0.55, 0.64) * height)
    belts = (belt, max(least, belt + u(-0.02, 0.1)))
    roof_front, glass = u(0.42, 0.5) * length, 0.0
    cowl = u(0.25, 0.31) * length
    hood = belts[0] + u(-0.05, 0.06)
    cowl_y = max(belts[0] + u(0.05, 0.12), hood + 0.02)
    roof_rear = u(0.66, 0.74) * length
    glass, glass_y = roof_rear + u(0.1, 0.16) * length, belts[1] + u(0.05, 0.12)
    tail = belts[1] + u(0.0, 0.1)
    body = Body(
        length=length, half=width / 2, wheel=wheel, front_axle=front, rear_axle=rear, clearance=clearance,
        nose=u(0.6, 0.92) * hood, hood=hood, cowl=(cowl, cowl_y), roof=(roof_front, roof_rear, height),
        rear_glass=(glass, glass_y), tail=tail, belt=belts, tumble=u(0.2, 0.4),
        taper=(u(0.1, 0.25), u(0.05, 0.18)), ledge=u(0.02, 0.07), tyre=u(0.18, 0.26), softness=u(0.05, 0.25),
    )  # fmt: skip
    if kind in ("hatchback", "wagon", "suv", "minivan"):
        end = length - (u(0.15, 0.5) if kind == "hatchback" else u(0.1, 0.35))
        low = length - u(0.02, 0.1)
        body = replace(body, roof=(roof_front, end, height), rear_glass=(low, belts[1] + 0.04), tail=belts[1] - 0.05)
        if kind == "minivan" or (kind == "hatchback" and maybe(rng, 0.4)):
            cowl = u(0.16, 0.21) * length
            body = replace(body, cowl=(cowl, cowl_y), roof=(cowl + u(0.13, 0.2) * length, end, height))
        if kind == "suv":
            body = replace(body, tumble=u(0.12, 0.28), cowl=(cowl, cowl_y + 0.04))
    elif kind == "coupe":
        slope = u(0.0, 1.0)  # from a notch to a fastback
        cowl = u(0.27, 0.4) * length
        top = cowl + u(0.14, 0.18) * length
        glass = (0.76 + 0.2 * slope) * length
        body = replace(
            body, cowl=(cowl, cowl_y - 0.02), roof=(top, top + u(0.06, 0.14) * length, height), tumble=u(0.3, 0.5)
        )
        body = replace(body, rear_glass=(glass, belts[1] + 0.06), tail=belts[1] + u(-0.02, 0.06))
        if maybe(rng, 0.35):  # mid-engined wedge
            cowl = u(0.19, 0.25) * length
            body = replace(body, cowl=(cowl, cowl_y), roof=(cowl + 0.2 * length, cowl + 0.3 * length, height))
            body = replace(body, nose=0.45 * hood, hood=hood - 0.08, softness=u(0.03, 0.1))
    elif kind == "van":
        cowl = u(0.06, 0.2) * length
        top = cowl + u(0.06, 0.14) * length
        belt = max(least, u(0.85, 1.05))
        low = belt + u(-0.1, 0.1)
        body = replace(body, cowl=(cowl, belt + 0.12), roof=(top, length - u(0.03, 0.12), height), tumble=u(0.04, 0.13))
        body = replace(
            body, belt=(belt, belt), hood=low, nose=0.75 * low, rear_glass=(length - 0.03, belt + 0.1), tail=belt
        )
        body = replace(body, taper=(u(0.06, 0.16), 0.03), softness=u(0.08, 0.3))
    elif kind == "pickup":
        cab = u(0.5, 0.66) * length
        belt = max(least, u(0.54, 0.62) * height)
        cowl = u(0.24, 0.29) * length
        top = cowl + u(0.09, 0.13) * length
        body = replace(
            body, cowl=(cowl, belt + 0.1), roof=(top, cab - u(0.03, 0.2), height), rear_glass=(cab, belt + 0.03)
        )
        body = replace(
            body, belt=(belt, belt), hood=belt + u(0.0, 0.06), nose=0.8 * belt, tail=belt, taper=(u(0.06, 0.15), 0.02)
        )
        body = replace(body, open_from=cab + 0.06, open_to=length - 0.08, open_floor=belt - u(0.3, 0.45), softness=0.1)
    elif kind == "convertible":
        seat, end = cowl + 0.08 * length, u(0.64, 0.76) * length
        body = replace(body, roof=(seat, end, belts[1] + 0.05), rear_glass=(end + 0.1, belts[1] + 0.05), ledge=0.01)
        body = replace(body, open_from=seat, open_to=end, open_floor=0.42)
    elif kind == "jeep":
        cowl = u(0.3, 0.36) * length
        belt = max(least, u(0.52, 0.6) * height)
        body = replace(
            body, belt=(belt, belt), hood=belt + u(0.0, 0.06), nose=0.85 * belt, cowl=(cowl, belt + 0.06), softness=0.03
        )
        body = replace(
            body, roof=(cowl + 0.1, length - 0.15, belt + 0.05), rear_glass=(length - 0.1, belt + 0.04), tail=belt
        )
        body = replace(
            body, open_from=cowl + 0.12, open_to=length - 0.1, open_floor=clearance + 0.2, taper=(0.06, 0.01)
        )
        body = replace(body, ledge=0.01, rear_axle=length - gap - u(0.12, 0.25))
    return body


def _wheels(rng: np.random.Generator, body: Body) -> list[Solid]:
    """Four wheels on two axles."""
    dish = rng.uniform(0.1, 0.6)
    solids = []
    for axle in (body.front_axle, body.rear_axle):
        z = body.length / 2 - axle
        x = body.half - body.tyre / 2 - 0.02
        wheel = road_wheel(body.wheel, body.tyre, dish).moved(x, body.wheel, z)
        solids += [*both_sides(wheel), bar((-x, body.wheel, z), (x, body.wheel, z), 0.1)]
    return solids


def _mirrors(rng: np.random.Generator, body: Body) -> list[Solid]:
    """Wing mirrors at the foot of the windscreen."""
    if maybe(rng, 0.15):
        return []
    z, y = body.length / 2 - body.cowl[0] - 0.2, body.belt[0] + 0.07
    size = (rng.uniform(0.14, 0.22), rng.uniform(0.09, 0.16), 0.08)
    mirror = box(size, (body.half + 0.07, y, z), 0.03)
    return both_sides(mirror) + both_sides(bar((0.85 * body.half, y - 0.09, z), (body.half + 0.04, y - 0.01, z), 0.05))


def _extras(rng: np.random.Generator, body: Body, kind: str) -> list[Solid]:
    """Things that some cars carry: bumpers, spoiler, roof rack or box, light bar, spare wheel, cargo rails."""
    b, solids = body, []
    front, rear, y = b.length / 2, -b.length / 2, b.clearance + 0.2
    if maybe(rng, 0.45):
        wide = 0.85 * b.half
        solids.append(box((2 * wide, rng.uniform(0.12, 0.2), 0.14), (0, y, front - 0.01), 0.04))
        solids.append(box((2 * wide * 1.05, rng.uniform(0.12, 0.2), 0.14), (0, y + 0.04, rear + 0.01), 0.04))
    roof_z, roof_y = front - (b.roof[0] + b.roof[1]) / 2, b.roof[2]
    long = 0.8 * (b.roof[1] - b.roof[0])
    roof_half = b.half * 0.97 - b.ledge - b.tumble * (roof_y - b.belt[1])
    if kind in ("wagon", "suv", "minivan", "van", "hatchback") and maybe(rng, 0.5):
        extra = pick(rng, {"rails": 2, "box": 1, "rack": 1, "dome": 0.4})
        x = 0.78 * roof_half
        if extra == "rails":
            path = [
                (x, roof_y - 0.06, long / 2),
                (x, roof_y + 0.05, long / 2 - 0.1),
                (x, roof_y + 0.05, -long / 2 + 0.1),
            ]
            path = rounded_path([*path, (x, roof_y - 0.08, -long / 2)], 0.08, 2)
            solids += both_sides(tube(path, 0.022).moved(z=roof_z))
        elif extra == "dome":
            solids.append(box((0.3, 0.14, 0.12), (0, roof_y + 0.05, roof_z + 0.2)))
        else:
            for z in (0.3 * long, -0.3 * long):
                solids.append(box((2 * x, 0.05, 0.06), (0, roof_y + 0.035, roof_z + z)))
                solids += both_sides(box((0.05, 0.12, 0.06), (0.9 * x, roof_y - 0.01, roof_z + z)))
            if extra == "box":
                outline = rectangle(rng.uniform(0.6, 0.9) * roof_half * 1.6, long, 0.2, 3)
                solids.append(slab(outline, rng.uniform(0.18, 0.35), 0.1).moved(y=roof_y + 0.05, z=roof_z))
    if kind == "sedan" and maybe(rng, 0.12):
        solids.append(box((1.4 * roof_half, 0.13, 0.25), (0, roof_y + 0.05, roof_z + 0.1), 0.04))
    if kind in ("coupe", "sedan", "hatchback") and maybe(rng, 0.6 if kind == "coupe" else 0.12):
        high, wide = rng.uniform(0.08, 0.3), 0.85 * b.half
        level = b.tail + high if kind != "hatchback" else roof_y + 0.02
        z = rear + rng.uniform(0.15, 0.4)
        if kind == "hatchback":
            solids.append(box((1.6 * roof_half, 0.05, 0.4), (0, roof_y - 0.03, front - b.roof[1]), 0.015))
        else:
            solids.append(wing([(-wide, level, z, 0.3, 0.12), (wide, level, z, 0.3, 0.12)]))
            solids += both_sides(box((0.05, high + 0.3, 0.14), (0.7 * wide, level - high / 2 - 0.13, z - 0.13)))
    if kind == "pickup" and maybe(rng, 0.4):
        z, x, top = front - b.open_from - 0.1, 0.9 * b.half, b.roof[2] - 0.02
        path = [(x, b.belt[0] - 0.05, z), (0.85 * x, top, z), (-0.85 * x, top, z), (-x, b.belt[0] - 0.05, z)]
        solids.append(tube(rounded_path(path, 0.15, 3), 0.04))
    if kind in ("suv", "jeep") and maybe(rng, 0.4 if kind == "suv" else 0.7):
        spare = road_wheel(0.95 * b.wheel, b.tyre, 0.2).rotated("y", 90)
        solids.append(spare.moved(rng.uniform(-0.1, 0.2), max(b.belt[1] - 0.1, 0.8), rear - 0.4 * b.tyre + 0.03))
    return solids
