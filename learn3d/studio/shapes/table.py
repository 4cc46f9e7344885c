"""Procedural tables, in metres: a top on legs, pedestals, trestles or a frame; desks; drums."""

from itertools import pairwise

import numpy as np

from .draw import Draw, ellipse, inset, recipe, rectangle, rounded_path, shares
from .parts import Part, X, bar, between, board, crossbar, join, revolve, slab, strip
from .supports import apron, cross, disc, legs, loops, panels, star

# Length, width over length and height of each kind of table, and the weight of the kind.
_SIZES = {
    ((0.9, 2.4), (0.42, 0.85), (0.7, 0.78)): 4,  # dining
    ((0.7, 1.4), (0.45, 1.0), (0.32, 0.48)): 3,  # coffee
    ((0.4, 0.6), (0.7, 1.0), (0.45, 0.7)): 1.5,  # side
    ((0.6, 1.3), (0.5, 1.0), (0.9, 1.1)): 1,  # bar
    ((0.9, 1.5), (0.25, 0.36), (0.72, 0.9)): 1,  # console
}


def _size(draw: Draw) -> tuple[float, float, float]:
    """Length, width and height of a table."""
    length, ratio, height = map(draw.of, draw.pick(_SIZES))
    return length, length * ratio, height


@recipe(thickness=(0.02, 0.07), bevel=[0.1, 0.2, 0.45])
def _top(draw: Draw, outline: np.ndarray, height: float, *, thickness, bevel) -> tuple[Part, float]:
    """A table top whose upper side is at `height`, and the height of its lower side."""
    under = height - thickness
    return slab(outline, thickness, bevel * thickness, under), under


def table_with_legs(draw: Draw) -> Part:
    """Four legs, loops of metal, panels or crossed legs under an angular, rounded or oval top."""
    length, width, height = _size(draw)
    corner = draw(0.1, 0.45) * width
    kind = draw.pick({"angular": 4, "rounded": 2, "oval": 1.5, "superellipse": 1})
    outline, reach = {
        "angular": (rectangle(length, width, 0.01, 1), 0.93),
        "rounded": (rectangle(length, width, corner, 4), 0.85),
        "oval": (ellipse(length, width, 32), 0.64),
        "superellipse": (ellipse(length, width, 32, 3.5), 0.74),
    }[kind]
    top, under = _top(draw, outline, height)
    support = draw.pick({legs: 4, loops: 1, panels: 1, cross: 0.7})
    if support is not legs:
        return top + support(draw, 0.45 * reach * length, 0.45 * reach * width, under)
    size = draw(0.035, 0.11) * (0.5 + 0.35 * length)
    half_x = reach * length / 2 - 0.6 * size
    half_z = reach * width / 2 - 0.6 * size
    table = top + legs(draw, half_x, half_z, under, size=size)
    if draw.maybe(0.5):
        table += apron(half_x, half_z, under, draw(0.05, 0.16), 0.4 * size)
    if draw.maybe(0.2):  # a shelf between the legs
        y = draw(0.15, 0.45) * under
        table += between((-half_x, y, -half_z), (half_x, y + 0.4 * size, half_z))
    return table


def pedestal_table(draw: Draw) -> Part:
    """One pedestal in the middle, or two under a long top."""
    length, width, height = _size(draw)
    kind = draw.pick({"circle": 4, "octagon": 1, "square": 1, "long": 2.5})
    if kind == "long":
        kind = draw.pick(["square", "superellipse"])
    else:
        length = width = min(length, 1.5)
    outline = {
        "circle": ellipse(length, width, 32),
        "octagon": ellipse(length, width, 8),
        "square": rectangle(length, width, 0.02),
        "superellipse": ellipse(length, width, 32, 3.0),
    }[kind]
    top, under = _top(draw, outline, height)
    reach = draw(0.5, 0.85) * width / 2
    if length < 1.35 * width:
        return top + _pedestal(draw, reach, under)
    unit = _pedestal(draw, min(reach, 0.22 * length), under)
    return top + unit.moved(x=-0.27 * length) + unit.moved(x=0.27 * length)


def _pedestal(draw: Draw, reach: float, under: float) -> Part:
    """A disc, a star, an hourglass, a block on a plate, or a column on feet; about the y axis."""
    kind = draw.pick({disc: 1, star: 1, "hourglass": 1, "block": 1, "claw": 2})
    if kind in (disc, star):
        return kind(draw, reach, reach, under)
    t = shares(13)
    top = under + 0.005
    if kind == "hourglass":
        waist = draw(0.2, 0.6)
        radius = reach * (waist + (1 - waist) * (2 * t - 1) ** 2)
        return revolve(np.c_[radius, t * top], draw.pick([6, 24]))
    if kind == "block":
        wide = draw(0.2, 0.5) * reach
        foot = slab(rectangle(1.8 * reach, 1.8 * reach), draw(0.03, 0.08))
        return foot + board(wide, (0.02, top), (-wide, wide))
    thick = draw(0.035, 0.06) * (0.6 + reach)
    low = draw(0.12, 0.3) * under
    radius = thick * (1 + 0.4 * np.sin(draw(2, 4) * np.pi * t))
    column = revolve(np.c_[radius, 0.5 * low + t * (top - 0.5 * low)], 14)
    plate = slab(ellipse(reach, reach, 16), 0.03, y=under - 0.025)
    path = [
        (0, 1.2 * low, 0),
        (0.45 * reach, 1.1 * low, 0),
        (0.75 * reach, 0.1 * low, 0),
        (reach, 0.025, 0),
    ]
    path = rounded_path(path, 0.2, 4)
    foot = strip(path, 1.1 * thick, 1.3 * thick, np.linspace(1.2, 0.7, len(path)))
    count = draw.pick([3, 4])
    return column + plate + foot.around(360 * (np.arange(count) + 0.5) / count)


