"""Conventions: object frame, Kato's views, axes of voxels, names of categories and splits.

The object frame is that of the renderer: LEFT-handed, x right, y up, z away from the camera of
view 0. Mesh files are right-handed; `mesh_to_object` converts their coordinates. A prediction is
voxelized in the object frame, and the grid is then converted to the axes of the stored ground
truth. Sources: the published evaluation code, see docs/methods/README.md.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

import nmr
from learn3d.data.poses import LookAtPoses

VOXEL_SIZE = 32
Definition = Literal["kato18", "kato19"]

# The views of Kato's renderings
NUM_VIEWS = 24
IMAGE_SIZE = 64
DISTANCE = 2.732
ELEVATION_DEG = 30.0
AZIMUTH_STEP_DEG = -15.0
HALF_FOV_DEG = 15.0


@dataclass(frozen=True)
class VoxelConvention:
    """Axes and normalisation of a data set's ground-truth grids."""

    name: str
    swap: tuple[int, int]  # dimensions of [B, x, y, z] to exchange
    flip: tuple[int, ...]  # dimensions to reverse after that
    # side of the cube of the grid, centred at the origin of the object frame
    cube_side: float = 1.0
    kato18_scale: float = 1.0  # scale of meshes before the kato18 voxelizer, whose rays are on the grid's corner lines

    def to_axes(self, grid: Tensor) -> Tensor:
        """Convert grids [B, s, s, s] from the object frame's axes to those of stored voxels."""
        return grid.transpose(*self.swap).flip(self.flip)

    def to_object(self, grid: Tensor) -> Tensor:
        """The inverse of `to_axes`, for stored voxels [B, s, s, s]."""
        return grid.flip(self.flip).transpose(*self.swap)

    def voxelize(
        self, vertices: Tensor, faces: Tensor, definition: Definition = "kato18"
    ) -> Tensor:
        """Occupancy bool [B, 32, 32, 32] of meshes, comparable with the stored voxels.

        vertices: float [B, V, 3] or [V, 3]. faces: integer [F, 3] or [B, F, 3]. definition:
        "kato18" for the voxelizer of Kato et al. 2018 and of the paper, "kato19" for the
        conservative one of Kato and Harada 2019 (VPL), which fills every cell that a face
        touches. Their IoUs must not be compared with each other.
        """
        grid = nmr.voxelize(
            self._to_unit(vertices, definition), faces, size=VOXEL_SIZE, definition=definition
        )
        return self.to_axes(grid)

    def exceeds_grid(self, vertices: Tensor, definition: Definition = "kato18") -> Tensor:
        """Which meshes (float [B, V, 3]) exceed the grid, so that they count as hollow: bool [B]."""
        return (self._to_unit(vertices, definition) - 0.5).abs().amax(dim=(1, 2)) > 0.5

    def _to_unit(self, vertices: Tensor, definition: Definition) -> Tensor:
        """Object frame to the unit cube that the grid spans."""
        return (
            vertices * ((self.kato18_scale if definition == "kato18" else 1.0) / self.cube_side)
            + 0.5
        )


#: Side of the cube of the grid's corner lines: `VoxelConvention.kato18_scale` of most data sets.
INNER = (VOXEL_SIZE - 1) / VOXEL_SIZE
#: Kato et al. 2018, SoftRas, the paper's table on Kato's data. Axes (y, x, -z).
KATO = VoxelConvention("kato", swap=(1, 2), flip=(3,), kato18_scale=INNER)


@dataclass(frozen=True)
class LayoutProperties:
    """Properties of all data sets of a layout."""

    voxels: bool  # True if there is ground truth for the voxel IoU
    inverted: bool  # True if colours are stored as 255 - colour, see `ViewDataset.inverted`
    convention: VoxelConvention = KATO  # axes of the voxels
    # True if there is a split "val"; otherwise networks are validated on "test"
    validation: bool = True
    angles: bool = True  # True if poses have azimuth and elevation, as cells of view classes need
    # True if images are boxes of photographs with background, stretched to squares
    stretched: bool = False
    # views of each object that training uses by the published protocol, the first ones; None: all
    training_views: int | None = None
    options: tuple[str, ...] = ()  # those of image_size and views_per_object that the reader takes

    def about(self, category: str, split: str) -> dict[str, Any]:
        """The fields of a `ViewDataset` that data sets of the layout share."""
        return {
            "category": category,
            "split": split,
            "convention": self.convention,
            "inverted": self.inverted,
        }


#: The .mat volumes of Kar, as the paper's code reads them: axes (-z, y, x) of the object frame.
KAR = VoxelConvention("kar", swap=(1, 3), flip=(1,), kato18_scale=INNER)
#: The grid of Pascal3D+ spans [-1, 1]; axes (-x, -z, -y) of the object frame.
PASCAL3D = VoxelConvention("pascal3d", swap=(2, 3), flip=(1, 2, 3), cube_side=2.0)

