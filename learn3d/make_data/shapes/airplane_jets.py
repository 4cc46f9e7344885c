"""Jet airplanes, fuselage about 1 long: airliners, freighters, business jets, fighters, deltas, flying wings."""

from __future__ import annotations

import numpy as np

from learn3d.make_data.shapes.airplane_parts import (
    Planform,
    canopy,
    engine_pod,
    fin,
    fuselage,
    jet_nozzle,
    landing_gear,
    nacelle,
    propeller,
    streamlined,
    surface,
    tail,
    tail_engines,
    winglets,
)
from learn3d.make_data.shapes.parts import (
    Solid,
    all_moved,
    both_sides,
    both_sides_of,
    box,
    ellipsoid,
    rectangle,
    wing,
)
from learn3d.make_data.shapes.sampling import drawn, maybe, pick


def airliner(rng: np.random.Generator) -> list[Solid]:
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
        solids += tail_engines(rng, radius, 0.9 * size, z=rng.uniform(-0.32, -0.24))
    if mount.endswith("3"):
        solids += all_moved(nacelle(0.9 * size, 4.5 * size), y=1.35 * radius, z=-0.36)
    kind = "T" if freighter or mount.startswith("tail") else "conventional"
    solids += tail(rng, kind, radius, swept=True)
    if maybe(rng, 0.4):
        solids += winglets(rng, plan)
    if not freighter and maybe(rng, 0.12):  # an upper deck
        solids.append(ellipsoid((1.5 * radius, 1.5 * radius, 0.4), (0, 0.75 * radius, 0.27)))
    if maybe(rng, 0.25):
        solids += landing_gear(radius, radius * rng.uniform(1.5, 2.0), main_z=-0.02, other_z=0.38, main_x=1.2 * radius)
    return solids


def business_jet(rng: np.random.Generator) -> list[Solid]:
    """A small jet with engines at the tail."""
    radius = rng.uniform(0.052, 0.075)
    body = fuselage(radius, nose=rng.uniform(0.14, 0.24), nose_power=1.6, tail_start=0.6, upsweep=0.35, droop=0.3)
    size = drawn(rng, half=(0.4, 0.52), root=(0.15, 0.2), tip=(0.045, 0.07), sweep_deg=(2, 34), dihedral_deg=(2, 6))
    plan = Planform(**size, z=rng.uniform(0.02, 0.08), y=-0.75 * radius)
    solids = [body, surface(plan)]
    solids += tail_engines(rng, radius, rng.uniform(0.026, 0.036), z=-0.2)
    solids += tail(rng, pick(rng, {"T": 3, "cross": 1, "V": 0.4}), radius, swept=True)
    if maybe(rng, 0.5):
        solids += winglets(rng, plan)
    if maybe(rng, 0.25):  # tanks at the wing tips
        x, y, z, chord = plan.at(1.0)
        solids += both_sides(ellipsoid((0.035, 0.035, 0.2), (x, y, z - 0.5 * chord)))
    return solids


def fighter(rng: np.random.Generator) -> list[Solid]:
    """A jet fighter: delta, swept or trapezoid wings, one or two fins, canards, stores under the wings."""
    radius = rng.uniform(0.05, 0.068)
    twin = maybe(rng, 0.45)
    form = drawn(rng, tall=(0.9, 1.15), nose=(0.3, 0.42), nose_power=(1.05, 1.4), tail_start=0.75)
    body = fuselage(radius, **form, tail_radius=rng.uniform(0.65, 0.85), exponent=rng.uniform(2.0, 3.2))
    shape = pick(rng, {"delta": 2.5, "swept": 2, "trapezoid": 2, "forward": 0.3})
    root, tip, sweep, z = {
        "delta": (rng.uniform(0.42, 0.52), rng.uniform(0.02, 0.06), rng.uniform(46, 58), 0.1),
        "swept": (rng.uniform(0.2, 0.28), rng.uniform(0.08, 0.12), rng.uniform(35, 50), 0.12),
        "trapezoid": (rng.uniform(0.28, 0.38), rng.uniform(0.06, 0.1), rng.uniform(25, 42), 0.06),
        "forward": (rng.uniform(0.22, 0.28), 0.1, rng.uniform(-28, -18), -0.08),
    }[shape]
    if shape == "delta":
        half = min(rng.uniform(0.28, 0.4), 0.9 * root / np.tan(np.radians(sweep)))
    else:
        half = rng.uniform(0.3, 0.4)
    plan = Planform(half, root, tip, sweep, rng.uniform(-5, 2), z, rng.uniform(-0.3, 0.6) * radius, thickness=0.06)
    solids = [body, surface(plan)]
    solids.append(
        canopy(0.9 * radius, 1.1 * radius, rng.uniform(0.18, 0.28), (0, 0.8 * radius, rng.uniform(0.15, 0.22)))
    )
    solids += _twin_engines(rng, radius) if twin else _single_engine(rng, radius)
    if maybe(rng, 0.55) if twin else maybe(rng, 0.1):
        cant, x = rng.uniform(0, 25), rng.uniform(0.9, 1.4) * radius
        height = rng.uniform(0.13, 0.19)
        solids += both_sides(
            fin(height, 0.19, 0.08, rng.uniform(30, 45), z=-0.27).rotated("z", -cant).moved(x, 0.3 * radius)
        )
    else:
        height = rng.uniform(0.17, 0.25)
        solids.append(
            fin(height + 0.6 * radius, rng.uniform(0.2, 0.3), 0.09, rng.uniform(35, 52), z=-0.2).moved(y=0.3 * radius)
        )
    if shape == "delta":
        if maybe(rng, 0.5):
            canard = Planform(rng.uniform(0.15, 0.2), 0.11, 0.04, 45, 4, 0.24, 0.35 * radius, thickness=0.06)
            solids.append(surface(canard))
    else:
        stabiliser = Planform(rng.uniform(0.17, 0.23), 0.15, 0.06, rng.uniform(30, 45), -3, -0.34, 0.0, thickness=0.06)
        solids.append(surface(stabiliser))
        if maybe(rng, 0.4):  # strakes from the wing root towards the nose
            strake = wing(
                [(0.0, plan.y, z + 0.2, root + 0.1, 0.05), (2.0 * radius, plan.y, z - 0.03, 0.7 * root, 0.05)]
            )
            solids += both_sides(strake)
    return solids + _stores(rng, plan)


