"""Propeller airplanes and gliders, fuselage about 1 long: turboprops, light planes, warbirds, biplanes, twin booms."""

from __future__ import annotations

import numpy as np

from learn3d.make_data.shapes.airplane_parts import (
    Planform,
    canopy,
    fin,
    fuselage,
    landing_gear,
    propeller,
    streamlined,
    surface,
    tail,
    winglets,
)
from learn3d.make_data.shapes.parts import (
    Solid,
    all_moved,
    bar,
    both_sides,
    both_sides_of,
    box,
    ellipse,
    revolve,
    tube,
    wing,
)
from learn3d.make_data.shapes.sampling import drawn, maybe, pick


def turboprop(rng: np.random.Generator) -> list[Solid]:
    """A twin or four-engined propeller plane."""
    radius = rng.uniform(0.05, 0.075)
    high = maybe(rng, 0.55)
    form = drawn(rng, tall=(0.95, 1.2), nose=(0.1, 0.2), nose_power=2.0, tail_start=(0.5, 0.66), upsweep=(0.3, 0.8))
    body = fuselage(radius, **form, droop=0.2, exponent=pick(rng, (2.0, 2.0, 2.6, 4.0)))
    size = drawn(rng, half=(0.48, 0.62), root=(0.11, 0.16), tip=(0.05, 0.1), sweep_deg=(0, 6), dihedral_deg=(0, 6))
    plan = Planform(**size, z=rng.uniform(0.08, 0.18), y=0.85 * radius if high else -0.65 * radius)
    solids = [body, surface(plan)]
    count = 2 if maybe(rng, 0.65) else 4
    thick = rng.uniform(0.02, 0.03)
    blades, disc = int(rng.integers(2, 7)), rng.uniform(0.07, 0.1)
    for share in (rng.uniform(0.26, 0.34),) if count == 2 else (0.27, 0.56):
        x, y, z, chord = plan.at(share)
        long = chord + rng.uniform(0.08, 0.13)
        pod = streamlined(thick, long).moved(x, y - 0.2 * thick, z - 0.5 * long + 0.075)
        screw = propeller(rng, disc, blades, hub=0.55 * thick)
        solids += both_sides_of([pod, *all_moved(screw, x, y - 0.2 * thick, z + 0.075)])
    kind = pick(rng, {"T": 2, "conventional": 2, "cross": 0.7} if high else {"conventional": 3, "twin": 1.2, "T": 0.6})
    solids += tail(rng, kind, radius, swept=maybe(rng, 0.5))
    if maybe(rng, 0.2):
        solids += landing_gear(radius, 1.8 * radius, main_z=0.02, other_z=0.36, main_x=1.1 * radius)
    return solids


