"""Parts of airplanes, in lengths of the fuselage, nose towards +z: fuselages, wings, tails, engines, landing gear."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .draw import Draw
from .parts import Part, bar, ellipse, ellipsoid, loft, rectangle, revolve, tube, wing

# Shares of the half span at which a wing of each shape has a section, in addition to its middle and its tip.
_STATIONS = {
    "straight": [],
    "elliptic": np.sin(np.linspace(0, np.pi / 2, 8)).round(4).tolist(),
    "kinked": [0.55, 0.95],
    "gull": [0.09, 0.18, 0.26, 0.35, 0.97],
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
    kink: float = 0.0  # share of the half span at which the trailing edge bends; 0 for a straight one
    shape: str = "straight"  # "straight", "elliptic", "kinked" (constant chord, then tapered) or "gull"
    thickness: float = 0.12  # thickness over chord

    def at(self, share: float) -> tuple[float, float, float, float]:
        """x, y, z of the leading edge and chord at a share (0..1) of the half span."""
        x = share * self.half
        slope = np.tan(np.radians(self.sweep_deg))
        y, z = self.y + x * np.tan(np.radians(self.dihedral_deg)), self.z - x * slope
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
        elif self.shape == "gull":
            bend, rise = np.sin(min(share, 0.35) / 0.35 * np.pi), max(share - 0.35, 0)
            y = self.y + self.half * (-0.05 * bend + 0.12 * rise)
        return float(x), float(y), float(z), float(chord)

    def wing(self) -> Part:
        """The whole wing, tip to tip, in one piece."""
        shares = {0.0, 1.0, *([self.kink] if self.kink > 0.0 else _STATIONS[self.shape])}
        return wing([(*self.at(share), self.thickness) for share in sorted(shares)], whole=True)

    def engines(self, draw: Draw, share: float, radius: float) -> Part:
        """Jet engines with their pylons, hung under (and before) both wings at a share of the half span."""
        x, y, z, chord = self.at(share)
        length = draw(3.0, 4.6) * radius
        drop = draw(1.1, 1.5) * radius
        forward = z + draw(0.0, 0.3) * length
        lower = (y - drop + 0.6 * radius, x, forward + 0.25 * length, 0.9 * length, 0.08)
        pylon = wing([lower, (y, x, z - 0.05 * chord, 0.5 * chord, 0.1)], upright=True)
        return (pylon + nacelle(radius, length).moved(x, y - drop, forward)).both_sides()

    def winglets(self, draw: Draw) -> Part:
        """Upturned wing tips."""
        x, y, z, chord = self.at(1.0)
        tip = fin(draw(0.05, 0.085), chord, 0.5 * chord, draw(25, 50), z=z, thickness=0.1)
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

    The nose ends at the share `nose` of the length, and the tail begins at the share `tail_start`. nose_power is the
    bluntness of the nose: 1 for a cone, 2 for an ellipse. upsweep lifts the end of the tail and droop lowers the tip of
    the nose, both in radii. tail_radius is the radius at the end, in radii. exponent is that of `ellipse`.
    """
    ahead = np.array([0.0, 0.02, 0.07, 0.16, 0.3, 0.5, 0.75, 1.0])
    behind = np.array([0.15, 0.35, 0.6, 0.85, 1.0])
    front = (1 - (1 - 0.998 * ahead - 0.002) ** nose_power) ** (1 / max(nose_power, 1.0))
    scale = np.concatenate([np.maximum(front, 0.04), 1 - (1 - tail_radius) * behind**tail_power])
    y = np.concatenate([-droop * (1 - ahead) ** 2, upsweep * behind**1.5]) * radius * tall
    z = length * (0.5 - np.concatenate([nose * ahead, tail_start + (1 - tail_start) * behind]))
    outline = scale[:, None, None] * ellipse(2.0 * radius, 2.0 * radius * tall, 16, exponent)
    return loft(np.stack([outline[..., 0], outline[..., 1] + y[:, None], np.repeat(z[:, None], 16, 1)], 2))


def fin(height: float, root: float, tip: float, sweep_deg: float, z: float, thickness: float = 0.09) -> Part:
    """An upright fin on y = 0, its leading edge starting at z."""
    back = height * np.tan(np.radians(sweep_deg))
    return wing([(0.0, 0.0, z, root, thickness), (height, 0.0, z - back, tip, thickness)], upright=True)


def tail(draw: Draw, kind: str, radius: float, swept: bool = False) -> Part:
    """Fin and stabiliser of a kind: "conventional", "cross" (stabiliser half-way up the fin), "T", "V" or "twin"."""
    height = draw(0.14, 0.21)
    sweep = draw(28, 45) if swept else draw(5, 20)
    root, tip = draw(0.13, 0.19), draw(0.06, 0.1)
    half, chord = draw(0.15, 0.22), draw(0.09, 0.13)
    lean = draw(25, 38) if swept else draw(0, 15)
    tip_chord = draw(0.4, 0.8) * chord
    base, z = 0.25 * radius, -0.5 + root + draw(-0.01, 0.03)
    if kind == "V":
        side = wing([(0, 0, z - 0.02, root, 0.1), (1.25 * half, 0, z - 0.02 - 0.5 * half * (1 + swept), tip, 0.1)])
        return side.rotated("z", draw(32, 45)).moved(y=base).both_sides()
    dihedral = draw(0, 7)
    if kind == "twin":
        plan = Planform(half, chord, 0.95 * chord, 3, dihedral, -0.5 + chord + 0.01, 0.4 * radius)
        x, y, z1, c = plan.at(1.0)
        upright = fin(0.8 * height, 1.2 * c, 0.8 * c, draw(5, 25), z=z1 + 0.02)
        return plan.wing() + upright.moved(x, y - draw(0.1, 0.45) * height).both_sides()
    part = fin(height + base, root, tip, sweep, z).moved(y=0.4 * base)
    if swept and draw.maybe(0.4):  # a dorsal fillet
        part += fin(0.45 * height + base, 1.6 * root, 0.5 * root, 62, z + 0.75 * root, 0.04).moved(y=0.4 * base)
    share = {"T": 0.97, "cross": draw(0.35, 0.6), "conventional": 0.0}[kind]
    level = 0.4 * base + share * (height + base)
    front = z - share * (height + base) * np.tan(np.radians(sweep)) + 0.01
    if share == 0.0:
        front, level = -0.5 + chord + draw(0.0, 0.04), draw(0.1, 0.45) * radius
    if kind == "T":
        chord, tip_chord = min(chord, 1.3 * tip), min(tip_chord, 0.9 * tip)
    dihedral = dihedral if share == 0 else 0.0
    return part + Planform(half, chord, tip_chord, lean, dihedral, front, level, thickness=0.1).wing()


