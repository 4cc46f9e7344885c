"""Supports of seats and table tops, in metres: legs, pedestals, loops, panels, rockers.

A support reaches from the floor (y = 0) to `height`, and to about x = +-half_x and z = +-half_z.
"""

import numpy as np

from .draw import Draw, Perhaps, ellipse, points, recipe, rectangle, rounded_path, shares
from .parts import (
    Part,
    X,
    Y,
    bar,
    between,
    board,
    crossbar,
    ellipsoid,
    join,
    post,
    revolve,
    slab,
    strip,
    tube,
)

TAPERED = [(0, 0.6), (1, 1)]  # the profile of a tapered leg


@recipe(size=(0.028, 0.055), splay=Perhaps(0.55, (0.02, 0.16)), hairpin=0.1)
def legs(
    draw: Draw,
    half_x: float,
    half_z: float,
    height: float,
    plain: bool = False,
    *,
    size,
    splay,
    hairpin,
) -> Part:
    """Four legs, straight or splayed, perhaps with stretchers and an apron; or hairpin legs.

    size: width of a leg. splay: how far the feet stand out, as a share of the height. plain:
    tapered legs, no apron.
    """
    splay *= height
    if hairpin:
        return _hairpin_legs(half_x, half_z, height, splay)
    profile, turned = (TAPERED, True) if plain else _leg_profile(draw)
    outline = (
        ellipse(size, size, 10) if turned or draw.maybe(0.3) else rectangle(size, size, segments=1)
    )
    splay_rear = splay * draw.pick([0.3, 1.0, 1.6])
    head = np.array([[half_x, height, half_z], [half_x, height, -half_z]])  # front, rear
    foot = head * [1, 0, 1] + [[splay, 0, splay], [splay, 0, -splay_rear]]
    part = join(
        post(f, h + [0, 0.01, 0], outline, profile).both_sides()
        for f, h in zip(foot, head, strict=True)
    )

    stretchers = draw.pick({"none": 3, "H": 1, "box": 1, "sides": 0.7, "X": 0.4})
    level = draw(0.15, 0.5)
    thick = 0.55 * size
    front, rear = foot + level * (head - foot)
    if stretchers == "X":
        part += bar(front, rear * [-1, 1, 1], thick, thick, side=Y).both_sides()
    elif stretchers != "none":
        part += bar(front, rear, thick).both_sides()
    if stretchers == "H":
        part += crossbar(0.5 * (front + rear), thick)
    if stretchers == "box":
        level = level if draw.maybe(0.5) else min(level + 0.12, 0.6)
        part += join(crossbar(end, thick) for end in foot + level * (head - foot))
    if draw.maybe(0.45) and splay < 0.1 * height and not plain:
        part += apron(half_x, half_z, height, draw(0.04, 0.09), 0.5 * size)
    return part


def _hairpin_legs(half_x: float, half_z: float, height: float, splay: float) -> Part:
    foot = (half_x + 0.5 * splay, 0.006, half_z + 0.5 * splay)
    heads = (half_x - 0.1, height + 0.01, half_z), (half_x, height + 0.01, half_z - 0.1)
    plate = board(half_x + 0.01, (height - 0.012, height + 0.005), (-half_z, half_z))
    return join(bar(foot, head, 0.013) for head in heads).four_corners() + plate


def _leg_profile(draw: Draw) -> tuple[list[tuple[float, float]], bool]:
    """The profile [(height, scale)] of a leg, 0 = floor, 1 = top; True if the leg is round."""
    kind = draw.pick({"straight": 2, "tapered": 3, "turned": 1.5, "baluster": 1, "stepped": 0.7})
    if kind == "straight":
        return [(0, 1), (1, 1)], False
    if kind == "tapered":
        return [(0, draw(0.45, 0.8)), (draw(0.6, 0.95), 1), (1, 1)], False
    if kind == "stepped":
        waist = draw(0.5, 0.75)
        return [(0, 1), (0.1, 1), (0.13, waist), (0.68, waist), (0.72, 1), (1, 1)], False
    if kind == "baluster":
        swell = (draw(0.25, 0.5), 1.25)
        return [
            (0, 0.55),
            (0.06, 0.75),
            (0.1, 0.5),
            swell,
            (0.75, 0.7),
            (0.82, 1.1),
            (0.88, 0.8),
            (1, 1),
        ], True
    a = draw(0.2, 0.35)
    b = draw(0.55, 0.75)
    lower = [(0, 0.5), (a - 0.08, 0.7), (a, 1.05), (a + 0.08, 0.65)]
    return [*lower, (b, 1.2), (b + 0.08, 0.7), (0.92, 1.1), (1, 1)], True


