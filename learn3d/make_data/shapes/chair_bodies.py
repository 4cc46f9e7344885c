"""Chairs made in one piece, in metres: moulded shells, upholstered club chairs, barrel chairs."""

from __future__ import annotations

import numpy as np

from learn3d.make_data.shapes import supports
from learn3d.make_data.shapes.parts import (
    Solid,
    bar,
    between,
    both_sides,
    box,
    ellipse,
    rectangle,
    rounded_path,
    sheet,
    slab,
)
from learn3d.make_data.shapes.sampling import maybe, pick


def shell_chair(rng: np.random.Generator) -> list[Solid]:
    """A moulded bucket: one curved sheet for seat and back, on any support."""
    width, depth = rng.uniform(0.42, 0.62), rng.uniform(0.40, 0.52)
    height, back, lean = rng.uniform(0.36, 0.47), rng.uniform(0.25, 0.5), rng.uniform(0.05, 0.2)
    curl, wings = rng.uniform(0.0, 0.07), rng.uniform(0.0, 0.22)
    path = rounded_path(
        [(0, -0.03, depth / 2), (0, 0, depth / 2 - 0.08), (0, -0.02, -depth / 2 + 0.05), (0, back, -depth / 2 - lean)],
        rng.uniform(0.1, 0.2),
        5,
    )
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    t = np.linspace(0, 1, 18)
    path = np.stack([np.interp(t * length[-1], length, path[:, k]) for k in range(3)], 1)
    t = t[:, None]
    v = np.linspace(-1, 1, 15)[None]
    ease = np.clip((t - 0.3) / 0.4, 0, 1)
    ease = ease**2 * (3 - 2 * ease)
    narrow = rng.uniform(-0.1, 0.35)
    span = 0.5 * width * (1 - narrow * ease) * (1 - np.clip((t - 0.75) / 0.25, 0, 1) ** 3 * rng.uniform(0.1, 0.6))
    span = span * (1 - 0.25 * np.clip(1 - t / 0.15, 0, 1) ** 2)
    # the rims are lifted off the seat and pulled forward off the back; `wings` makes arms of them about the hip
    hip = np.exp(-(((t - 0.5) / 0.25) ** 2))
    lift = (curl * np.abs(v) ** 2.5 + wings * hip * np.abs(v) ** 3) * (1 - 0.7 * ease)
    pull = (curl + wings * hip) * np.abs(v) ** 2.5 * ease
    surface = np.stack([span * v, path[:, 1:2] + lift, path[:, 2:3] + pull], 2)
    shell = sheet(surface, rng.uniform(0.018, 0.035)).moved(y=height)
    kind = pick(rng, {"legs": 2, "star": 1, "disc": 1, "loops": 1, "rocker": 0.5})
    plate = slab(ellipse(0.8 * width, 0.8 * depth, 20, 5), 0.03).moved(y=height - 0.045)
    if kind == "legs":
        return [shell, plate, *supports.four_legs(rng, 0.34 * width, 0.34 * depth, height - 0.035, plain=True)]
    return [shell, plate, *supports.base(rng, kind, 0.37 * width, 0.38 * depth, height - 0.035)]


