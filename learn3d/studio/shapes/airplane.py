"""Procedural airplanes, in lengths of the fuselage, nose towards +z."""

from dataclasses import dataclass

import numpy as np

from .draw import Draw, Perhaps, ellipse, points, recipe, rectangle
from .parts import Part, bar, box, ellipsoid, join, loft, revolve, strip, wing

# Sections of a wing of each shape besides its middle and its tip, as shares of the half span.
_STATIONS = {
    "straight": [],
    "kinked": [0.55, 0.95],
    "elliptic": np.sin(np.linspace(0, np.pi / 2, 8)).round(4).tolist(),
}


@dataclass(frozen=True)
class Planform:
    """The outline of a wing or stabiliser."""

    half: float  # half of the span
    root: float  # chord in the middle
    tip: float  # chord at the tip
    sweep_deg: float  # sweep of the leading edge, backwards
    dihedral_deg: float  # rise of the wing towards the tip
    z: float  # position of the leading edge in the middle
    y: float  # height of the wing in the middle
    # share of the half span at which the trailing edge bends; 0 for a straight one
    kink: float = 0.0
    # "straight", "elliptic" or "kinked" (constant chord, then tapered)
    shape: str = "straight"
    thickness: float = 0.12  # thickness over chord

    def at(self, share: float) -> tuple[float, float, float, float]:
        """x, y, z of the leading edge and chord at a share (0..1) of the half span."""
        x = share * self.half
        slope = np.tan(np.radians(self.sweep_deg))
        y = self.y + x * np.tan(np.radians(self.dihedral_deg))
        z = self.z - x * slope
        chord = self.root + share * (self.tip - self.root)
        if self.kink > 0.0:  # unswept trailing edge up to the kink, swept beyond it
            inner = self.root - self.kink * self.half * slope
            middle = max(inner, 0.5 * (self.root + self.tip) * 0.8, 1.2 * self.tip)
            chord = np.interp(share, [0, self.kink, 1], [self.root, middle, self.tip])
        elif self.shape == "elliptic":
            chord = self.root * np.sqrt(1 - (0.985 * share) ** 2)
            z = z - 0.3 * (self.root - chord)
        elif self.shape == "kinked":
            chord = np.interp(share, [0, 0.55, 1], [self.root, self.root, self.tip])
        return x, y, z, chord

    def wing(self) -> Part:
        """The whole wing, tip to tip, in one piece."""
        shares = {0.0, self.kink, *_STATIONS[self.shape], 1.0}
        middle, *right = [(*self.at(share), self.thickness) for share in sorted(shares)]
        return wing([*((-x, *rest) for x, *rest in right[::-1]), middle, *right])

    def winglets(self, draw: Draw) -> Part:
        """Upturned wing tips."""
        x, y, z, chord = self.at(1.0)
        tip = fin(
            draw(0.05, 0.085),
            root=chord,
            tip=0.5 * chord,
            sweep_deg=draw(25, 50),
            z=z,
            thickness=0.1,
        )
        return tip.rotated("z", -draw(0, 30)).moved(x - 0.004, y - 0.004).both_sides()


def fuselage(
    radius: float,
    tall: float = 1.0,
    nose: float = 0.15,
    nose_power: float = 2.0,
    tail_start: float = 0.6,
    tail_radius: float = 0.1,
    upsweep: float = 0.3,
    droop: float = 0.0,
    exponent: float = 2.0,
    length: float = 1.0,
    tail_power: float = 1.6,
) -> Part:
    """A fuselage along z from +length/2 (nose) to -length/2, `tall` times as high as wide.

    The nose ends at the share `nose` of the length, and the tail begins at the share
    `tail_start`. nose_power is the bluntness of the nose: 1 for a cone, 2 for an ellipse. upsweep
    lifts the end of the tail and droop lowers the tip of the nose, both in radii. tail_radius is
    the radius at the end, in radii. exponent is that of `ellipse`.
    """
    ahead = np.array([0.0, 0.02, 0.07, 0.16, 0.3, 0.5, 0.75, 1.0])
    behind = np.array([0.15, 0.35, 0.6, 0.85, 1.0])
    front = (1 - (1 - 0.998 * ahead - 0.002) ** nose_power) ** (1 / max(nose_power, 1.0))
    scale = np.concatenate([np.maximum(front, 0.04), 1 - (1 - tail_radius) * behind**tail_power])
    y = np.concatenate([-droop * (1 - ahead) ** 2, upsweep * behind**1.5]) * radius * tall
    z = length * (0.5 - np.concatenate([nose * ahead, tail_start + (1 - tail_start) * behind]))
    outline = scale[:, None, None] * ellipse(2.0 * radius, 2.0 * radius * tall, 16, exponent)
    return loft(points(outline[..., 0], outline[..., 1] + y[:, None], z[:, None]))


