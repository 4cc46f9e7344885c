"""Cars that are not one closed body, in metres: cabins of convertibles, jeeps, cars of the 1930s, racing cars."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from learn3d.make_data.shapes.car_body import Body, hull, road_wheel
from learn3d.make_data.shapes.parts import (
    Solid,
    bar,
    between,
    both_sides,
    box,
    ellipsoid,
    rectangle,
    rounded_path,
    sheet,
    tube,
    wing,
)
from learn3d.make_data.shapes.sampling import maybe, pick


def cabin(rng: np.random.Generator, body: Body) -> list[Solid]:
    """What shows of an open car: windscreen, seats, perhaps roll hoops or a folded roof."""
    b, front = body, body.length / 2
    half = 0.82 * b.half
    foot, top = front - b.open_from + 0.12, b.belt[0] + rng.uniform(0.34, 0.45)
    v = np.linspace(-1, 1, 7)[None]
    t = np.linspace(0, 1, 3)[:, None]
    x = half * v * (1 - 0.18 * t)
    y = b.belt[0] - 0.05 + t * (top - b.belt[0] + 0.05) + 0 * v
    z = foot - rng.uniform(0.25, 0.45) * t - 0.12 * v**2
    solids = [sheet(np.stack([x, y, z], 2), 0.035)]
    seat_z = front - b.open_to + 0.3
    rows = (seat_z, seat_z + 0.75) if b.open_to - b.open_from > 1.45 else (seat_z,)
    for row in rows:
        tall = b.belt[1] + 0.12 - b.open_floor
        back = box((0.54 * b.half, tall, 0.14), (0.4 * b.half, b.open_floor + tall / 2 - 0.01, row), 0.05)
        solids += both_sides(back.rotated("x", -10, (0, b.open_floor, row)))
        solids += both_sides(box((0.56 * b.half, 0.2, 0.5), (0.4 * b.half, b.open_floor + 0.08, row + 0.25), 0.05))
    if maybe(rng, 0.3):
        hoop = [(x * b.half, b.belt[1] + y, 0) for x, y in ((0.16, -0.1), (0.2, 0.28), (0.6, 0.28), (0.65, -0.1))]
        solids += both_sides(tube(rounded_path(hoop, 0.12, 3), 0.03).moved(z=front - b.open_to - 0.02))
    elif maybe(rng, 0.4):
        solids.append(box((1.7 * half, 0.18, 0.4), (0, b.belt[1] + 0.06, front - b.open_to - 0.1), 0.07))
    return solids


def jeep_parts(rng: np.random.Generator, body: Body) -> list[Solid]:
    """Upright windscreen and seats with a roll cage, a canvas roof on bows or a hard top."""
    b, front = body, body.length / 2
    half, low, top = 0.88 * b.half, b.belt[0] - 0.03, b.belt[0] + rng.uniform(0.6, 0.75)
    z = front - b.open_from + 0.06
    lean = rng.uniform(0.0, 0.2)
    frame = [(half, low, z), (half, top, z - lean), (-half, top, z - lean), (-half, low, z)]
    solids = [tube(rounded_path(frame, 0.05, 2), 1.0, rectangle(0.07, 0.07, segments=1))]
    solids.append(sheet(np.array([[frame[0], frame[1]], [frame[3], frame[2]]]), 0.03))
    rear = -front + 0.12
    kind = pick(rng, ("cage", "roof", "hard", "open"))
    if kind == "cage":
        for zz in ((z - lean + rear) / 2, rear):
            hoop = [(half, low, zz), (half, top, zz), (-half, top, zz), (-half, low, zz)]
            solids.append(tube(rounded_path(hoop, 0.15, 3), 0.04))
        solids += both_sides(bar((0.9 * half, top, z - lean), (0.9 * half, top, rear), 0.07))
    elif kind != "open":
        solids.append(
            between((-half - 0.02, top - 0.04, rear - 0.03), (half + 0.02, top + 0.03, z - lean + 0.08), 0.03)
        )
        if kind == "hard":
            middle = rear + rng.uniform(0.35, 0.6) * (z - rear)
            solids += both_sides(between((half - 0.04, low, rear), (half, top, middle)))
            solids.append(between((-half, low, rear - 0.02), (half, top, rear + 0.03)))
        else:
            solids += both_sides(bar((half - 0.03, low, rear), (half - 0.03, top, rear), 0.07))
    for x in (-0.36, 0.36):
        seat_z = (z + rear) / 2
        solids.append(box((0.44, 0.66, 0.12), (x, b.open_floor + 0.5, seat_z), 0.04))
        solids.append(box((0.46, 0.26, 0.46), (x, b.open_floor + 0.1, seat_z + 0.22), 0.04))
    return solids


def vintage(rng: np.random.Generator) -> list[Solid]:
    """A car of the 1930s: narrow body, separate curved fenders, running boards, upright grille."""
    u = rng.uniform
    length, height, wheel = u(3.7, 4.7), u(1.5, 1.75), u(0.34, 0.4)
    half, narrow = u(0.78, 0.88), u(0.46, 0.6)
    front, rear = wheel + u(0.1, 0.25), length - wheel - u(0.3, 0.5)
    belt = u(0.95, 1.05)
    closed = maybe(rng, 0.65)
    cowl = front + u(0.55, 0.9)
    end = rear + u(0.2, 0.45)
    body = Body(
        length=length - 0.2, half=narrow, wheel=0.1, front_axle=-9.0, rear_axle=99.0, clearance=0.3,
        nose=belt - 0.08, hood=belt - 0.03, cowl=(cowl, belt + 0.08),
        roof=(cowl + u(0.1, 0.3), end - u(0.1, 0.4), height), rear_glass=(min(end + 0.1, length - 0.35), belt),
        tail=0.7 * belt, belt=(belt - 0.03, belt + 0.02), tumble=u(0.05, 0.15),
        taper=(u(0.2, 0.35), u(0.1, 0.4)), ledge=0.01, tyre=0.05, softness=u(0.1, 0.4),
    )  # fmt: skip
    if not closed:
        body = replace(body, roof=(cowl + 0.2, end - 0.2, belt + 0.07), open_from=cowl + 0.15, open_to=end - 0.1)
    shape = hull(body)
    if closed:  # the cabin is wider than the bonnet
        rings = shape.rings.copy()
        s = body.length / 2 - rings[..., 2]
        rings[..., 0] *= 1 + u(0.1, 0.3) * np.clip((s - cowl + 0.1) / 0.3, 0, 1)
        shape = Solid(rings)
    solids = [shape.moved(z=0.0)]
    if not closed:
        solids += cabin(rng, body)
    tyre, x = u(0.14, 0.2), half - 0.12
    shift = body.length / 2
    reach = wheel + u(0.08, 0.12)
    for axle, tail_deg in ((front, 150), (rear, 170)):
        z = shift - axle
        solids += [
            *both_sides(road_wheel(wheel, tyre, 0.3).moved(x, wheel, z)),
            bar((-x, wheel, z), (x, wheel, z), 0.1),
        ]
        angle = np.radians(np.linspace(u(-5, 20), tail_deg, 12))
        arc = np.stack([reach * np.cos(angle), wheel + reach * np.sin(angle)], 1)
        if axle == front:  # sweeps down to the running board
            arc = np.concatenate([arc, [[-reach - 0.25, 0.36], [-reach - 0.4, 0.33]]])
        v = np.linspace(-1, 1, 5)[None]
        wide = u(0.16, 0.2)
        crown = -0.06 * v**2
        y = arc[:, 1:] + crown * np.clip(arc[:, 1:] - 0.3, 0, 1)
        grid = np.stack([x - 0.04 + wide * v + 0 * y, y, arc[:, :1] + z + 0 * v], 2)
        solids += both_sides(sheet(grid, 0.04))
        solids += both_sides(box((x - 0.5 * narrow, 0.1, 0.3), ((x + 0.4 * narrow) / 2, wheel + 0.35 * reach, z), 0.02))
        stay = bar((0.4 * narrow, 0.6 * belt, z), (x, wheel + 0.97 * reach, z), 0.07)
        solids += both_sides(stay)
    board = between((0.7 * narrow, 0.29, shift - rear + 0.8 * reach), (half + 0.02, 0.35, shift - front - reach - 0.1))
    solids += both_sides(board)
    lamp = ellipsoid((0.22, 0.22, 0.24), (0.7 * narrow + 0.1, belt - 0.15, shift - 0.12), 12, 6)
    solids += both_sides(lamp) + both_sides(
        bar((0.3 * narrow, belt - 0.25, shift - 0.16), (0.7 * narrow + 0.1, belt - 0.2, shift - 0.12), 0.06)
    )
    for z in (shift - 0.02, -shift + 0.02):
        solids.append(box((1.9 * half, 0.12, 0.07), (0, 0.42, z + np.sign(z) * 0.06), 0.03))
        solids += both_sides(
            bar((0.5 * narrow, 0.42, z - np.sign(z) * 0.25), (0.5 * narrow, 0.42, z + np.sign(z) * 0.06), 0.07)
        )
    if maybe(rng, 0.4):
        spare = road_wheel(wheel * 0.95, tyre, 0.3).rotated("y", 90).rotated("x", 15)
        solids.append(spare.moved(0, 0.75, -shift + 0.0))
    return solids


def racer(rng: np.random.Generator) -> list[Solid]:
    """An open-wheel racing car with wings."""
    u = rng.uniform
    length, half, wheel, tyre = u(4.2, 5.2), u(0.85, 1.0), u(0.31, 0.36), u(0.28, 0.4)
    front, rear = length / 2 - u(0.7, 1.0), -length / 2 + u(0.6, 0.8)
    pods = u(0.45, 0.62)
    stations = [
        (length / 2, 0.10, 0.14, 0.28), (length / 2 - 0.5, 0.14, 0.12, 0.42), (front - 0.4, 0.22, 0.1, 0.56),
        (0.35, 0.32, 0.08, 0.68), (0.1, 0.34, 0.08, 0.66), (-0.2, 0.34, 0.08, 0.72), (-0.35, 0.2, 0.08, u(0.8, 1.0)),
        (rear + 0.2, 0.16, 0.1, 0.6), (rear - 0.25, 0.1, 0.16, 0.42),
    ]  # fmt: skip
    rings = []
    for z, w, y0, y1 in stations:
        outline = rectangle(2 * w, y1 - y0, 0.35 * w, 3)
        rings.append(np.stack([outline[:, 0], outline[:, 1] + (y0 + y1) / 2, np.full(len(outline), z)], 1))
    solids = [Solid(np.stack(rings)), box((2 * pods, 0.06, 0.5 * length), (0, 0.1, 0.0), 0.02)]
    pod = [(0.5, 0.9, 0.45), (0.3, 1.0, 0.5), (-0.5, 0.9, 0.4), (rear + 0.35, 0.3, 0.25)]
    rings = []
    for z, w, h in pod:
        outline = rectangle(w * pods, h, 0.1, 3)
        rings.append(
            np.stack([0.55 * pods * (0.4 + 0.6 * w) + outline[:, 0], 0.1 + h / 2 + outline[:, 1], np.full(16, z)], 1)
        )
    solids += both_sides(Solid(np.stack(rings)))
    for z, scale in ((front, 0.85), (rear, 1.0)):
        x = half - scale * tyre / 2
        solids += both_sides(road_wheel(wheel * (0.95 if z == front else 1), scale * tyre, 0.4).moved(x, wheel, z))
        for dz, y in ((0.2, 0.28), (-0.2, 0.28), (0.12, 0.42), (-0.15, 0.42)):
            solids += both_sides(bar((0.08, min(y, 0.36), z + dz), (x, wheel + 0.3 * (y - 0.35), z), 0.04))
    wide = half - 0.05
    nose = length / 2 + 0.05
    solids.append(wing([(-wide, 0.2, nose, 0.4, 0.12), (wide, 0.2, nose, 0.4, 0.12)]))
    solids += both_sides(box((0.03, 0.22, 0.45), (wide, 0.24, nose - 0.2)))
    level, back = u(0.75, 1.0), rear - 0.15
    span = u(0.45, 0.75)
    solids.append(wing([(-span, level, back, 0.36, 0.12), (span, level, back, 0.36, 0.12)]))
    solids += both_sides(box((0.03, 0.5, 0.5), (span, level - 0.16, back - 0.2)))
    solids += both_sides(box((0.03, level - 0.25, 0.16), (0.07, (level + 0.27) / 2, back - 0.08)))
    solids.append(ellipsoid((0.27, 0.28, 0.32), (0, 0.76, 0.08), 12, 6))
    if maybe(rng, 0.4):  # a halo over the driver
        halo = [(0.24, 0.62, -0.15), (0.26, 0.86, -0.05), (0.0, 0.88, 0.5), (-0.26, 0.86, -0.05), (-0.24, 0.62, -0.15)]
        solids += [tube(rounded_path(halo, 0.2, 4), 0.03), bar((0, 0.62, 0.55), (0, 0.88, 0.46), 0.05)]
    return solids
