"""Settings of a data set to be made."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any, Literal

from pydantic import Field

from learn3d.data import conventions
from learn3d.data.categories import synset_of
from learn3d.make_data.writers import WRITERS, WrittenLayout
from learn3d.settings import Count, FilePath, Rare, Weight, checked

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
Amount = Annotated[int, Field(ge=0)]
NOT_SETTINGS = {"output", "overwrite", "shards", "jobs"}  # options on which no file depends


@checked
class DatasetConfig:
    """One category of a data set: its meshes, its layout and its splits. The same settings give the same bytes."""

    output: FilePath
    """Folder for the files. Other categories may live in it, too."""
    category: str
    """Name of the category. Kato's 13 names become synset ids in the names of files."""
    layout: WrittenLayout = "kato"
    """Published data set whose files and viewpoints are made, see docs/data-sets.md."""
    views: Count | None = None
    """Views of each object (default: 20 for kar, 24 for r2n2, 8 for pascal3d, 12 for photos and around; kato and dvr
    always have 24)."""
    source: FilePath | None = None
    """Folder of meshes, searched with all folders in it, or a mesh pack .npz (default: --procedural is given)."""
    procedural: Amount = 0
    """Make this many shapes with the procedural generator instead of reading meshes."""
    test: Weight | None = None
    """Part of the meshes for the test split: a share below 1 (then at least 4 meshes), or their number (default: 0.2;
    pascal3d has no test split)."""
    val: Weight | None = None
    """Part of the meshes for the validation split, 0 for none (default: 0.1, for pascal3d 0.2; r2n2 has no validation
    split)."""
    augment: Amount = 0
    """Copies of each mesh to train on, besides itself, with every axis scaled by a random 0.75 .. 1.25."""
    up: Axis = "y"
    """Axis of the mesh files that points up."""
    front: Axis | None = None
    """Axis of the mesh files that faces the camera of view 0 (default: x, or y if x is up; z for procedural shapes)."""
    seed: Rare[Amount] = 0
    """Seed of the splits, scales, colours, views and procedural shapes."""
    overwrite: bool = False
    """Replace files of this category that are already in the folder."""
    shards: bool = False
    """Write shards, which training reads piece by piece: for data sets that do not fit into memory (docs/scale.md).
    Only for the layouts kato and around. The same command continues an interrupted one."""
    jobs: Count = 1
    """Shards that are made at a time, each in a process of its own."""

    def __post_init__(self) -> None:
        if (self.source is None) == (self.procedural == 0):
            raise ValueError(
                "give either --source (a folder of meshes or a mesh pack .npz) or --procedural (a number of shapes)"
            )
        if WRITERS[self.layout].only_shards and not self.shards:
            raise ValueError(f"the layout {self.layout} is made as shards: add --shards")
        if self.shards and self.layout not in ("kato", "around"):
            raise ValueError(
                f"shards are made in the layouts kato and around, not {self.layout}; make the data set without "
                "--shards, and convert it (learn3d convert-dataset)"
            )
        if not self.shards and self.jobs > 1:
            raise ValueError("--jobs is for shards: add --shards")
        synset_of(self.category)
        conventions.mesh_to_object(self.up, self.facing)
        writer = WRITERS[self.layout]
        defaults = {"views": writer.default_views, "test": writer.default_test, "val": writer.default_val}
        for name, value in defaults.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
            if value == 0 and getattr(self, name) != 0:
                raise ValueError(f"the layout {self.layout} has no {name} split; leave {name} at 0")
        if writer.fixed_views and self.views != writer.default_views:
            raise ValueError(f"the layout {self.layout} has {writer.default_views} views per object, not {self.views}")
        if writer.fixed_splits and (self.test != writer.default_test or self.augment):
            raise ValueError(
                f"the layout {self.layout} has no list of splits: the first 80 % of the sorted ids are for training; "
                "leave test at 0.2 and augment at 0, or choose another layout"
            )

    @property
    def facing(self) -> str:
        """The axis that faces the camera of view 0."""
        return self.front or ("z" if self.procedural else "y" if self.up.endswith("x") else "x")

    def copies(self, split: str) -> int:
        """Objects that are made of each mesh of a split."""
        return 1 + self.augment if split == "train" else 1

    def plain(self) -> dict[str, Any]:
        """The settings that the files depend on, as plain values."""
        settings = {name: value for name, value in asdict(self).items() if name not in NOT_SETTINGS}
        return settings | {"source": self.source and self.source.name}