def fin(
    height: float, root: float, tip: float, sweep_deg: float, z: float, thickness: float = 0.09
) -> Part:
    """An upright fin on y = 0, its leading edge starting at z."""
    back = height * np.tan(np.radians(sweep_deg))
    return wing(
        [(0.0, 0.0, z, root, thickness), (height, 0.0, z - back, tip, thickness)], upright=True
    )


# Measures of tails, of slow airplanes and of jets. lean_deg: sweep of the stabiliser. taper: its
# chord at the tip over that in the middle. ahead: how far the fin begins before its usual place.
_TAIL = {
    "height": (0.14, 0.21),
    "sweep_deg": (5, 20),
    "root": (0.13, 0.19),
    "tip": (0.06, 0.1),
    "half": (0.15, 0.22),
    "chord": (0.09, 0.13),
    "lean_deg": (0, 15),
    "taper": (0.4, 0.8),
    "ahead": (-0.01, 0.03),
}
_SWEPT_TAIL = _TAIL | {"sweep_deg": (28, 45), "lean_deg": (25, 38)}


def tail(draw: Draw, kind: str, radius: float, swept: bool = False) -> Part:
    """Fin and stabiliser: "conventional", "cross" (half-way up the fin), "T", "V" or "twin"."""
    measures = draw.measures(**(_SWEPT_TAIL if swept else _TAIL))
    return _tail(draw, kind, radius, swept, **measures)


def _tail(
    draw: Draw,
    kind: str,
    radius: float,
    swept: bool,
    *,
    height,
    sweep_deg,
    root,
    tip,
    half,
    chord,
    lean_deg,
    taper,
    ahead,
) -> Part:
    z = -0.5 + root + ahead
    base = 0.25 * radius
    if kind == "V":
        middle = (0, 0, z - 0.02, root, 0.1)
        end = (1.25 * half, 0, z - 0.02 - 0.5 * half * (1 + swept), tip, 0.1)
        return wing([middle, end]).rotated("z", draw(32, 45)).moved(y=base).both_sides()
    dihedral = draw(0, 7)
    if kind == "twin":
        return _twin_tail(draw, radius, half, chord, height, dihedral)
    total = height + base
    upright = fin(total, root, tip, sweep_deg, z)
    if swept and draw.maybe(0.4):  # a dorsal fillet
        low = 0.45 * height + base
        upright += fin(low, 1.6 * root, 0.5 * root, 62, z + 0.75 * root, 0.04)
    part = upright.moved(y=0.4 * base)
    rise = {"T": 0.97, "cross": draw(0.35, 0.6), "conventional": 0.0}[kind] * total
    end = taper * chord
    if kind == "conventional":
        front = -0.5 + chord + draw(0.0, 0.04)
        level = draw(0.1, 0.45) * radius
    else:
        dihedral = 0.0
        front = z - rise * np.tan(np.radians(sweep_deg)) + 0.01
        level = 0.4 * base + rise
    if kind == "T":
        chord, end = min(chord, 1.3 * tip), min(end, 0.9 * tip)
    stabiliser = Planform(half, chord, end, lean_deg, dihedral, front, level, thickness=0.1)
    return part + stabiliser.wing()


