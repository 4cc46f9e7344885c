"""Procedural sofas, in metres: upholstered blocks, corner sofas, framed settees, curved sofas."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import trimesh

from learn3d.make_data.shapes import supports
from learn3d.make_data.shapes.parts import Solid, assemble, bar, between, both_sides, ellipse, sheet, slab
from learn3d.make_data.shapes.sampling import maybe, pick


def make_sofa(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random sofa."""
    maker = pick(rng, {_block_sofa: 4.0, _corner_sofa: 1.5, _settee: 1.6, _curved_sofa: 1.2})
    return assemble(maker(rng))


def _cushions(lower: tuple[float, float, float], upper: tuple[float, float, float], count: int) -> list[Solid]:
    """Cushions side by side along x that fill the box between two corners."""
    edges = np.linspace(lower[0], upper[0], count + 1)
    return [between((left + 0.008, *lower[1:]), (right - 0.008, *upper[1:]), 0.05) for left, right in pairwise(edges)]


def _block_sofa(rng: np.random.Generator) -> list[Solid]:
    """Two to four seats between upholstered arms, the back in one piece or with a cushion for each seat."""
    seats = pick(rng, {2: 3, 3: 4, 4: 1})
    half, depth = seats * rng.uniform(0.27, 0.36), rng.uniform(0.75, 1.0)
    foot, seat, high = rng.uniform(0.05, 0.16), rng.uniform(0.36, 0.46), rng.uniform(0.66, 0.95)
    back, lean, soft = rng.uniform(0.14, 0.24), rng.uniform(0, 12), rng.uniform(0.02, 0.06)
    front, rear, low = depth / 2, -depth / 2, seat - rng.uniform(0.1, 0.17)
    solids = [between((-half, foot, rear), (half, low + 0.005, front - 0.03), 0.02)]
    solids += _cushions((-half, low, rear + 0.7 * back), (half, seat, front), pick(rng, (1, seats, seats)))
    upright = [between((-half, low - 0.1, rear), (half, high, rear + back), soft)]
    if maybe(rng, 0.5):
        top = high + rng.uniform(-0.08, 0.08)
        upright += _cushions((-half, seat - 0.05, rear + 0.4 * back), (half, top, rear + 1.6 * back), seats)
    solids += [part.rotated("x", -lean, (0, low, rear + back)) for part in upright]
    solids += supports.feet(rng, half - 0.08, front - 0.09, foot + 0.015)
    kind = pick(rng, {"box": 3, "rolled": 2, "low": 1, "none": 0.7})
    if kind == "none":
        return solids
    wide = rng.uniform(0.1, 0.24)
    level = seat + 0.06 if kind == "low" else min(rng.uniform(0.52, 0.68), high - 0.03)
    solids += both_sides(between((half - 0.01, foot, rear), (half + wide, level, front - 0.01), soft))
    if kind == "rolled":
        x, y = half + 0.5 * wide, level - 0.05
        solids += both_sides(bar((x, y, rear + 0.02), (x, y, front), 1.3 * wide, 1.3 * wide))
    return solids


def _corner_sofa(rng: np.random.Generator) -> list[Solid]:
    """An L-shaped sofa: a long side along x, and a chaise or a second side towards +z, left or right."""
    half, depth, reach = rng.uniform(1.05, 1.5), rng.uniform(0.8, 0.98), rng.uniform(1.4, 2.3)
    foot, seat, high = rng.uniform(0.04, 0.12), rng.uniform(0.38, 0.44), rng.uniform(0.7, 0.9)
    back, arm, wing = rng.uniform(0.16, 0.24), rng.uniform(0.1, 0.2), rng.uniform(0.75, 0.95)
    low, level, inner = seat - 0.14, rng.uniform(0.52, 0.66), half - wing
    solids = [
        between((-half, foot, 0), (half, low + 0.005, depth), 0.02),
        between((inner, foot, 0.3), (half, low + 0.005, reach), 0.02),
        between((-half, low - 0.08, 0), (half, high, back), 0.04),
        between((inner + 0.01, low, back - 0.05), (half - 0.005, seat, reach), 0.04),
        between((-half - arm, foot, 0), (-half + 0.01, level, depth), 0.04),
    ]
    count = pick(rng, (2, 3))
    solids += _cushions((-half, low, back - 0.05), (inner, seat, depth), count)
    solids += _cushions((-half, seat - 0.02, back - 0.06), (inner, high + 0.03, back + 0.14), count)
    if maybe(rng, 0.5):  # a chaise, open towards its end
        solids.append(between((half - 0.01, foot, 0), (half + arm, level, depth), 0.04))
    else:  # a second side, with the back around the corner
        solids.append(between((half - back, low - 0.08, 0), (half, high, reach), 0.04))
        solids.append(between((inner, foot, reach - 0.01), (half, level, reach + arm), 0.04))
    leg = slab(ellipse(0.08, 0.08, 10), foot + 0.02)
    corners = ((-half, 0), (-half, depth), (half, 0), (half, reach), (inner, reach))
    for x, z in corners:
        solids.append(leg.moved(x=x + (0.08 if x < half else -0.08), z=z + (0.08 if z == 0 else -0.08)))
    side = pick(rng, (1.0, -1.0))
    return [solid.scaled(x=side) for solid in solids]


