"""Supports of seats and table tops, in metres: legs, pedestals, loops of tube, crossed bars, panels, rockers.

A support reaches from the floor (y = 0) to `height`, and to about x = +-half_x and z = +-half_z.
"""

import numpy as np

from .draw import Draw, ellipse, points, rectangle, rounded_path
from .parts import Part, bar, between, crossbar, ellipsoid, join, post, revolve, slab, tube


def legs(draw: Draw, half_x: float, half_z: float, height: float, size: float = 0.0, plain: bool = False) -> Part:
    """Four legs, straight or splayed, perhaps with stretchers and an apron; or bent-wire (hairpin) legs.

    size 0 is a random one. plain: tapered legs without an apron.
    """
    size = size or draw(0.028, 0.055)
    splay = draw(0.02, 0.16) * height if draw.maybe(0.55) else 0.0
    if draw.maybe(0.1):
        foot, level = (half_x + 0.5 * splay, 0.006, half_z + 0.5 * splay), height + 0.01
        leg = bar(foot, (half_x - 0.1, level, half_z), 0.013) + bar(foot, (half_x, level, half_z - 0.1), 0.013)
        plate = between((-half_x - 0.01, height - 0.012, -half_z), (half_x + 0.01, height + 0.005, half_z))
        return leg.four_corners() + plate
    profile, turned = ([(0, 0.6), (1, 1)], True) if plain else _leg_profile(draw)
    outline = ellipse(size, size, 10) if turned or draw.maybe(0.3) else rectangle(size, size, segments=1)
    splay_rear = splay * draw.pick((0.3, 1.0, 1.6))
    foot = np.array([[half_x + splay, 0, half_z + splay], [half_x + splay, 0, -half_z - splay_rear]])  # front, rear
    head = np.array([[half_x, height, half_z], [half_x, height, -half_z]])
    part = join(post(f, h + [0, 0.01, 0], outline, profile).both_sides() for f, h in zip(foot, head, strict=True))

    kind = draw.pick({"none": 3, "H": 1, "box": 1, "sides": 0.7, "X": 0.4})  # of the stretchers
    t, thick = draw(0.15, 0.5), 0.55 * size
    front, rear = foot + t * (head - foot)
    if kind == "X":
        part += bar(front, rear * [-1, 1, 1], thick, thick, side=(0, 1, 0)).both_sides()
    elif kind != "none":
        part += bar(front, rear, thick).both_sides()
    if kind == "H":
        part += crossbar(0.5 * (front + rear), thick)
    if kind == "box":
        t = t if draw.maybe(0.5) else min(t + 0.12, 0.6)
        part += join(crossbar(end, thick) for end in foot + t * (head - foot))
    if draw.maybe(0.45) and splay < 0.1 * height and not plain:
        part += apron(half_x, half_z, height, draw(0.04, 0.09), 0.5 * size)
    return part


def _leg_profile(draw: Draw) -> tuple[list[tuple[float, float]], bool]:
    """The profile [(height, scale)] of a leg, 0 = floor, 1 = top, and whether the leg is turned (round)."""
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
        return [(0, 0.55), (0.06, 0.75), (0.1, 0.5), swell, (0.75, 0.7), (0.82, 1.1), (0.88, 0.8), (1, 1)], True
    a, b = draw(0.2, 0.35), draw(0.55, 0.75)
    lower, upper = [(0, 0.5), (a - 0.08, 0.7), (a, 1.05), (a + 0.08, 0.65)], [(b, 1.2), (b + 0.08, 0.7)]
    return [*lower, *upper, (0.92, 1.1), (1, 1)], True


def apron(half_x: float, half_z: float, top: float, depth: float, thickness: float) -> Part:
    """Four boards under a top, between the legs."""
    t, low, high = thickness / 2, top - depth, top + 0.005
    part = between((half_x - t, low, -half_z), (half_x + t, high, half_z)).both_sides()
    return part + join(between((-half_x, low, z - t), (half_x, high, z + t)) for z in (half_z, -half_z))