def _twin_tail(
    draw: Draw, radius: float, half: float, chord: float, height: float, dihedral_deg: float
) -> Part:
    """A stabiliser with a fin at each end."""
    front = -0.5 + chord + 0.01
    plan = Planform(half, chord, 0.95 * chord, 3, dihedral_deg, front, 0.4 * radius)
    x, y, z, end = plan.at(1.0)
    upright = fin(0.8 * height, 1.2 * end, 0.8 * end, sweep_deg=draw(5, 25), z=z + 0.02)
    return plan.wing() + upright.moved(x, y - draw(0.1, 0.45) * height).both_sides()


def along_z(
    profile: list[tuple[float, float]],
    radius: float,
    length: float,
    sides: int,
    hollow: bool = False,
) -> Part:
    """The solid of revolution about z of a profile [(share of the radius, of the length)]."""
    return revolve(np.array(profile) * [radius, length], sides, hollow).rotated("x", 90)


def nacelle(radius: float, length: float) -> Part:
    """A jet engine along z, centred: an open cowl around a core with spinner and cone."""
    cowl = [
        (0.78, -0.5),
        (0.97, -0.1),
        (1.0, 0.25),
        (0.95, 0.45),
        (0.88, 0.5),
        (0.8, 0.44),
        (0.8, 0.0),
        (0.72, -0.48),
    ]
    core = [
        (0.03, 0.42),
        (0.2, 0.35),
        (0.22, 0.3),
        (0.86, 0.28),
        (0.86, 0.2),
        (0.55, 0.1),
        (0.5, -0.5),
        (0.1, -0.72),
    ]
    return along_z(cowl, radius, length, 14, hollow=True) + along_z(core, radius, length, 14)


def tail_engines(draw: Draw, radius: float, size: float, z: float) -> Part:
    """A pair of jet engines on short stubs at the rear fuselage."""
    x = 0.8 * radius + 1.1 * size
    y = draw(0.1, 0.6) * radius
    stub = wing([(0.0, y, z + 0.02, 0.09, 0.12), (x, y, z + 0.01, 0.08, 0.12)])
    return (nacelle(size, draw(4.0, 5.5) * size).moved(x, y, z) + stub).both_sides()


@recipe(width=(0.12, 0.2), turn_deg=(0, 360))
def propeller(draw: Draw, radius: float, blades: int, hub: float, *, width, turn_deg) -> Part:
    """A spinner and `blades` blades in the plane z = 0, turned to a random angle."""
    part = along_z([(1.0, -1.0), (1.0, 0.0), (0.8, 0.8), (0.4, 1.5), (0.05, 1.8)], hub, hub, 10)
    scale = np.array([0.5, 0.8, 0.8, 0.4]) * (width * radius)
    path = [(0, share * radius, 0) for share in (0, 0.35, 0.75, 1)]
    blade = strip(path, 2.0, 0.5, scale, side=(0.9, 0, 0.45))
    return part + join(blade.rotated("z", turn_deg + 360.0 * k / blades) for k in range(blades))


def pod(radius: float, length: float) -> Part:
    """A drop-shaped body along z, its blunt end forward, centred."""
    profile = np.array(
        [(0.1, 0), (0.3, 0.05), (0.6, 0.15), (0.95, 0.35), (1.0, 0.6), (0.85, 0.85), (0.55, 1)]
    )
    return along_z(profile - [0, 0.5], radius, length, 12)


def nozzle(radius: float, length: float) -> Part:
    """An open jet nozzle along z, centred."""
    profile = np.array(
        [(0.8, -1), (1, 1), (0.9, 1.02), (0.02, 0.9), (0.02, 0.7), (0.8, 0.6), (0.7, -1)]
    )
    return revolve(profile * [radius, -0.5 * length], 12, hollow=True).rotated("x", -90)


def canopy(width: float, height: float, length: float, y: float, z: float) -> Part:
    """A cockpit bubble about (0, y, z), steeper in front than behind."""
    ((rings, _),) = ellipsoid((width, height, length), sides=12)
    return loft(rings * points(1.0, 1.0, np.where(rings[..., 2] > 0, 0.75, 1.25))).moved(0, y, z)


