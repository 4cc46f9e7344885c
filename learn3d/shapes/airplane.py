"""Procedural airplanes, fuselage about 1 long."""

from __future__ import annotations

import numpy as np

from .airplane_parts import Planform, canopy, fin, fuselage, gear, nacelle, nozzle, pod, propeller, tail, tail_engines
from .draw import Draw
from .parts import Part, bar, box, ellipsoid, loft, rectangle, wing


def airliner(draw: Draw) -> Part:
    """A jet airliner, or a freighter with high wings, T-tail and upswept rear."""
    radius, freighter = draw(0.042, 0.068), draw.maybe(0.25)
    tall, nose, nose_power, tail_start = draw(0.95, 1.15), draw(1.6, 3.0) * radius, draw(1.7, 2.2), draw(0.58, 0.72)
    upsweep = draw(0.5, 0.9) if freighter else draw(0.25, 0.6)
    plane = fuselage(radius, tall, nose, nose_power, tail_start, upsweep=upsweep, droop=draw(0.1, 0.35))
    half, sweep, root, tip = draw(0.40, 0.56), draw(15, 38), draw(0.15, 0.21), draw(0.035, 0.07)
    dihedral, z = draw(-4, 0) if freighter else draw(3, 8), draw(0.1, 0.17)
    kink = draw(0.25, 0.42) if draw.maybe(0.7) else 0.0
    plan = Planform(half, root, tip, sweep, dihedral, z, y=0.8 * radius if freighter else -0.6 * radius, kink=kink)
    plane += plan.wing()
    if freighter:
        plane += ellipsoid((1.5 * radius, 0.7 * radius, 0.32), (0, 0.85 * radius, plan.z - 0.1))
    mount = "wing" if freighter else draw.pick({"wing": 4, "tail": 1, "tail3": 0.5, "wing3": 0.4})
    size = draw(0.35, 0.58) * radius
    if mount.startswith("wing"):
        two = draw.maybe(0.35 if freighter else 0.7)
        size *= 1.25 if two else 0.9
        for share in (draw(0.28, 0.4),) if two else (0.3, draw(0.55, 0.65)):
            plane += plan.engines(draw, share, size)
    else:
        plane += tail_engines(draw, radius, 0.9 * size, z=draw(-0.32, -0.24))
    if mount.endswith("3"):
        plane += nacelle(0.9 * size, 4.5 * size).moved(y=1.35 * radius, z=-0.36)
    plane += tail(draw, "T" if freighter or mount.startswith("tail") else "conventional", radius, swept=True)
    if draw.maybe(0.4):
        plane += plan.winglets(draw)
    if not freighter and draw.maybe(0.12):  # an upper deck
        plane += ellipsoid((1.5 * radius, 1.5 * radius, 0.4), (0, 0.75 * radius, 0.27))
    if draw.maybe(0.25):
        plane += gear(radius, radius * draw(1.5, 2.0), main_x=1.2 * radius, main_z=-0.02, other_z=0.38)
    return plane


def business_jet(draw: Draw) -> Part:
    """A small jet with engines at the tail."""
    radius = draw(0.052, 0.075)
    plane = fuselage(radius, nose=draw(0.14, 0.24), nose_power=1.6, tail_start=0.6, upsweep=0.35, droop=0.3)
    size = draw.measures(half=(0.4, 0.52), root=(0.15, 0.2), tip=(0.045, 0.07), sweep_deg=(2, 34), dihedral_deg=(2, 6))
    plan = Planform(**size, z=draw(0.02, 0.08), y=-0.75 * radius)
    plane += plan.wing() + tail_engines(draw, radius, draw(0.026, 0.036), z=-0.2)
    plane += tail(draw, draw.pick({"T": 3, "cross": 1, "V": 0.4}), radius, swept=True)
    if draw.maybe(0.5):
        plane += plan.winglets(draw)
    if draw.maybe(0.25):  # tanks at the wing tips
        x, y, z, chord = plan.at(1.0)
        plane += ellipsoid((0.035, 0.035, 0.2), (x, y, z - 0.5 * chord)).both_sides()
    return plane


