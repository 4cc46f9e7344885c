"""The torch operators behind the public functions: each is declared once, by ``@kernel``
(``_kernel.py``).

Kernels read and write the memory of tensors on the CPU. Tensors on other devices are copied to
the CPU, and the results are copied back. Arguments are checked in the public functions; kernels
check shapes and indices again.

A batch of meshes is ``vertices [B, V, 3]`` with ``faces [F, 3]`` or ``[B, F, 3]`` and
``starts=None``, or packed: ``vertices [N, 3]``, ``faces [M, 3]`` (vertex numbers count from the
mesh's own first vertex) and ``starts`` int64 ``[B + 1, 2]`` in host memory: first vertex and
first face of each mesh, then N and M. faces are int64.

Images are ``[B, h, w]``; rasters are ``[B, H, W]``, twice as fine when anti-aliased, else the
same; row 0 = top. A face index map is int32:
-1 = background, f = face f is nearest, ``F + f`` = its reversed copy is (F = number of faces of that mesh).
"""

from ._kernel import in_forward_mode
from .camera import count_cameras, project
from .clip_space import antialias, clip_weights
from .edges import resolve
from .fragments import depth_image, fragments
from .losses import soft_iou_in_torch, soft_iou_loss
from .mesh import smoothness, voxels
from .raster import (
    RasterSettings,
    clip_count,
    clip_faces,
    no_camera,
    rasterize,
    rasterize_layers,
    silhouette,
)
from .shade import interpolate, lit, normals, texture_cubes
from .soft import soft_fragments, soft_layers, soft_silhouette
from .texture import WRAPS, mipmaps, sample_uv, uv_levels

__all__ = [
    "WRAPS",
    "RasterSettings",
    "antialias",
    "clip_count",
    "clip_faces",
    "clip_weights",
    "count_cameras",
    "depth_image",
    "fragments",
    "in_forward_mode",
    "interpolate",
    "lit",
    "mipmaps",
    "no_camera",
    "normals",
    "project",
    "rasterize",
    "rasterize_layers",
    "resolve",
    "sample_uv",
    "silhouette",
    "smoothness",
    "soft_fragments",
    "soft_iou_in_torch",
    "soft_iou_loss",
    "soft_layers",
    "soft_silhouette",
    "texture_cubes",
    "uv_levels",
    "voxels",
]
