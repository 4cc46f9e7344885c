"""Procedural airplanes: which kind, then its own recipe."""

from __future__ import annotations

import numpy as np
import trimesh

from learn3d.make_data.shapes.airplane_jets import airliner, business_jet, fighter, flying_wing, supersonic
from learn3d.make_data.shapes.airplane_propellers import biplane, glider, light_plane, turboprop, twin_boom, warbird
from learn3d.make_data.shapes.parts import assemble
from learn3d.make_data.shapes.sampling import pick


def make_airplane(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random airplane."""
    maker = pick(
        rng,
        {
            airliner: 4.0,
            business_jet: 1.5,
            turboprop: 2.0,
            light_plane: 3.0,
            glider: 1.0,
            fighter: 3.0,
            warbird: 1.5,
            biplane: 0.8,
            supersonic: 0.6,
            flying_wing: 0.6,
            twin_boom: 0.7,
        },
    )
    return assemble(maker(rng))
