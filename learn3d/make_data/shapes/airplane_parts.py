"""Parts of airplanes, nose towards +z: fuselage, wings, tails, engines, propellers, canopy, landing gear."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from learn3d.make_data.shapes.parts import (
    Solid,
    all_moved,
    bar,
    both_sides,
    both_sides_of,
    ellipse,
    ellipsoid,
    rectangle,
    revolve,
    tube,
    wing,
)
from learn3d.make_data.shapes.sampling import maybe


@dataclass(frozen=True)
class Planform:
    """The outline of a wing or stabiliser; lengths in fuselage lengths."""

    half: float  # half of the span
    root: float  # chord in the middle
    tip: float  # chord at the tip
    sweep_deg: float  # of the leading edge, backwards
    dihedral_deg: float  # upwards
    z: float  # of the leading edge in the middle
    y: float  # height in the middle
    kink: float = 0.0  # share of the half span where the trailing edge bends (0: nowhere)
    shape: str = "straight"  # "straight", "elliptic", "kinked" (constant chord, then tapered) or "gull"
    thickness: float = 0.12  # over the chord

    def at(self, share: float) -> tuple[float, float, float, float]:
        """x, y, z of the leading edge and chord at a share (0..1) of the half span."""
        x = share * self.half
        chord = self.root + share * (self.tip - self.root)
        z = self.z - x * np.tan(np.radians(self.sweep_deg))
        y = self.y + x * np.tan(np.radians(self.dihedral_deg))
        if self.kink > 0.0:  # straight trailing edge up to the kink, tapered behind it
            inner = self.root - self.kink * self.half * np.tan(np.radians(self.sweep_deg))
            middle = max(inner, 0.5 * (self.root + self.tip) * 0.8, 1.2 * self.tip)
            chord = np.interp(share, [0, self.kink, 1], [self.root, middle, self.tip])
        elif self.shape == "elliptic":
            chord = self.root * np.sqrt(1 - (0.985 * share) ** 2)
            z = z - 0.3 * (self.root - chord)
        elif self.shape == "kinked":
            chord = np.interp(share, [0, 0.55, 1], [self.root, self.root, self.tip])
        elif self.shape == "gull":
            y = self.y + self.half * (0.05 * np.sin(min(share, 0.35) / 0.35 * np.pi) * -1 + 0.12 * max(share - 0.35, 0))
        return float(x), float(y), float(z), float(chord)


def surface(plan: Planform) -> Solid:
    """The whole wing, tip to tip, in one piece."""
    shares = {0.0, 1.0}
    if plan.kink > 0.0:
        shares |= {plan.kink}
    elif plan.shape == "elliptic":
        shares |= set(np.sin(np.linspace(0, np.pi / 2, 8)).round(4).tolist())
    elif plan.shape == "kinked":
        shares |= {0.55, 0.95}
    elif plan.shape == "gull":
        shares |= {0.09, 0.18, 0.26, 0.35, 0.97}
    right = []
    for share in sorted(shares):
        x, y, z, chord = plan.at(share)
        right.append((x, y, z, chord, plan.thickness))
    return wing([(-x, *rest) for x, *rest in right[:0:-1]] + right)


def fuselage(
    radius: float,
    tall: float = 1.0,
    nose: float = 0.15,
    nose_power: float = 2.0,
    tail_start: float = 0.6,
    tail_power: float = 1.6,
    tail_radius: float = 0.1,
    upsweep: float = 0.3,
    droop: float = 0.0,
    exponent: float = 2.0,
    length: float = 1.0,
) -> Solid:
    """A fuselage along z from +length/2 (nose) to -length/2, `tall` times as high as wide.

    nose is its length as a share of the whole, nose_power its bluntness (1 = cone, 2 = ellipse); upsweep lifts the
    end of the tail and droop lowers the tip of the nose, in radii; tail_radius is what is left of the radius there.
    """
    ahead = np.array([0.0, 0.02, 0.07, 0.16, 0.3, 0.5, 0.75, 1.0])
    behind = np.array([0.15, 0.35, 0.6, 0.85, 1.0])
    t = np.concatenate([nose * ahead, tail_start + (1 - tail_start) * behind])
    front = (1 - (1 - 0.998 * ahead - 0.002) ** nose_power) ** (1 / max(nose_power, 1.0))
    rear = 1 - (1 - tail_radius) * behind**tail_power
    scale = np.concatenate([np.maximum(front, 0.04), rear])
    y = np.concatenate([-droop * (1 - ahead) ** 2, upsweep * behind**1.5]) * radius * tall
    outline = ellipse(2.0 * radius, 2.0 * radius * tall, 16, exponent)
    rings = np.zeros((len(t), 16, 3))
    rings[:, :, :2] = scale[:, None, None] * outline
    rings[:, :, 1] += y[:, None]
    rings[:, :, 2] = (length * (0.5 - t))[:, None]
    return Solid(rings)


def fin(height: float, root: float, tip: float, sweep_deg: float, z: float, thickness: float = 0.09) -> Solid:
    """An upright fin on y = 0, its leading edge starting at z."""
    back = height * np.tan(np.radians(sweep_deg))
    return wing([(0.0, 0.0, z, root, thickness), (height, 0.0, z - back, tip, thickness)], upright=True)


def tail(rng: np.random.Generator, kind: str, radius: float, swept: bool) -> list[Solid]:
    """Fin and stabiliser: "conventional", "cross" (half-way up the fin), "T", "V" or "twin" (fins at the ends)."""
    height = rng.uniform(0.14, 0.21)
    sweep = rng.uniform(28, 45) if swept else rng.uniform(5, 20)
    root, tip = rng.uniform(0.13, 0.19), rng.uniform(0.06, 0.1)
    half, chord = rng.uniform(0.15, 0.22), rng.uniform(0.09, 0.13)
    lean = rng.uniform(25, 38) if swept else rng.uniform(0, 15)
    tip_chord = rng.uniform(0.4, 0.8) * chord
    base, z = 0.25 * radius, -0.5 + root + rng.uniform(-0.01, 0.03)
    if kind == "V":
        side = wing([(0, 0, z - 0.02, root, 0.1), (1.25 * half, 0, z - 0.02 - 0.5 * half * (1 + swept), tip, 0.1)])
        return both_sides(side.rotated("z", rng.uniform(32, 45)).moved(y=base))
    dihedral = rng.uniform(0, 7)
    if kind == "twin":
        plan = Planform(half, chord, 0.95 * chord, 3, dihedral, -0.5 + chord + 0.01, 0.4 * radius)
        x, y, z1, c = plan.at(1.0)
        upright = fin(0.8 * height, 1.2 * c, 0.8 * c, rng.uniform(5, 25), z=z1 + 0.02)
        return [surface(plan), *both_sides(upright.moved(x, y - rng.uniform(0.1, 0.45) * height))]
    solids = [fin(height + base, root, tip, sweep, z).moved(y=0.4 * base)]
    if swept and maybe(rng, 0.4):  # a dorsal fillet
        solids.append(fin(0.45 * height + base, 1.6 * root, 0.5 * root, 62, z + 0.75 * root, 0.04).moved(y=0.4 * base))
    share = {"T": 0.97, "cross": rng.uniform(0.35, 0.6), "conventional": 0.0}[kind]
    level = 0.4 * base + share * (height + base)
    front = z - share * (height + base) * np.tan(np.radians(sweep)) + 0.01
    if share == 0.0:
        front, level = -0.5 + chord + rng.uniform(0.0, 0.04), rng.uniform(0.1, 0.45) * radius
    if kind == "T":
        chord, tip_chord = min(chord, 1.3 * tip), min(tip_chord, 0.9 * tip)
    plan = Planform(half, chord, tip_chord, lean, dihedral if share == 0 else 0.0, front, level, thickness=0.1)
    return [*solids, surface(plan)]


def nacelle(radius: float, length: float) -> list[Solid]:
    """A jet engine along z, centred: an open cowl around a core with a spinner in front and a cone behind."""
    cowl = [(0.78, -0.5), (0.97, -0.1), (1.0, 0.25), (0.95, 0.45), (0.88, 0.5), (0.8, 0.44), (0.8, 0.0), (0.72, -0.48)]
    core = [(0.03, 0.42), (0.2, 0.35), (0.22, 0.3), (0.86, 0.28), (0.86, 0.2), (0.55, 0.1), (0.5, -0.5), (0.1, -0.72)]
    scale = np.array([radius, length])
    return [
        revolve(np.array(cowl) * scale, 14, hollow=True).rotated("x", 90),
        revolve(np.array(core) * scale, 14).rotated("x", 90),
    ]


def engine_pod(rng: np.random.Generator, plan: Planform, share: float, radius: float) -> list[Solid]:
    """A jet engine with its pylon, hung under (and before) the wing at the given share of the half span."""
    x, y, z, chord = plan.at(share)
    length = rng.uniform(3.0, 4.6) * radius
    drop = rng.uniform(1.1, 1.5) * radius
    forward = z + rng.uniform(0.0, 0.3) * length
    pylon = wing(
        [
            (y - drop + 0.6 * radius, x, forward + 0.25 * length, 0.9 * length, 0.08),
            (y, x, z - 0.05 * chord, 0.5 * chord, 0.1),
        ],
        upright=True,
    )
    return [pylon, *all_moved(nacelle(radius, length), x, y - drop, forward)]


def propeller(rng: np.random.Generator, radius: float, blades: int, hub: float) -> list[Solid]:
    """A spinner and `blades` blades in the plane z = 0, turned to a random angle."""
    profile = [(1.0, -1.0), (1.0, 0.0), (0.8, 0.8), (0.4, 1.5), (0.05, 1.8)]
    solids = [revolve([(hub * r, hub * y) for r, y in profile], 10).rotated("x", 90)]
    width = rng.uniform(0.12, 0.2) * radius
    section = rectangle(2.0, 0.5, segments=1)
    turn = rng.uniform(0, 360)
    for k in range(blades):
        path = [(0, 0, 0), (0, 0.35 * radius, 0), (0, 0.75 * radius, 0), (0, radius, 0)]
        blade = tube(path, np.array([0.5, 0.8, 0.8, 0.4]) * width, section, side=(0.9, 0, 0.45))
        solids.append(blade.rotated("z", turn + 360.0 * k / blades))
    return solids


def canopy(width: float, height: float, length: float, center: tuple[float, float, float]) -> Solid:
    """A cockpit bubble, steeper in front than behind."""
    bubble = ellipsoid((width, height, length), sides=12, stacks=8)
    rings = bubble.rings.copy()
    front = rings[..., 2] > 0
    rings[..., 2] *= np.where(front, 0.75, 1.25)
    return Solid(rings).moved(*center)


def winglets(rng: np.random.Generator, plan: Planform) -> list[Solid]:
    """Upturned wing tips."""
    x, y, z, chord = plan.at(1.0)
    height = rng.uniform(0.05, 0.085)
    tip = fin(height, chord, 0.5 * chord, rng.uniform(25, 50), z=z, thickness=0.1)
    return both_sides(tip.rotated("z", -rng.uniform(0, 30)).moved(x - 0.004, y - 0.004))


def landing_gear(
    belly: float, drop: float, main_z: float, other_z: float, main_x: float, taildragger: bool = False
) -> list[Solid]:
    """A main gear at +-main_x and a nose (or tail) wheel, `drop` below the axis of a fuselage of radius `belly`."""
    main = wheel(0.026)
    top = -0.5 * belly
    solids = both_sides(bar((0.4 * main_x, top, main_z), (main_x, -drop, main_z), 0.016))
    solids += both_sides(main.moved(main_x + 0.004, -drop, main_z))
    if taildragger:
        leg = bar((0, 0, other_z), (0, -0.06, other_z - 0.01), 0.014)
        return [*solids, leg, wheel(0.015).moved(y=-0.065, z=other_z - 0.01)]
    return [*solids, bar((0, top, other_z), (0, -drop, other_z), 0.016), main.moved(y=-drop, z=other_z)]


def wheel(radius: float) -> Solid:
    """A wheel about the x axis."""
    t = 0.35 * radius
    return revolve([(0.7 * radius, -t), (radius, -0.6 * t), (radius, 0.6 * t), (0.7 * radius, t)], 12).rotated("z", 90)


def tail_engines(rng: np.random.Generator, radius: float, size: float, z: float) -> list[Solid]:
    """A pair of jet engines on short stubs at the rear fuselage."""
    x, y = 0.8 * radius + 1.1 * size, rng.uniform(0.1, 0.6) * radius
    stub = wing([(0.0, y, z + 0.02, 0.09, 0.12), (x, y, z + 0.01, 0.08, 0.12)])
    return both_sides_of([*all_moved(nacelle(size, rng.uniform(4.0, 5.5) * size), x, y, z), stub])


def streamlined(radius: float, length: float) -> Solid:
    """A drop-shaped body along z, its blunt end forward, centred."""
    t = np.array([0.0, 0.05, 0.15, 0.35, 0.6, 0.85, 1.0])
    r = np.array([0.1, 0.3, 0.6, 0.95, 1.0, 0.85, 0.55]) * radius
    return revolve(np.stack([r, (t - 0.5) * length], 1), 12).rotated("x", 90)


def jet_nozzle(radius: float, length: float) -> Solid:
    """An open jet nozzle along z, centred."""
    profile = [(0.8, -1), (1, 1), (0.9, 1.02), (0.02, 0.9), (0.02, 0.7), (0.8, 0.6), (0.7, -1)]
    outer = [(r * radius, -y * 0.5 * length) for r, y in profile]
    return revolve(outer, 12, hollow=True).rotated("x", -90)