def gear(belly: float, drop: float, main_x: float, main_z: float, other_z: float) -> Part:
    """A main gear at x = +-main_x, and a nose wheel or, if other_z < main_z, a tail wheel.

    drop: depth of the wheels below the axis of the fuselage. belly: radius of the fuselage at the
    gear.
    """
    main = _wheel(0.026)
    top = -0.5 * belly
    part = bar((0.4 * main_x, top, main_z), (main_x, -drop, main_z), 0.016).both_sides()
    part += main.moved(main_x + 0.004, -drop, main_z).both_sides()
    if other_z < main_z:
        leg = bar((0, 0, other_z), (0, -0.06, other_z - 0.01), 0.014)
        return part + leg + _wheel(0.015).moved(y=-0.065, z=other_z - 0.01)
    return (
        part + bar((0, top, other_z), (0, -drop, other_z), 0.016) + main.moved(y=-drop, z=other_z)
    )


def _wheel(radius: float) -> Part:
    t = 0.35 * radius
    return revolve(
        [(0.7 * radius, -t), (radius, -0.6 * t), (radius, 0.6 * t), (0.7 * radius, t)], 12
    ).rotated("z", 90)


@recipe(
    radius=(0.042, 0.068),
    freighter=0.25,
    tall=(0.95, 1.15),
    nose=(1.6, 3.0),
    nose_power=(1.7, 2.2),
    tail_start=(0.58, 0.72),
)
def airliner(draw: Draw, *, radius, freighter, tall, nose, nose_power, tail_start) -> Part:
    """A jet airliner, or a freighter with high wings, T-tail and upswept rear."""
    upsweep = draw(0.5, 0.9) if freighter else draw(0.25, 0.6)
    droop = draw(0.1, 0.35)
    plane = fuselage(
        radius,
        tall=tall,
        nose=nose * radius,
        nose_power=nose_power,
        tail_start=tail_start,
        upsweep=upsweep,
        droop=droop,
    )
    size = draw.measures(
        half=(0.40, 0.56), sweep_deg=(15, 38), root=(0.15, 0.21), tip=(0.035, 0.07)
    )
    size["dihedral_deg"] = draw(-4, 0) if freighter else draw(3, 8)
    size |= draw.measures(z=(0.1, 0.17), kink=Perhaps(0.7, (0.25, 0.42)))
    plan = Planform(**size, y=0.8 * radius if freighter else -0.6 * radius)
    plane += plan.wing()
    if freighter:
        plane += ellipsoid((1.5 * radius, 0.7 * radius, 0.32), (0, 0.85 * radius, plan.z - 0.1))
    mount = "wing" if freighter else draw.pick({"wing": 4, "tail": 1, "tail3": 0.5, "wing3": 0.4})
    size = draw(0.35, 0.58) * radius
    if mount.startswith("tail"):
        plane += tail_engines(draw, radius, 0.9 * size, z=draw(-0.32, -0.24))
    elif draw.maybe(0.35 if freighter else 0.7):
        size *= 1.25
        plane += _wing_engine(draw, plan, draw(0.28, 0.4), size).both_sides()
    else:
        size *= 0.9
        outer = draw(0.55, 0.65)
        plane += join(_wing_engine(draw, plan, share, size).both_sides() for share in (0.3, outer))
    if mount.endswith("3"):
        plane += nacelle(0.9 * size, 4.5 * size).moved(y=1.35 * radius, z=-0.36)
    plane += tail(
        draw, "T" if freighter or mount.startswith("tail") else "conventional", radius, swept=True
    )
    if draw.maybe(0.4):
        plane += plan.winglets(draw)
    if not freighter and draw.maybe(0.12):  # an upper deck
        plane += ellipsoid((1.5 * radius, 1.5 * radius, 0.4), (0, 0.75 * radius, 0.27))
    if draw.maybe(0.25):
        plane += gear(
            radius, radius * draw(1.5, 2.0), main_x=1.2 * radius, main_z=-0.02, other_z=0.38
        )
    return plane


