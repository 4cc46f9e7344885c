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
_RECIPES = {
    "airplane": airplane.KINDS,
    "car": car.KINDS,
    "chair": chair.KINDS,
    "lamp": lamp.KINDS,
    "sofa": sofa.KINDS,
    "table": table.KINDS,
}

CATEGORIES: tuple[str, ...] = tuple(_RECIPES)


def make_shape(category: str, rng: np.random.Generator) -> trimesh.Trimesh:
    """A random shape of the category, decided by the state of `rng` alone.

    Parameters
    ----------
    category
        One of `CATEGORIES`.
    rng
        Source of every choice: the same state gives the same mesh. It is advanced.

    Returns
    -------
    trimesh.Trimesh
        Closed components, each watertight and oriented outwards, that overlap where the parts of the object are
        joined; 150 to 8000 faces, mostly 1000 to 5000. Box centred at the origin, longest side 1; y up, front
        towards +z.

    Raises
    ------
    ValueError
        If the category is not known.
    TypeError
        If rng is not a `numpy.random.Generator`.

    Examples
    --------
    >>> chair = make_shape("chair", np.random.default_rng(7))
    >>> chair.is_watertight
    True
    """
    if category not in _RECIPES:
        raise ValueError(f"category must be one of {', '.join(CATEGORIES)}; got {category!r}")
    if not isinstance(rng, np.random.Generator):
        raise TypeError(
            f"rng must be a numpy.random.Generator, got {type(rng).__name__}; use numpy.random.default_rng(seed)"
        )
    draw = Draw(rng)
    return assemble(draw.pick(_RECIPES[category])(draw))
