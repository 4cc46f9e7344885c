"""What carries a seat or a table top, in metres: legs, pedestals, loops of tube, crossed bars, panels, rockers."""

from __future__ import annotations

import numpy as np

from learn3d.make_data.shapes.parts import (
    Solid,
    bar,
    between,
    both_sides,
    ellipse,
    ellipsoid,
    post,
    rectangle,
    revolve,
    rounded_path,
    slab,
    tube,
)
from learn3d.make_data.shapes.sampling import maybe, pick

Profile = list[tuple[float, float]]


def base(rng: np.random.Generator, kind: str, half_x: float, half_z: float, height: float) -> list[Solid]:
    """A support of the given kind from the floor (y = 0) to `height`, reaching about x = +-half_x and z = +-half_z."""
    make = {
        "legs": four_legs,
        "star": star_pedestal,
        "disc": disc_pedestal,
        "loops": loops,
        "cantilever": cantilever,
        "cross": crossed_legs,
        "panels": panels,
        "rocker": rocker,
    }[kind]
    return make(rng, half_x, half_z, height)


def leg_profile(rng: np.random.Generator) -> tuple[Profile, bool]:
    """The scale of a leg over its height (0 = floor), and whether the leg is turned (round)."""
    kind = pick(rng, {"straight": 2, "tapered": 3, "turned": 1.5, "baluster": 1, "stepped": 0.7})
    if kind == "straight":
        return [(0, 1), (1, 1)], False
    if kind == "tapered":
        return [(0, rng.uniform(0.45, 0.8)), (rng.uniform(0.6, 0.95), 1), (1, 1)], False
    if kind == "stepped":
        waist = rng.uniform(0.5, 0.75)
        return [(0, 1), (0.1, 1), (0.13, waist), (0.68, waist), (0.72, 1), (1, 1)], False
    if kind == "turned":
        a, b = rng.uniform(0.2, 0.35), rng.uniform(0.55, 0.75)
        return [
            (0, 0.5),
            (a - 0.08, 0.7),
            (a, 1.05),
            (a + 0.08, 0.65),
            (b, 1.2),
            (b + 0.08, 0.7),
            (0.92, 1.1),
            (1, 1),
        ], True
    swell = rng.uniform(0.25, 0.5)
    return [(0, 0.55), (0.06, 0.75), (0.1, 0.5), (swell, 1.25), (0.75, 0.7), (0.82, 1.1), (0.88, 0.8), (1, 1)], True


def four_legs(
    rng: np.random.Generator,
    half_x: float,
    half_z: float,
    height: float,
    size: float | None = None,
    plain: bool = False,
) -> list[Solid]:
    """Four legs, straight or splayed, perhaps with stretchers and an apron; sometimes bent-wire (hairpin) legs.

    `plain` ones are tapered and without an apron.
    """
    size = rng.uniform(0.028, 0.055) if size is None else size
    splay = rng.uniform(0.02, 0.16) * height if maybe(rng, 0.55) else 0.0
    if maybe(rng, 0.1):
        solids = []
        for x, z in ((half_x, half_z), (half_x, -half_z)):
            foot = np.array([x + 0.5 * splay, 0.006, z + 0.5 * splay * np.sign(z)])
            for dx, dz in ((-0.1, 0.0), (0.0, -0.1 * np.sign(z))):
                solids += both_sides(bar(foot, (x + dx, height + 0.01, z + dz), 0.013))
        return solids + [between((-half_x - 0.01, height - 0.012, -half_z), (half_x + 0.01, height + 0.005, half_z))]
    profile, turned = ([(0, 0.6), (1, 1)], True) if plain else leg_profile(rng)
    outline = ellipse(size, size, 10) if turned or maybe(rng, 0.3) else rectangle(size, size, segments=1)
    rear = splay * pick(rng, (0.3, 1.0, 1.6))
    corners = {(half_x, half_z): (half_x + splay, half_z + splay), (half_x, -half_z): (half_x + splay, -half_z - rear)}
    solids = []
    for (x, z), (foot_x, foot_z) in corners.items():
        solids += both_sides(post((foot_x, 0, foot_z), (x, height + 0.01, z), outline, profile))

    def at(corner: tuple[float, float], t: float) -> np.ndarray:
        foot = corners[corner]
        return np.array([foot[0] + t * (corner[0] - foot[0]), t * height, foot[1] + t * (corner[1] - foot[1])])

    front, back = tuple(corners)
    stretchers = pick(rng, {"none": 3, "H": 1, "box": 1, "sides": 0.7, "X": 0.4})
    t, thick = rng.uniform(0.15, 0.5), 0.55 * size
    flip = np.array([-1.0, 1.0, 1.0])
    if stretchers in ("H", "box", "sides"):
        solids += both_sides(bar(at(front, t), at(back, t), thick))
    if stretchers == "H":
        middle = 0.5 * (at(front, t) + at(back, t))
        solids.append(bar(middle, middle * flip, thick))
    if stretchers == "box":
        t2 = t if maybe(rng, 0.5) else min(t + 0.12, 0.6)
        solids += [bar(at(front, t2), at(front, t2) * flip, thick), bar(at(back, t2), at(back, t2) * flip, thick)]
    if stretchers == "X":
        solids += both_sides(bar(at(front, t), at(back, t) * flip, thick, thick, side=(0, 1, 0)))
    if maybe(rng, 0.45) and splay < 0.1 * height and not plain:
        solids += apron(half_x, half_z, height, rng.uniform(0.04, 0.09), 0.5 * size)
    return solids


