"""Procedural cars, in metres: the measures of each kind of body, and what is fitted to it."""

from __future__ import annotations

import numpy as np
import trimesh

from learn3d.make_data.shapes.car_body import TYRE, Body, hull, road_wheel
from learn3d.make_data.shapes.parts import Solid, assemble, bar, both_sides, box, rectangle, slab, wing
from learn3d.make_data.shapes.sampling import maybe, pick

# The least and the largest measures of each kind, in the order of the fields of Body.
_KINDS = {
    #               length width height wheel clear. bonnet screen roof window belt  lean
    "sedan":     (( 4.2,  1.70,  1.38,  0.30,  0.14,  0.25,  0.14, 0.66,  0.80, 0.56, 0.20),
                  ( 5.2,  1.92,  1.52,  0.35,  0.20,  0.31,  0.19, 0.74,  0.90, 0.64, 0.40)),
    "hatchback": (( 3.3,  1.58,  1.40,  0.28,  0.15,  0.16,  0.14, 0.84,  0.96, 0.56, 0.20),
                  ( 4.3,  1.80,  1.60,  0.34,  0.20,  0.28,  0.20, 0.92,  1.00, 0.64, 0.40)),
    "wagon":     (( 4.3,  1.70,  1.42,  0.30,  0.15,  0.24,  0.13, 0.91,  0.97, 0.56, 0.20),
                  ( 5.0,  1.90,  1.58,  0.35,  0.22,  0.30,  0.18, 0.95,  1.00, 0.64, 0.40)),
    "coupe":     (( 4.0,  1.78,  1.10,  0.31,  0.10,  0.26,  0.13, 0.56,  0.76, 0.58, 0.30),
                  ( 4.7,  2.00,  1.34,  0.36,  0.15,  0.37,  0.17, 0.66,  0.96, 0.64, 0.50)),
    "suv":       (( 4.1,  1.78,  1.62,  0.36,  0.22,  0.23,  0.12, 0.88,  0.96, 0.56, 0.12),
                  ( 5.1,  2.02,  1.95,  0.43,  0.30,  0.30,  0.17, 0.94,  1.00, 0.64, 0.28)),
    "van":       (( 4.4,  1.80,  1.90,  0.32,  0.18,  0.06,  0.06, 0.95,  0.98, 0.44, 0.04),
                  ( 6.0,  2.05,  2.60,  0.37,  0.25,  0.20,  0.14, 0.97,  1.00, 0.52, 0.13)),
    "pickup":    (( 4.8,  1.75,  1.60,  0.36,  0.24,  0.23,  0.09, 0.46,  0.57, 0.54, 0.20),
                  ( 5.9,  2.05,  1.95,  0.44,  0.34,  0.29,  0.13, 0.55,  0.64, 0.62, 0.40)),
}  # fmt: skip


def make_car(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random car."""
    weights = {"sedan": 2.5, "hatchback": 2, "wagon": 1.2, "coupe": 1.8, "suv": 1.8, "van": 1.6, "pickup": 1.6}
    kind = pick(rng, weights)
    body = Body(*rng.uniform(*_KINDS[kind]), has_bed=kind == "pickup")
    solids = [hull(body), *_wheels(rng, body), *_mirrors(rng, body)]
    if kind in ("hatchback", "wagon", "suv", "van") and maybe(rng, 0.4):
        solids += _roof_box(rng, body)
    if kind == "coupe" and maybe(rng, 0.5):
        solids += _spoiler(rng, body)
    return assemble(solids)


def _wheels(rng: np.random.Generator, body: Body) -> list[Solid]:
    """Four wheels on two axles."""
    x, y = (body.width - TYRE) / 2 - 0.02, body.wheel
    wheel = road_wheel(body.wheel, TYRE, rng.uniform(0.1, 0.6)).moved(x, y)
    axle = bar((-x, y, 0), (x, y, 0), 0.1)
    return [part.moved(z=body.length / 2 - s) for s in body.axles for part in (*both_sides(wheel), axle)]


def _mirrors(rng: np.random.Generator, body: Body) -> list[Solid]:
    """Wing mirrors at the foot of the windscreen."""
    half, y, z = body.width / 2, body.shoulder + 0.07, (0.5 - body.bonnet) * body.length - 0.2
    mirror = box((rng.uniform(0.14, 0.22), rng.uniform(0.09, 0.16), 0.08), (half + 0.07, y, z), 0.03)
    return both_sides(mirror) + both_sides(bar((0.85 * half, y - 0.09, z), (half + 0.04, y - 0.01, z), 0.05))


def _roof_box(rng: np.random.Generator, body: Body) -> list[Solid]:
    """Two bars across the roof that carry a box."""
    start, end = body.bonnet + body.screen, body.roof
    z, long = (0.5 - (start + end) / 2) * body.length, 0.8 * (end - start) * body.length
    half = 0.35 * body.width - 0.5 * body.lean * (body.height - body.shoulder)
    solids = [box((2 * half, 0.12, 0.06), (0, body.height + 0.01, z + s * 0.3 * long)) for s in (-1, 1)]
    outline = rectangle(rng.uniform(1.0, 1.8) * half, long, 0.2, 3)
    return [*solids, slab(outline, rng.uniform(0.18, 0.35), 0.1).moved(y=body.height + 0.05, z=z)]


def _spoiler(rng: np.random.Generator, body: Body) -> list[Solid]:
    """A wing on two stays over the tail."""
    half, z = 0.42 * body.width, rng.uniform(0.15, 0.4) - body.length / 2
    high = rng.uniform(0.1, 0.3)
    y = body.shoulder + high
    stay = box((0.05, high + 0.3, 0.14), (0.7 * half, y - high / 2 - 0.13, z - 0.13))
    return [wing([(-half, y, z, 0.3, 0.12), (half, y, z, 0.3, 0.12)]), *both_sides(stay)]
