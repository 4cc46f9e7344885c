"""A layout that can be written, and what all layouts share: random cameras, PNG files."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image
from torch import Tensor

from learn3d.data.conventions import IMAGE_SIZE, KATO, NUM_VIEWS, VoxelConvention, mesh_to_object
from learn3d.data.dataset import ViewDataset
from learn3d.data.poses import LookAtPoses, Poses

#: Takes the object frame to ShapeNet's coordinates (right-handed, y up, front x): [3, 3],
#: determinant -1.
WORLD_FROM_OBJECT = mesh_to_object("y", "x").T
#: Range of camera distances, as multiples of the smallest one at which the image holds the whole
#: bounding sphere.
RELATIVE_DISTANCES = (1.02, 1.25)


@dataclass(frozen=True, eq=False)
class RenderedObject:
    """One object, rendered from n cameras."""

    name: str  # unique in the category, valid as a file name
    split: str
    vertices: Tensor  # float32 [V, 3] in the layout's object frame
    faces: Tensor  # int64 [F, 3]
    poses: Poses  # n cameras
    rgb: np.ndarray  # uint8 [n, S, S, 3], shaded, over white
    alpha: np.ndarray  # uint8 [n, S, S]: 255 * `nmr.render_silhouette`
    voxels: np.ndarray  # bool [32, 32, 32], in the axes of the layout
    rng: np.random.Generator  # for backgrounds

    def rgba(self) -> np.ndarray:
        """The images with straight alpha, uint8 [n, S, S, 4]; pixels with alpha 0 are black."""
        share = self.alpha[..., None] / np.float32(255)
        color = (self.rgb - 255 * (1 - share)) / np.maximum(share, 1 / 255)
        color = np.where(share > 0, np.rint(color).clip(0, 255), 0).astype(np.uint8)
        return np.concatenate([color, self.alpha[..., None]], axis=-1)

    def world_to_camera(self) -> np.ndarray:
        """Extrinsics [R | t] float64 [n, 3, 4], ShapeNet to x right, y down, z away."""
        matrices = self.poses.cameras().projection().plain().matrix.numpy().astype(np.float64)
        matrices[:, :, :3] = matrices[:, :, :3] @ WORLD_FROM_OBJECT.T
        return matrices


@dataclass(frozen=True, kw_only=True)
class Writer:
    """How a category is rendered and written in a layout; `learn3d.data.readers` has the files.

    Images, cameras and voxel axes are Kato's unless a field says otherwise.
    """

    #: Files and folders of a category alone, relative to the data set's folder.
    paths: Callable[[str], tuple[str, ...]] = lambda category: ()
    #: write(objects, category, temporary, folder) writes train, val and test of a category into
    #: `temporary`; then `paths` and `shared` are moved to `folder`, that of the data set. None if
    #: the layout exists as shards only.
    write: Callable[[Iterable[RenderedObject], str, Path, Path], None] | None = None
    #: Joins objects of a category and a split for a shard. None if the layout has no shards.
    join: Callable[[Sequence[RenderedObject], str, str], ViewDataset] | None = None
    #: Draws the given number of cameras for the placed vertices [V, 3]. None if all objects have
    #: Kato's 24 views.
    views: Callable[[np.ndarray, int, np.random.Generator], Poses] | None = None
    image_size: int = IMAGE_SIZE
    default_views: int = NUM_VIEWS  # per object
    default_test: float = 0.2  # share of the test split; 0 if the layout has none
    default_val: float = 0.1  # share of the validation split
    fixed: tuple[str, ...] = ()  # options (views, test) that must have their default values
    shared: tuple[str, ...] = ()  # files with entries for all categories of the folder
    convention: VoxelConvention = KATO
    # frame of `mesh_to_object` to layout's object frame
    turn: np.ndarray = field(default_factory=lambda: np.eye(3))
    # diagonal of an object's bounding box; None if its longest side is 1
    diagonal: float | None = None
    natural: bool = False  # True for everyday colours and lights; else objects are light grey


def random_views(
    elevations_deg: tuple[float, float],
    half_fovs_deg: tuple[float, float] | float,
    vertices: np.ndarray,
    count: int,
    rng: np.random.Generator,
) -> LookAtPoses:
    """Draw `count` cameras whose images hold the bounding sphere of vertices [V, 3] around 0."""
    azimuth_deg = uniform(rng, (-180.0, 180.0), count)
    elevation_deg = uniform(rng, elevations_deg, count)
    half_fov_deg = (
        half_fovs_deg if isinstance(half_fovs_deg, float) else uniform(rng, half_fovs_deg, count)
    )
    least = np.linalg.norm(vertices, axis=1).max() / np.sin(np.deg2rad(np.float64(half_fov_deg)))
    distance = np.round(least * rng.uniform(*RELATIVE_DISTANCES, count), 4).astype(np.float32)
    return LookAtPoses(azimuth_deg, elevation_deg, distance, half_fov_deg)


def uniform(rng: np.random.Generator, limits: tuple[float, float], count: int) -> np.ndarray:
    """Draw float32 [count] in [low, high), rounded to 4 decimals so that text files hold exactly the same numbers.

    A value that is rounded up to `high` becomes `low`, the same angle.
    """
    low, high = limits
    values = np.round(rng.uniform(low, high, count), 4)
    return np.where(values >= high, low, values).astype(np.float32)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write uint8 [H, W] (grey), [H, W, 3] or [H, W, 4]; missing folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path, compress_level=4)
