"""Meshes without any symmetry, and data sets of them."""

from __future__ import annotations

from pathlib import Path

import trimesh

from learn3d.studio.make_data.render import DatasetConfig, DatasetReport, make_dataset


def lopsided_mesh(depth: float) -> trimesh.Trimesh:
    """A slab with a post and a block: no rotation or reflection takes it to itself. x to the front, y up."""
    parts = [trimesh.creation.box((1, 0.15, depth)), trimesh.creation.box((0.2, 0.7, 0.2))]
    parts.append(trimesh.creation.box((0.3, 0.25, 0.3)))
    parts[1].apply_translation((0.35, 0.4, depth / 2 - 0.1))
    parts[2].apply_translation((-0.3, 0.15, 0.1 - depth / 2))
    mesh = trimesh.util.concatenate(parts)
    mesh.apply_translation((7, -2, 3))
    return mesh


def write_meshes(folder: Path) -> Path:
    """Five of them of different depth, as files in the folder."""
    for i in range(5):
        lopsided_mesh(0.5 + 0.08 * i).export(folder / f"my chair {i}.ply")
    return folder


def make(out: Path, source: Path | None, layout: str = "kato", **settings: object) -> DatasetReport:
    """A data set of chairs without val and test splits, unless the settings say so."""
    config = {"category": "chair", "val": 0, "test": 0, **settings}
    return make_dataset(DatasetConfig(output=out, source=source, layout=layout, **config))