#: By name; the module of that name in `readers` reads it.
LAYOUTS = {
    "kato": LayoutProperties(voxels=True, inverted=True),
    "dvr": LayoutProperties(voxels=False, inverted=True),
    "kar": LayoutProperties(
        voxels=True,
        convention=KAR,
        inverted=False,
        training_views=1,
        options=("image_size", "views_per_object"),
    ),
    "pascal3d": LayoutProperties(
        voxels=True,
        convention=PASCAL3D,
        inverted=False,
        angles=False,
        stretched=True,
        options=("image_size",),
    ),
    "photos": LayoutProperties(voxels=False, inverted=True, options=("image_size",)),
    "around": LayoutProperties(voxels=True, inverted=True),
}


def mesh_to_object(up: str = "y", front: str = "x") -> np.ndarray:
    """Matrix float64 [3, 3] from mesh coordinates to the object frame: object = matrix @ mesh.

    `up` is the mesh axis that points up, `front` the one that faces the camera of view 0 ("x",
    "-x", "y" ...). A viewer in front of the mesh has up x front on the right. So the rows are [up
    x front, up, -front], and the determinant is -1. The default, (x, y, z) -> (-z, y, -x), is
    that of Kato's renderings of ShapeNet. Raises ValueError for other or parallel axes.
    """
    axes = {
        s + a: np.float64(-1 if s else 1) * row
        for s in ("", "-")
        for a, row in zip("xyz", np.eye(3), strict=True)
    }
    if up not in axes or front not in axes or up[-1] == front[-1]:
        wanted = f"two different axes, each one of {sorted(axes)}"
        raise ValueError(f"up and front must be {wanted}; got up={up!r}, front={front!r}")
    return np.stack([np.cross(axes[up], axes[front]), axes[up], -axes[front]]) + 0.0


def view_poses(view_ids: torch.Tensor) -> LookAtPoses:
    """Poses of Kato's views `view_ids`, int64 [B] in 0 .. 23."""
    azimuth_deg = AZIMUTH_STEP_DEG * torch.as_tensor(view_ids).to(torch.float32)
    return LookAtPoses(azimuth_deg, ELEVATION_DEG, DISTANCE, HALF_FOV_DEG)


# Kato's 13 categories of ShapeNet, splits, and the names of their files
SPLITS = ("train", "val", "test")
SET_FILE = "set.json"  # a split with this file is complete as shards (`data.shards`)
SYNSETS = {
    "airplane": "02691156",
    "bench": "02828884",
    "cabinet": "02933112",
    "car": "02958343",
    "chair": "03001627",
    "display": "03211117",
    "lamp": "03636649",
    "loudspeaker": "03691459",
    "rifle": "04090263",
    "sofa": "04256520",
    "table": "04379243",
    "telephone": "04401088",
    "vessel": "04530566",
}
_OTHER_NAMES = {"aeroplane": "airplane"}  # in Pascal3D+


def synset_of(category: str) -> str:
    """File name prefix of a category: the ShapeNet synset id of Kato's 13 names; any other name
    is its own prefix.

    Raises ValueError for an empty name or one that cannot be part of a file name.
    """
    forbidden = set('/\\:*?"<>|\0')
    if (
        not category
        or not category.isprintable()
        or set(category) & forbidden
        or category.startswith(".")
    ):
        raise ValueError(
            f"category must be a plain name such as 'chair' or a synset id, got {category!r}"
        )
    return SYNSETS.get(_OTHER_NAMES.get(category, category), category)


def shards_folder(folder: Path | str, category: str, split: str) -> Path:
    """The folder of the shards of a split."""
    return Path(folder) / synset_of(category) / split


def has_shards(folder: Path | str, category: str, split: str) -> bool:
    """Whether the folder has this split as complete shards; False for an invalid category."""
    try:
        return (shards_folder(folder, category, split) / SET_FILE).is_file()
    except (ValueError, OSError):
        return False


def find_splits(folder: Path | str, *patterns: str) -> dict[str, tuple[str, ...]]:
    """The categories of a folder and the splits of each. patterns: paths such as "*/SPLIT.txt"; *
    is the category.
    """
    found = {}
    for pattern in patterns:
        for split in SPLITS:
            before, after = pattern.replace("SPLIT", split).split("*")
            for path in Path(folder).glob(f"{before}*{after}"):
                name = path.relative_to(folder).as_posix().removeprefix(before).removesuffix(after)
                found.setdefault(name, set()).add(split)
    return {
        name: tuple(split for split in SPLITS if split in found[name]) for name in sorted(found)
    }
