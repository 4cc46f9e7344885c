"""The base class of the writers, and their shared functions: random cameras, PNG files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from PIL import Image
from torch import Tensor

import nmr
from learn3d.data import conventions
from learn3d.data.dataset import ViewDataset
from learn3d.data.poses import Poses
from learn3d.pictures.studio import KEY_LIGHT, studio_lights

#: Takes the object frame to ShapeNet's coordinates (right-handed, y up, front x): [3, 3], determinant -1.
WORLD_FROM_OBJECT = conventions.mesh_to_object("y", "x").T
#: Range of camera distances, as multiples of the smallest one at which the image holds the whole bounding sphere.
RELATIVE_DISTANCES = (1.02, 1.25)


@dataclass(frozen=True, eq=False)
class RenderedObject:
    """One object, rendered from n cameras."""

    name: str  # unique in the category, valid as a file name
    split: str
    vertices: Tensor  # float32 [V, 3] in the layout's object frame, as `Writer.place` returned them
    faces: Tensor  # int64 [F, 3]
    poses: Poses  # n cameras
    rgb: np.ndarray  # uint8 [n, S, S, 3], shaded, over white
    alpha: np.ndarray  # uint8 [n, S, S]: 255 * `nmr.render_silhouette`
    voxels: np.ndarray  # bool [32, 32, 32], as `Writer.voxelize` returned them
    rng: np.random.Generator  # for backgrounds and surface points

    def rgba(self) -> np.ndarray:
        """The images with straight alpha, uint8 [n, S, S, 4]; pixels with alpha 0 are black."""
        share = self.alpha[..., None] / np.float32(255)
        color = (self.rgb - 255 * (1 - share)) / np.maximum(share, 1 / 255)
        color = np.where(share > 0, np.rint(color).clip(0, 255), 0).astype(np.uint8)
        return np.concatenate([color, self.alpha[..., None]], axis=-1)

    def world_to_camera(self) -> np.ndarray:
        """Extrinsics [R | t] float64 [n, 3, 4], from ShapeNet's coordinates to x right, y down, z away."""
        matrices = self.poses.cameras().projection().plain().matrix.numpy().astype(np.float64)
        matrices[:, :, :3] = matrices[:, :, :3] @ WORLD_FROM_OBJECT.T
        return matrices


class Writer(ABC):
    """Writes one category in one layout, object by object, into the temporary folder `folder`.

    `write` is called for the objects of train, val and test, then `finish`. Then the files `paths(category)` and
    `shared` are moved to the data set's folder. Images, cameras and voxel axes are Kato's unless a subclass changes
    them. The readers in `learn3d.data.readers` describe the files.
    """

    image_size: ClassVar[int] = conventions.IMAGE_SIZE
    default_views: ClassVar[int] = conventions.NUM_VIEWS  # per object
    fixed_views: ClassVar[bool] = False  # True if no other number of views is allowed
    default_test: ClassVar[float] = 0.2  # share of the test split; 0 if the layout has none
    default_val: ClassVar[float] = 0.1  # share of the validation split; 0 if the layout has none
    only_shards: ClassVar[bool] = False  # True if the layout exists as shards only
    fixed_splits: ClassVar[bool] = False  # True if readers split by the order of the objects
    convention: ClassVar[conventions.VoxelConvention] = conventions.KATO
    shared: ClassVar[tuple[str, ...]] = ()  # files with entries for all categories of the folder
    turn: ClassVar[np.ndarray] = np.eye(3)  # from the frame of `mesh_to_object` to the layout's object frame
    diagonal: ClassVar[float | None] = None  # diagonal of an object's bounding box; None: its longest side is 1

    def __init__(self, folder: Path, category: str) -> None:
        self.folder, self.category = folder, category

    @staticmethod
    @abstractmethod
    def paths(category: str) -> tuple[str, ...]:
        """Files and folders of this category alone, relative to the data set's folder."""

    def place(self, vertices: np.ndarray) -> np.ndarray:
        """Take vertices [V, 3] (box centred, longest side 1, frame of `mesh_to_object`) to the layout's frame."""
        vertices = vertices @ self.turn.T
        return vertices if self.diagonal is None else vertices / (np.linalg.norm(np.ptp(vertices, 0)) / self.diagonal)

    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> Poses:
        """Choose `count` cameras for the placed vertices [V, 3]."""
        return conventions.view_poses(torch.arange(count))

    def paint(
        self, vertices: np.ndarray, faces: np.ndarray, color: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, nmr.Lights]:
        """Colours [3] or [F, 3] in [0, 1] and lights for the placed mesh. `color` [3]: a random light grey."""
        return color, studio_lights(tuple((self.turn @ KEY_LIGHT).tolist()))

    def voxelize(self, vertices: Tensor, faces: Tensor) -> np.ndarray:
        """Occupancy bool [32, 32, 32] of the placed mesh in the axes of the layout."""
        return self.convention.voxelize(vertices, faces)[0].numpy()

    @abstractmethod
    def write(self, item: RenderedObject) -> None:
        """Write, or keep, one object."""

    @classmethod
    def dataset(cls, objects: Sequence[RenderedObject], category: str, split: str) -> ViewDataset:
        """The objects as a data set, to be written as a shard; only for layouts with shards."""
        raise NotImplementedError

    def split(self, meshes: list[dict]) -> list[dict]:
        """The entries of `DatasetReport.meshes` with the splits that readers of the layout will find."""
        return meshes

    def finish(self, output: Path, objects: dict[str, list[str]]) -> None:
        """Complete the files. `objects` are the names of each split; `output` is the final folder."""
        return None


def uniform(rng: np.random.Generator, limits: tuple[float, float], count: int) -> np.ndarray:
    """Draw float32 [count] in [low, high), rounded to 4 decimals so that text files hold exactly the same numbers.

    A value that is rounded up to `high` becomes `low`, the same angle.
    """
    low, high = limits
    values = np.round(rng.uniform(low, high, count), 4)
    return np.where(values >= high, low, values).astype(np.float32)


def distances(rng: np.random.Generator, vertices: np.ndarray, half_fov_deg: np.ndarray) -> np.ndarray:
    """Draw a camera distance for each half_fov_deg [count]: float32 [count], in RELATIVE_DISTANCES.

    The image then holds the whole bounding sphere of the vertices [V, 3] around 0.
    """
    radius = float(np.linalg.norm(vertices, axis=1).max())
    least = radius / np.sin(np.deg2rad(half_fov_deg.astype(np.float64)))
    return np.round(least * rng.uniform(*RELATIVE_DISTANCES, len(least)), 4).astype(np.float32)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write uint8 [H, W] (grey), [H, W, 3] or [H, W, 4]; missing folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path, compress_level=4)
