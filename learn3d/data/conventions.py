"""Conventions: the object frame, Kato's 24 views, and where a data set's voxels lie.

The object frame is that of the renderer, which is LEFT-handed (x right, y up, z away from the camera of view 0), while
mesh files are right-handed: `mesh_to_object` is the one place where that reflection is made. A prediction is voxelised
in the object frame's axes and then brought into those of the stored ground truth, which is never touched. Sources: the
published evaluation code, see docs/methods/README.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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
    swap: tuple[int, int]  # grid axes to exchange (of batch, 1, 2, 3) ...
    flip: tuple[int, ...]  # ... and then to reverse
    cube_side: float = 1.0  # of the cube of the object frame, centred at the origin, that the grid spans
    kato18_scale: float = 1.0  # shrinking before the kato18 voxeliser, whose rays sit on the grid's corner lines

    def to_axes(self, grid: Tensor) -> Tensor:
        """Grids [B, s, s, s] with axes (x, y, z) of the object frame, in the axes of the stored voxels."""
        return grid.transpose(*self.swap).flip(self.flip)

    def to_object(self, grid: Tensor) -> Tensor:
        """The inverse of `to_axes`: stored voxels [B, s, s, s] in the axes (x, y, z) of the object frame."""
        return grid.flip(self.flip).transpose(*self.swap)

    def voxelize(self, vertices: Tensor, faces: Tensor, definition: Definition = "kato18") -> Tensor:
        """Occupancy bool [B, 32, 32, 32] of meshes in the object frame, comparable with the stored voxels.

        vertices float [B, V, 3] or [V, 3]; faces integer [F, 3] or [B, F, 3]. "kato18" is the voxeliser of Kato et al.
        2018 and of the paper, "kato19" the conservative one of Kato and Harada 2019 (VPL): every cell that a face
        touches. Not the same metric.
        """
        grid = nmr.voxelize(self._to_unit(vertices, definition), faces, size=VOXEL_SIZE, definition=definition)
        return self.to_axes(grid)

    def exceeds_grid(self, vertices: Tensor, definition: Definition = "kato18") -> Tensor:
        """Which meshes, vertices float [B, V, 3], reach beyond the grid and so count as hollow: bool [B]."""
        return (self._to_unit(vertices, definition) - 0.5).abs().amax(dim=(1, 2)) > 0.5

    def _to_unit(self, vertices: Tensor, definition: Definition) -> Tensor:
        """Object frame to the unit cube that the grid spans."""
        return vertices * ((self.kato18_scale if definition == "kato18" else 1.0) / self.cube_side) + 0.5


#: Where a grid's corner lines lie inside the box: `VoxelConvention.kato18_scale` of most data sets.
INNER = (VOXEL_SIZE - 1) / VOXEL_SIZE
#: Kato et al. 2018, SoftRas, the paper's table on Kato's data. Axes (y, x, -z).
KATO = VoxelConvention("kato", swap=(1, 2), flip=(3,), kato18_scale=INNER)


@dataclass(frozen=True)
class LayoutProperties:
    """Facts about all data sets of a layout."""

    voxels: bool  # there are true shapes, with which voxel IoU can be measured
    convention: VoxelConvention  # axes of the true shapes
    inverted: bool  # colours are stored as 255 - colour over black, see `ViewDataset.inverted`
    validation: bool = True  # there is a split "val"; without one, networks are validated on "test"
    angles: bool = True  # cameras have azimuth and elevation, whose cells can serve as view classes
    stretched: bool = False  # images are the object's box of a photograph, stretched to a square over its background
    options: tuple[str, ...] = ()  # of `load_dataset`, beside view_bins, that the reader knows


def mesh_to_object(up: str = "y", front: str = "x") -> np.ndarray:
    """Matrix [3, 3] that takes right-handed mesh coordinates to the object frame: object = matrix @ mesh.

    `up` is the mesh axis that points up, `front` the one that faces the camera of view 0 ("x", "-x", "y" ...). A viewer
    in front of the mesh has (-front) x up = up x front on the right, so the rows are [up x front, up, -front] and the
    determinant is -1. The default, (x, y, z) -> (-z, y, -x), is that of Kato's rendering of ShapeNet.
    """
    axes = {s + a: np.float64(-1 if s else 1) * row for s in ("", "-") for a, row in zip("xyz", np.eye(3), strict=True)}
    if up not in axes or front not in axes:
        raise ValueError(f"up and front must be one of {sorted(axes)}, got up={up!r}, front={front!r}")
    if up[-1] == front[-1]:
        raise ValueError(f"up and front must be two different axes, got up={up!r}, front={front!r}")
    return np.stack([np.cross(axes[up], axes[front]), axes[up], -axes[front]]) + 0.0


def view_poses(view_ids: torch.Tensor) -> LookAtPoses:
    """Poses of Kato's views, one per entry of `view_ids` (int64 [B] in 0 .. 23)."""
    azimuth_deg = AZIMUTH_STEP_DEG * torch.as_tensor(view_ids).to(torch.float32)
    return LookAtPoses(azimuth_deg, ELEVATION_DEG, DISTANCE, HALF_FOV_DEG)
