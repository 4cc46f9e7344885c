"""Settings of `learn3d make-dataset`."""

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
WITHOUT_EFFECT = {"output", "overwrite", "shards", "jobs"}  # options that do not change the content of the files


@checked
class DatasetConfig:
    """One category of a data set: its meshes, its layout and its splits. The same settings give the same bytes."""

    output: FilePath
    """Folder for the files. It may hold other categories, too."""
    category: str
    """Name of the category. File names have a synset id instead of each of Kato's 13 names."""
    layout: WrittenLayout = "kato"
    """Published data set whose file layout and viewpoints are used, see docs/data-sets.md."""
    views: Count | None = None
    """Views of each object (default: 20 for kar, 24 for r2n2, 8 for pascal3d, 12 for photos and around; kato and dvr
    always have 24)."""
    source: FilePath | None = None
    """Folder of meshes, searched recursively, or a mesh pack .npz (default: shapes from --procedural)."""
    procedural: Amount = 0
    """Number of shapes from the procedural generator, instead of meshes from files or together with them."""
    test: Weight | None = None
    """Share (below 1, at least 4 meshes) or number of the meshes for the test split (default: 0.2; pascal3d has no test
    split)."""
    val: Weight | None = None
    """Share or number of the meshes for the validation split, 0 for none (default: 0.1, for pascal3d 0.2; r2n2 has no
    validation split)."""
    augment: Amount = 0
    """Additional copies of each training mesh, with each axis scaled by a random factor in 0.75 .. 1.25. With --source,
    shapes of --procedural get none."""
    up: Axis = "y"
    """Axis of the mesh files that points up."""
    front: Axis | None = None
    """Axis of the mesh files that faces the camera of view 0 (default: x, or y if x is up; z for procedural shapes)."""
    seed: Rare[Amount] = 0
    """Seed of the splits, scales, colours, views and procedural shapes."""
    overwrite: bool = False
    """Replace files of this category that are already in the folder."""
    shards: bool = False
    """Write shards, for data sets that exceed the memory (docs/scale.md). Only for the layouts kato and around. If the
    command is interrupted, run it again: it continues."""
    jobs: Count = 1
    """Number of processes, each of which makes one shard at a time."""

    def __post_init__(self) -> None:
        if self.source is None and self.procedural == 0:
            raise ValueError("give --source (a folder of meshes or a mesh pack .npz), --procedural (a number), or both")
        if self.source and self.procedural and (self.up, self.front_axis) != ("y", "z"):
            raise ValueError("with --procedural, meshes of --source must have its axes: --up y --front z")
        if WRITERS[self.layout].only_shards and not self.shards:
            raise ValueError(f"the layout {self.layout} is made as shards: add --shards")
        if self.shards and self.layout not in ("kato", "around"):
            raise ValueError(
                f"shards need the layout kato or around, not {self.layout}; make the data set without --shards, and "
                "convert it (learn3d convert-dataset)"
            )
        if not self.shards and self.jobs > 1:
            raise ValueError("--jobs is for shards: add --shards")
        synset_of(self.category)
        conventions.mesh_to_object(self.up, self.front_axis)
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
                f"the splits of the layout {self.layout} are fixed: the first 80 % of the sorted ids are for training; "
                "leave test at 0.2 and augment at 0, or choose another layout"
            )

    @property
    def front_axis(self) -> str:
        """Axis of the mesh files that faces the camera of view 0."""
        return self.front or ("z" if self.procedural else "y" if self.up.endswith("x") else "x")

    def to_dict(self) -> dict[str, Any]:
        """The settings that determine the files, as JSON values."""
        settings = {name: value for name, value in asdict(self).items() if name not in WITHOUT_EFFECT}
        return settings | {"source": self.source and self.source.name}