def apron(half_x: float, half_z: float, top: float, depth: float, thickness: float) -> Part:
    """Four boards under a top, between the legs."""
    t = thickness / 2
    low = top - depth
    high = top + 0.005
    part = between((half_x - t, low, -half_z), (half_x + t, high, half_z)).both_sides()
    return part + join(board(half_x, (low, high), (z - t, z + t)) for z in (half_z, -half_z))


@recipe(size=(0.045, 0.08), kind=["block", "cone", "bun"])
def feet(draw: Draw, half_x: float, half_z: float, height: float, *, size, kind) -> Part:
    """Four short feet under a block: tapered blocks, cones or bun feet."""
    if kind == "bun":
        return ellipsoid(
            (1.4 * size, height, 1.4 * size), (half_x, height / 2, half_z)
        ).four_corners()
    outline = rectangle(size, size, segments=1) if kind == "block" else ellipse(size, size, 10)
    lean = draw.maybe(0.4) * 0.03
    foot = (half_x + lean, 0, half_z + lean)
    return post(foot, (half_x, height, half_z), outline, TAPERED).four_corners()


@recipe(
    reach=(1.05, 1.3),
    arms={5: 3, 4: 2, 3: 0.6, 6: 0.5},
    castors=0.6,
    hub=(0.02, 0.12),
    thick=(0.018, 0.032),
)
def star(
    draw: Draw, half_x: float, half_z: float, height: float, *, reach, arms, castors, hub, thick
) -> Part:
    """A column on a star of 3 to 6 arms, perhaps on castors, with a plate under the seat."""
    reach *= max(half_x, half_z)
    castors = castors and height < 0.6
    low = 0.055 if castors else 0.01
    hub = hub * height + low + 0.03
    column = [(1.4 * thick, low), (1.6 * thick, hub + 0.02), (thick, hub + 0.05)]
    if draw.maybe(0.6):  # a gas spring with a cover
        middle = hub + draw(0.4, 0.7) * (height - hub)
        column += [(1.1 * thick, middle), (0.65 * thick, middle + 0.01)]
    part = revolve([*column, (0.7 * thick, height + 0.01)], 10)
    turn = 90.0 if arms % 2 else draw.count(0, 1) * 180 / arms
    width = draw(0.8, 1.4) * 2 * thick
    path = [(0.3 * thick, hub, 0), (0.4 * reach, 0.7 * hub + 0.3 * low, 0), (reach, low + 0.012, 0)]
    path = rounded_path(path, 0.1, 3)
    arm = strip(path, width, 0.8 * width, np.linspace(1.0, 0.6, len(path)))
    if castors:
        wheel = revolve([(0.02, -0.02), (0.03, -0.012), (0.03, 0.012), (0.02, 0.02)], 10).rotated(
            "z", 90
        )
        arm += wheel.rotated("y", 35).moved(reach - 0.01, 0.03)
    part += arm.around(-turn - 360 / arms * np.arange(arms))
    return part + slab(rectangle(1.2 * half_x, 1.2 * half_z), 0.03, y=height - 0.025)


@recipe(reach=(0.8, 1.15), thick=(0.02, 0.045), kind=["disc", "tulip", "dome", "cone"])
def disc(draw: Draw, half_x: float, half_z: float, height: float, *, reach, thick, kind) -> Part:
    """A column on a flat, domed or trumpet-shaped (tulip) foot."""
    reach *= min(half_x, half_z)
    thick *= 1 + height
    if kind == "disc":
        profile = [
            (reach, 0),
            (reach, 0.02),
            (reach - 0.015, 0.03),
            (thick, 0.035),
            (thick, height + 0.01),
        ]
    elif kind == "cone":
        profile = [(reach, 0), (reach, 0.012), (draw(0.6, 1) * thick, height + 0.01)]
    else:
        t = shares(9)
        flare = 0.45 * draw(0.5, 1.2) * reach * np.exp(-(1 - t) * 5) * (kind == "tulip")
        radius = thick + (reach - thick) * np.exp(-(9.0 if kind == "dome" else 3.5) * t) + flare
        profile = [(reach, 0.0), *zip(radius, 0.012 + t * (height - 0.002), strict=True)]
    part = revolve(profile, 20)
    if kind in ("disc", "dome"):
        part += slab(ellipse(1.2 * half_x, 1.2 * half_z, 16), 0.025, y=height - 0.02)
    if height > 0.55 and draw.maybe(0.6):
        ring = 0.75 * reach
        y = 0.35 * height
        angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
        part += tube(points(ring * np.cos(angle), y, ring * np.sin(angle)), 0.012, closed=True)
        part += crossbar((-ring, y, 0), 0.02)
    return part