def apron(half_x: float, half_z: float, top: float, depth: float, thickness: float) -> list[Solid]:
    """Four boards under a top, between the legs."""
    t, low, high = thickness / 2, top - depth, top + 0.005
    return [
        *both_sides(between((half_x - t, low, -half_z), (half_x + t, high, half_z))),
        between((-half_x, low, half_z - t), (half_x, high, half_z + t)),
        between((-half_x, low, -half_z - t), (half_x, high, -half_z + t)),
    ]


def feet(rng: np.random.Generator, half_x: float, half_z: float, height: float) -> list[Solid]:
    """Four short feet under a block: tapered blocks, cones or bun feet."""
    size = rng.uniform(0.045, 0.08)
    kind = pick(rng, ("block", "cone", "bun"))
    if kind == "bun":
        return [
            s
            for z in (half_z, -half_z)
            for s in both_sides(ellipsoid((1.4 * size, height, 1.4 * size), (half_x, height / 2, z)))
        ]
    outline = rectangle(size, size, segments=1) if kind == "block" else ellipse(size, size, 10)
    lean = 0.03 if maybe(rng, 0.4) else 0.0
    return [
        s
        for z in (half_z, -half_z)
        for s in both_sides(
            post((half_x + lean, 0, z + np.sign(z) * lean), (half_x, height, z), outline, [(0, 0.6), (1, 1)])
        )
    ]


def star_pedestal(rng: np.random.Generator, half_x: float, half_z: float, height: float) -> list[Solid]:
    """A column on a star of 3 to 6 arms, perhaps on castors, with a plate under the seat."""
    reach = rng.uniform(1.05, 1.3) * max(half_x, half_z)
    count = pick(rng, {5: 3, 4: 2, 3: 0.6, 6: 0.5})
    castors = maybe(rng, 0.6) and height < 0.6
    low = 0.055 if castors else 0.01
    hub = rng.uniform(0.02, 0.12) * height + low + 0.03
    thick = rng.uniform(0.018, 0.032)
    column: list[tuple[float, float]] = [(1.4 * thick, low), (1.6 * thick, hub + 0.02), (thick, hub + 0.05)]
    if maybe(rng, 0.6):  # a gas spring with a cover
        middle = hub + rng.uniform(0.4, 0.7) * (height - hub)
        column += [(1.1 * thick, middle), (0.65 * thick, middle + 0.01)]
    solids = [revolve([*column, (0.7 * thick, height + 0.01)], 10)]
    turn = np.radians(90.0 if count % 2 else rng.choice([0, 180 / count]))
    width = rng.uniform(0.8, 1.4) * 2 * thick
    for k in range(count):
        angle = turn + 2 * np.pi * k / count
        way = np.array([np.cos(angle), 0.0, np.sin(angle)])
        tip = way * reach + [0, low + 0.012, 0]
        path = rounded_path(
            [way * 0.3 * thick + [0, hub, 0], way * 0.4 * reach + [0, 0.7 * hub + 0.3 * low, 0], tip], 0.1, 3
        )
        section = rectangle(width, 0.8 * width, segments=1)
        solids.append(tube(path, np.linspace(1.0, 0.6, len(path)), section, side=np.cross(way, (0, 1, 0))))
        if castors:
            wheel = revolve([(0.02, -0.02), (0.03, -0.012), (0.03, 0.012), (0.02, 0.02)], 10).rotated("z", 90)
            solids.append(wheel.rotated("y", -np.degrees(angle) + 35).moved(*(way * (reach - 0.01) + [0, 0.03, 0])))
    plate = slab(rectangle(1.2 * half_x, 1.2 * half_z), 0.03)
    return solids + [plate.moved(y=height - 0.025)]