@recipe(length=(3.0, 4.6), drop=(1.1, 1.5), forward=(0.0, 0.3))
def _wing_engine(
    draw: Draw, plan: Planform, share: float, size: float, *, length, drop, forward
) -> Part:
    """A jet engine of radius `size` on a pylon under the right wing, at a share of the span."""
    x, y, z, chord = plan.at(share)
    length *= size
    low = y - drop * size
    front = z + forward * length
    lower = (low + 0.6 * size, x, front + 0.25 * length, 0.9 * length, 0.08)
    pylon = wing([lower, (y, x, z - 0.05 * chord, 0.5 * chord, 0.1)], upright=True)
    return pylon + nacelle(size, length).moved(x, low, front)


@recipe(radius=(0.052, 0.075), nose=(0.14, 0.24))
def business_jet(draw: Draw, *, radius, nose) -> Part:
    """A small jet with engines at the tail."""
    plane = fuselage(radius, nose=nose, nose_power=1.6, tail_start=0.6, upsweep=0.35, droop=0.3)
    size = draw.measures(
        half=(0.4, 0.52),
        root=(0.15, 0.2),
        tip=(0.045, 0.07),
        sweep_deg=(2, 34),
        dihedral_deg=(2, 6),
        z=(0.02, 0.08),
    )
    plan = Planform(**size, y=-0.75 * radius)
    plane += plan.wing() + tail_engines(draw, radius, draw(0.026, 0.036), z=-0.2)
    plane += tail(draw, draw.pick({"T": 3, "cross": 1, "V": 0.4}), radius, swept=True)
    if draw.maybe(0.5):
        plane += plan.winglets(draw)
    if draw.maybe(0.25):  # tanks at the wing tips
        x, y, z, chord = plan.at(1.0)
        plane += ellipsoid((0.035, 0.035, 0.2), (x, y, z - 0.5 * chord)).both_sides()
    return plane


@recipe(
    radius=(0.05, 0.068),
    twin=0.45,
    tall=(0.9, 1.15),
    nose=(0.3, 0.42),
    nose_power=(1.05, 1.4),
    tail_radius=(0.65, 0.85),
    exponent=(2.0, 3.2),
    shape={"delta": 2.5, "swept": 2, "trapezoid": 2, "forward": 0.3},
)
def fighter(draw: Draw, *, radius, twin, shape, **form) -> Part:
    """A jet fighter: wings of four forms, one or two fins, canards, stores under the wings."""
    plan = _fighter_wing(draw, shape, radius)
    plane = fuselage(radius, tail_start=0.75, **form) + plan.wing()
    long, z = draw(0.18, 0.28), draw(0.15, 0.22)
    plane += canopy(0.9 * radius, 1.1 * radius, long, 0.8 * radius, z)
    plane += _intakes(draw, radius, twin) + _fighter_fins(draw, radius, twin)
    if shape != "delta":
        half, sweep = draw(0.17, 0.23), draw(30, 45)
        plane += Planform(half, 0.15, 0.06, sweep, -3, -0.34, 0.0, thickness=0.06).wing()
        if draw.maybe(0.4):  # strakes from the wing root towards the nose
            outer = (2.0 * radius, plan.y, plan.z - 0.03, 0.7 * plan.root, 0.05)
            inner = (0.0, plan.y, plan.z + 0.2, plan.root + 0.1, 0.05)
            plane += wing([inner, outer]).both_sides()
    elif draw.maybe(0.5):  # canards
        half, y = draw(0.15, 0.2), 0.35 * radius
        plane += Planform(half, 0.11, 0.04, 45, 4, 0.24, y, thickness=0.06).wing()
    places = {(0.4, 0.6, 0.8, 1.0)[draw.count(0, 3)] for _ in range(draw.count(0, 3))}
    return plane + join(_store(draw, plan, share).both_sides() for share in sorted(places))


