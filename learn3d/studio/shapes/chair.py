"""Procedural chairs, in metres: jointed chairs, moulded shells, stools."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from .draw import (
    Draw,
    Perhaps,
    Point,
    ellipse,
    points,
    recipe,
    rectangle,
    rounded_path,
    shares,
    spread,
)
from .parts import Part, X, bar, between, board, join, post, sheet, slab, strip, tube
from .sofa import upholstered
from .supports import cantilever, cross, disc, legs, loops, panels, rocker, star


class Family(NamedTuple):
    """Chairs for one use: what they do not share with `_MEASURES`."""

    name: str
    measures: dict[str, Any]
    supports: dict[Any, float]
    padded: float  # probability of a padded back
    arms: float  # probability of arms


# Measures of all chairs. A back of dining chairs is sometimes that of a throne.
_MEASURES = {
    "width": (0.40, 0.54),
    "depth": (0.40, 0.50),
    "height": (0.42, 0.5),
    "recline": (2, 14),
    "back_height": (0.32, 0.62),
    "cushioned": 0.3,
}
_LOUNGE = {
    "width": (0.52, 0.7),
    "depth": (0.52, 0.66),
    "height": (0.28, 0.40),
    "recline": (15, 30),
    "back_height": (0.4, 0.75),
    "cushioned": 0.6,
}
_OFFICE = {"width": (0.46, 0.56), "depth": (0.44, 0.52), "back_height": (0.4, 0.75)}
_BAR = {
    "width": (0.36, 0.44),
    "depth": (0.34, 0.42),
    "height": (0.62, 0.78),
    "back_height": (0.14, 0.4),
}
_STOOLS = {legs: 3, disc: 1.5, loops: 1, panels: 0.3}
_DINING_SUPPORTS = {
    legs: 6,
    loops: 1,
    cantilever: 1,
    cross: 0.8,
    panels: 0.6,
    disc: 0.7,
    star: 0.4,
    rocker: 0.5,
}
_LOUNGE_SUPPORTS = {
    legs: 2.5,
    loops: 2,
    cantilever: 1,
    rocker: 1,
    star: 0.6,
    panels: 0.7,
    cross: 0.7,
}
DINING = Family("dining", {"throne": Perhaps(0.15, (0.65, 0.85))}, _DINING_SUPPORTS, 0.12, 0.3)
LOUNGE = Family("lounge", _LOUNGE, _LOUNGE_SUPPORTS, 0.5, 0.6)
OFFICE = Family("office", _OFFICE, {}, 0.8, 0.6)
BAR = Family("bar", _BAR, _STOOLS, 0.12, 0.1)

# Weights of the backs of chairs without padding.
_BACKS = {
    "ladder": 2,
    "slats": 2,
    "spindles": 1,
    "splat": 1.2,
    "cross": 0.8,
    "open": 1.0,
    "lattice": 0.7,
    "band": 1.0,
    "panel": 1.2,
    "hoop": 1.2,
    "solid": 2.0,
}


def jointed_chair(draw: Draw, family: Family) -> Part:
    """A dining, office, lounge or bar chair: a seat, a support, a back and perhaps arms."""
    return _join_chair(
        draw, family, **draw.measures(**_MEASURES) | draw.measures(**family.measures)
    )


def _join_chair(
    draw: Draw,
    family: Family,
    width: float,
    depth: float,
    height: float,
    recline: float,
    back_height: float,
    cushioned: bool,
    throne: float = 0.0,
) -> Part:
    back_height = throne or back_height
    cushioned = cushioned or family is OFFICE
    # outline of the seat: 2 = ellipse ... 8 = rectangle
    exponent = draw.pick({8.0: 4, 5.0: 2, 3.0: 1.5, 2.0: 1})
    thickness = draw(0.07, 0.13) if cushioned else draw(0.025, 0.05)
    taper = draw.of(Perhaps(0.4, (0.8, 1.0), 1.0))  # narrower at the rear
    outline = ellipse(width, depth, 24, exponent)
    outline[:, 0] *= 1 + (taper - 1) * (0.5 - outline[:, 1] / depth)
    under = height - thickness
    part = slab(outline, thickness, (0.35 if cushioned else 0.2) * thickness, under)

    support = star if family is OFFICE else draw.pick(family.supports)
    inside = 0.5 * 0.35 ** (1 / exponent)  # share of the half width where the legs stand
    half_x = inside * width * (0.5 + 0.5 * taper) - 0.03
    part += support(draw, half_x, inside * depth - 0.03, under)
    if family is BAR and not draw.maybe(0.8):  # a stool
        return part

    angular = exponent > 4
    stile_x = 0.5 * width * taper - 0.03 if angular else 0.36 * width
    # -z of the seat at x = stile_x
    rear_edge = depth / 2 * (1 - (2 * stile_x / width) ** exponent) ** (1 / exponent)
    curve = max(0.0 if angular else depth / 2 - rear_edge, draw.of(Perhaps(0.6, (0.0, 0.08))))
    back, bulge = _back(draw, family, stile_x, back_height, curve)
    part += back.rotated("x", -recline).moved(y=height - 0.5 * thickness, z=-depth / 2 + 0.03)
    if draw.maybe(family.arms) and back_height > 0.3:
        rise = draw(0.17, 0.26)
        rear = -depth / 2 + 0.03 + (curve + bulge) - np.tan(np.radians(recline)) * rise
        edge = 0.5 * width - 0.02 if angular else max(stile_x, half_x)
        part += _arm(
            draw,
            back=(stile_x, height + rise, rear),
            rise=rise,
            edge=edge,
            base=height - 0.6 * thickness,
            depth=depth,
        ).both_sides()
    return part


@recipe(
    front=(0.15, 0.45),
    kind={"post": 3, "panel": 0.8, "loop": 1.5, "swoop": 1.5, "cantilever": 0.7},
    size=(0.025, 0.05),
    width=(1.0, 2.0),
)
def _arm(
    draw: Draw,
    back: Point,
    rise: float,
    edge: float,
    base: float,
    depth: float,
    *,
    front,
    kind,
    size,
    width,
) -> Part:
    """The arm at x > 0, from the point `back` to the front, `rise` above the seat."""
    x, y, rear = back
    front *= depth
    foot_z = min(front, depth * 0.3)
    start = (x, y, rear - 0.01)
    if kind == "panel":
        return between((edge - 0.02, base - 0.02, rear), (edge + 0.03, y, front + 0.02), 0.012)
    if kind == "loop":
        path = [
            start,
            (edge + 0.02, y, front),
            (edge + 0.02, base, foot_z),
            (edge - 0.06, base, foot_z),
        ]
        return tube(rounded_path(path, 0.09), 0.011 + 0.2 * size)
    if kind == "swoop":
        path = [
            start,
            (edge, y + 0.02, 0.2 * front),
            (edge, y - 0.4 * rise, front),
            (edge - 0.01, base, foot_z),
        ]
        return strip(rounded_path(path, 0.12, 5), size * width, 0.7 * size, side=X)
    path = rounded_path([start, (edge, y, 0.0), (edge, y, front)], 0.1)
    arm = strip(path, size * width, 0.7 * size, side=X)
    if kind == "cantilever":
        return arm + bar((edge - 0.01, base, rear / 2), (edge, y, rear / 2), 0.03, 0.05)
    outline = (
        ellipse(0.8 * size, 0.8 * size, 8) if draw.maybe(0.5) else rectangle(0.8 * size, 0.8 * size)
    )
    profile = [(0, 1), (0.5, draw(0.8, 1.5)), (1, 0.9)]
    return arm + post((edge - 0.012, base, foot_z), (edge, y, foot_z), outline, profile)


def _back(
    draw: Draw, family: Family, half: float, height: float, curve: float
) -> tuple[Part, float]:
    """A back at z = 0, from y = 0 to `height`, between stiles at x = +-half; z of its front."""
    top = height + 0.02
    if not draw.maybe(family.padded):
        kind = draw.pick(_BACKS)
        if kind == "solid":
            return _plate(draw, half, top=top, curve=curve, thickness=draw(0.02, 0.045)), 0.0
        return _hoop(draw, half, top, curve) if kind == "hoop" else _frame(
            draw, half, height, curve, kind
        ), 0.0
    thickness = draw(0.05, 0.11)
    if family is OFFICE and not draw.maybe(0.3):  # mostly held above the seat by a spine
        gap = draw(0.12, 0.35) * top
        back = _plate(
            draw, draw(0.8, 1.1) * half, top=top - gap, curve=max(curve, 0.03), thickness=thickness
        ).moved(y=gap)
        path = [(0, -0.06, 0.12), (0, -0.06, -0.07), (0, gap + 0.3 * (top - gap), -0.4 * thickness)]
        back += strip(rounded_path(path, 0.06), 0.06, 0.02, side=X)
    elif draw.maybe(0.5):
        back = _plate(draw, 1.05 * half, top=top, curve=curve, thickness=thickness)
    else:
        back = board(half + 0.03, (-0.02, top), (-thickness / 2, thickness / 2), 0.03)
    return back, thickness / 2


@recipe(stile=(0.022, 0.045), thick=(0.015, 0.028), rounded=0.4, taper=(0.7, 1))
def _frame(
    draw: Draw, half: float, height: float, curve: float, kind: str, *, stile, thick, rounded, taper
) -> Part:
    """Two stiles and a rail on top, open or filled with boards, slats, a splat, a cross ..."""
    top = height + 0.02
    high = height > 0.3
    outline = ellipse(stile, stile, 8) if rounded else rectangle(stile, stile, segments=1)
    part = post(
        (half, -0.02, curve), (half, top, curve), outline, [(0, 1), (1, taper)]
    ).both_sides()
    rail = draw(0.04, 0.12) if high else draw(0.03, 0.06)
    arch = draw.of(Perhaps(0.4, (0.01, 0.07)))
    part += _rail(half, y=top - 0.45 * rail, height=rail, thickness=thick, curve=curve, arch=arch)
    if kind == "open":
        return part
    low = draw(0.06, 0.3) * height
    if kind == "ladder":
        count = draw.count(1, 4) if high else 1
        pitch = (top - rail - low) / (count + 0.5)
        each = min(draw(0.25, 0.6) * pitch, 0.08)
        return part + join(
            _rail(
                half,
                y=low + (k + 0.5) * pitch,
                height=each,
                thickness=thick,
                curve=curve,
                arch=0.6 * arch,
            )
            for k in range(count)
        )
    if kind in ("panel", "band"):
        x = np.linspace(-half, half, 9)
        y = np.array([[low if kind == "panel" else 0.55 * height], [top - 0.5 * rail]])
        return part + sheet(points(x, y, _bow(x, half, curve)), thick)
    bottom = -0.01
    upper = top - 0.6 * rail
    if draw.maybe(0.5) or kind == "lattice":
        bottom = low
        part += _rail(half, y=low, height=draw(0.025, 0.05), thickness=thick, curve=curve)
    if kind == "splat":
        return part + _splat(draw, low=bottom, high=upper + arch * 0.8, half=half, thick=thick)
    if kind == "cross":
        x = np.linspace(-half, half, 7)
        path = points(x, np.linspace(bottom + 0.01, upper, 7), _bow(x, half, curve))
        return part + join(strip(path * [side, 1, 1], thick, draw(0.02, 0.04)) for side in (-1, 1))
    count = draw.measures(slats=range(2, 8), spindles=range(4, 9), lattice=range(2, 5))[kind]
    wide = draw(0.25, 0.6) * 2 * half / (count + 1)
    size = (0.018, None) if kind == "spindles" else (0.8 * thick, min(wide, 0.07))
    for x in spread(half, count):
        z = _bow(x, half, curve)
        part += bar((x, bottom, z), (x, upper + arch * (1 - (x / half) ** 2), z), *size)
    if kind == "lattice":
        for y in np.linspace(bottom, upper, draw.count(1, 3) + 2)[1:-1]:
            part += _rail(half, y=y, height=draw(0.015, 0.03), thickness=0.7 * thick, curve=curve)
    return part


@recipe(wide=(0.25, 0.5), swell=(0.1, 0.5), waves=(0.6, 1.4), phase=(0, 1))
def _splat(
    draw: Draw, low: float, high: float, half: float, thick: float, *, wide, swell, waves, phase
) -> Part:
    """A vase-shaped board in the middle of a back."""
    wide *= half
    t = shares(9)[:, None]
    width = wide * (1 + swell * np.sin(2 * np.pi * (waves * t + phase)))
    x = np.linspace(-1, 1, 5) * np.minimum(width, 1.8 * wide)
    return sheet(points(x, low + t * (high - low), 0.0), thick)


def _bow(x: np.ndarray, half: float, curve: float) -> np.ndarray:
    """z of a back that is bent forward: `curve` at the stiles (|x| = half), 0 in the middle."""
    return curve * (np.abs(x) / half) ** 2


def _rail(
    half: float, y: float, height: float, thickness: float, curve: float, arch: float = 0.0
) -> Part:
    """A horizontal board between the stiles, bent as the back, its middle lifted by `arch`."""
    x = np.linspace(-half, half, 9)
    return strip(
        points(x, y + arch * (1 - (x / half) ** 2), _bow(x, half, curve)), thickness, height
    )


@recipe(flare=(-0.25, 0.2), power=[2.0, 3.0, 6.0, 12.0], wave=(-0.02, 0.03))
def _plate(
    draw: Draw, half: float, top: float, curve: float, thickness: float, *, flare, power, wave
) -> Part:
    """A one-piece back: straight or flared, its upper corners rounded, with a lumbar bulge."""
    t = np.concatenate([np.linspace(0, 0.7, 4), 1 - 0.3 * np.linspace(0.75, 0, 5) ** 1.8])[:, None]
    v = np.linspace(-1, 1, 11)[None]
    rounding = (1 - np.clip((t - 0.4) / 0.605, 0, 1) ** power) ** (1 / power)
    x = v * half * (1 + flare * t) * np.maximum(rounding, 0.12)
    z = _bow(x, half, curve) + wave * np.sin(np.pi * t)
    return sheet(points(x, -0.01 + t * (top + 0.01), z), thickness)


@recipe(straight=(0.2, 0.6), thick=(0.018, 0.035), spindles=Perhaps(0.85, range(3, 9), 0))
def _hoop(draw: Draw, half: float, top: float, curve: float, *, straight, thick, spindles) -> Part:
    """A bent hoop, empty or filled with spindles (Windsor)."""
    angle = np.linspace(0, np.pi, 17)
    straight *= top
    x = np.r_[half, half * np.cos(angle), -half]
    y = np.r_[-0.02, straight + (top - straight) * np.sin(angle) ** 0.9, -0.02]
    part = tube(points(x, y, _bow(x, half, curve)), thick / 2)
    for x in spread(half, spindles):
        end = straight + (top - straight) * (1 - (x / half) ** 2) ** 0.45
        part += bar(
            (0.75 * x, -0.01, _bow(0.75 * x, half, curve)), (x, end, _bow(x, half, curve)), 0.016
        )
    return part


@recipe(
    width=(0.42, 0.62),
    depth=(0.40, 0.52),
    height=(0.36, 0.47),
    back=(0.25, 0.5),
    lean=(0.05, 0.2),
    curl=(0.0, 0.07),
    wings=(0.0, 0.22),
    bend=(0.1, 0.2),
    waist=(-0.1, 0.35),
    top=(0.1, 0.6),
    thickness=(0.018, 0.035),
    support={legs: 2, star: 1, disc: 1, loops: 1, rocker: 0.5},
)
def shell_chair(
    draw: Draw,
    *,
    width,
    depth,
    height,
    back,
    lean,
    curl,
    wings,
    bend,
    waist,
    top,
    thickness,
    support,
) -> Part:
    """A moulded bucket: one curved sheet for seat and back, on any support."""
    front = depth / 2
    rear = -depth / 2
    path = [
        (0, -0.03, front),
        (0, 0, front - 0.08),
        (0, -0.02, rear + 0.05),
        (0, back, rear - lean),
    ]
    path = rounded_path(path, bend, 5)
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    t = shares(18)[:, None]  # from the front edge to the top of the back
    across = np.linspace(-1, 1, 15)
    y, z = (np.interp(t * length[-1], length, path[:, k]) for k in (1, 2))
    ease = np.clip((t - 0.3) / 0.4, 0, 1)
    ease = ease**2 * (3 - 2 * ease)
    span = 0.5 * width * (1 - waist * ease) * (1 - np.clip((t - 0.75) / 0.25, 0, 1) ** 3 * top)
    span = span * (1 - 0.25 * np.clip(1 - t / 0.15, 0, 1) ** 2)
    # The rims of the seat are lifted and those of the back pulled forward; at the hip `wings`
    # turns them into arms.
    hip = np.exp(-(((t - 0.5) / 0.25) ** 2))
    lift = (curl * np.abs(across) ** 2.5 + wings * hip * np.abs(across) ** 3) * (1 - 0.7 * ease)
    pull = (curl + wings * hip) * np.abs(across) ** 2.5 * ease
    part = sheet(points(span * across, y + lift, z + pull), thickness).moved(y=height)
    part += slab(ellipse(0.8 * width, 0.8 * depth, 20, 5), 0.03, y=height - 0.045)
    if support is legs:
        return part + legs(draw, 0.34 * width, 0.34 * depth, height - 0.035, plain=True)
    return part + support(draw, 0.37 * width, 0.38 * depth, height - 0.035)


@recipe(
    width=(0.3, 0.45),
    height=(0.35, 0.78),
    thickness=(0.02, 0.12),
    ratio=Perhaps(0.4, (0.7, 1.0), 1.0),
    exponent=[2.0, 2.0, 4.0, 8.0],
    support=_STOOLS,
)
def stool(draw: Draw, *, width, height, thickness, ratio, exponent, support) -> Part:
    """A seat without a back, round or square, low or high."""
    depth = width * ratio
    seat = slab(ellipse(width, depth, 24, exponent), thickness, y=height - thickness)
    return seat + support(draw, 0.38 * width, 0.38 * depth, height - thickness + 0.005)


KINDS = {
    partial(jointed_chair, family=DINING): 5,
    partial(jointed_chair, family=OFFICE): 1.5,
    shell_chair: 2,
    partial(upholstered, seats=1): 1.5,
    partial(jointed_chair, family=LOUNGE): 1.5,
    partial(jointed_chair, family=BAR): 2,
    stool: 1.9,
}
