"""Procedural sofas, in metres: upholstered blocks, corner sofas, framed settees."""

from itertools import pairwise

import numpy as np

from .draw import Draw, ellipse, points, recipe, shares
from .parts import Part, X, bar, between, board, crossbar, join, sheet, slab
from .supports import feet, legs, loops, panels


def _cushions(
    lower: tuple[float, float, float], upper: tuple[float, float, float], count: int
) -> Part:
    """Cushions side by side along x that fill the box between two corners."""
    edges = pairwise(np.linspace(lower[0], upper[0], count + 1))
    return join(
        between((left + 0.008, *lower[1:]), (right - 0.008, *upper[1:]), 0.05)
        for left, right in edges
    )


@recipe(
    seats={2: 3, 3: 4, 4: 1},
    half=(0.27, 0.36),
    depth=(0.75, 1.0),
    foot=(0.05, 0.16),
    seat=(0.36, 0.46),
)
def upholstered(draw: Draw, *, seats, half, depth, foot, seat) -> Part:
    """An armchair (one seat) or a sofa: a block, cushions, a leaning back, perhaps arms."""
    half *= seats
    high = draw(0.66, 0.95 if seats > 1 else 1.1)
    back = draw(0.14, 0.24)
    lean = draw(0, 12)
    soft = draw(0.02, 0.06)
    low = seat - draw(0.1, 0.17)
    front = depth / 2
    rear = -depth / 2
    part = board(half, (foot, low + 0.005), (rear, front - 0.03), 0.02)
    part += _cushions(
        (-half, low, rear + 0.7 * back), (half, seat, front), draw.pick([1, seats, seats])
    )
    upright = board(half, (low - 0.1, high), (rear, rear + back), soft)
    if draw.maybe(0.5):
        top = high + draw(-0.08, 0.08)
        upright += _cushions(
            (-half, seat - 0.05, rear + 0.4 * back), (half, top, rear + 1.6 * back), seats
        )
    if seats == 1 and high > 0.8 and draw.maybe(0.35):  # wings
        t = shares(6)[:, None]
        reach = draw(0.18, 0.3) * np.sin(np.pi * (0.12 + 0.8 * t)) ** 0.7
        z = rear + back - 0.06 + shares(4)[None] * (reach + 0.06)
        y = seat + 0.1 + t * (high - seat - 0.1)
        upright += sheet(points(half - 0.03, y, z), draw(0.04, 0.08)).both_sides()
    part += upright.rotated("x", -lean, (0, low, rear + back))
    part += feet(draw, half - 0.08, front - 0.09, foot + 0.015)
    kind = draw.pick({"box": 3, "rolled": 2, "low": 1, "none": 0.7})
    if kind == "none":
        return part
    wide = draw(0.1, 0.24)
    level = seat + 0.06 if kind == "low" else min(draw(0.52, 0.68), high - 0.03)
    arm = between((half - 0.01, foot, rear), (half + wide, level, front - 0.01), soft)
    if kind == "rolled":
        x = half + 0.5 * wide
        arm += bar((x, level - 0.05, rear + 0.02), (x, level - 0.05, front), 1.3 * wide, 1.3 * wide)
    return part + arm.both_sides()


@recipe(
    half=(1.05, 1.5),
    depth=(0.8, 0.98),
    reach=(1.4, 2.3),
    foot=(0.04, 0.12),
    seat=(0.38, 0.44),
    high=(0.7, 0.9),
    back=(0.16, 0.24),
    arm=(0.1, 0.2),
    wing=(0.75, 0.95),
    level=(0.52, 0.66),
    count=[2, 3],
    chaise=0.5,
    side=[1.0, -1.0],
)
def corner_sofa(
    draw: Draw, *, half, depth, reach, foot, seat, high, back, arm, wing, level, count, chaise, side
) -> Part:
    """An L-shaped sofa: a long side along x, a chaise or second side towards +z."""
    low = seat - 0.14
    inner = half - wing
    sofa = board(half, (foot, low + 0.005), (0, depth), 0.02)
    sofa += between((inner, foot, 0.3), (half, low + 0.005, reach), 0.02)
    sofa += board(half, (low - 0.08, high), (0, back), 0.04)
    sofa += between((inner + 0.01, low, back - 0.05), (half - 0.005, seat, reach), 0.04)
    sofa += between((-half - arm, foot, 0), (-half + 0.01, level, depth), 0.04)
    sofa += _cushions((-half, low, back - 0.05), (inner, seat, depth), count)
    sofa += _cushions((-half, seat - 0.02, back - 0.06), (inner, high + 0.03, back + 0.14), count)
    if chaise:  # open towards its end
        sofa += between((half - 0.01, foot, 0), (half + arm, level, depth), 0.04)
    else:  # a second side, with the back around the corner
        sofa += between((half - back, low - 0.08, 0), (half, high, reach), 0.04)
        sofa += between((inner, foot, reach - 0.01), (half, level, reach + arm), 0.04)
    leg = slab(ellipse(0.08, 0.08, 10), foot + 0.02)
    for x, z in ((-half, 0), (-half, depth), (half, 0), (half, reach), (inner, reach)):
        sofa += leg.moved(x=x + (0.08 if x < half else -0.08), z=z + (0.08 if z == 0 else -0.08))
    return sofa.scaled(x=side)


@recipe(
    seats={2: 3, 3: 2},
    half=(0.26, 0.34),
    depth=(0.62, 0.82),
    size=(0.03, 0.06),
    seat=(0.38, 0.46),
    high=(0.72, 0.95),
    rest=(0.56, 0.66),
    sink=(0.08, 0.15),
    support={legs: 3, loops: 2, panels: 1},
)
def settee(draw: Draw, *, seats, half, depth, size, seat, high, rest, sink, support) -> Part:
    """Cushions on an open frame of wood or metal."""
    half *= seats
    low = seat - sink
    front = depth / 2
    rear = -depth / 2
    sofa = support(draw, half - 0.02, 0.85 * front, low)
    sofa += board(half, (low - 0.05, low + 0.01), (rear + 0.03, front - 0.03), 0.01)
    sofa += _cushions((-half, low, rear + 0.04), (half, seat, front), seats)
    lean = draw(5, 16)
    z = rear + 0.04
    frame = bar((half - 0.03, low - 0.04, z), (half - 0.03, high, z), size, size).both_sides()
    frame += crossbar((-half, high - 0.02, z), size, 1.3 * size)
    if draw.maybe(0.55):
        frame += _cushions((-half, seat - 0.04, z), (half, high + 0.03, rear + 0.17), seats)
    else:
        for x in np.linspace(-half + 0.03, half - 0.03, draw.count(7, 13))[1:-1]:
            frame += bar((x, low - 0.02, z), (x, high, z), 0.4 * size, 0.8 * size)
    sofa += frame.rotated("x", -lean, (0, low, rear + 0.06))
    if draw.maybe(0.75):
        x = half - 0.02
        start = z - np.tan(np.radians(lean)) * (rest - low)
        arm = bar((x, rest, start), (x, rest, front - 0.03), 1.6 * size, 0.8 * size, side=X)
        sofa += (
            arm + bar((x, low - 0.03, front - 0.08), (x, rest, front - 0.08), size, size)
        ).both_sides()
    return sofa


KINDS = {upholstered: 4.0, corner_sofa: 1.5, settee: 2.8}
