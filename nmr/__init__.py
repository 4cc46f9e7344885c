"""nmr: the Neural Mesh Renderer of Kato et al. 2018 as compiled CPU operators for torch.

Public names
------------
render              meshes -> several of the images below in one pass
render_silhouette   meshes -> anti-aliased silhouettes, differentiable with NMR's gradient or a local one
render_soft_silhouette    meshes -> the soft silhouettes of SoftRas, with their true derivative
render_rgb          meshes -> colour images, with the same gradient
render_depth        meshes -> depth images, with their true derivative
render_normals      meshes -> normals in world or camera space
render_soft     meshes -> the soft colours of SoftRas and PyTorch3D, with their true derivative
render_transparent  meshes -> colour images of transparent surfaces
render_fragments    meshes -> Fragments: face, weights and depth at each pixel, for shading of your own
render_face_index   meshes -> which face is nearest at each pixel
VertexColors, FaceColors, TextureCubes, UVTexture   colours of meshes; Colors: the interface for a class of your own
sample_texture      the colours of an image at uv coordinates of your own
Lights              ambient, directional and point lights, spherical harmonics; NormalMap: normals from an image
LookAt, Look, Pinhole, Orthographic, Camera   cameras: world space -> renderer space; ``nmr.cameras`` converts them
voxelize            meshes -> filled occupancy grids (kato18 or kato19, the published voxel IoU)
load_obj, load_gltf  a mesh file -> vertices, faces, texture coordinates, materials, vertex colours; save_obj
Materials           colours of such a mesh: an image or a colour for each material
icosphere, edge_table, unique_edges, losses   a sphere to deform, its edges, loss functions
metrics             points on surfaces, Chamfer distance, F-score, IoU of grids
face_normals, vertex_normals    unit normals, differentiable
neural_renderer     the interface of neural_renderer_pytorch 1.1.3; import it explicitly
nvdiffrast          the interface of nvdiffrast.torch; import it explicitly

Conventions (``docs/conventions.md`` has the drawing): vertices are ``[B, V, 3]`` with faces
``[F, 3]`` or ``[B, F, 3]``, or lists of ``[V_b, 3]`` and ``[F_b, 3]``. In renderer space x points
right, y up, both in [-1, 1] across the image, and z is the depth in front of the camera. Images
are ``[B, h, w]``, with channels ``[B, h, w, C]``; row 0 is at the top.
"""

import torch as _torch  # noqa: F401  torch first: the extension then shares torch's OpenMP runtime

from . import cameras, losses, metrics
from .cameras import Camera, Look, LookAt, Orthographic, Pinhole
from .fragments import Fragments
from .images import Images
from .layers import render_soft, render_transparent
from .lights import Lights
from .materials import Materials
from .mesh import edge_table, face_normals, icosphere, unique_edges, vertex_normals
from .mesh_files import load_gltf, load_obj, save_obj
from .render import (
    render,
    render_depth,
    render_face_index,
    render_fragments,
    render_normals,
    render_rgb,
    render_silhouette,
    render_soft_silhouette,
)
from .textures import (
    Colors,
    FaceColors,
    NormalMap,
    TextureCubes,
    UVTexture,
    VertexColors,
    sample_texture,
)
from .voxels import voxelize

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Colors",
    "FaceColors",
    "Fragments",
    "Images",
    "Lights",
    "Look",
    "LookAt",
    "Materials",
    "NormalMap",
    "Orthographic",
    "Pinhole",
    "TextureCubes",
    "UVTexture",
    "VertexColors",
    "cameras",
    "edge_table",
    "face_normals",
    "icosphere",
    "load_gltf",
    "load_obj",
    "losses",
    "metrics",
    "render",
    "render_depth",
    "render_face_index",
    "render_fragments",
    "render_normals",
    "render_rgb",
    "render_silhouette",
    "render_soft",
    "render_soft_silhouette",
    "render_transparent",
    "sample_texture",
    "save_obj",
    "unique_edges",
    "vertex_normals",
    "voxelize",
]
