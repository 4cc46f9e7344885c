"""Procedural shapes: an endless supply of small watertight meshes that needs no download.

Frame of every category: y up, the front (nose of an airplane or car, the side a chair or sofa is sat on from) towards
+z, left-right symmetric about x = 0 except where a real object is not (an L-shaped sofa, a desk with one drawer unit).
"""

from __future__ import annotations

import numpy as np
import trimesh

from . import airplane, car, chair, lamp, sofa, table
from .draw import Draw
from .parts import assemble

# The recipes of each category, with their weights: a shape is made by one of them.
_RECIPES = {module.__name__.rpartition(".")[2]: module.KINDS for module in (airplane, car, chair, lamp, sofa, table)}

CATEGORIES: tuple[str, ...] = tuple(_RECIPES)


def make_shape(category: str, rng: np.random.Generator) -> trimesh.Trimesh:
    """A random shape of the category (one of `CATEGORIES`), decided by the state of `rng` alone, which is advanced.

    Its components are closed, each watertight and oriented outwards, and overlap where the parts of the object are
    joined: 150 to 8000 faces, mostly 1000 to 5000. The box is centred at the origin, its longest side is 1; y is up,
    the front towards +z. Raises ValueError for an unknown category.

    >>> make_shape("chair", np.random.default_rng(7)).is_watertight
    True
    """
    if category not in _RECIPES:
        raise ValueError(f"category must be one of {', '.join(CATEGORIES)}; got {category!r}")
    draw = Draw(rng)
    return assemble(draw.pick(_RECIPES[category])(draw))