def disc_pedestal(rng: np.random.Generator, half_x: float, half_z: float, height: float) -> list[Solid]:
    """A column on a flat, domed or trumpet-shaped (tulip) foot."""
    reach = rng.uniform(0.8, 1.15) * min(half_x, half_z)
    thick = rng.uniform(0.02, 0.045) * (1 + height)
    kind = pick(rng, ("disc", "tulip", "dome", "cone"))
    if kind == "disc":
        profile = [(reach, 0), (reach, 0.02), (reach - 0.015, 0.03), (thick, 0.035), (thick, height + 0.01)]
    elif kind == "cone":
        profile = [(reach, 0), (reach, 0.012), (rng.uniform(0.6, 1) * thick, height + 0.01)]
    else:
        t = np.linspace(0, 1, 9)
        sharp = 9.0 if kind == "dome" else 3.5
        flare = 0.45 * rng.uniform(0.5, 1.2) * reach * np.exp(-(1 - t) * 5)
        radius = thick + (reach - thick) * np.exp(-sharp * t) + (flare if kind == "tulip" else 0)
        profile = [(reach, 0.0), *zip(radius, 0.012 + t * (height - 0.002), strict=True)]
    solids = [revolve(profile, 20)]
    if kind in ("disc", "dome"):
        solids.append(slab(ellipse(1.2 * half_x, 1.2 * half_z, 16), 0.025).moved(y=height - 0.02))
    if height > 0.55 and maybe(rng, 0.6):  # a ring to put the feet on
        angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
        ring = np.stack([0.75 * reach * np.cos(angle), np.full(20, 0.35 * height), 0.75 * reach * np.sin(angle)], 1)
        solids.append(tube(ring, 0.012, closed=True))
        solids.append(bar((-0.75 * reach, 0.35 * height, 0), (0.75 * reach, 0.35 * height, 0), 0.02))
    return solids


def loops(rng: np.random.Generator, half_x: float, half_z: float, height: float) -> list[Solid]:
    """A closed frame of tube or flat bar on each side (a sled), joined by cross bars."""
    lean, flat = rng.uniform(-0.05, 0.25) * height, maybe(rng, 0.45)
    size = rng.uniform(0.018, 0.032)
    spread = 1.0 + (rng.uniform(0, 0.2) if maybe(rng, 0.4) else 0.0)
    low, high = size / 2, height - 0.3 * size
    rear = half_z + rng.uniform(-0.3, 0.5) * lean
    corners = [
        (half_x * spread, low, half_z + lean / 2), (half_x, high, half_z),
        (half_x, high, -half_z), (half_x * spread, low, -rear),
    ]  # fmt: skip
    section = rectangle(1.5 * size, size, segments=1) if flat else ellipse(size, size, 8)
    bend = 0.012 if flat else rng.uniform(0.02, 0.09)
    frame = tube(rounded_path(corners, bend, 3, closed=True), 1.0, section, closed=True, side=(1, 0, 0))
    solids = both_sides(frame)
    for z in (0.75 * half_z, -0.75 * half_z):
        solids.append(bar((-half_x, high, z), (half_x, high, z), size))
    if maybe(rng, 0.3):
        solids.append(bar((-half_x * spread, low, -rear + 0.03), (half_x * spread, low, -rear + 0.03), size))
    return solids