def fighter(draw: Draw) -> Part:
    """A jet fighter: delta, swept or trapezoid wings, one or two fins, canards, stores under the wings."""
    radius, twin = draw(0.05, 0.068), draw.maybe(0.45)
    form = draw.measures(tall=(0.9, 1.15), nose=(0.3, 0.42), nose_power=(1.05, 1.4))
    form |= draw.measures(tail_radius=(0.65, 0.85), exponent=(2.0, 3.2))
    shape = draw.pick({"delta": 2.5, "swept": 2, "trapezoid": 2, "forward": 0.3})
    root, tip, sweep, z = {
        "delta": (draw(0.42, 0.52), draw(0.02, 0.06), draw(46, 58), 0.1),
        "swept": (draw(0.2, 0.28), draw(0.08, 0.12), draw(35, 50), 0.12),
        "trapezoid": (draw(0.28, 0.38), draw(0.06, 0.1), draw(25, 42), 0.06),
        "forward": (draw(0.22, 0.28), 0.1, draw(-28, -18), -0.08),
    }[shape]
    half = draw(0.28, 0.4) if shape == "delta" else draw(0.3, 0.4)
    if shape == "delta":
        half = min(half, 0.9 * root / np.tan(np.radians(sweep)))
    plan = Planform(half, root, tip, sweep, draw(-5, 2), z, draw(-0.3, 0.6) * radius, thickness=0.06)
    plane = fuselage(radius, tail_start=0.75, **form) + plan.wing()
    plane += canopy(0.9 * radius, 1.1 * radius, draw(0.18, 0.28), 0.8 * radius, draw(0.15, 0.22))
    plane += _two_engines(draw, radius) if twin else _one_engine(draw, radius)
    if draw.maybe(0.55 if twin else 0.1):
        cant, x, height = draw(0, 25), draw(0.9, 1.4) * radius, draw(0.13, 0.19)
        upright = fin(height, 0.19, 0.08, draw(30, 45), z=-0.27)
        plane += upright.rotated("z", -cant).moved(x, 0.3 * radius).both_sides()
    else:
        height = draw(0.17, 0.25) + 0.6 * radius
        plane += fin(height, draw(0.2, 0.3), 0.09, draw(35, 52), z=-0.2).moved(y=0.3 * radius)
    if shape != "delta":
        plane += Planform(draw(0.17, 0.23), 0.15, 0.06, draw(30, 45), -3, -0.34, 0.0, thickness=0.06).wing()
        if draw.maybe(0.4):  # strakes from the wing root towards the nose
            outer = (2.0 * radius, plan.y, z - 0.03, 0.7 * root, 0.05)
            plane += wing([(0.0, plan.y, z + 0.2, root + 0.1, 0.05), outer]).both_sides()
    elif draw.maybe(0.5):  # canards
        plane += Planform(draw(0.15, 0.2), 0.11, 0.04, 45, 4, 0.24, 0.35 * radius, thickness=0.06).wing()
    return plane + _stores(draw, plan)


def _two_engines(draw: Draw, radius: float) -> Part:
    """Two tunnels beside the fuselage, each with a slanted intake and a nozzle."""
    wide = draw(0.8, 1.25) * radius
    rings = []
    for z, w, h, y in ((0.14, 0.9, 1.3, -0.3), (0.0, 1.0, 1.4, -0.2), (-0.3, 1.0, 1.3, 0), (-0.48, 0.8, 0.9, 0.1)):
        outline = rectangle(w * wide, h * wide, 0.3 * wide, 2)
        slant = (0.05 if z > 0.1 else 0.0) * (outline[:, 1] / wide)
        rings.append(np.stack([wide + outline[:, 0], y * wide + outline[:, 1], z + slant], 1))
    return (loft(rings) + nozzle(0.42 * wide, 0.07).moved(wide, 0.08 * wide, -0.5)).both_sides()


def _one_engine(draw: Draw, radius: float) -> Part:
    """A nozzle at the rear, and intakes at the sides or at the chin, or in the nose, where none is drawn."""
    intake = {
        "side": box((0.8 * radius, 1.2 * radius, 0.34), (0.95 * radius, 0.1 * radius, 0.03), 0.02).both_sides(),
        "chin": box((1.2 * radius, 0.9 * radius, 0.3), (0, -0.9 * radius, 0.06), 0.02),
        "nose": Part(),
    }
    return intake[draw.pick(tuple(intake))] + nozzle(0.75 * radius, 0.08).moved(z=-0.52)


def _stores(draw: Draw, plan: Planform) -> Part:
    """Up to three tanks or missiles under each wing, or at its tip."""
    part = Part()
    number = draw.count(0, 3)
    for share in sorted({(0.4, 0.6, 0.8, 1.0)[draw.count(0, 3)] for _ in range(number)}):
        x, y, z, chord = plan.at(share)
        size, at_tip = (0.022, 0.022, draw(0.14, 0.26)), share == 1
        store = ellipsoid(size, (x, y - (0 if at_tip else 0.026), z - 0.4 * chord), 8, 6)
        pylon = Part() if at_tip else box((0.01, 0.03, 0.06), (x, y - 0.012, z - 0.45 * chord))
        part += (store + pylon).both_sides()
    return part