def _settee(rng: np.random.Generator) -> list[Solid]:
    """Cushions on an open frame of wood or metal."""
    seats = pick(rng, {2: 3, 3: 2})
    half, depth, size = seats * rng.uniform(0.26, 0.34), rng.uniform(0.62, 0.82), rng.uniform(0.03, 0.06)
    seat, high, rest = rng.uniform(0.38, 0.46), rng.uniform(0.72, 0.95), rng.uniform(0.56, 0.66)
    low, front, rear = seat - rng.uniform(0.08, 0.15), depth / 2, -depth / 2
    kind = pick(rng, {"legs": 3, "loops": 2, "panels": 1})
    solids = supports.base(rng, kind, half - 0.02, 0.85 * front, low)
    solids.append(between((-half, low - 0.05, rear + 0.03), (half, low + 0.01, front - 0.03), 0.01))
    solids += _cushions((-half, low, rear + 0.04), (half, seat, front), seats)
    lean, hinge, z = rng.uniform(5, 16), (0, low, rear + 0.06), rear + 0.04
    frame = both_sides(bar((half - 0.03, low - 0.04, z), (half - 0.03, high, z), size, size))
    frame.append(bar((-half, high - 0.02, z), (half, high - 0.02, z), size, 1.3 * size))
    if maybe(rng, 0.55):
        frame += _cushions((-half, seat - 0.04, z), (half, high + 0.03, rear + 0.17), seats)
    else:
        for x in np.linspace(-half + 0.03, half - 0.03, int(rng.integers(7, 14)))[1:-1]:
            frame.append(bar((x, low - 0.02, z), (x, high, z), 0.4 * size, 0.8 * size))
    solids += [part.rotated("x", -lean, hinge) for part in frame]
    if maybe(rng, 0.75):
        x, start = half - 0.02, z - np.tan(np.radians(lean)) * (rest - low)
        solids += both_sides(bar((x, rest, start), (x, rest, front - 0.03), 1.6 * size, 0.8 * size, side=(1, 0, 0)))
        solids += both_sides(bar((x, low - 0.03, front - 0.08), (x, rest, front - 0.08), size, size))
    return solids


def _curved_sofa(rng: np.random.Generator) -> list[Solid]:
    """A sofa on an arc, or a tub sofa, whose back runs around into the arms."""
    half, depth, seat = rng.uniform(0.7, 1.25), rng.uniform(0.75, 0.95), rng.uniform(0.36, 0.44)
    foot, high, thick = rng.uniform(0.04, 0.14), rng.uniform(0.66, 0.85), rng.uniform(0.1, 0.2)
    turn = np.radians(rng.uniform(75, 92))
    angle = np.linspace(-turn, turn, 31)
    forward = (1 - np.cos(angle)) / (1 - np.cos(turn))  # 0 in the middle of the back, 1 at the ends of the arms
    sine = np.sin(angle) / np.sin(turn)
    x = (half - thick / 2) * np.sign(sine) * np.abs(sine) ** rng.uniform(0.5, 0.8)  # flatter than a circle's arc
    z = -depth / 2 + thick / 2 + (depth - thick) * forward
    y = foot + np.linspace(0, 1, 4)[:, None] * (high - rng.uniform(0, 0.25) * forward - foot)
    wrap = sheet(np.stack([np.broadcast_to(x, y.shape), y, np.broadcast_to(z, y.shape)], 2), thick)
    edge = np.linspace(x[0], x[-1], 9)[1:-1]
    front = np.stack([edge, z[0] + rng.uniform(-0.1, 0.1) * (1 - (edge / x[0]) ** 2)], 1)
    outline = np.concatenate([front, np.stack([x, z], 1)[::-1]])[::-1]
    cushion = slab(outline, seat - foot, 0.04).moved(y=foot)
    return [wrap, cushion, *supports.feet(rng, 0.6 * half, 0.22 * depth, foot + 0.02)]