def cantilever(rng: np.random.Generator, half_x: float, half_z: float, height: float) -> list[Solid]:
    """One bent tube: under the seat to the front, down to the floor, back and across; nothing under the rear edge."""
    size = rng.uniform(0.022, 0.034)
    low, high, reach = size / 2, height - 0.3 * size, half_z * rng.uniform(0.9, 1.15)
    forward = rng.uniform(-0.05, 0.08)
    side = [(half_x, high, -half_z), (half_x, high, half_z), (half_x, low, half_z + forward), (half_x, low, -reach)]
    path = [*side, *[(-x, y, z) for x, y, z in side[::-1]]]
    solids = [tube(rounded_path(path, rng.uniform(0.05, 0.1), 4), size / 2, side=(1, 0, 0))]
    solids += [bar((-half_x, high, z), (half_x, high, z), size) for z in (-0.8 * half_z, 0.6 * half_z)]
    return solids


def crossed_legs(rng: np.random.Generator, half_x: float, half_z: float, height: float) -> list[Solid]:
    """Legs crossing like scissors, at the sides (folding chair, camp table) or at front and rear."""
    size, deep = rng.uniform(0.022, 0.035), rng.uniform(1.2, 1.8)
    low, high = 0.012, height
    solids = []
    if maybe(rng, 0.6):
        for s in (-1, 1):
            x = half_x - (0.5 + 0.5 * s) * size
            leg = bar((x, low, s * half_z * 1.1), (x, high, -s * half_z), size, deep * size, side=(1, 0, 0))
            solids += both_sides(leg)
            for y, z in ((0.12 * height, s * half_z * 0.84), (high - 0.015, -s * half_z)):
                solids.append(bar((-x, y, z), (x, y, z), 0.9 * size))
        return solids + [bar((-half_x, height / 2, 0), (half_x, height / 2, 0), 0.9 * size)]
    for z in (0.85 * half_z, -0.85 * half_z):
        for s in (-1, 1):
            start = (s * half_x * 1.05, low, z + 0.4 * s * size)
            solids.append(bar(start, (-s * half_x, high, z + 0.4 * s * size), size, deep * size))
    t = 0.06
    for s in (-1, 1):
        solids.append(between((s * half_x - t, high - 0.025, -half_z), (s * half_x + t, high + 0.004, half_z)))
    return solids + [bar((0, height / 2, -half_z * 0.85), (0, height / 2, half_z * 0.85), size)]


def panels(rng: np.random.Generator, half_x: float, half_z: float, height: float) -> list[Solid]:
    """A board on each side, perhaps one at the back and a rail, plain or with a raised foot."""
    t = rng.uniform(0.018, 0.05)
    solids = both_sides(between((half_x - t, 0, -half_z), (half_x, height + 0.005, half_z)))
    if maybe(rng, 0.6):
        low = rng.uniform(0.0, 0.7) * height
        z = rng.uniform(-1, 0) * (half_z - 0.02)
        solids.append(between((-half_x, low, z - t / 2), (half_x, height, z + t / 2)))
    else:
        y = rng.uniform(0.25, 0.6) * height
        solids.append(between((-half_x, y, -0.8 * half_z), (half_x, y + 0.8 * t, 0.8 * half_z)))
    return solids


def rocker(rng: np.random.Generator, half_x: float, half_z: float, height: float) -> list[Solid]:
    """Four legs on a pair of curved runners."""
    size = rng.uniform(0.025, 0.04)
    radius = rng.uniform(0.8, 1.4)
    reach = rng.uniform(1.35, 1.9) * half_z
    z = np.linspace(reach * 0.95, -reach * 1.15, 13)
    y = radius - np.sqrt(radius**2 - z**2) + size / 2
    section = rectangle(size, 1.2 * size, segments=1)
    solids = both_sides(tube(np.stack([np.full(13, half_x + 0.02), y, z], 1), 1.0, section, side=(1, 0, 0)))
    for s in (-1, 1):
        foot = s * half_z * 1.08
        start = (half_x + 0.02, float(np.interp(foot, z[::-1], y[::-1])), foot)
        solids += both_sides(
            post(start, (half_x, height + 0.01, s * half_z), ellipse(size, size, 8), [(0, 0.8), (1, 1)])
        )
        middle = 0.4 * height
        zz = foot + 0.4 * (s * half_z - foot)
        solids.append(bar((-half_x - 0.01, middle, zz), (half_x + 0.01, middle, zz), 0.6 * size))
    return solids