def turboprop(draw: Draw) -> Part:
    """A twin or four-engined propeller plane."""
    radius, high = draw(0.05, 0.075), draw.maybe(0.55)
    form = draw.measures(tall=(0.95, 1.2), nose=(0.1, 0.2), tail_start=(0.5, 0.66), upsweep=(0.3, 0.8))
    plane = fuselage(radius, **form, droop=0.2, exponent=draw.pick((2.0, 2.0, 2.6, 4.0)))
    size = draw.measures(half=(0.48, 0.62), root=(0.11, 0.16), tip=(0.05, 0.1), sweep_deg=(0, 6), dihedral_deg=(0, 6))
    plan = Planform(**size, z=draw(0.08, 0.18), y=0.85 * radius if high else -0.65 * radius)
    plane += plan.wing()
    two = draw.maybe(0.65)
    thick, blades, disc = draw(0.02, 0.03), draw.count(2, 6), draw(0.07, 0.1)
    for share in (draw(0.26, 0.34),) if two else (0.27, 0.56):
        x, y, z, chord = plan.at(share)
        long = chord + draw(0.08, 0.13)
        y = y - 0.2 * thick
        body = pod(thick, long).moved(x, y, z - 0.5 * long + 0.075)
        plane += (body + propeller(draw, disc, blades, hub=0.55 * thick).moved(x, y, z + 0.075)).both_sides()
    kind = {"T": 2, "conventional": 2, "cross": 0.7} if high else {"conventional": 3, "twin": 1.2, "T": 0.6}
    plane += tail(draw, draw.pick(kind), radius, swept=draw.maybe(0.5))
    if draw.maybe(0.2):
        plane += gear(radius, 1.8 * radius, main_x=1.1 * radius, main_z=0.02, other_z=0.36)
    return plane


def light_plane(draw: Draw) -> Part:
    """A single-engined light plane; sometimes on floats."""
    radius, high, pusher = draw(0.065, 0.085), draw.maybe(0.55), draw.maybe(0.1)
    form = draw.measures(tall=(1.05, 1.35), nose=(0.08, 0.22), nose_power=(2.0, 3.2), tail_start=(0.36, 0.48))
    form |= draw.measures(upsweep=(0.0, 0.4), tail_radius=(0.15, 0.3), exponent=(2.0, 4.5))
    tall = 1.2 * radius
    size = draw.measures(half=(0.5, 0.72), root=(0.14, 0.2), tip=(0.09, 0.14), sweep_deg=(0, 4))
    dihedral, z = draw(0, 3) if high else draw(3, 8), draw(0.16, 0.24)
    y = tall * draw(1.05, 1.2) if high else -0.7 * tall
    shape = draw.pick(("straight", "straight", "elliptic", "kinked"))
    plan = Planform(**size, dihedral_deg=dihedral, z=z, y=y, shape=shape)
    plane = fuselage(radius, **form) + plan.wing()
    if high:
        plane += box((1.5 * radius, 1.1 * tall, 0.2), (0, 0.62 * tall, 0.14), 0.03)
    else:
        plane += canopy(1.5 * radius, 1.3 * tall, draw(0.24, 0.36), 0.72 * tall, 0.1)
    plane += propeller(draw, draw(0.11, 0.16), draw.count(2, 3), hub=0.025).moved(z=-0.515 if pusher else 0.497)
    swept = draw.maybe(0.5)
    plane += tail(draw, draw.pick({"conventional": 4, "T": 1, "V": 0.6, "cross": 0.5}), radius, swept)
    if high and draw.maybe(0.6):
        x, y, z, chord = plan.at(draw(0.4, 0.6))
        plane += bar((0.6 * radius, -0.6 * tall, z - 0.4 * chord), (x, y, z - 0.4 * chord), 0.018, 0.01).both_sides()
    if draw.maybe(0.12):
        return plane + _floats(draw, radius, tall)
    if draw.maybe(0.75):
        main_z, other_z = (0.03, 0.4) if draw.maybe(0.6) else (0.25, -0.46)
        plane += gear(tall, tall + draw(0.05, 0.09), 2.0 * radius, main_z, other_z)
    return plane


def _floats(draw: Draw, radius: float, tall: float) -> Part:
    x, y = 2.2 * radius, -tall - draw(0.08, 0.11)
    hull = fuselage(0.035, nose=0.25, nose_power=1.8, tail_start=0.5, upsweep=0.9, length=draw(0.65, 0.8))
    part = hull.moved(x, y, 0.12)
    for z in (0.24, 0.02):
        part += bar((0.5 * radius, -0.6 * tall, z), (x, y + 0.02, z), 0.016)
        part += bar((0.0, y + 0.02, z), (x, y + 0.02, z), 0.012)
    return part.both_sides()