def feet(draw: Draw, half_x: float, half_z: float, height: float) -> Part:
    """Four short feet under a block: tapered blocks, cones or bun feet."""
    size, kind = draw(0.045, 0.08), draw.pick(("block", "cone", "bun"))
    if kind == "bun":
        return ellipsoid((1.4 * size, height, 1.4 * size), (half_x, height / 2, half_z)).four_corners()
    outline = rectangle(size, size, segments=1) if kind == "block" else ellipse(size, size, 10)
    lean = 0.03 if draw.maybe(0.4) else 0.0
    foot = (half_x + lean, 0, half_z + lean)
    return post(foot, (half_x, height, half_z), outline, [(0, 0.6), (1, 1)]).four_corners()


def star(draw: Draw, half_x: float, half_z: float, height: float) -> Part:
    """A column on a star of 3 to 6 arms, perhaps on castors, with a plate under the seat."""
    reach = draw(1.05, 1.3) * max(half_x, half_z)
    count = draw.pick({5: 3, 4: 2, 3: 0.6, 6: 0.5})
    castors = draw.maybe(0.6) and height < 0.6
    low = 0.055 if castors else 0.01
    hub, thick = draw(0.02, 0.12) * height + low + 0.03, draw(0.018, 0.032)
    column = [(1.4 * thick, low), (1.6 * thick, hub + 0.02), (thick, hub + 0.05)]
    if draw.maybe(0.6):  # a gas spring with a cover
        middle = hub + draw(0.4, 0.7) * (height - hub)
        column += [(1.1 * thick, middle), (0.65 * thick, middle + 0.01)]
    part = revolve([*column, (0.7 * thick, height + 0.01)], 10)
    turn = 90.0 if count % 2 else draw.count(0, 1) * 180 / count
    width = draw(0.8, 1.4) * 2 * thick
    path = [(0.3 * thick, hub, 0), (0.4 * reach, 0.7 * hub + 0.3 * low, 0), (reach, low + 0.012, 0)]
    path = rounded_path(path, 0.1, 3)
    arm = tube(path, np.linspace(1.0, 0.6, len(path)), rectangle(width, 0.8 * width, segments=1))
    if castors:
        wheel = revolve([(0.02, -0.02), (0.03, -0.012), (0.03, 0.012), (0.02, 0.02)], 10).rotated("z", 90)
        arm += wheel.rotated("y", 35).moved(reach - 0.01, 0.03)
    part += arm.around(-turn - 360 / count * np.arange(count))
    return part + slab(rectangle(1.2 * half_x, 1.2 * half_z), 0.03).moved(y=height - 0.025)


def disc(draw: Draw, half_x: float, half_z: float, height: float) -> Part:
    """A column on a flat, domed or trumpet-shaped (tulip) foot."""
    reach = draw(0.8, 1.15) * min(half_x, half_z)
    thick, t = draw(0.02, 0.045) * (1 + height), np.linspace(0, 1, 9)
    kind = draw.pick(("disc", "tulip", "dome", "cone"))
    if kind == "disc":
        profile = [(reach, 0), (reach, 0.02), (reach - 0.015, 0.03), (thick, 0.035), (thick, height + 0.01)]
    elif kind == "cone":
        profile = [(reach, 0), (reach, 0.012), (draw(0.6, 1) * thick, height + 0.01)]
    else:
        flare = 0.45 * draw(0.5, 1.2) * reach * np.exp(-(1 - t) * 5) * (kind == "tulip")
        radius = thick + (reach - thick) * np.exp(-(9.0 if kind == "dome" else 3.5) * t) + flare
        profile = [(reach, 0.0), *zip(radius, 0.012 + t * (height - 0.002), strict=True)]
    part = revolve(profile, 20)
    if kind in ("disc", "dome"):
        part += slab(ellipse(1.2 * half_x, 1.2 * half_z, 16), 0.025).moved(y=height - 0.02)
    if height > 0.55 and draw.maybe(0.6):  # a foot ring
        radius, y, angle = 0.75 * reach, 0.35 * height, np.linspace(0, 2 * np.pi, 20, endpoint=False)
        part += tube(points(radius * np.cos(angle), y, radius * np.sin(angle)), 0.012, closed=True)
        part += crossbar((-radius, y, 0), 0.02)
    return part


