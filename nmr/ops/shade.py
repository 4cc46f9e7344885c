"""Operators: colours from texture cubes, values given at the corners of faces, normals, and lit
colours.
"""

import torch
from torch import Tensor

from .._vectors import face_cross, gather_rows, unit
from ._kernel import kernel


@kernel("colors", gradients="textures", used_by="render_rgb")
def texture_cubes(
    textures: Tensor,
    face_index: Tensor,
    weights: Tensor,
    starts: Tensor | None,
    eps: float,
) -> Tensor:
    """Colours ``[B, H, W, C]`` from texture cubes; 0 on background.

    textures are ``[B or 1, F, ts, ts, ts, C]``, packed ``[M, ts, ts, ts, C]``. Axis k of a cube
    is the weight of the face's vertex k: sampled trilinearly at ``weights * (ts - 1)``, clamped
    to ``[0, ts - 1 - eps]``. Differentiable in ``textures`` only, as published.
    """
    return textures.new_empty((*face_index.shape, textures.shape[-1]))


@kernel("values", gradients="attributes weights", used_by="render_rgb")
def interpolate(
    attributes: Tensor,
    corners: Tensor,
    face_index: Tensor,
    weights: Tensor,
    starts: Tensor | None,
) -> Tensor:
    """``values[b, y, x] = sum_k weights[b, y, x, k] attributes[b, corners[f, k]]``
    ``[B, H, W, C]``; 0 on background.

    attributes are ``[B or 1, N, C]``, packed ``[N, C]``; corners ``[F, 3]``, ``[B, F, 3]`` or
    packed ``[M, 3]`` are rows of them, counted from the first of the mesh; ``starts`` (packed)
    are first row and first face of each mesh.
    """
    return attributes.new_empty((*face_index.shape, attributes.shape[-1]))


def _normals_in_torch(
    vertices: Tensor, faces: Tensor, starts: Tensor | None, smooth: bool
) -> Tensor:
    """:func:`normals` by torch, for second derivatives."""
    if starts is not None:  # packed: one large mesh
        first = starts[:-1, :1].repeat_interleave(starts[:, 1].diff(), 0)
        faces = faces + first.to(faces.device)
        return _normals_in_torch(vertices.unsqueeze(0), faces, None, smooth)[0]
    corner_of = faces.flip(-1).flatten(-2)
    cross = face_cross(gather_rows(vertices, corner_of).unflatten(1, (-1, 3)))
    if smooth:
        index = corner_of.expand(len(cross), -1).unsqueeze(-1).expand(-1, -1, 3)
        sums = torch.zeros_like(vertices)
        cross = sums.scatter_add(1, index, cross.repeat_interleave(3, dim=1))
    return unit(cross)


@kernel("normals", gradients="vertices", used_by="render_normals", twice=_normals_in_torch)
def normals(vertices: Tensor, faces: Tensor, starts: Tensor | None, smooth: bool) -> Tensor:
    """Unit normals ``n((v0 - v1) x (v2 - v1))`` of faces, ``[B or 1, F, 3]`` or packed
    ``[M, 3]``.

    smooth: normals of vertices, like ``vertices``: the direction of the sum of these products. 0
    without an area.
    """
    return vertices.new_empty(
        vertices.shape if smooth else (*vertices.shape[:-2], *faces.shape[-2:])
    )


@kernel(
    "lit", gradients="colors normals parameters vertices weights", used_by="render_rgb with lights"
)
def lit(
    colors: Tensor | None,
    normals: Tensor,
    parameters: Tensor | None,
    layout: Tensor,
    viewer: Tensor,
    vertices: Tensor,
    faces: Tensor,
    face_index: Tensor,
    weights: Tensor,
    starts: Tensor | None,
    smooth: bool,
) -> Tensor:
    """Lit colours ``[B, H, W, 3]``; 0 on background. Without parameters, the normals.

    colors are ``[B, H, W, 1 or 3]``, None is white; normals those of :func:`normals`; parameters
    ``[P]`` all values of lights, and layout int64 ``[11, 3]`` the place of each: first value,
    rows (1 or B), lights; viewer ``[B, 5]``: the place of the eye and 1, or the direction towards
    the viewer and 0, then -1 if the camera sees a right-handed world, else 1; vertices and faces
    the meshes in world space.
    """
    return weights.new_empty((*face_index.shape, 3))