def glider(draw: Draw) -> Part:
    """A sailplane: a slender pod and boom under very long wings."""
    radius = draw(0.042, 0.055)
    plane = fuselage(radius, 1.25, 0.26, 1.8, tail_start=0.33, tail_power=0.75, tail_radius=0.22, upsweep=0.1)
    size = draw.measures(half=(0.9, 1.35), root=(0.085, 0.12), tip=(0.03, 0.055), sweep_deg=(0, 3), dihedral_deg=(2, 6))
    y = draw(0.3, 0.9) * radius
    plan = Planform(**size, z=0.16, y=y, shape=draw.pick(("straight", "elliptic", "kinked")))
    plane += plan.wing() + canopy(1.5 * radius, 1.6 * radius, 0.26, 0.75 * radius, 0.27)
    plane += tail(draw, draw.pick({"T": 3, "conventional": 1, "V": 0.5}), 0.9 * radius)
    return plane + (plan.winglets(draw) if draw.maybe(0.4) else Part())


def warbird(draw: Draw) -> Part:
    """A propeller fighter or a twin-engined bomber of the 1940s."""
    radius, twin, radial = draw(0.058, 0.08), draw.maybe(0.35), draw.maybe(0.4)
    tall, nose = draw(1.1, 1.3), 0.07 if radial and not twin else draw(0.12, 0.25)
    nose_power, tail_start = 3.0 if radial else 2.0, draw(0.4, 0.5)
    plane = fuselage(radius, tall, nose, nose_power, tail_start, tail_radius=0.15, upsweep=0.35)
    size = draw.measures(half=(0.5, 0.66), root=(0.19, 0.25), tip=(0.07, 0.12), sweep_deg=(2, 9), dihedral_deg=(3, 7))
    z, y = draw(0.14, 0.2), draw(-0.8, 0.2) * radius
    plan = Planform(**size, z=z, y=y, shape=draw.pick(("elliptic", "straight", "gull")))
    plane += plan.wing()
    plane += canopy(0.95 * radius, 1.2 * radius, draw(0.16, 0.34), 1.05 * radius, draw(-0.02, 0.1))
    disc = draw(0.12, 0.16)
    if twin:
        x, y, z, chord = plan.at(0.32)
        body = pod(0.04, chord + 0.15).moved(x, y, z - 0.5 * chord)
        plane += (body + propeller(draw, disc, 3, hub=0.022).moved(x, y, z + 0.075)).both_sides()
    else:
        plane += propeller(draw, disc, draw.count(2, 4), hub=0.032).moved(z=0.495)
    plane += tail(draw, "twin" if twin and draw.maybe(0.5) else "conventional", radius)
    if draw.maybe(0.3):
        plane += gear(0.8 * radius, radius + 0.1, main_x=0.16, main_z=0.2, other_z=-0.46)
    return plane


def biplane(draw: Draw) -> Part:
    """A biplane, or rarely a triplane, with struts and fixed gear."""
    radius = draw(0.06, 0.075)
    plane = fuselage(radius, 1.2, 0.06, 3.0, tail_start=0.35, tail_radius=0.2, exponent=draw(2, 5))
    gap, stagger = draw(0.16, 0.22), draw(-0.03, 0.1)
    decks = 3 if draw.maybe(0.2) else 2
    chord, half = draw(0.13, 0.18) * (0.8 if decks == 3 else 1), draw(0.42, 0.58)
    z, low = draw(0.24, 0.3), -0.9 * radius
    shape = draw.pick(("straight", "elliptic"))
    plans = []
    for t in np.linspace(0, 1, decks):
        reach = half * (1 if t == 1 else draw(0.85, 1.0))
        y = low + t * (gap + radius)
        plans.append(Planform(reach, chord, 0.9 * chord, 0, 1.5, z + t * stagger, y, shape=shape))
        plane += plans[-1].wing()
    bottom, top = plans[0], plans[-1]
    for share in (0.75,) if draw.maybe(0.5) else (0.45, 0.85):
        x = share * bottom.half
        (_, y0, z0, c0), (_, y1, z1, c1) = (plan.at(x / plan.half) for plan in (bottom, top))
        for along in (0.2, 0.7):
            plane += bar((x, y0, z0 - along * c0), (x, y1, z1 - along * c1), 0.013).both_sides()
    for z in (top.z - 0.2 * chord, top.z - 0.7 * chord):
        plane += bar((0.7 * radius, 0.5 * radius, z), (0.08, top.y, z), 0.012).both_sides()
    plane += propeller(draw, draw(0.12, 0.15), 2, hub=0.025).moved(z=0.495)
    plane += tail(draw, "conventional", radius)
    return plane + gear(radius, 2.6 * radius, main_x=0.11, main_z=0.27, other_z=-0.46)


KINDS = {airliner: 4.0, business_jet: 1.5, turboprop: 2.0, light_plane: 3.0, glider: 1.0, fighter: 3.0, warbird: 1.5}
KINDS |= {biplane: 0.8}
