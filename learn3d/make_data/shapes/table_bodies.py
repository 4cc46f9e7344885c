"""Tables that are not a top on a base, in metres: desks with drawers, waterfall tables, drums, boxes, tiers."""

from __future__ import annotations

import numpy as np

from learn3d.make_data.shapes import supports
from learn3d.make_data.shapes.parts import (
    Solid,
    bar,
    between,
    both_sides,
    ellipse,
    inset,
    rectangle,
    revolve,
    rounded_path,
    slab,
    tube,
)
from learn3d.make_data.shapes.sampling import maybe, pick


def desk(rng: np.random.Generator) -> list[Solid]:
    """A writing desk: drawer units or panels or legs, modesty panel, perhaps a hutch or a shelf on top."""
    length, width, height = rng.uniform(1.0, 1.9), rng.uniform(0.5, 0.85), rng.uniform(0.7, 0.78)
    half_x, half_z, t = length / 2, width / 2, rng.uniform(0.02, 0.045)
    solids = [slab(rectangle(length, width, 0.01, 1), t).moved(y=height - t)]
    unit = rng.uniform(0.3, 0.42)
    plinth = rng.uniform(0.0, 0.14)
    sides = pick(rng, {"both": 1.5, "left": 1.5, "right": 1.5, "hung": 0.7})
    top = height - t + 0.004
    for s, name in ((-1, "left"), (1, "right")):
        x0, x1 = s * (half_x - 0.02), s * (half_x - 0.02 - unit)
        if sides in ("both", name) or (sides == "hung" and s == 1):
            low = plinth if sides != "hung" else 0.45 * height
            solids += _drawers(rng, min(x0, x1), max(x0, x1), low, top, half_z - 0.03)
            if low > 0.03:
                for z in (-half_z + 0.07, half_z - 0.08):
                    for x in (x0 - s * 0.03, x1 + s * 0.03):
                        if sides != "hung" or x == x0 - s * 0.03:
                            solids.append(bar((x, 0, z), (x, low + 0.01, z), 0.04, 0.04))
        elif maybe(rng, 0.5):
            solids.append(between((x0, 0, -half_z + 0.02), (x0 - s * 0.03, top, half_z - 0.03)))
        else:
            for z in (-half_z + 0.05, half_z - 0.05):
                solids.append(between((x0 - s * 0.045, 0, z - 0.0225), (x0, top, z + 0.0225)))
    if maybe(rng, 0.6):
        low = rng.uniform(0.1, 0.6) * height
        solids.append(between((-half_x + 0.03, low, -half_z + 0.03), (half_x - 0.03, top, -half_z + 0.05)))
    extra = pick(rng, {"none": 3, "hutch": 1, "shelf": 1, "screen": 0.6})
    if extra == "screen":
        tall = height + rng.uniform(0.2, 0.5)
        solids.append(between((-half_x, height - 0.1, -half_z - 0.015), (half_x, tall, -half_z + 0.01)))
    elif extra != "none":
        tall, deep = height + rng.uniform(0.15, 0.5), rng.uniform(0.16, 0.26)
        near = -half_z + deep
        solids.append(between((-half_x, tall - 0.025, -half_z), (half_x, tall, near)))
        count = 2 if extra == "shelf" else int(rng.integers(3, 6))
        for x in np.linspace(-half_x + 0.0125, half_x - 0.0125, count):
            solids.append(between((x - 0.0125, height - 0.01, -half_z), (x + 0.0125, tall - 0.01, near)))
        if extra == "hutch":
            solids.append(between((-half_x, height - 0.01, -half_z - 0.005), (half_x, tall, -half_z + 0.015)))
    return solids


def _drawers(rng: np.random.Generator, x0: float, x1: float, low: float, high: float, half_z: float) -> list[Solid]:
    """A unit of drawers with raised fronts and handles."""
    solids = [between((x0, low, -half_z), (x1, high, half_z))]
    count = int(rng.integers(1, 5)) if high - low > 0.4 else 1
    tall = (high - low - 0.02) / count
    for k in range(count):
        y = low + 0.01 + k * tall
        solids.append(between((x0 + 0.015, y + 0.008, half_z - 0.01), (x1 - 0.015, y + tall - 0.008, half_z + 0.015)))
        middle, centre = y + 0.6 * tall, (x0 + x1) / 2
        solids.append(bar((centre - 0.05, middle, half_z + 0.022), (centre + 0.05, middle, half_z + 0.022), 0.02))
    return solids