def _fighter_wing(draw: Draw, shape: str, radius: float) -> Planform:
    root, tip, sweep, z = {
        "delta": (draw(0.42, 0.52), draw(0.02, 0.06), draw(46, 58), 0.1),
        "swept": (draw(0.2, 0.28), draw(0.08, 0.12), draw(35, 50), 0.12),
        "trapezoid": (draw(0.28, 0.38), draw(0.06, 0.1), draw(25, 42), 0.06),
        "forward": (draw(0.22, 0.28), 0.1, draw(-28, -18), -0.08),
    }[shape]
    half = draw(0.28, 0.4) if shape == "delta" else draw(0.3, 0.4)
    if shape == "delta":
        half = min(half, 0.9 * root / np.tan(np.radians(sweep)))
    dihedral, y = draw(-5, 2), draw(-0.3, 0.6) * radius
    return Planform(half, root, tip, sweep, dihedral, z, y, thickness=0.06)


def _intakes(draw: Draw, radius: float, twin: bool) -> Part:
    """Two tunnels beside the fuselage, or one nozzle with intakes at the sides, below, or in the nose."""
    if twin:
        return _intake_tunnel(radius, draw(0.8, 1.25) * radius).both_sides()
    side = box((0.8 * radius, 1.2 * radius, 0.34), (0.95 * radius, 0.1 * radius, 0.03), 0.02)
    chin = box((1.2 * radius, 0.9 * radius, 0.3), (0, -0.9 * radius, 0.06), 0.02)
    return draw.pick([side.both_sides(), chin, Part()]) + nozzle(0.75 * radius, 0.08).moved(z=-0.52)


def _fighter_fins(draw: Draw, radius: float, twin: bool) -> Part:
    """Two fins, canted outwards, or an upright one."""
    if draw.maybe(0.55 if twin else 0.1):
        return _canted_fin(draw, radius).both_sides()
    height, root = draw(0.17, 0.25) + 0.6 * radius, draw(0.2, 0.3)
    return fin(height, root, 0.09, sweep_deg=draw(35, 52), z=-0.2).moved(y=0.3 * radius)


def _intake_tunnel(radius: float, wide: float) -> Part:
    """A tunnel beside the fuselage with a slanted intake and a nozzle."""
    rings = []
    for z, width, height, y in (
        (0.14, 0.9, 1.3, -0.3),
        (0.0, 1.0, 1.4, -0.2),
        (-0.3, 1.0, 1.3, 0),
        (-0.48, 0.8, 0.9, 0.1),
    ):
        across, up = rectangle(width * wide, height * wide, 0.3 * wide).T
        rings.append(points(wide + across, y * wide + up, z + 0.05 * (z > 0.1) * (up / wide)))
    return loft(rings) + nozzle(0.42 * wide, 0.07).moved(wide, 0.08 * wide, -0.5)


@recipe(cant_deg=(0, 25), x=(0.9, 1.4), height=(0.13, 0.19), sweep_deg=(30, 45))
def _canted_fin(draw: Draw, radius: float, *, cant_deg, x, height, sweep_deg) -> Part:
    upright = fin(height, root=0.19, tip=0.08, sweep_deg=sweep_deg, z=-0.27)
    return upright.rotated("z", -cant_deg).moved(x * radius, 0.3 * radius)


@recipe(length=(0.14, 0.26))
def _store(draw: Draw, plan: Planform, share: float, *, length) -> Part:
    """A tank or missile under the right wing, or at its tip."""
    x, y, z, chord = plan.at(share)
    store = ellipsoid((0.022, 0.022, length), (x, y - 0.026 * (share < 1), z - 0.4 * chord), 8, 6)
    if share < 1:
        store += box((0.01, 0.03, 0.06), (x, y - 0.012, z - 0.45 * chord))
    return store