def trestle_table(draw: Draw) -> Part:
    """A trestle at each end, shaped like an A, an X or a T, joined by a beam."""
    length, width, height = _size(draw)
    top, under = _top(draw, rectangle(length, width, 0.01, 1), height)
    x = draw(0.3, 0.45) * length
    size = draw(0.035, 0.08)
    kind = draw.pick(["A", "X", "T"])
    beam = under / 2 if kind == "X" else draw(0.2, 0.7) * under
    deep = 0.4 * width
    trestle = between((x - 0.6 * size, under - size, -deep), (x + 0.6 * size, under + 0.004, deep))
    if kind == "T":
        trestle += between((x - size / 2, 0.02, -size), (x + size / 2, under - 0.2 * size, size))
        trestle += between((x - 0.7 * size, 0, -deep), (x + 0.7 * size, 0.06, deep))
    else:
        upper = -0.9 * deep if kind == "X" else 0.25 * deep
        for side in (-1, 1):
            head = (x, under - 0.2 * size, side * upper)
            trestle += bar((x, 0.012, side * deep), head, size * (1 + 0.1 * side), size, side=X)
    if kind == "A":
        half = deep + beam / under * (upper - deep)
        trestle += bar((x, beam, -half), (x, beam, half), 0.8 * size, size)
    return top + trestle.both_sides() + crossbar((-x, beam, 0), 0.8 * size, 1.3 * size)


@recipe(half_x=(0.5, 0.95), half_z=(0.25, 0.42), height=(0.7, 0.78))
def desk(draw: Draw, *, half_x, half_z, height) -> Part:
    """A writing desk: drawers on one or both sides, a board at the rear, perhaps a shelf on top."""
    top, under = _top(draw, rectangle(2 * half_x, 2 * half_z, 0.01, 1), height)
    left = half_x - 0.02 - draw(0.3, 0.42)
    low = draw(0.0, 0.6) * height
    right = half_x - 0.02
    high = under + 0.004
    front = half_z - 0.03
    drawers = between((left, low, -front), (right, high, front))
    count = draw.count(2, 5) if high - low > 0.4 else 2
    for lower, upper in pairwise(np.linspace(low + 0.01, high - 0.01, count)):
        drawers += between(
            (left + 0.015, lower + 0.008, front - 0.01),
            (right - 0.015, upper - 0.008, front + 0.015),
        )
        handle = ((left + right) / 2, 0.4 * lower + 0.6 * upper, front + 0.022)
        drawers += bar(handle - 0.05 * X, handle + 0.05 * X, 0.02)
    if low > 0.03:
        x = half_x - 0.05
        drawers += join(
            bar((x, 0, z), (x, low + 0.01, z), 0.04, 0.04) for z in (-half_z + 0.07, half_z - 0.08)
        )
    panel = between((half_x - 0.05, 0, -half_z + 0.02), (right, high, front))
    other = draw.pick([drawers, panel])
    side = draw.pick([-1.0, 1.0])
    rear = draw(0.1, 0.6) * height
    back = between((-half_x + 0.03, rear, -half_z + 0.03), (half_x - 0.03, high, -half_z + 0.05))
    part = top + drawers + other.scaled(x=-1.0) + back
    if draw.maybe(0.4):
        tall = height + draw(0.15, 0.5)
        deep = draw(0.16, 0.26) - half_z
        part += board(half_x, (tall - 0.025, tall), (-half_z, deep))
        for x in np.linspace(-half_x + 0.0125, half_x - 0.0125, draw.count(2, 5)):
            part += between((x - 0.0125, height - 0.01, -half_z), (x + 0.0125, tall - 0.01, deep))
    return part.scaled(x=side)


@recipe(width=(0.5, 1.0), height=(0.3, 0.5), solid=0.5)
def drum_table(draw: Draw, *, width, height, solid) -> Part:
    """A low round table: a solid drum, or a cage of rods between two plates."""
    plate = ellipse(width, width, 32)
    top = slab(plate, 0.04, y=height - 0.04)
    if solid:
        waist = (draw(0.3, 0.55) * width, height / 2)
        return top + revolve([(0.45 * width, 0), waist, (0.45 * width, height - 0.02)], 32)
    rod = bar((width / 2 - 0.07, 0.005, 0), (width / 2 - 0.07, height - 0.02, 0), 0.016)
    return (
        top
        + slab(inset(plate, 0.04), 0.02)
        + rod.around(np.arange(0, 360, 360 / draw.count(10, 21)))
    )


KINDS = {table_with_legs: 4, pedestal_table: 2.5, trestle_table: 1.5, desk: 2, drum_table: 0.8}