@recipe(
    lean=(-0.05, 0.25),
    flat=0.45,
    size=(0.018, 0.032),
    flare=Perhaps(0.4, (0.0, 0.2)),
    rear_lean=(-0.3, 0.5),
)
def loops(
    draw: Draw, half_x: float, half_z: float, height: float, *, lean, flat, size, flare, rear_lean
) -> Part:
    """A closed frame of tube or flat bar on each side (a sled), joined by cross bars."""
    lean *= height
    foot_x = half_x * (1.0 + flare)
    low = size / 2
    high = height - 0.3 * size
    rear = half_z + rear_lean * lean
    path = [
        (foot_x, low, half_z + lean / 2),
        (half_x, high, half_z),
        (half_x, high, -half_z),
        (foot_x, low, -rear),
    ]
    section = rectangle(1.5 * size, size, segments=1) if flat else ellipse(size, size, 8)
    path = rounded_path(path, 0.012 if flat else draw(0.02, 0.09), 3, closed=True)
    part = tube(path, 1.0, section, closed=True, side=X).both_sides()
    part += join(crossbar((-half_x, high, z), size) for z in (0.75 * half_z, -0.75 * half_z))
    if draw.maybe(0.3):
        part += crossbar((-foot_x, low, -rear + 0.03), size)
    return part


@recipe(size=(0.022, 0.034), reach=(0.9, 1.15), forward=(-0.05, 0.08), bend=(0.05, 0.1))
def cantilever(
    draw: Draw, half_x: float, half_z: float, height: float, *, size, reach, forward, bend
) -> Part:
    """One bent tube: under the seat to the front, down to the floor, to the rear and across.

    It has no rear legs.
    """
    low = size / 2
    high = height - 0.3 * size
    foot = [(half_x, low, half_z + forward), (half_x, low, -(half_z * reach))]
    side = np.array([(half_x, high, -half_z), (half_x, high, half_z), *foot])
    path = rounded_path([*side, *side[::-1] * [-1, 1, 1]], bend)
    bars = join(crossbar((-half_x, high, z), size) for z in (-0.8 * half_z, 0.6 * half_z))
    return tube(path, size / 2, side=X) + bars


@recipe(size=(0.022, 0.035), deep=(1.2, 1.8), at_sides=0.6)
def cross(draw: Draw, half_x: float, half_z: float, height: float, *, size, deep, at_sides) -> Part:
    """Legs that cross like scissors, at the sides or at front and rear, joined by bars."""
    x, z = (half_x, half_z) if at_sides else (half_z, half_x)
    part = Part()
    for s in (-1, 1):
        outer = x - (0.5 + 0.5 * s) * size
        part += bar(
            (outer, 0.012, s * z * 1.1), (outer, height, -s * z), size, deep * size, side=X
        ).both_sides()
        part += crossbar((-outer, 0.12 * height, s * z * 0.84), 0.9 * size)
        part += crossbar((-outer, height - 0.015, -s * z), 0.9 * size)
    part += crossbar((-x, height / 2, 0), 0.9 * size)
    return part if at_sides else part.rotated("y", 90)


@recipe(thick=(0.018, 0.05), upright=0.6)
def panels(draw: Draw, half_x: float, half_z: float, height: float, *, thick, upright) -> Part:
    """A board on each side, and an upright board or a shelf between them."""
    part = between((half_x - thick, 0, -half_z), (half_x, height + 0.005, half_z)).both_sides()
    if upright:
        low = draw(0.0, 0.7) * height
        z = draw(-1, 0) * (half_z - 0.02)
        return part + board(half_x, (low, height), (z - thick / 2, z + thick / 2))
    y = draw(0.25, 0.6) * height
    return part + board(half_x, (y, y + 0.8 * thick), (-0.8 * half_z, 0.8 * half_z))


@recipe(size=(0.025, 0.04), radius=(0.8, 1.4), reach=(1.35, 1.9))
def rocker(draw: Draw, half_x: float, half_z: float, height: float, *, size, radius, reach) -> Part:
    """Four legs on a pair of curved runners."""
    reach *= half_z
    z = np.linspace(reach * 0.95, -reach * 1.15, 13)
    y = radius - np.sqrt(radius**2 - z**2) + size / 2
    x = half_x + 0.02
    part = strip(points(x, y, z), size, 1.2 * size, side=X).both_sides()
    for end in (-half_z, half_z):
        foot_z = end * 1.08
        foot = (x, np.interp(foot_z, z[::-1], y[::-1]), foot_z)
        part += post(
            foot, (half_x, height + 0.01, end), ellipse(size, size, 8), [(0, 0.8), (1, 1)]
        ).both_sides()
        part += crossbar((-half_x - 0.01, 0.4 * height, foot_z + 0.4 * (end - foot_z)), 0.6 * size)
    return part
