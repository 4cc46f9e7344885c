"""Procedural shapes: an endless supply of small watertight meshes that needs no download.

Frame of every category: y up, the front (nose of an airplane or car, the side a chair or sofa is sat on from) towards
+z, left-right symmetric about x = 0 except where a real object is not (an L-shaped sofa, a desk with one drawer unit).
"""

from __future__ import annotations

import numpy as np
import trimesh

from learn3d.make_data.shapes.airplane import make_airplane
from learn3d.make_data.shapes.car import make_car
from learn3d.make_data.shapes.chair import make_chair
from learn3d.make_data.shapes.lamp import make_lamp
from learn3d.make_data.shapes.sofa import make_sofa
from learn3d.make_data.shapes.table import make_table

_MAKERS = {
    "airplane": make_airplane,
    "car": make_car,
    "chair": make_chair,
    "lamp": make_lamp,
    "sofa": make_sofa,
    "table": make_table,
}

CATEGORIES: tuple[str, ...] = tuple(_MAKERS)


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
    if category not in _MAKERS:
        raise ValueError(f"category must be one of {', '.join(CATEGORIES)}; got {category!r}")
    if not isinstance(rng, np.random.Generator):
        raise TypeError(
            f"rng must be a numpy.random.Generator, got {type(rng).__name__}; use numpy.random.default_rng(seed)"
        )
    return _MAKERS[category](rng)