def loops(draw: Draw, half_x: float, half_z: float, height: float) -> Part:
    """A closed frame of tube or flat bar on each side (a sled), joined by cross bars."""
    lean, flat, size = draw(-0.05, 0.25) * height, draw.maybe(0.45), draw(0.018, 0.032)
    foot_x = half_x * (1.0 + (draw(0, 0.2) if draw.maybe(0.4) else 0.0))
    low, high = size / 2, height - 0.3 * size
    rear = half_z + draw(-0.3, 0.5) * lean
    path = [(foot_x, low, half_z + lean / 2), (half_x, high, half_z), (half_x, high, -half_z), (foot_x, low, -rear)]
    section = rectangle(1.5 * size, size, segments=1) if flat else ellipse(size, size, 8)
    path = rounded_path(path, 0.012 if flat else draw(0.02, 0.09), 3, closed=True)
    part = tube(path, 1.0, section, closed=True, side=(1, 0, 0)).both_sides()
    part += join(crossbar((-half_x, high, z), size) for z in (0.75 * half_z, -0.75 * half_z))
    return part + (crossbar((-foot_x, low, -rear + 0.03), size) if draw.maybe(0.3) else Part())


def cantilever(draw: Draw, half_x: float, half_z: float, height: float) -> Part:
    """One bent tube: under the seat to the front, down to the floor, to the rear and across. It has no rear legs."""
    size = draw(0.022, 0.034)
    low, high, reach = size / 2, height - 0.3 * size, half_z * draw(0.9, 1.15)
    front = half_z + draw(-0.05, 0.08)
    side = [(half_x, high, -half_z), (half_x, high, half_z), (half_x, low, front), (half_x, low, -reach)]
    path = rounded_path([*side, *((-x, y, z) for x, y, z in side[::-1])], draw(0.05, 0.1))
    bars = join(crossbar((-half_x, high, z), size) for z in (-0.8 * half_z, 0.6 * half_z))
    return tube(path, size / 2, side=(1, 0, 0)) + bars


def cross(draw: Draw, half_x: float, half_z: float, height: float) -> Part:
    """Legs that cross like scissors, at the sides (folding chair) or at front and rear, joined by bars."""
    size, deep, at_sides = draw(0.022, 0.035), draw(1.2, 1.8), draw.maybe(0.6)
    x, z = (half_x, half_z) if at_sides else (half_z, half_x)
    part = Part()
    for s in (-1, 1):
        outer = x - (0.5 + 0.5 * s) * size
        foot, head = (outer, 0.012, s * z * 1.1), (outer, height, -s * z)
        part += bar(foot, head, size, deep * size, side=(1, 0, 0)).both_sides()
        for y, along in ((0.12 * height, s * z * 0.84), (height - 0.015, -s * z)):
            part += crossbar((-outer, y, along), 0.9 * size)
    part += crossbar((-x, height / 2, 0), 0.9 * size)
    return part if at_sides else part.rotated("y", 90)


def panels(draw: Draw, half_x: float, half_z: float, height: float) -> Part:
    """A board on each side, and an upright board or a shelf between them."""
    t = draw(0.018, 0.05)
    part = between((half_x - t, 0, -half_z), (half_x, height + 0.005, half_z)).both_sides()
    if draw.maybe(0.6):
        low, z = draw(0.0, 0.7) * height, draw(-1, 0) * (half_z - 0.02)
        return part + between((-half_x, low, z - t / 2), (half_x, height, z + t / 2))
    y = draw(0.25, 0.6) * height
    return part + between((-half_x, y, -0.8 * half_z), (half_x, y + 0.8 * t, 0.8 * half_z))


def rocker(draw: Draw, half_x: float, half_z: float, height: float) -> Part:
    """Four legs on a pair of curved runners."""
    size, radius, reach = draw(0.025, 0.04), draw(0.8, 1.4), draw(1.35, 1.9) * half_z
    z = np.linspace(reach * 0.95, -reach * 1.15, 13)
    y = radius - np.sqrt(radius**2 - z**2) + size / 2
    x, section = half_x + 0.02, rectangle(size, 1.2 * size, segments=1)
    part = tube(points(x, y, z), 1.0, section, side=(1, 0, 0)).both_sides()
    for end in (-half_z, half_z):
        foot = (x, np.interp(end * 1.08, z[::-1], y[::-1]), end * 1.08)
        part += post(foot, (half_x, height + 0.01, end), ellipse(size, size, 8), [(0, 0.8), (1, 1)]).both_sides()
        part += crossbar((-half_x - 0.01, 0.4 * height, foot[2] + 0.4 * (end - foot[2])), 0.6 * size)
    return part