def _twin_engines(rng: np.random.Generator, radius: float) -> list[Solid]:
    """Two tunnels beside the fuselage, each with a slanted intake and a nozzle."""
    wide = rng.uniform(0.8, 1.25) * radius
    rings = []
    for z, w, h, y in ((0.14, 0.9, 1.3, -0.3), (0.0, 1.0, 1.4, -0.2), (-0.3, 1.0, 1.3, 0), (-0.48, 0.8, 0.9, 0.1)):
        outline = rectangle(w * wide, h * wide, 0.3 * wide, 2)
        slant = 0.05 * (outline[:, 1] / wide) if z > 0.1 else 0.0 * outline[:, 1]
        rings.append(np.stack([wide + outline[:, 0], y * wide + outline[:, 1], z + slant], 1))
    nozzle = jet_nozzle(0.42 * wide, 0.07).moved(wide, 0.08 * wide, -0.5)
    return both_sides_of([Solid(np.stack(rings)), nozzle])


def _single_engine(rng: np.random.Generator, radius: float) -> list[Solid]:
    """A nozzle at the rear, with an intake at the chin, on both sides, or in the nose, where it does not show."""
    intakes = {
        "side": both_sides(box((0.8 * radius, 1.2 * radius, 0.34), (0.95 * radius, 0.1 * radius, 0.03), 0.02)),
        "chin": [box((1.2 * radius, 0.9 * radius, 0.3), (0, -0.9 * radius, 0.06), 0.02)],
        "nose": [],
    }
    return [*intakes[pick(rng, tuple(intakes))], jet_nozzle(0.75 * radius, 0.08).moved(z=-0.52)]


def _stores(rng: np.random.Generator, plan: Planform) -> list[Solid]:
    """Up to three tanks or missiles under each wing, or at its tip."""
    solids = []
    for share in sorted(set(rng.choice([0.4, 0.6, 0.8, 1.0], int(rng.integers(0, 4))))):
        x, y, z, chord = plan.at(float(share))
        size, at_tip = (0.022, 0.022, rng.uniform(0.14, 0.26)), share == 1
        store = ellipsoid(size, (x, y - (0 if at_tip else 0.026), z - 0.4 * chord), 8, 6)
        pylon = box((0.01, 0.03, 0.06), (x, y - 0.012, z - 0.45 * chord))
        solids += both_sides_of([store] if at_tip else [store, pylon])
    return solids


def supersonic(rng: np.random.Generator) -> list[Solid]:
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


def flying_wing(rng: np.random.Generator) -> list[Solid]:
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
            pods = all_moved(nacelle(0.03, 0.14), x, y + 0.045, z - 0.6 * chord)
            solids += both_sides_of(pods)
        else:
            pod = streamlined(0.022, 0.2).rotated("y", 180).moved(x, y, z - chord + 0.05)
            screw = all_moved(propeller(rng, 0.09, 3, hub=0.014), x, y, z - chord - 0.05)
            solids += both_sides_of([pod, *screw])
    if maybe(rng, 0.4):
        x, y, z, chord = plan.at(0.97)
        upright = fin(rng.uniform(0.08, 0.14), max(chord, 0.09), 0.05, 35, z=z)
        solids += both_sides(upright.moved(x, y - 0.02))
    return solids
