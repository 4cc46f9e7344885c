"""Procedural shapes: any number of small watertight meshes, without a download.

Frame of all categories: y up, the front (nose of an airplane or car, open side of a chair or
sofa) towards +z. Shapes are symmetric about x = 0, except L-shaped sofas, desks with one drawer
unit, and the like.
"""

from collections.abc import Callable

import numpy as np
import trimesh

from . import airplane, car, chair, lamp, sofa, table
from .draw import Draw
from .parts import Part, assemble

# The recipes of each category, with the weights of a random choice.
_RECIPES = {
    module.__name__.rpartition(".")[2]: module.KINDS
    for module in (airplane, car, chair, lamp, sofa, table)
}
CATEGORIES: tuple[str, ...] = tuple(_RECIPES)


def make_shape(category: str, rng: np.random.Generator, loads: bool = True) -> trimesh.Trimesh:
    """A random shape of the category (one of `CATEGORIES`). loads: cars may have boxes on their roofs.

    It depends on the state of `rng` alone, which advances.

    The components are watertight, oriented outwards, and overlap at the joints of the object. It
    has 150 to 8000 faces, mostly 1000 to 5000. The bounding box is centred at the origin, its
    longest side is 1. Raises ValueError for an unknown category.

    >>> make_shape("chair", np.random.default_rng(7)).is_watertight
    True
    """
    draw = Draw(rng.bit_generator)
    draw.loads = loads
    return assemble(_pick_recipe(category, draw)(draw))


def _pick_recipe(category: str, draw: Draw) -> Callable[[Draw], Part]:
    if category not in _RECIPES:
        raise ValueError(f"category must be one of {', '.join(CATEGORIES)}; got {category!r}")
    return draw.pick(_RECIPES[category])


def numbered_shape(category: str, seed: int, number: int, loads: bool = True) -> trimesh.Trimesh:
    """Shape `number` of a data set of generated shapes with this seed; see `make_shape`.

    Exported models know shapes by their numbers (`picture_to_mesh.templates`): after a change of
    recipes, train and export the package's model again.
    """
    return make_shape(category, _rng(seed, number), loads)


def numbered_recipe(category: str, seed: int, number: int) -> Callable[[Draw], Part]:
    """The recipe of a `numbered_shape`, a key of the category's `KINDS`."""
    return _pick_recipe(category, Draw(_rng(seed, number).bit_generator))


def _rng(seed: int, number: int) -> np.random.Generator:
    return np.random.default_rng([seed, 0, number])