def bent_table(rng: np.random.Generator) -> list[Solid]:
    """A waterfall table: one bent board, perhaps with a shelf."""
    length, width, height = rng.uniform(0.7, 1.5), rng.uniform(0.4, 0.7), rng.uniform(0.35, 0.75)
    t, lean = rng.uniform(0.02, 0.06), rng.uniform(-0.1, 0.12)
    half = length / 2
    y = height - t / 2
    corners = [(half + lean, 0, 0), (half, y, 0), (-half, y, 0), (-half - lean, 0, 0)]
    closed = maybe(rng, 0.3)
    path = rounded_path(corners, rng.uniform(0.04, 0.2), 5, closed=closed)
    if closed:
        path = path + [0, t / 2, 0]
    solids = [tube(path, 1.0, rectangle(width, t, 0.2 * t, 1), closed=closed, side=(0, 0, 1))]
    if maybe(rng, 0.5) and not closed:
        level = rng.uniform(0.25, 0.65) * height
        reach = half + lean * (1 - level / height)
        solids.append(between((-reach, level, -0.45 * width), (reach, level + 0.02, 0.45 * width)))
    brace = between((-0.4 * half, height - t - 0.02, -0.3 * width), (0.4 * half, height - 0.7 * t, 0.3 * width))
    return [*solids, brace.moved(y=t / 2 if closed else 0.0)]


def drum_table(rng: np.random.Generator) -> list[Solid]:
    """A low solid table: drum, cube, or a box open at the front, perhaps with two tiers of tops."""
    width, height = rng.uniform(0.5, 1.0), rng.uniform(0.3, 0.5)
    kind = pick(rng, ("drum", "cage", "open", "tiers"))
    round_top = ellipse(width, width, 32)
    if kind == "drum":
        waist = rng.uniform(0.7, 1.15)
        r = width / 2
        body = revolve(
            [(0.9 * r, 0), (r * (waist + 1) / 2, 0.1 * height), (waist * r, height / 2), (0.92 * r, height - 0.03)], 32
        )
        return [body, slab(round_top, 0.04).moved(y=height - 0.04)]
    if kind == "cage":  # rods between two rings
        solids = [slab(round_top, 0.03).moved(y=height - 0.03), slab(inset(round_top, 0.04), 0.02)]
        count = int(rng.integers(8, 22))
        twist = rng.uniform(0, 0.9)
        for a in np.arange(count) * 2 * np.pi / count:
            r = width / 2 - 0.07
            foot = (r * np.cos(a), 0.005, r * np.sin(a))
            solids.append(bar(foot, (r * np.cos(a + twist), height - 0.02, r * np.sin(a + twist)), 0.016))
        return solids
    if kind == "open":
        length, t = width * rng.uniform(1.1, 1.8), rng.uniform(0.025, 0.05)
        half_x, half_z = length / 2, width / 2
        solids = [between((-half_x, y, -half_z), (half_x, y + t, half_z)) for y in (0.06, height - t)]
        solids += both_sides(between((half_x - t, 0.06, -half_z), (half_x, height - 0.005, half_z)))
        for x in np.linspace(-half_x, half_x, int(rng.integers(2, 5)))[1:-1]:
            solids.append(between((x - t / 2, 0.07, -half_z + 0.01), (x + t / 2, height - 0.01, half_z - 0.01)))
        if maybe(rng, 0.6):
            solids.append(between((-half_x, 0.065, -half_z), (half_x, height - 0.005, -half_z + t)))
        return solids + supports.feet(rng, half_x - 0.06, half_z - 0.06, 0.08)
    length = width * rng.uniform(1.0, 1.6)
    solids = []
    half_x, half_z = length / 2, width / 2
    for y in np.linspace(0.08, height - 0.02, int(rng.integers(2, 4))):
        solids.append(slab(rectangle(length, width, 0.05, 3), 0.02).moved(y=y))
    for z in (half_z - 0.04, -half_z + 0.04):
        solids += both_sides(bar((half_x - 0.04, 0, z), (half_x - 0.04, height + 0.03, z), 0.035))
    return solids
