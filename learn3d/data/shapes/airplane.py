"""Procedural airplanes, fuselage about 1 long: airliners, propeller planes, gliders, fighters, biplanes, flying wings."""

from __future__ import annotations

import numpy as np
import trimesh

from learn3d.data.shapes.airplane_parts import (
    Planform,
    canopy,
    engine_pod,
    fin,
    fuselage,
    landing_gear,
    nacelle,
    propeller,
    surface,
    tail,
    winglets,
)
from learn3d.data.shapes.parts import (
    Solid,
    assemble,
    bar,
    both_sides,
    box,
    ellipse,
    ellipsoid,
    rectangle,
    revolve,
    tube,
    wing,
)
from learn3d.data.shapes.sampling import maybe, pick


def make_airplane(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random airplane."""
    maker = pick(
        rng,
        {
            _airliner: 4.0,
            _business_jet: 1.5,
            _turboprop: 2.0,
            _light_plane: 3.0,
            _glider: 1.0,
            _fighter: 3.0,
            _warbird: 1.5,
            _biplane: 0.8,
            _supersonic: 0.6,
            _flying_wing: 0.6,
            _twin_boom: 0.7,
        },
    )
    return assemble(maker(rng))


def _airliner(rng: np.random.Generator) -> list[Solid]:
    """A jet airliner or freighter: two to four engines under the wings or at the tail."""
    radius = rng.uniform(0.042, 0.068)
    freighter = maybe(rng, 0.25)  # high wing, T-tail, upswept rear
    body = fuselage(
        radius,
        tall=rng.uniform(0.95, 1.15),
        nose=rng.uniform(1.6, 3.0) * radius,
        nose_power=rng.uniform(1.7, 2.2),
        tail_start=rng.uniform(0.58, 0.72),
        upsweep=rng.uniform(0.5, 0.9) if freighter else rng.uniform(0.25, 0.6),
        droop=rng.uniform(0.1, 0.35),
    )
    half, sweep = rng.uniform(0.40, 0.56), rng.uniform(15, 38)
    plan = Planform(
        half=half,
        root=rng.uniform(0.15, 0.21),
        tip=rng.uniform(0.035, 0.07),
        sweep_deg=sweep,
        dihedral_deg=rng.uniform(-4, 0) if freighter else rng.uniform(3, 8),
        z=rng.uniform(0.1, 0.17),
        y=0.8 * radius if freighter else -0.6 * radius,
        kink=rng.uniform(0.25, 0.42) if maybe(rng, 0.7) else 0.0,
    )
    solids = [body, surface(plan)]
    if freighter:
        solids.append(ellipsoid((1.5 * radius, 0.7 * radius, 0.32), (0, 0.85 * radius, plan.z - 0.1)))
    mount = "wing" if freighter else pick(rng, {"wing": 4, "tail": 1, "tail3": 0.5, "wing3": 0.4})
    size = rng.uniform(0.35, 0.58) * radius
    if mount.startswith("wing"):
        count = 2 if maybe(rng, 0.35 if freighter else 0.7) else 4
        size *= 1.25 if count == 2 else 0.9
        for share in (rng.uniform(0.28, 0.4),) if count == 2 else (0.3, rng.uniform(0.55, 0.65)):
            solids += both_sides_of(engine_pod(rng, plan, share, size))
    if mount.startswith("tail"):
        solids += _tail_engines(rng, radius, 0.9 * size, z=rng.uniform(-0.32, -0.24))
    if mount.endswith("3"):
        solids += [part.moved(y=1.35 * radius, z=-0.36) for part in nacelle(0.9 * size, 4.5 * size)]
    kind = "T" if freighter or mount.startswith("tail") else "conventional"
    solids += tail(rng, kind, radius, swept=True)
    if maybe(rng, 0.4):
        solids += winglets(rng, plan)
    if not freighter and maybe(rng, 0.12):  # an upper deck
        solids.append(ellipsoid((1.5 * radius, 1.5 * radius, 0.4), (0, 0.75 * radius, 0.27)))
    if maybe(rng, 0.25):
        solids += landing_gear(radius, radius * rng.uniform(1.5, 2.0), main_z=-0.02, other_z=0.38, main_x=1.2 * radius)
    return solids


def both_sides_of(parts: list[Solid]) -> list[Solid]:
    """The parts and their mirror images."""
    return [solid for part in parts for solid in both_sides(part)]


def _tail_engines(rng: np.random.Generator, radius: float, size: float, z: float) -> list[Solid]:
    """A pair of jet engines on short stubs at the rear fuselage."""
    x, y = 0.8 * radius + 1.1 * size, rng.uniform(0.1, 0.6) * radius
    stub = wing([(0.0, y, z + 0.02, 0.09, 0.12), (x, y, z + 0.01, 0.08, 0.12)])
    return both_sides_of([*[p.moved(x, y, z) for p in nacelle(size, rng.uniform(4.0, 5.5) * size)], stub])


def _business_jet(rng: np.random.Generator) -> list[Solid]:
    """A small jet with engines at the tail."""
    radius = rng.uniform(0.052, 0.075)
    body = fuselage(radius, nose=rng.uniform(0.14, 0.24), nose_power=1.6, tail_start=0.6, upsweep=0.35, droop=0.3)
    plan = Planform(
        half=rng.uniform(0.4, 0.52),
        root=rng.uniform(0.15, 0.2),
        tip=rng.uniform(0.045, 0.07),
        sweep_deg=rng.uniform(2, 34),
        dihedral_deg=rng.uniform(2, 6),
        z=rng.uniform(0.02, 0.08),
        y=-0.75 * radius,
    )
    solids = [body, surface(plan)]
    solids += _tail_engines(rng, radius, rng.uniform(0.026, 0.036), z=-0.2)
    solids += tail(rng, pick(rng, {"T": 3, "cross": 1, "V": 0.4}), radius, swept=True)
    if maybe(rng, 0.5):
        solids += winglets(rng, plan)
    if maybe(rng, 0.25):  # tanks at the wing tips
        x, y, z, chord = plan.at(1.0)
        solids += both_sides(ellipsoid((0.035, 0.035, 0.2), (x, y, z - 0.5 * chord)))
    return solids


def _turboprop(rng: np.random.Generator) -> list[Solid]:
    """A twin or four-engined propeller plane."""
    radius = rng.uniform(0.05, 0.075)
    high = maybe(rng, 0.55)
    body = fuselage(
        radius,
        tall=rng.uniform(0.95, 1.2),
        nose=rng.uniform(0.1, 0.2),
        nose_power=2.0,
        tail_start=rng.uniform(0.5, 0.66),
        upsweep=rng.uniform(0.3, 0.8),
        droop=0.2,
        exponent=pick(rng, (2.0, 2.0, 2.6, 4.0)),
    )
    plan = Planform(
        half=rng.uniform(0.48, 0.62),
        root=rng.uniform(0.11, 0.16),
        tip=rng.uniform(0.05, 0.1),
        sweep_deg=rng.uniform(0, 6),
        dihedral_deg=rng.uniform(0, 6),
        z=rng.uniform(0.08, 0.18),
        y=0.85 * radius if high else -0.65 * radius,
    )
    solids = [body, surface(plan)]
    count = 2 if maybe(rng, 0.65) else 4
    size = rng.uniform(0.02, 0.03)
    blades, disc = int(rng.integers(2, 7)), rng.uniform(0.07, 0.1)
    for share in (rng.uniform(0.26, 0.34),) if count == 2 else (0.27, 0.56):
        x, y, z, chord = plan.at(share)
        long = chord + rng.uniform(0.08, 0.13)
        pod = _streamlined(size, long).moved(x, y - 0.2 * size, z - 0.5 * long + 0.075)
        screw = propeller(rng, disc, blades, hub=0.55 * size)
        solids += both_sides_of([pod, *[p.moved(x, y - 0.2 * size, z + 0.075) for p in screw]])
    kind = pick(rng, {"T": 2, "conventional": 2, "cross": 0.7} if high else {"conventional": 3, "twin": 1.2, "T": 0.6})
    solids += tail(rng, kind, radius, swept=maybe(rng, 0.5))
    if maybe(rng, 0.2):
        solids += landing_gear(radius, 1.8 * radius, main_z=0.02, other_z=0.36, main_x=1.1 * radius)
    return solids


def _streamlined(radius: float, length: float) -> Solid:
    """A drop-shaped body along z, its blunt end forward, centred."""
    t = np.array([0.0, 0.05, 0.15, 0.35, 0.6, 0.85, 1.0])
    r = np.array([0.1, 0.3, 0.6, 0.95, 1.0, 0.85, 0.55]) * radius
    return revolve(np.stack([r, (t - 0.5) * length], 1), 12).rotated("x", 90)


def _light_plane(rng: np.random.Generator) -> list[Solid]:
    """A single-engined light plane; sometimes on floats."""
    radius = rng.uniform(0.065, 0.085)
    high = maybe(rng, 0.55)
    pusher = maybe(rng, 0.1)
    body = fuselage(
        radius,
        tall=rng.uniform(1.05, 1.35),
        nose=rng.uniform(0.08, 0.22),
        nose_power=rng.uniform(2.0, 3.2),
        tail_start=rng.uniform(0.36, 0.48),
        upsweep=rng.uniform(0.0, 0.4),
        tail_radius=rng.uniform(0.15, 0.3),
        exponent=rng.uniform(2.0, 4.5),
    )
    tall = 1.2 * radius
    plan = Planform(
        half=rng.uniform(0.5, 0.72),
        root=rng.uniform(0.14, 0.2),
        tip=rng.uniform(0.09, 0.14),
        sweep_deg=rng.uniform(0, 4),
        dihedral_deg=rng.uniform(0, 3) if high else rng.uniform(3, 8),
        z=rng.uniform(0.16, 0.24),
        y=tall * rng.uniform(1.05, 1.2) if high else -0.7 * tall,
        shape=pick(rng, ("straight", "straight", "elliptic", "kinked")),
    )
    solids = [body, surface(plan)]
    cabin_z = 0.14
    solids.append(
        box((1.5 * radius, 1.1 * tall, 0.2), (0, 0.62 * tall, cabin_z), 0.03)
        if high
        else canopy(1.5 * radius, 1.3 * tall, rng.uniform(0.24, 0.36), (0, 0.72 * tall, 0.1))
    )
    screw_z = -0.515 if pusher else 0.497
    solids += [p.moved(z=screw_z) for p in propeller(rng, rng.uniform(0.11, 0.16), int(rng.integers(2, 4)), hub=0.025)]
    swept = maybe(rng, 0.5)
    solids += tail(rng, pick(rng, {"conventional": 4, "T": 1, "V": 0.6, "cross": 0.5}), radius, swept=swept)
    if high and maybe(rng, 0.6):
        x, y, z, chord = plan.at(rng.uniform(0.4, 0.6))
        strut = bar((0.6 * radius, -0.6 * tall, z - 0.4 * chord), (x, y, z - 0.4 * chord), 0.018, 0.01)
        solids += both_sides(strut)
    if maybe(rng, 0.12):
        solids += _floats(rng, radius, tall)
    elif maybe(rng, 0.75):
        nose = maybe(rng, 0.6)
        solids += landing_gear(
            tall, tall + rng.uniform(0.05, 0.09), 0.03 if nose else 0.25, 0.4 if nose else -0.46, 2.0 * radius, not nose
        )
    return solids


def _floats(rng: np.random.Generator, radius: float, tall: float) -> list[Solid]:
    """A pair of floats on struts."""
    x, y = 2.2 * radius, -tall - rng.uniform(0.08, 0.11)
    hull = fuselage(0.035, nose=0.25, nose_power=1.8, tail_start=0.5, upsweep=0.9, length=rng.uniform(0.65, 0.8))
    parts = [hull.moved(x, y, 0.12)]
    for z in (0.24, 0.02):
        parts.append(bar((0.5 * radius, -0.6 * tall, z), (x, y + 0.02, z), 0.016))
        parts.append(bar((0.0, y + 0.02, z), (x, y + 0.02, z), 0.012))
    return both_sides_of(parts)


def _glider(rng: np.random.Generator) -> list[Solid]:
    """A sailplane: a slender pod and boom under very long wings."""
    radius = rng.uniform(0.042, 0.055)
    body = fuselage(
        radius, tall=1.25, nose=0.26, nose_power=1.8, tail_start=0.33, tail_power=0.75, tail_radius=0.22, upsweep=0.1
    )
    plan = Planform(
        half=rng.uniform(0.9, 1.35),
        root=rng.uniform(0.085, 0.12),
        tip=rng.uniform(0.03, 0.055),
        sweep_deg=rng.uniform(0, 3),
        dihedral_deg=rng.uniform(2, 6),
        z=0.16,
        y=rng.uniform(0.3, 0.9) * radius,
        shape=pick(rng, ("straight", "elliptic", "kinked")),
    )
    solids = [body, surface(plan), canopy(1.5 * radius, 1.6 * radius, 0.26, (0, 0.75 * radius, 0.27))]
    solids += tail(rng, pick(rng, {"T": 3, "conventional": 1, "V": 0.5}), 0.9 * radius, swept=False)
    return solids + (winglets(rng, plan) if maybe(rng, 0.4) else [])


def _fighter(rng: np.random.Generator) -> list[Solid]:
    """A jet fighter: delta, swept or trapezoid wings, one or two fins, canards, stores under the wings."""
    radius = rng.uniform(0.05, 0.068)
    twin = maybe(rng, 0.45)
    body = fuselage(
        radius,
        tall=rng.uniform(0.9, 1.15),
        nose=rng.uniform(0.3, 0.42),
        nose_power=rng.uniform(1.05, 1.4),
        tail_start=0.75,
        tail_radius=rng.uniform(0.65, 0.85),
        exponent=rng.uniform(2.0, 3.2),
    )
    shape = pick(rng, {"delta": 2.5, "swept": 2, "trapezoid": 2, "forward": 0.3})
    root, tip, sweep, z = {
        "delta": (rng.uniform(0.42, 0.52), rng.uniform(0.02, 0.06), rng.uniform(46, 58), 0.1),
        "swept": (rng.uniform(0.2, 0.28), rng.uniform(0.08, 0.12), rng.uniform(35, 50), 0.12),
        "trapezoid": (rng.uniform(0.28, 0.38), rng.uniform(0.06, 0.1), rng.uniform(25, 42), 0.06),
        "forward": (rng.uniform(0.22, 0.28), 0.1, rng.uniform(-28, -18), -0.08),
    }[shape]
    half = rng.uniform(0.3, 0.4) if shape != "delta" else min(rng.uniform(0.28, 0.4), 0.9 * root / np.tan(np.radians(sweep)))
    plan = Planform(half, root, tip, sweep, rng.uniform(-5, 2), z, rng.uniform(-0.3, 0.6) * radius, thickness=0.06)
    solids = [body, surface(plan)]
    solids.append(canopy(0.9 * radius, 1.1 * radius, rng.uniform(0.18, 0.28), (0, 0.8 * radius, rng.uniform(0.15, 0.22))))
    if twin:  # two engine tunnels with ramp intakes and nozzles
        wide = rng.uniform(0.8, 1.25) * radius
        rings = []
        for z0, w, h, y in ((0.14, 0.9, 1.3, -0.3), (0.0, 1.0, 1.4, -0.2), (-0.3, 1.0, 1.3, 0), (-0.48, 0.8, 0.9, 0.1)):
            outline = rectangle(w * wide, h * wide, 0.3 * wide, 2)
            shear = 0.05 * (outline[:, 1] / wide) if z0 > 0.1 else 0.0 * outline[:, 1]
            rings.append(np.stack([wide + outline[:, 0], y * wide + outline[:, 1], z0 + shear], 1))
        nozzle = _nozzle(0.42 * wide, 0.07).moved(wide, 0.08 * wide, -0.5)
        solids += both_sides_of([Solid(np.stack(rings)), nozzle])
    else:
        kind = pick(rng, ("side", "chin", "nose"))
        if kind == "chin":
            solids.append(box((1.2 * radius, 0.9 * radius, 0.3), (0, -0.9 * radius, 0.06), 0.02))
        elif kind == "side":
            side = box((0.8 * radius, 1.2 * radius, 0.34), (0.95 * radius, 0.1 * radius, 0.03), 0.02)
            solids += both_sides(side)
        solids.append(_nozzle(0.75 * radius, 0.08).moved(z=-0.52))
    base = plan.root
    if maybe(rng, 0.55) if twin else maybe(rng, 0.1):
        cant, x = rng.uniform(0, 25), rng.uniform(0.9, 1.4) * radius
        height = rng.uniform(0.13, 0.19)
        solids += both_sides(fin(height, 0.19, 0.08, rng.uniform(30, 45), z=-0.27).rotated("z", -cant).moved(x, 0.3 * radius))
    else:
        height = rng.uniform(0.17, 0.25)
        solids.append(fin(height + 0.6 * radius, rng.uniform(0.2, 0.3), 0.09, rng.uniform(35, 52), z=-0.2).moved(y=0.3 * radius))
    if shape == "delta":
        if maybe(rng, 0.5):
            canard = Planform(rng.uniform(0.15, 0.2), 0.11, 0.04, 45, 4, 0.24, 0.35 * radius, thickness=0.06)
            solids.append(surface(canard))
    else:
        stabiliser = Planform(rng.uniform(0.17, 0.23), 0.15, 0.06, rng.uniform(30, 45), -3, -0.34, 0.0, thickness=0.06)
        solids.append(surface(stabiliser))
        if maybe(rng, 0.4):  # strakes from the wing root towards the nose
            strake = wing([(0.0, plan.y, z + 0.2, base + 0.1, 0.05), (2.0 * radius, plan.y, z - 0.03, 0.7 * base, 0.05)])
            solids += both_sides(strake)
    for share in sorted(set(rng.choice([0.4, 0.6, 0.8, 1.0], int(rng.integers(0, 4))))):
        x, y, z1, chord = plan.at(float(share))
        store = ellipsoid((0.022, 0.022, rng.uniform(0.14, 0.26)), (x, y - (0.026 if share < 1 else 0), z1 - 0.4 * chord), 8, 6)
        pylon = box((0.01, 0.03, 0.06), (x, y - 0.012, z1 - 0.45 * chord))
        solids += both_sides_of([store, pylon] if share < 1 else [store])
    return solids


def _nozzle(radius: float, length: float) -> Solid:
    """An open jet nozzle along z, centred."""
    profile = [(0.8, -1), (1, 1), (0.9, 1.02), (0.02, 0.9), (0.02, 0.7), (0.8, 0.6), (0.7, -1)]
    outer = [(r * radius, -y * 0.5 * length) for r, y in profile]
    return revolve(outer, 12, hollow=True).rotated("x", -90)


def _warbird(rng: np.random.Generator) -> list[Solid]:
    """A propeller fighter or a twin-engined bomber of the 1940s."""
    radius = rng.uniform(0.058, 0.08)
    twin = maybe(rng, 0.35)
    radial = maybe(rng, 0.4)
    body = fuselage(
        radius,
        tall=rng.uniform(1.1, 1.3),
        nose=0.07 if radial and not twin else rng.uniform(0.12, 0.25),
        nose_power=3.0 if radial else 2.0,
        tail_start=rng.uniform(0.4, 0.5),
        tail_radius=0.15,
        upsweep=0.35,
    )
    plan = Planform(
        half=rng.uniform(0.5, 0.66),
        root=rng.uniform(0.19, 0.25),
        tip=rng.uniform(0.07, 0.12),
        sweep_deg=rng.uniform(2, 9),
        dihedral_deg=rng.uniform(3, 7),
        z=rng.uniform(0.14, 0.2),
        y=rng.uniform(-0.8, 0.2) * radius,
        shape=pick(rng, ("elliptic", "straight", "gull")),
    )
    solids = [body, surface(plan)]
    solids.append(canopy(0.95 * radius, 1.2 * radius, rng.uniform(0.16, 0.34), (0, 1.05 * radius, rng.uniform(-0.02, 0.1))))
    disc = rng.uniform(0.12, 0.16)
    if twin:
        x, y, z, chord = plan.at(0.32)
        pod = _streamlined(0.04, chord + 0.15).moved(x, y, z - 0.5 * chord + 0.0)
        solids += both_sides_of([pod, *[p.moved(x, y, z + 0.075) for p in propeller(rng, disc, 3, hub=0.022)]])
    else:
        solids += [p.moved(z=0.495) for p in propeller(rng, disc, int(rng.integers(2, 5)), hub=0.032)]
    solids += tail(rng, "twin" if twin and maybe(rng, 0.5) else "conventional", radius, swept=False)
    if maybe(rng, 0.3):
        solids += landing_gear(0.8 * radius, radius + 0.1, 0.2, -0.46, 0.16, True)
    return solids


def _biplane(rng: np.random.Generator) -> list[Solid]:
    """A biplane, or rarely a triplane, with struts and fixed gear."""
    radius = rng.uniform(0.06, 0.075)
    body = fuselage(radius, tall=1.2, nose=0.06, nose_power=3.0, tail_start=0.35, tail_radius=0.2, exponent=rng.uniform(2, 5))
    gap, stagger = rng.uniform(0.16, 0.22), rng.uniform(-0.03, 0.1)
    decks = 3 if maybe(rng, 0.2) else 2
    chord, half = rng.uniform(0.13, 0.18) * (0.8 if decks == 3 else 1), rng.uniform(0.42, 0.58)
    z, low = rng.uniform(0.24, 0.3), -0.9 * radius
    shape = pick(rng, ("straight", "elliptic"))
    plans = []
    for k in range(decks):
        t = k / (decks - 1)
        reach = half * (1 if k == decks - 1 else rng.uniform(0.85, 1.0))
        plans.append(Planform(reach, chord, 0.9 * chord, 0, 1.5, z + t * stagger, low + t * (gap + radius), shape=shape))
    solids = [body, *[surface(p) for p in plans]]
    shares = (0.75,) if maybe(rng, 0.5) else (0.45, 0.85)
    for share in shares:
        for along in (0.2, 0.7):
            ends = []
            for plan in (plans[0], plans[-1]):
                _, y, z1, c = plan.at(share * plans[0].half / plan.half)
                ends.append((share * plans[0].half, y, z1 - along * c))
            solids += both_sides(bar(*ends, 0.013))
    top = plans[-1]
    for along in (0.2, 0.7):
        solids += both_sides(bar((0.7 * radius, 0.5 * radius, top.z - along * chord), (0.08, top.y, top.z - along * chord), 0.012))
    solids += [p.moved(z=0.495) for p in propeller(rng, rng.uniform(0.12, 0.15), 2, hub=0.025)]
    solids += tail(rng, "conventional", radius, swept=False)
    solids += landing_gear(radius, 2.6 * radius, 0.27, -0.46, 0.11, True)
    return solids


def _supersonic(rng: np.random.Generator) -> list[Solid]:
    """A supersonic transport or delta bomber: a needle on a long delta, engine boxes below."""
    radius = rng.uniform(0.024, 0.036)
    body = fuselage(radius, nose=rng.uniform(0.2, 0.3), nose_power=1.15, tail_start=0.72, tail_radius=0.1, droop=0.3)
    half, root = rng.uniform(0.2, 0.3), rng.uniform(0.5, 0.62)
    z, y = 0.2, -0.6 * radius
    t = np.linspace(0, 1, 7)
    lead = z - root * (0.95 - rng.uniform(0.0, 0.12) * (1 - t)) * t ** rng.uniform(0.7, 1.05)
    trail = z - root - 0.03 * t
    right = [(half * s, y, a, max(a - b, 0.03), 0.035) for s, a, b in zip(t, lead, trail, strict=True)]
    left = [(-s, *rest) for s, *rest in right[:0:-1]]
    solids = [body, wing(left + right)]
    for x in (0.3, 0.45) if maybe(rng, 0.6) else (0.4,):
        solids += both_sides(box((0.035, 0.035, 0.22), (x * half, y - 0.018, z - root + 0.08), 0.006))
    solids.append(fin(rng.uniform(0.1, 0.16), 0.26, 0.07, 55, z=-0.2))
    if maybe(rng, 0.4):
        solids.append(surface(Planform(0.1, 0.08, 0.03, 45, 0, 0.33, 0.3 * radius, thickness=0.05)))
    return solids


def _flying_wing(rng: np.random.Generator) -> list[Solid]:
    """A flying wing with a faired body; jets, buried intakes or pusher propellers; perhaps fins."""
    sweep, half = rng.uniform(22, 40), rng.uniform(0.55, 0.8)
    root, tip = rng.uniform(0.34, 0.5), rng.uniform(0.05, 0.14)
    plan = Planform(half, root, tip, sweep, rng.uniform(0, 4), 0.2, 0.0, rng.uniform(0.25, 0.4), thickness=0.13)
    solids = [surface(plan)]
    bulge = ellipsoid((rng.uniform(0.12, 0.2), rng.uniform(0.1, 0.15), 1.15 * root), (0, 0.015, 0.2 - 0.48 * root))
    solids += [bulge]
    kind = pick(rng, ("humps", "props", "pods"))
    for share in (0.2,) if maybe(rng, 0.5) else (0.17, 0.33):
        x, y, z, chord = plan.at(share)
        if kind == "humps":
            solids += both_sides(ellipsoid((0.09, 0.07, 0.8 * chord), (x, y + 0.02, z - 0.45 * chord)))
        elif kind == "pods":
            pods = [p.moved(x, y + 0.045, z - 0.6 * chord) for p in nacelle(0.03, 0.14)]
            solids += both_sides_of(pods)
        else:
            pod = _streamlined(0.022, 0.2).rotated("y", 180).moved(x, y, z - chord + 0.05)
            screw = [p.moved(x, y, z - chord - 0.05) for p in propeller(rng, 0.09, 3, hub=0.014)]
            solids += both_sides_of([pod, *screw])
    if maybe(rng, 0.4):
        x, y, z, chord = plan.at(0.97)
        upright = fin(rng.uniform(0.08, 0.14), max(chord, 0.09), 0.05, 35, z=z)
        solids += both_sides(upright.moved(x, y - 0.02))
    return solids


def _twin_boom(rng: np.random.Generator) -> list[Solid]:
    """A central pod between two booms that carry the tail."""
    radius, x = rng.uniform(0.05, 0.07), rng.uniform(0.14, 0.22)
    pod = fuselage(radius, tall=1.15, nose=0.2, nose_power=1.8, tail_start=0.5, tail_radius=0.35, length=rng.uniform(0.42, 0.6))
    plan = Planform(
        half=rng.uniform(0.55, 0.75),
        root=rng.uniform(0.16, 0.21),
        tip=rng.uniform(0.06, 0.11),
        sweep_deg=rng.uniform(0, 6),
        dihedral_deg=rng.uniform(1, 5),
        z=0.14,
        y=0.0,
    )
    solids = [pod.moved(z=0.12), surface(plan), canopy(1.1 * radius, 1.4 * radius, 0.24, (0, 0.8 * radius, 0.16))]
    _, y, z, _ = plan.at(x / plan.half)
    thick = rng.uniform(0.024, 0.036)
    front = z + (0.1 if maybe(rng, 0.7) else 0.0)
    path = [(x, y, front - s * (front + 0.5)) for s in (0, 0.04, 0.12, 0.3, 0.6, 1)]
    size = np.array([0.3, 0.7, 1.0, 1.0, 0.6, 0.4]) * thick
    parts = [tube(path, size, ellipse(2, 2, 10))]
    if front > z:
        parts += [p.moved(x, y, front) for p in propeller(rng, min(0.12, 0.75 * x), 3, hub=0.02)]
    else:
        solids += [p.moved(z=-0.2) for p in propeller(rng, min(0.1, 0.7 * x), 3, hub=0.03)]
        solids.append(revolve([(0.03, -0.1), (0.03, 0.1)], 10).rotated("x", 90).moved(z=-0.11))
    height = rng.uniform(0.12, 0.18)
    parts.append(fin(height, 0.12, 0.07, rng.uniform(5, 30), z=-0.38).moved(x, y - 0.02))
    level = y + rng.uniform(0.0, 0.95) * height - 0.02
    drift = 0.35 * (level - y)
    solids.append(wing([(-1.1 * x, level, -0.39 - drift, 0.09, 0.1), (1.1 * x, level, -0.39 - drift, 0.09, 0.1)]))
    return solids + both_sides_of(parts)
