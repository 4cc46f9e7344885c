"""Procedural tables, in metres: a top on legs, pedestals, trestles or a frame; desks; drums."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import trimesh

from learn3d.make_data.shapes import supports
from learn3d.make_data.shapes.parts import (
    Solid,
    assemble,
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


def make_table(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random table."""
    maker = pick(rng, {_table_with_legs: 4, _pedestal_table: 2.5, _trestle_table: 1.5, _desk: 2, _drum_table: 0.8})
    return assemble(maker(rng))


def _size(rng: np.random.Generator) -> tuple[float, float, float]:
    """Length, width and height of a dining, coffee, side, bar or console table."""
    use = pick(rng, {"dining": 4, "coffee": 3, "side": 1.5, "bar": 1, "console": 1})
    length, ratio, height = {
        "dining": ((0.9, 2.4), (0.42, 0.85), (0.7, 0.78)),
        "coffee": ((0.7, 1.4), (0.45, 1.0), (0.32, 0.48)),
        "side": ((0.4, 0.6), (0.7, 1.0), (0.45, 0.7)),
        "bar": ((0.6, 1.3), (0.5, 1.0), (0.9, 1.1)),
        "console": ((0.9, 1.5), (0.25, 0.36), (0.72, 0.9)),
    }[use]
    length = rng.uniform(*length)
    return length, length * rng.uniform(*ratio), rng.uniform(*height)


def _top(rng: np.random.Generator, outline: np.ndarray, height: float) -> tuple[Solid, float]:
    """A table top whose upper side is at `height`, and the height of its lower side."""
    thickness = rng.uniform(0.02, 0.07)
    bevel = pick(rng, (0.1, 0.2, 0.45)) * thickness
    return slab(outline, thickness, bevel).moved(y=height - thickness), height - thickness


def _table_with_legs(rng: np.random.Generator) -> list[Solid]:
    """Four legs, loops of metal, panels or crossed legs under an angular, rounded or oval top."""
    length, width, height = _size(rng)
    outline, reach = {
        "rectangle": (rectangle(length, width, 0.01, 1), 0.93),
        "rounded": (rectangle(length, width, rng.uniform(0.1, 0.45) * width, 4), 0.85),
        "oval": (ellipse(length, width, 32), 0.64),
        "superellipse": (ellipse(length, width, 32, 3.5), 0.74),
    }[pick(rng, {"rectangle": 4, "rounded": 2, "oval": 1.5, "superellipse": 1})]
    top, under = _top(rng, outline, height)
    kind = pick(rng, {"legs": 4, "loops": 1, "panels": 1, "cross": 0.7})
    if kind != "legs":
        return [top, *supports.base(rng, kind, 0.45 * reach * length, 0.45 * reach * width, under)]
    size = rng.uniform(0.035, 0.11) * (0.5 + 0.35 * length)
    half_x, half_z = reach * length / 2 - 0.6 * size, reach * width / 2 - 0.6 * size
    solids = [top, *supports.four_legs(rng, half_x, half_z, under, size)]
    if maybe(rng, 0.5):
        solids += supports.apron(half_x, half_z, under, rng.uniform(0.05, 0.16), 0.4 * size)
    return solids


def _pedestal_table(rng: np.random.Generator) -> list[Solid]:
    """One pedestal in the middle, or two under a long top."""
    length, width, height = _size(rng)
    kind = pick(rng, {"circle": 4, "octagon": 1, "square": 1, "long": 2.5})
    if kind == "long":
        outline = pick(rng, (rectangle(length, width, 0.02), ellipse(length, width, 32, 3.0)))
    else:
        length = width = min(length, 1.5)
        square = rectangle(length, length, 0.02)
        outline = square if kind == "square" else ellipse(length, length, 8 if kind == "octagon" else 32)
    top, under = _top(rng, outline, height)
    reach = rng.uniform(0.5, 0.85) * width / 2
    if length < 1.35 * width:
        return [top, *_pedestal(rng, reach, under)]
    unit, x = _pedestal(rng, min(reach, 0.22 * length), under), 0.27 * length
    return [top, *(part.moved(x=s * x) for s in (-1, 1) for part in unit)]


def _pedestal(rng: np.random.Generator, reach: float, under: float) -> list[Solid]:
    """A disc, a star, an hourglass, a block on a plate, or a column on curved feet; about the y axis."""
    kind = pick(rng, {"disc": 1, "star": 1, "hourglass": 1, "block": 1, "claw": 2})
    if kind in ("disc", "star"):
        return supports.base(rng, kind, reach, reach, under)
    t = np.linspace(0, 1, 13)
    if kind == "hourglass":
        waist = rng.uniform(0.2, 0.6)
        radius = reach * (waist + (1 - waist) * (2 * t - 1) ** 2)
        return [revolve(np.stack([radius, t * (under + 0.005)], 1), pick(rng, (6, 24)))]
    if kind == "block":
        wide = rng.uniform(0.2, 0.5) * reach
        foot = slab(rectangle(1.8 * reach, 1.8 * reach), rng.uniform(0.03, 0.08))
        return [foot, between((-wide, 0.02, -wide), (wide, under + 0.005, wide))]
    thick, low = rng.uniform(0.035, 0.06) * (0.6 + reach), rng.uniform(0.12, 0.3) * under
    radius = thick * (1 + 0.4 * np.sin(rng.uniform(2, 4) * np.pi * t))
    column = revolve(np.stack([radius, 0.5 * low + t * (under + 0.005 - 0.5 * low)], 1), 14)
    plate = slab(ellipse(reach, reach, 16), 0.03).moved(y=under - 0.025)
    path = [(0, 1.2 * low, 0), (0.45 * reach, 1.1 * low, 0), (0.75 * reach, 0.1 * low, 0), (reach, 0.025, 0)]
    path = rounded_path(path, 0.2, 4)
    section = rectangle(1.1 * thick, 1.3 * thick, segments=1)
    foot = tube(path, np.linspace(1.2, 0.7, len(path)), section)
    count = pick(rng, (3, 4))
    return [column, plate, *(foot.rotated("y", 360 * (k + 0.5) / count) for k in range(count))]