def light_plane(rng: np.random.Generator) -> list[Solid]:
    """A single-engined light plane; sometimes on floats."""
    radius = rng.uniform(0.065, 0.085)
    high = maybe(rng, 0.55)
    pusher = maybe(rng, 0.1)
    form = drawn(rng, tall=(1.05, 1.35), nose=(0.08, 0.22), nose_power=(2.0, 3.2), tail_start=(0.36, 0.48))
    body = fuselage(radius, **form, **drawn(rng, upsweep=(0.0, 0.4), tail_radius=(0.15, 0.3), exponent=(2.0, 4.5)))
    tall = 1.2 * radius
    size = drawn(rng, half=(0.5, 0.72), root=(0.14, 0.2), tip=(0.09, 0.14), sweep_deg=(0, 4))
    plan = Planform(
        **size,
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
    solids += all_moved(propeller(rng, rng.uniform(0.11, 0.16), int(rng.integers(2, 4)), hub=0.025), z=screw_z)
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


def glider(rng: np.random.Generator) -> list[Solid]:
    """A sailplane: a slender pod and boom under very long wings."""
    radius = rng.uniform(0.042, 0.055)
    body = fuselage(
        radius, tall=1.25, nose=0.26, nose_power=1.8, tail_start=0.33, tail_power=0.75, tail_radius=0.22, upsweep=0.1
    )
    size = drawn(rng, half=(0.9, 1.35), root=(0.085, 0.12), tip=(0.03, 0.055), sweep_deg=(0, 3), dihedral_deg=(2, 6))
    y = rng.uniform(0.3, 0.9) * radius
    plan = Planform(**size, z=0.16, y=y, shape=pick(rng, ("straight", "elliptic", "kinked")))
    solids = [body, surface(plan), canopy(1.5 * radius, 1.6 * radius, 0.26, (0, 0.75 * radius, 0.27))]
    solids += tail(rng, pick(rng, {"T": 3, "conventional": 1, "V": 0.5}), 0.9 * radius, swept=False)
    return solids + (winglets(rng, plan) if maybe(rng, 0.4) else [])


def warbird(rng: np.random.Generator) -> list[Solid]:
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
    size = drawn(rng, half=(0.5, 0.66), root=(0.19, 0.25), tip=(0.07, 0.12), sweep_deg=(2, 9), dihedral_deg=(3, 7))
    z, y = rng.uniform(0.14, 0.2), rng.uniform(-0.8, 0.2) * radius
    plan = Planform(**size, z=z, y=y, shape=pick(rng, ("elliptic", "straight", "gull")))
    solids = [body, surface(plan)]
    solids.append(
        canopy(0.95 * radius, 1.2 * radius, rng.uniform(0.16, 0.34), (0, 1.05 * radius, rng.uniform(-0.02, 0.1)))
    )
    disc = rng.uniform(0.12, 0.16)
    if twin:
        x, y, z, chord = plan.at(0.32)
        pod = streamlined(0.04, chord + 0.15).moved(x, y, z - 0.5 * chord + 0.0)
        solids += both_sides_of([pod, *all_moved(propeller(rng, disc, 3, hub=0.022), x, y, z + 0.075)])
    else:
        solids += all_moved(propeller(rng, disc, int(rng.integers(2, 5)), hub=0.032), z=0.495)
    solids += tail(rng, "twin" if twin and maybe(rng, 0.5) else "conventional", radius, swept=False)
    if maybe(rng, 0.3):
        solids += landing_gear(0.8 * radius, radius + 0.1, 0.2, -0.46, 0.16, True)
    return solids


def biplane(rng: np.random.Generator) -> list[Solid]:
    """A biplane, or rarely a triplane, with struts and fixed gear."""
    radius = rng.uniform(0.06, 0.075)
    body = fuselage(
        radius, tall=1.2, nose=0.06, nose_power=3.0, tail_start=0.35, tail_radius=0.2, exponent=rng.uniform(2, 5)
    )
    gap, stagger = rng.uniform(0.16, 0.22), rng.uniform(-0.03, 0.1)
    decks = 3 if maybe(rng, 0.2) else 2
    chord, half = rng.uniform(0.13, 0.18) * (0.8 if decks == 3 else 1), rng.uniform(0.42, 0.58)
    z, low = rng.uniform(0.24, 0.3), -0.9 * radius
    shape = pick(rng, ("straight", "elliptic"))
    plans = []
    for k in range(decks):
        t = k / (decks - 1)
        reach = half * (1 if k == decks - 1 else rng.uniform(0.85, 1.0))
        plans.append(
            Planform(reach, chord, 0.9 * chord, 0, 1.5, z + t * stagger, low + t * (gap + radius), shape=shape)
        )
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
        solids += both_sides(
            bar((0.7 * radius, 0.5 * radius, top.z - along * chord), (0.08, top.y, top.z - along * chord), 0.012)
        )
    solids += all_moved(propeller(rng, rng.uniform(0.12, 0.15), 2, hub=0.025), z=0.495)
    solids += tail(rng, "conventional", radius, swept=False)
    solids += landing_gear(radius, 2.6 * radius, 0.27, -0.46, 0.11, True)
    return solids


def twin_boom(rng: np.random.Generator) -> list[Solid]:
    """A central pod between two booms that carry the tail."""
    radius, x = rng.uniform(0.05, 0.07), rng.uniform(0.14, 0.22)
    pod = fuselage(
        radius, tall=1.15, nose=0.2, nose_power=1.8, tail_start=0.5, tail_radius=0.35, length=rng.uniform(0.42, 0.6)
    )
    size = drawn(rng, half=(0.55, 0.75), root=(0.16, 0.21), tip=(0.06, 0.11), sweep_deg=(0, 6), dihedral_deg=(1, 5))
    plan = Planform(**size, z=0.14, y=0.0)
    solids = [pod.moved(z=0.12), surface(plan), canopy(1.1 * radius, 1.4 * radius, 0.24, (0, 0.8 * radius, 0.16))]
    _, y, z, _ = plan.at(x / plan.half)
    thick = rng.uniform(0.024, 0.036)
    front = z + (0.1 if maybe(rng, 0.7) else 0.0)
    path = [(x, y, front - s * (front + 0.5)) for s in (0, 0.04, 0.12, 0.3, 0.6, 1)]
    thickness = np.array([0.3, 0.7, 1.0, 1.0, 0.6, 0.4]) * thick
    parts = [tube(path, thickness, ellipse(2, 2, 10))]
    if front > z:
        parts += all_moved(propeller(rng, min(0.12, 0.75 * x), 3, hub=0.02), x, y, front)
    else:
        solids += all_moved(propeller(rng, min(0.1, 0.7 * x), 3, hub=0.03), z=-0.2)
        solids.append(revolve([(0.03, -0.1), (0.03, 0.1)], 10).rotated("x", 90).moved(z=-0.11))
    height = rng.uniform(0.12, 0.18)
    parts.append(fin(height, 0.12, 0.07, rng.uniform(5, 30), z=-0.38).moved(x, y - 0.02))
    level = y + rng.uniform(0.0, 0.95) * height - 0.02
    drift = 0.35 * (level - y)
    solids.append(wing([(-1.1 * x, level, -0.39 - drift, 0.09, 0.1), (1.1 * x, level, -0.39 - drift, 0.09, 0.1)]))
    return solids + both_sides_of(parts)
