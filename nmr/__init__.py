"""nmr: the Neural Mesh Renderer of Kato et al. 2018 as a compiled CPU operator for torch.

Public names
------------
render_silhouette   meshes -> anti-aliased silhouettes, differentiable with NMR's gradient
render_face_index   meshes -> which face is nearest at each pixel
voxelize            meshes -> filled occupancy grids (kato18, the published voxel IoU)
LookAt, Look, Pinhole, Orthographic, Camera   cameras: world space -> renderer space; ``nmr.cameras`` converts them
icosphere, edge_table, unique_edges, losses   meshes to deform, and what to minimise
metrics             points on surfaces, Chamfer distance, F-score, IoU of grids
face_normals, vertex_normals    unit normals, differentiable

Conventions (``docs/conventions.md`` has the drawing): vertices are ``[B, V, 3]``; in renderer space x points right, y
up, both in [-1, 1] across the image, and z is the depth in front of the camera. Images are ``[B, S, S]`` with row 0
at the top.
"""

import torch as _torch  # noqa: F401  torch first: the extension then shares torch's OpenMP runtime

from . import cameras, losses, metrics
from .cameras import Camera, Look, LookAt, Orthographic, Pinhole
from .mesh import edge_table, face_normals, icosphere, unique_edges, vertex_normals
from .render import render_face_index, render_silhouette
from .voxels import voxelize

__all__ = [
    "Camera",
    "Look",
    "LookAt",
    "Orthographic",
    "Pinhole",
    "cameras",
    "edge_table",
    "face_normals",
    "icosphere",
    "losses",
    "metrics",
    "render_face_index",
    "render_silhouette",
    "unique_edges",
    "vertex_normals",
    "voxelize",
]
