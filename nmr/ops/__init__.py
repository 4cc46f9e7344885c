"""The torch operators behind the public functions: forward, fake, set-up and backward of each stand together.

The kernels take NumPy views of the tensors (zero-copy on the CPU). Tensors on other devices are copied to the CPU, and
the results are copied back. Arguments are not checked here, but in the public functions.

A batch of meshes is ``vertices [B, V, 3]`` with ``faces [F, 3]`` or ``[B, F, 3]`` and ``starts=None``, or packed:
``vertices [N, 3]``, ``faces [M, 3]`` (vertex numbers count from the mesh's own first vertex) and ``starts`` int64
``[B + 1, 2]`` in host memory: first vertex and first face of each mesh, then N and M. faces are int64.

Images are ``[B, h, w]``; rasters are ``[B, H, W]``, twice as fine when anti-aliased, else the same; row 0 = top. A
face index map is int32:
-1 = background, f = face f is nearest, ``F + f`` = its reversed copy is (F = number of faces of that mesh).
"""

from .camera import pose, pose_backward, project, project_backward
from .clip import clip_count, clip_faces
from .clip_space import antialias, antialias_backward, clip_weights, clip_weights_backward
from .edges import edges_backward, resolve, resolve_backward
from .fragments import depth_backward, depth_image, fragments, fragments_backward
from .lights import lit, lit_backward, normals, normals_backward, viewer_of
from .losses import soft_iou, soft_iou_backward
from .mesh import smoothness, smoothness_backward, voxels
from .raster import local_gradient, rasterize, rasterize_layers, silhouette, silhouette_backward
from .shade import interpolate, interpolate_backward, sample_texture_cubes, texture_cubes_backward
from .soft import (
    soft_fragments,
    soft_fragments_backward,
    soft_layers,
    soft_silhouette,
    soft_silhouette_backward,
)
from .texture import WRAPS, mipmaps, mipmaps_backward, sample_uv, sample_uv_backward, uv_levels

__all__ = [
    "WRAPS",
    "antialias",
    "antialias_backward",
    "clip_count",
    "clip_faces",
    "clip_weights",
    "clip_weights_backward",
    "depth_backward",
    "depth_image",
    "edges_backward",
    "fragments",
    "fragments_backward",
    "interpolate",
    "interpolate_backward",
    "lit",
    "lit_backward",
    "local_gradient",
    "mipmaps",
    "mipmaps_backward",
    "normals",
    "normals_backward",
    "pose",
    "pose_backward",
    "project",
    "project_backward",
    "rasterize",
    "rasterize_layers",
    "resolve",
    "resolve_backward",
    "sample_texture_cubes",
    "sample_uv",
    "sample_uv_backward",
    "silhouette",
    "silhouette_backward",
    "smoothness",
    "smoothness_backward",
    "soft_fragments",
    "soft_fragments_backward",
    "soft_iou",
    "soft_iou_backward",
    "soft_layers",
    "soft_silhouette",
    "soft_silhouette_backward",
    "texture_cubes_backward",
    "uv_levels",
    "viewer_of",
    "voxels",
]