def club_chair(rng: np.random.Generator) -> list[Solid]:
    """An upholstered armchair: a block seat, thick arms and back, perhaps wings, on short feet."""
    width, depth = rng.uniform(0.68, 0.95), rng.uniform(0.68, 0.9)
    arm, arm_height = rng.uniform(0.09, 0.2), rng.uniform(0.5, 0.66)
    back, back_height = rng.uniform(0.12, 0.24), rng.uniform(0.66, 1.1)
    foot = rng.uniform(0.03, 0.2)
    seat_height = rng.uniform(0.36, 0.46)
    soft = rng.uniform(0.02, 0.06)
    half, inner, lean = width / 2, width / 2 - arm, rng.uniform(0, 14)
    split = seat_height - rng.uniform(0.1, 0.16)
    solids = [
        between((-half + 0.02, foot, -depth / 2 + 0.02), (half - 0.02, split + 0.01, depth / 2 - 0.03), 0.02),
        between((-inner - 0.02, split, -depth / 2 + 0.05), (inner + 0.02, seat_height, depth / 2), soft),
    ]
    solids.append(
        between((-inner - 0.05, split - 0.1, -depth / 2), (inner + 0.05, back_height, -depth / 2 + back), soft).rotated(
            "x", -lean, (0, split, -depth / 2 + back)
        )
    )
    kind = pick(rng, ("box", "rolled", "sloped"))
    if kind == "sloped":
        z = np.array([depth / 2 - 0.01, -depth / 2 + 0.02])
        rise = np.array([arm_height - rng.uniform(0.03, 0.12), arm_height + 0.05])
        outline = rectangle(arm, 1.0, 0.03, 3)
        rings = [
            np.stack([half - arm / 2 + outline[:, 0], foot + (outline[:, 1] + 0.5) * (h - foot), np.full(16, zz)], 1)
            for zz, h in zip(z, rise, strict=True)
        ]
        solids += both_sides(Solid(np.stack(rings)))
    else:
        solids += both_sides(between((inner, foot, -depth / 2 + 0.02), (half, arm_height, depth / 2 - 0.01), soft))
        if kind == "rolled":
            start, end = (half - arm / 2, arm_height, -depth / 2 + 0.03), (half - arm / 2, arm_height, depth / 2)
            solids += both_sides(bar(start, end, 1.35 * arm))
    if maybe(rng, 0.35) and back_height > 0.8:  # wings
        t = np.linspace(0, 1, 6)[:, None]
        reach = rng.uniform(0.18, 0.3) * np.sin(np.pi * (0.12 + 0.8 * t)) ** 0.7
        z = -depth / 2 + back - 0.06 + np.linspace(0, 1, 4)[None] * (reach + 0.06)
        y = arm_height - 0.05 + t * (back_height - arm_height) + 0 * z
        sweep = np.tan(np.radians(lean)) * (y - split)
        side = sheet(np.stack([np.full_like(z, inner + 0.02), y, z - sweep], 2), rng.uniform(0.04, 0.08))
        solids += both_sides(side)
    if foot > 0.05:
        solids += supports.feet(rng, half - 0.07, depth / 2 - 0.08, foot + 0.02)
    if maybe(rng, 0.25):
        hip = -depth / 2 + back
        pillow = between((-0.2, seat_height, hip), (0.2, seat_height + 0.3, hip + 0.13), 0.06)
        solids.append(pillow.rotated("x", -lean - 8, (0, seat_height, hip)))
    return solids


def barrel_chair(rng: np.random.Generator) -> list[Solid]:
    """A round seat with a back that wraps around it and falls towards the arms."""
    radius, height = rng.uniform(0.26, 0.38), rng.uniform(0.36, 0.47)
    rise, fall = rng.uniform(0.22, 0.5), rng.uniform(0.0, 0.8)
    reach = np.radians(rng.uniform(80, 150))
    angle = np.linspace(-reach, reach, 25)
    thickness = pick(rng, (0.025, 0.04, 0.09)) * rng.uniform(0.9, 1.2)
    drop = (1 - np.cos(angle)) / (1 - np.cos(reach))
    top = rise * (1 - fall * drop)
    open_gap = rng.uniform(0.1, 0.22) if maybe(rng, 0.4) else None
    bottom = -0.06 if open_gap is None else np.minimum(open_gap, 0.5 * top)
    t = np.linspace(0, 1, 4)[:, None]
    flare = rng.uniform(0.0, 0.12)
    y = bottom + t * (top - bottom)
    r = radius - 0.3 * thickness + flare * np.maximum(y, 0.0)
    wrap = sheet(np.stack([r * np.sin(angle), y, -r * np.cos(angle)], 2), thickness).moved(y=height)
    solids = [wrap]
    cushion = rng.uniform(0.06, 0.14)
    solids.append(
        slab(ellipse(2 * radius, 2 * radius, 28, pick(rng, (2.0, 2.0, 3.0))), cushion).moved(y=height - cushion)
    )
    if open_gap is not None:
        for a in np.linspace(-0.92 * reach, 0.92 * reach, int(rng.integers(4, 12))):
            lift = 0.6 * min(open_gap, 0.5 * float(np.interp(a, angle, top))) + 0.05
            foot = np.array([radius * np.sin(a), height - 0.5 * cushion, -radius * np.cos(a)]) * [0.93, 1, 0.93]
            head = np.array([radius * np.sin(a), height + lift, -radius * np.cos(a)]) * [0.99, 1, 0.99]
            head[1] = height + min(open_gap, 0.5 * float(np.interp(a, angle, top))) + 0.02
            solids.append(bar(foot, head, 0.022))
    if maybe(rng, 0.2):  # a solid drum down to the floor
        base = ellipse(1.9 * radius, 1.9 * radius, 28)
        return [*solids, slab(base, height - cushion + 0.02, 0.02)]
    kind = pick(rng, {"legs": 3, "disc": 1, "star": 0.7, "loops": 0.7})
    solids += supports.base(rng, kind, 0.66 * radius, 0.66 * radius, height - cushion)
    if kind in ("legs", "loops") and maybe(rng, 0.3):
        solids.append(box((1.2 * radius, 0.02, 1.2 * radius), (0, height - cushion - 0.01, 0)))
    return solids
