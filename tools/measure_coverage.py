"""Measures what each recipe of generated shapes is worth: how much nearer its templates come to real meshes.

python tools/measure_coverage.py --category chair --models models/chair

A recipe should lose more than as many templates that are left out at random.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
import trimesh
import tyro

import nmr
from learn3d.files.formats import RawMesh
from learn3d.studio.make_data.meshes import check, fit_to_box, mesh_sources
from learn3d.studio.shapes import numbered_recipe, numbered_shape

DRAWS = 20  # of as many templates at random


def describe(recipe: Callable) -> str:
    """The name of a recipe: that of its function, with the kind or family that it makes."""
    if not isinstance(recipe, partial):
        return recipe.__name__
    kinds = (getattr(value, "name", value) for value in recipe.keywords.values())
    return " ".join(map(str, [recipe.func.__name__, *kinds]))


def cells(mesh: RawMesh | trimesh.Trimesh, turn_deg: float = 0.0) -> torch.Tensor:
    """The voxels of a mesh in the unit cube, turned about y, float32 [32^3]."""
    turn = trimesh.transformations.rotation_matrix(np.radians(turn_deg), [0, 1, 0])[:3, :3]
    vertices = fit_to_box(np.asarray(mesh.vertices) @ turn.T)
    vertices = torch.tensor(0.998 * vertices[None] + 0.5, dtype=torch.float32)
    return nmr.voxelize(vertices, torch.tensor(np.asarray(mesh.faces))).flatten().float()


def main(category: str, models: Path, count: int = 1000, turn_deg: float = 0.0) -> None:
    """Print for each recipe how much the mean of the best voxel IoU falls if its templates are missing.

    models: a folder or pack of real meshes. count: templates of the category. turn_deg: turn
    the real meshes about y, if their front is not towards +z.
    """
    names = np.array([describe(numbered_recipe(category, 0, k)) for k in range(count)])
    templates = torch.stack([cells(numbered_shape(category, 0, k)) for k in range(count)])
    real = torch.stack([cells(check(read()), turn_deg) for read in mesh_sources(models).values()])
    both = real @ templates.T
    ious = (both / (real.sum(1)[:, None] + templates.sum(1) - both)).numpy()
    best, rng = ious.max(1).mean(), np.random.default_rng(0)
    print(f"{len(real)} meshes, {count} templates: mean of the best IoU {best:.3f}")
    print(f"{'recipe':24}{'templates':>10}{'nearest to':>11}{'loss':>9}{'at random':>10}")
    for name in np.unique(names):
        own = names == name
        nearest = own[ious.argmax(1)].sum()
        loss = best - ious[:, ~own].max(1).mean()
        chance = [best - ious[:, ~rng.permutation(own)].max(1).mean() for _ in range(DRAWS)]
        print(f"{name:24}{own.sum():10}{nearest:11}{loss:9.4f}{np.mean(chance):10.4f}", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
