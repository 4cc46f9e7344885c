"""Ambient and directional light, one value per face."""

from __future__ import annotations

import torch
from torch import Tensor

from nmr._validate import describe
from nmr.neural_renderer._convert import Numbers, check_textures, like


def face_light(
    faces: Tensor,
    intensity_ambient: float,
    intensity_directional: float,
    color_ambient: Numbers,
    color_directional: Numbers,
    direction: Numbers,
) -> Tensor:
    """Light ``[B, F, 3]`` on faces with corners ``[B, F, 3, 3]``:
    ``ia ca + id cd max(0, n . direction)``.

    ``n = (v0 - v1) x (v2 - v1)``, scaled to length 1; a face without area gets only the ambient
    light.
    """
    ambient, directional, direction = (
        _per_image(value, name, faces)
        for value, name in (
            (color_ambient, "color_ambient"),
            (color_directional, "color_directional"),
            (direction, "direction"),
        )
    )
    if not isinstance(intensity_directional, Tensor) and intensity_directional == 0:
        return (intensity_ambient * ambient).expand(*faces.shape[:2], 3)
    normal = torch.linalg.cross(
        faces[..., 0, :] - faces[..., 1, :], faces[..., 2, :] - faces[..., 1, :], dim=-1
    )
    normal = torch.nn.functional.normalize(normal, dim=-1, eps=1e-5)
    cosine = (normal * direction).sum(-1, keepdim=True).relu()
    return intensity_ambient * ambient + intensity_directional * directional * cosine


def _per_image(value: Numbers, name: str, faces: Tensor) -> Tensor:
    """``[3]`` or ``[B, 3]`` as ``[1 or B, 1, 3]``."""
    tensor = like(value, name, faces)
    if tensor.ndim not in (1, 2) or tensor.shape[-1] != 3:
        raise ValueError(f"{name} must have shape [3] or [B, 3], got {list(tensor.shape)}")
    tensor = tensor.reshape(-1, 1, 3)
    if tensor.shape[0] != 1 and faces.shape[0] not in (1, tensor.shape[0]):
        raise ValueError(
            f"{name} must have shape [3] or [{faces.shape[0]}, 3], got {[tensor.shape[0], 3]}"
        )
    return tensor


def lighting(
    faces: Tensor,
    textures: Tensor,
    intensity_ambient: float = 0.5,
    intensity_directional: float = 0.5,
    color_ambient: Numbers = (1, 1, 1),
    color_directional: Numbers = (1, 1, 1),
    direction: Numbers = (0, 1, 0),
) -> Tensor:
    """Textures under ambient and directional light; the argument ``textures`` is not changed.

    Parameters
    ----------
    faces : Tensor [B, F, 3, 3]
        Corners of the faces in world space, see :func:`vertices_to_faces`.
    textures : Tensor [B, F, ts, ts, ts, 3]
        Colours in [0, 1].
    intensity_ambient, intensity_directional : float
        ia, id.
    color_ambient, color_directional : [3] or [B, 3]
        ca, cd: lists, tuples, arrays or tensors.
    direction : [3] or [B, 3]
        Towards the light. It is not normalised: a longer vector gives more light.

    Returns
    -------
    Tensor [B, F, ts, ts, ts, 3]
        ``textures * (ia ca + id cd max(0, n . direction))`` with the unit normal ``n`` along
        ``(v0 - v1) x (v2 - v1)``. Differentiable in everything that is a tensor.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes.

    >>> lit = nr.lighting(nr.vertices_to_faces(vertices, faces), textures, direction=(0, 1, 0))
    """
    if not isinstance(faces, Tensor) or faces.ndim != 4 or faces.shape[2:] != (3, 3):
        raise ValueError(
            f"faces must be corners [B, F, 3, 3] (see vertices_to_faces), got {describe(faces)}"
        )
    textures = check_textures(textures, faces.shape[0], faces.shape[1])
    light = face_light(
        faces, intensity_ambient, intensity_directional, color_ambient, color_directional, direction
    )
    return textures * light[:, :, None, None, None, :]