@recipe(
    radius=(0.05, 0.075),
    high=0.55,
    tall=(0.95, 1.2),
    nose=(0.1, 0.2),
    tail_start=(0.5, 0.66),
    upsweep=(0.3, 0.8),
    exponent=[2.0, 2.0, 2.6, 4.0],
)
def turboprop(draw: Draw, *, radius, high, **form) -> Part:
    """A twin or four-engined propeller plane."""
    plane = fuselage(radius, **form, droop=0.2)
    size = draw.measures(
        half=(0.48, 0.62),
        root=(0.11, 0.16),
        tip=(0.05, 0.1),
        sweep_deg=(0, 6),
        dihedral_deg=(0, 6),
        z=(0.08, 0.18),
    )
    plan = Planform(**size, y=0.85 * radius if high else -0.65 * radius)
    plane += plan.wing()
    two = draw.maybe(0.65)
    thick = draw(0.02, 0.03)
    blades = draw.count(2, 6)
    disc = draw(0.07, 0.1)
    for share in (draw(0.26, 0.34),) if two else (0.27, 0.56):
        plane += _propeller_engine(
            draw, plan, share, thick=thick, longer=draw(0.08, 0.13), disc=disc, blades=blades
        ).both_sides()
    kind = (
        {"T": 2, "conventional": 2, "cross": 0.7}
        if high
        else {"conventional": 3, "twin": 1.2, "T": 0.6}
    )
    plane += tail(draw, draw.pick(kind), radius, swept=draw.maybe(0.5))
    if draw.maybe(0.2):
        plane += gear(radius, 1.8 * radius, main_x=1.1 * radius, main_z=0.02, other_z=0.36)
    return plane


def _propeller_engine(
    draw: Draw, plan: Planform, share: float, thick: float, longer: float, disc: float, blades: int
) -> Part:
    """A pod with a propeller on the right wing: `longer` than the chord, `thick` in radius."""
    x, y, z, chord = plan.at(share)
    long = chord + longer
    y = y - 0.2 * thick
    body = pod(thick, long).moved(x, y, z - 0.5 * long + 0.075)
    return body + propeller(draw, disc, blades, hub=0.55 * thick).moved(x, y, z + 0.075)


@recipe(
    radius=(0.065, 0.085),
    high=0.55,
    pusher=0.1,
    tall=(1.05, 1.35),
    nose=(0.08, 0.22),
    nose_power=(2.0, 3.2),
    tail_start=(0.36, 0.48),
    upsweep=(0.0, 0.4),
    tail_radius=(0.15, 0.3),
    exponent=(2.0, 4.5),
)
def light_plane(draw: Draw, *, radius, high, pusher, **form) -> Part:
    """A single-engined light plane; sometimes on floats."""
    tall = 1.2 * radius
    size = draw.measures(half=(0.5, 0.72), root=(0.14, 0.2), tip=(0.09, 0.14), sweep_deg=(0, 4))
    size["dihedral_deg"] = draw(0, 3) if high else draw(3, 8)
    size["z"] = draw(0.16, 0.24)
    size["y"] = tall * draw(1.05, 1.2) if high else -0.7 * tall
    plan = Planform(**size, shape=draw.pick(["straight", "straight", "elliptic", "kinked"]))
    plane = fuselage(radius, **form) + plan.wing()
    if high:
        plane += box((1.5 * radius, 1.1 * tall, 0.2), (0, 0.62 * tall, 0.14), 0.03)
    else:
        plane += canopy(
            width=1.5 * radius, height=1.3 * tall, length=draw(0.24, 0.36), y=0.72 * tall, z=0.1
        )
    plane += propeller(draw, draw(0.11, 0.16), draw.count(2, 3), hub=0.025).moved(
        z=-0.515 if pusher else 0.497
    )
    swept = draw.maybe(0.5)
    plane += tail(
        draw, draw.pick({"conventional": 4, "T": 1, "V": 0.6, "cross": 0.5}), radius, swept
    )
    if high and draw.maybe(0.6):
        x, y, z, chord = plan.at(draw(0.4, 0.6))
        z = z - 0.4 * chord
        plane += bar((0.6 * radius, -0.6 * tall, z), (x, y, z), 0.018, 0.01).both_sides()
    if draw.maybe(0.12):
        return plane + _floats(draw, radius, tall)
    if draw.maybe(0.75):
        main_z, other_z = (0.03, 0.4) if draw.maybe(0.6) else (0.25, -0.46)
        plane += gear(
            belly=tall,
            drop=tall + draw(0.05, 0.09),
            main_x=2.0 * radius,
            main_z=main_z,
            other_z=other_z,
        )
    return plane