def along_z(profile: list[tuple[float, float]], radius: float, length: float, sides: int, hollow: bool = False) -> Part:
    """The solid of revolution about the z axis of a profile [(share of the radius, share of the length)]."""
    return revolve(np.array(profile) * [radius, length], sides, hollow).rotated("x", 90)


def nacelle(radius: float, length: float) -> Part:
    """A jet engine along z, centred: an open cowl around a core with a spinner in front and a cone behind."""
    cowl = [(0.78, -0.5), (0.97, -0.1), (1.0, 0.25), (0.95, 0.45), (0.88, 0.5), (0.8, 0.44), (0.8, 0.0), (0.72, -0.48)]
    core = [(0.03, 0.42), (0.2, 0.35), (0.22, 0.3), (0.86, 0.28), (0.86, 0.2), (0.55, 0.1), (0.5, -0.5), (0.1, -0.72)]
    return along_z(cowl, radius, length, 14, hollow=True) + along_z(core, radius, length, 14)


def tail_engines(draw: Draw, radius: float, size: float, z: float) -> Part:
    """A pair of jet engines on short stubs at the rear fuselage."""
    x, y = 0.8 * radius + 1.1 * size, draw(0.1, 0.6) * radius
    stub = wing([(0.0, y, z + 0.02, 0.09, 0.12), (x, y, z + 0.01, 0.08, 0.12)])
    return (nacelle(size, draw(4.0, 5.5) * size).moved(x, y, z) + stub).both_sides()


def propeller(draw: Draw, radius: float, blades: int, hub: float) -> Part:
    """A spinner and `blades` blades in the plane z = 0, turned to a random angle."""
    part = along_z([(1.0, -1.0), (1.0, 0.0), (0.8, 0.8), (0.4, 1.5), (0.05, 1.8)], hub, hub, 10)
    width = np.array([0.5, 0.8, 0.8, 0.4]) * (draw(0.12, 0.2) * radius)
    path = [(0, share * radius, 0) for share in (0, 0.35, 0.75, 1)]
    blade = tube(path, width, rectangle(2.0, 0.5, segments=1), side=(0.9, 0, 0.45))
    turn = draw(0, 360)
    for k in range(blades):
        part += blade.rotated("z", turn + 360.0 * k / blades)
    return part


def pod(radius: float, length: float) -> Part:
    """A drop-shaped body along z, its blunt end forward, centred."""
    profile = np.array([(0.1, 0), (0.3, 0.05), (0.6, 0.15), (0.95, 0.35), (1.0, 0.6), (0.85, 0.85), (0.55, 1)])
    return along_z(profile - [0, 0.5], radius, length, 12)


def nozzle(radius: float, length: float) -> Part:
    """An open jet nozzle along z, centred."""
    profile = [(0.8, -1), (1, 1), (0.9, 1.02), (0.02, 0.9), (0.02, 0.7), (0.8, 0.6), (0.7, -1)]
    return revolve(np.array(profile) * [radius, -0.5 * length], 12, hollow=True).rotated("x", -90)


def canopy(width: float, height: float, length: float, y: float, z: float) -> Part:
    """A cockpit bubble about (0, y, z), steeper in front than behind."""
    rings = ellipsoid((width, height, length), sides=12, stacks=8).lofts[0].rings
    stretch = np.where(rings[..., 2:] > 0, 0.75, 1.25)
    return loft(rings * np.concatenate([np.ones_like(rings[..., :2]), stretch], 2)).moved(0, y, z)


def gear(belly: float, drop: float, main_x: float, main_z: float, other_z: float) -> Part:
    """A main gear at x = +-main_x, and a nose wheel or, if other_z < main_z, a tail wheel.

    drop: depth of the wheels below the axis of the fuselage. belly: radius of the fuselage at the gear.
    """
    main, top = _wheel(0.026), -0.5 * belly
    part = bar((0.4 * main_x, top, main_z), (main_x, -drop, main_z), 0.016).both_sides()
    part += main.moved(main_x + 0.004, -drop, main_z).both_sides()
    if other_z < main_z:
        leg = bar((0, 0, other_z), (0, -0.06, other_z - 0.01), 0.014)
        return part + leg + _wheel(0.015).moved(y=-0.065, z=other_z - 0.01)
    return part + bar((0, top, other_z), (0, -drop, other_z), 0.016) + main.moved(y=-drop, z=other_z)


def _wheel(radius: float) -> Part:
    t = 0.35 * radius
    return revolve([(0.7 * radius, -t), (radius, -0.6 * t), (radius, 0.6 * t), (0.7 * radius, t)], 12).rotated("z", 90)
