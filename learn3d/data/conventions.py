"""Where each data set's voxels lie: one named transform per data set, from the object frame to its grid.

A prediction is voxelised in the object frame's axes (x, y, z) and then brought into those of the stored ground truth,
which is never touched. Sources: the published evaluation code, see docs/methods/README.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

import nmr

VOXEL_SIZE = 32
Definition = Literal["kato18", "kato19"]


@dataclass(frozen=True)
class VoxelConvention:
    """Axes and normalisation of a data set's ground-truth grids."""

    name: str
    swap: tuple[int, int] | None  # grid axes to exchange (of batch, 1, 2, 3) ...
    flip: tuple[int, ...]  # ... and then to reverse
    box: float = 1.0  # side of the cube of the object frame, centred at the origin, that the grid spans
    kato18_scale: float = 1.0  # shrinking before the kato18 voxeliser, whose rays sit on the grid's corner lines

    def to_axes(self, grid: Tensor) -> Tensor:
        """Grids [B, s, s, s] with axes (x, y, z) of the object frame, in the axes of the stored voxels."""
        if self.swap is not None:
            grid = grid.transpose(*self.swap)
        return grid.flip(self.flip) if self.flip else grid

    def to_object(self, grid: Tensor) -> Tensor:
        """The inverse of `to_axes`: stored voxels [B, s, s, s] in the axes (x, y, z) of the object frame."""
        if self.flip:
            grid = grid.flip(self.flip)
        return grid.transpose(*self.swap) if self.swap is not None else grid

    def voxelize(self, vertices: Tensor, faces: Tensor, definition: Definition = "kato18") -> Tensor:
        """Occupancy bool [B, 32, 32, 32] of meshes in the object frame, comparable with the stored voxels.

        vertices float [B, V, 3] or [V, 3]; faces integer [F, 3] or [B, F, 3]. "kato18" is the voxeliser of Kato et al.
        2018 and of the paper, "kato19" the conservative one of Kato and Harada 2019 (VPL): every cell that a face
        touches. Not the same metric.
        """
        scale = (self.kato18_scale if definition == "kato18" else 1.0) / self.box
        grid = nmr.voxelize(vertices * scale + 0.5, faces, size=VOXEL_SIZE, definition=definition)
        return self.to_axes(grid)


_INNER = (VOXEL_SIZE - 1) / VOXEL_SIZE

#: Kato et al. 2018, SoftRas, the paper's table on Kato's data. Axes (y, x, -z).
KATO = VoxelConvention("kato", swap=(1, 2), flip=(3,), kato18_scale=_INNER)
#: Kar et al. 2017 (LSM), .mat volumes, as the paper's code reads them. Axes (-z, y, x).
KAR = VoxelConvention("kar", swap=(1, 3), flip=(1,), kato18_scale=_INNER)
#: Kato and Harada 2019's own packing of Kar's data. Axes (x, y, -z).
KAR_VPL = VoxelConvention("kar-vpl", swap=None, flip=(3,))
#: Pascal3D+ as packed by Kato and Harada 2019: the grid spans [-1, 1]. Axes (-x, -z, -y).
PASCAL3D = VoxelConvention("pascal3d", swap=(2, 3), flip=(1, 2, 3), box=2.0)
#: 3D-R2N2's binvox grids. binvox keeps the axes (x, y, z) of ShapeNet's mesh files (y up, right-handed), and the object
#: frame of the renderings is (-z, y, -x) of the mesh (the same as Kato's, see `kato.mesh_to_object`). Read backwards,
#: the grid's axes are (-z, y, -x) of the object frame. The grid spans the cube that binvox fits around the object.
R2N2 = VoxelConvention("r2n2", swap=(1, 3), flip=(1, 3), kato18_scale=_INNER)