def _trestle_table(rng: np.random.Generator) -> list[Solid]:
    """A trestle at each end, shaped like an A, an X or a T, joined by a beam."""
    length, width, height = _size(rng)
    top, under = _top(rng, rectangle(length, width, 0.01, 1), height)
    x, deep, size = rng.uniform(0.3, 0.45) * length, 0.4 * width, rng.uniform(0.035, 0.08)
    trestle = [between((x - 0.6 * size, under - size, -deep), (x + 0.6 * size, under + 0.004, deep))]
    kind = pick(rng, ("A", "X", "T"))
    beam = under / 2 if kind == "X" else rng.uniform(0.2, 0.7) * under
    if kind == "T":
        trestle.append(between((x - size / 2, 0.02, -size), (x + size / 2, under - 0.2 * size, size)))
        trestle.append(between((x - 0.7 * size, 0, -deep), (x + 0.7 * size, 0.06, deep)))
    else:
        upper = -0.9 * deep if kind == "X" else 0.25 * deep
        for side in (-1, 1):
            foot, head = (x, 0.012, side * deep), (x, under - 0.2 * size, side * upper)
            trestle.append(bar(foot, head, size * (1 + 0.1 * side), size, side=(1, 0, 0)))
    if kind == "A":
        half = deep + beam / under * (upper - deep)
        trestle.append(bar((x, beam, -half), (x, beam, half), 0.8 * size, size))
    solids = [solid for part in trestle for solid in both_sides(part)]
    return [top, *solids, bar((-x, beam, 0), (x, beam, 0), 0.8 * size, 1.3 * size)]


def _desk(rng: np.random.Generator) -> list[Solid]:
    """A writing desk: drawers on one or both sides, a board at the rear, perhaps a shelf on top."""
    half_x, half_z, height = rng.uniform(0.5, 0.95), rng.uniform(0.25, 0.42), rng.uniform(0.7, 0.78)
    top, under = _top(rng, rectangle(2 * half_x, 2 * half_z, 0.01, 1), height)
    unit, low = rng.uniform(0.3, 0.42), rng.uniform(0.0, 0.6) * height
    drawers = _drawers(rng, half_x - 0.02 - unit, half_x - 0.02, low, under + 0.004, half_z - 0.03)
    if low > 0.03:
        legs = [(half_x - 0.05, z) for z in (-half_z + 0.07, half_z - 0.08)]
        drawers += [bar((x, 0, z), (x, low + 0.01, z), 0.04, 0.04) for x, z in legs]
    panel = between((half_x - 0.05, 0, -half_z + 0.02), (half_x - 0.02, under + 0.004, half_z - 0.03))
    other = pick(rng, (drawers, [panel]))
    side = pick(rng, (-1.0, 1.0))
    solids = [top, *drawers, *(part.mirrored() for part in other)]
    rear = rng.uniform(0.1, 0.6) * height
    solids.append(between((-half_x + 0.03, rear, -half_z + 0.03), (half_x - 0.03, under + 0.004, -half_z + 0.05)))
    if maybe(rng, 0.4):
        tall, deep = height + rng.uniform(0.15, 0.5), rng.uniform(0.16, 0.26) - half_z
        solids.append(between((-half_x, tall - 0.025, -half_z), (half_x, tall, deep)))
        for x in np.linspace(-half_x + 0.0125, half_x - 0.0125, int(rng.integers(2, 6))):
            solids.append(between((x - 0.0125, height - 0.01, -half_z), (x + 0.0125, tall - 0.01, deep)))
    return [solid.scaled(x=side) for solid in solids]


def _drawers(rng: np.random.Generator, x0: float, x1: float, low: float, high: float, half_z: float) -> list[Solid]:
    """A block from x0 to x1 with one to four drawers, each with a handle."""
    solids = [between((x0, low, -half_z), (x1, high, half_z))]
    edges = np.linspace(low + 0.01, high - 0.01, int(rng.integers(2, 6)) if high - low > 0.4 else 2)
    middle = (x0 + x1) / 2
    for bottom, top in pairwise(edges):
        solids.append(between((x0 + 0.015, bottom + 0.008, half_z - 0.01), (x1 - 0.015, top - 0.008, half_z + 0.015)))
        y, z = 0.4 * bottom + 0.6 * top, half_z + 0.022
        solids.append(bar((middle - 0.05, y, z), (middle + 0.05, y, z), 0.02))
    return solids


def _drum_table(rng: np.random.Generator) -> list[Solid]:
    """A low round table: a solid drum, or a cage of rods between two plates."""
    width, height = rng.uniform(0.5, 1.0), rng.uniform(0.3, 0.5)
    plate = ellipse(width, width, 32)
    top = slab(plate, 0.04).moved(y=height - 0.04)
    if maybe(rng, 0.5):
        waist = rng.uniform(0.3, 0.55) * width
        return [top, revolve([(0.45 * width, 0), (waist, height / 2), (0.45 * width, height - 0.02)], 32)]
    solids = [top, slab(inset(plate, 0.04), 0.02)]
    rod = bar((width / 2 - 0.07, 0.005, 0), (width / 2 - 0.07, height - 0.02, 0), 0.016)
    for angle in np.arange(0, 360, 360 / rng.integers(10, 22)):
        solids.append(rod.rotated("y", angle))
    return solids