@recipe(drop=(0.08, 0.11), length=(0.65, 0.8))
def _floats(draw: Draw, radius: float, tall: float, *, drop, length) -> Part:
    x = 2.2 * radius
    y = -tall - drop
    hull = fuselage(0.035, nose=0.25, nose_power=1.8, tail_start=0.5, upsweep=0.9, length=length)
    part = hull.moved(x, y, 0.12).both_sides()
    for z in (0.24, 0.02):
        end = (x, y + 0.02, z)
        part += (
            bar((0.5 * radius, -0.6 * tall, z), end, 0.016) + bar((0.0, *end[1:]), end, 0.012)
        ).both_sides()
    return part


@recipe(radius=(0.042, 0.055))
def glider(draw: Draw, *, radius) -> Part:
    """A sailplane: a slender pod and boom under very long wings."""
    plane = fuselage(
        radius,
        tall=1.25,
        nose=0.26,
        nose_power=1.8,
        tail_start=0.33,
        tail_power=0.75,
        tail_radius=0.22,
        upsweep=0.1,
    )
    size = draw.measures(
        half=(0.9, 1.35),
        root=(0.085, 0.12),
        tip=(0.03, 0.055),
        sweep_deg=(0, 3),
        dihedral_deg=(2, 6),
        y=(0.3, 0.9),
        shape=["straight", "elliptic", "kinked"],
    )
    size["y"] *= radius
    plan = Planform(**size, z=0.16)
    plane += plan.wing() + canopy(
        width=1.5 * radius, height=1.6 * radius, length=0.26, y=0.75 * radius, z=0.27
    )
    plane += tail(draw, draw.pick({"T": 3, "conventional": 1, "V": 0.5}), 0.9 * radius)
    return plane + (plan.winglets(draw) if draw.maybe(0.4) else Part())


@recipe(radius=(0.06, 0.075), exponent=(2, 5), gap=(0.16, 0.22), stagger=(-0.03, 0.1), triplane=0.2)
def biplane(draw: Draw, *, radius, exponent, gap, stagger, triplane) -> Part:
    """A biplane, or rarely a triplane, with struts and fixed gear."""
    plane = fuselage(
        radius,
        tall=1.2,
        nose=0.06,
        nose_power=3.0,
        tail_start=0.35,
        tail_radius=0.2,
        exponent=exponent,
    )
    chord = draw(0.13, 0.18) * (0.8 if triplane else 1)
    half = draw(0.42, 0.58)
    z = draw(0.24, 0.3)
    shape = draw.pick(["straight", "elliptic"])
    plans = []
    for t in np.linspace(0, 1, 3 if triplane else 2):
        reach = half * (1 if t == 1 else draw(0.85, 1.0))
        y = -0.9 * radius + t * (gap + radius)
        plan = Planform(
            half=reach,
            root=chord,
            tip=0.9 * chord,
            sweep_deg=0,
            dihedral_deg=1.5,
            z=z + t * stagger,
            y=y,
            shape=shape,
        )
        plans.append(plan)
        plane += plan.wing()
    bottom, *_, top = plans
    for share in (0.75,) if draw.maybe(0.5) else (0.45, 0.85):
        x = share * bottom.half
        (_, y0, z0, c0), (_, y1, z1, c1) = (plan.at(x / plan.half) for plan in (bottom, top))
        for along in (0.2, 0.7):
            plane += bar((x, y0, z0 - along * c0), (x, y1, z1 - along * c1), 0.013).both_sides()
    for z in (top.z - 0.2 * chord, top.z - 0.7 * chord):
        plane += bar((0.7 * radius, 0.5 * radius, z), (0.08, top.y, z), 0.012).both_sides()
    plane += propeller(draw, draw(0.12, 0.15), 2, hub=0.025).moved(z=0.495) + tail(
        draw, "conventional", radius
    )
    return plane + gear(radius, 2.6 * radius, main_x=0.11, main_z=0.27, other_z=-0.46)


KINDS = {
    airliner: 4.0,
    business_jet: 1.5,
    turboprop: 2.0,
    light_plane: 3.0,
    glider: 1.0,
    fighter: 4.5,
    biplane: 0.8,
}
