"""What every layout's writer has in common: it is given one rendered object at a time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from torch import Tensor

from learn3d.data.conventions import VoxelConvention, mesh_to_object
from learn3d.data.poses import Poses

#: From the object frame to ShapeNet's coordinates (right-handed, y up, front x): [3, 3], determinant -1.
WORLD_FROM_OBJECT = mesh_to_object("y", "x").T


@dataclass(frozen=True, eq=False)
class RenderedObject:
    """One object, rendered from n cameras."""

    name: str  # unique in the category, fit for a file name
    split: str
    vertices: Tensor  # float32 [V, 3] in the layout's object frame, as `Writer.place` returned them
    faces: Tensor  # int64 [F, 3]
    poses: Poses  # n cameras
    rgb: np.ndarray  # uint8 [n, S, S, 3], shaded, over white
    alpha: np.ndarray  # uint8 [n, S, S]: 255 * `nmr.render_silhouette`
    voxels: np.ndarray  # bool [32, 32, 32], as `Writer.voxelize` returned them
    rng: np.random.Generator  # for what else is random in its files (backgrounds, points)

    def over(self, backgrounds: np.ndarray) -> np.ndarray:
        """The pictures over backgrounds instead of white; both are uint8 [n, S, S, 3]."""
        clear = 1 - self.alpha[..., None] / np.float32(255)
        return np.rint(self.rgb + (backgrounds.astype(np.float32) - 255) * clear).clip(0, 255).astype(np.uint8)

    def rgba(self) -> np.ndarray:
        """The pictures without the white: colours and alpha, uint8 [n, S, S, 4]; colours are 0 where alpha is."""
        share = self.alpha[..., None] / np.float32(255)
        color = (self.rgb - 255 * (1 - share)) / np.maximum(share, 1 / 255)
        color = np.where(share > 0, np.rint(color).clip(0, 255), 0).astype(np.uint8)
        return np.concatenate([color, self.alpha[..., None]], axis=-1)


class Writer(ABC):
    """One category in one layout, written below `folder` (an empty, temporary one) object by object.

    `make_dataset` calls `start` and then `write` for the objects of each split (train, val, test), then `finish`.
    After that it moves what is in `paths(category)` and `shared` to its final place.
    """

    image_size: ClassVar[int]
    default_views: ClassVar[int]  # views per object unless the user asks for another number
    fixed_views: ClassVar[bool] = False  # no other number is allowed
    default_test: ClassVar[float] = 0.2  # shares of the splits unless the user says; 0 where there is no such split
    default_val: ClassVar[float] = 0.1
    bytes_per_view: ClassVar[int]  # an upper estimate for the check of the disk
    convention: ClassVar[VoxelConvention]
    shared: ClassVar[tuple[str, ...]] = ()  # files with entries of all categories of the folder
    turn: ClassVar[np.ndarray] = np.eye(3)  # from the frame of `mesh_to_object` to the layout's object frame
    objects_fill: ClassVar[str] = "box centred at the origin, longest side 1"
    card: ClassVar[dict[str, str]]  # what is in the files, for people

    def __init__(self, folder: Path, category: str) -> None:
        self.folder = folder
        self.category = category

    @classmethod
    @abstractmethod
    def paths(cls, category: str) -> tuple[str, ...]:
        """Files and folders, relative to the data set's, that belong to the category alone."""

    @classmethod
    def check(cls, output: Path, category: str, test: float, augment: int) -> None:
        """Raises ValueError where the settings, or files that are there already, do not go with the layout."""
        return None

    def place(self, vertices: np.ndarray) -> np.ndarray:
        """Vertices [V, 3] (box centred, longest side 1, frame of `mesh_to_object`) in the layout's object frame."""
        return vertices if self.turn is Writer.turn else vertices @ self.turn.T

    @abstractmethod
    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> Poses:
        """The `count` cameras that look at the placed vertices."""

    def voxelize(self, vertices: Tensor, faces: Tensor) -> np.ndarray:
        """Occupancy bool [32, 32, 32] of the placed mesh in the axes of the layout."""
        return self.convention.voxelize(vertices, faces)[0].numpy()

    def start(self, split: str, most: int) -> None:
        """`most` objects of a split, or fewer, follow."""
        return None

    @abstractmethod
    def write(self, item: RenderedObject) -> None:
        """Write, or keep, one object."""

    def finish(self, output: Path, objects: dict[str, list[str]]) -> dict[str, list[str]]:
        """Complete the files; `objects` are the names written per split, `output` is where the files will go.

        Returns the names per split as readers of the layout will see them.
        """
        return objects
