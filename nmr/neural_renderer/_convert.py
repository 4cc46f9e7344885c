"""Converts arguments of scripts (points, colours, sizes, faces) to tensors and numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from nmr._scene import LARGEST_IMAGE
from nmr._validate import as_floats, check_faces, check_image_size, check_vertices, describe

Numbers = float | Sequence | np.ndarray | Tensor


def like(value: object, name: str, reference: Tensor) -> Tensor:
    """A number, list, tuple, array or tensor with the dtype and device of ``reference``;
    gradients reach tensors.
    """
    value = (
        value
        if isinstance(value, Tensor)
        else as_floats(value, name, "numbers in a list, tuple, array or tensor")
    )
    return value.to(device=reference.device, dtype=reference.dtype)


def check_batch(vertices: object) -> Tensor:
    """``vertices`` as ``[B, V, 3]``."""
    checked = check_vertices(vertices)
    if vertices.ndim != 3:
        raise ValueError(
            f"vertices must have shape [B, V, 3], got {describe(vertices)}; use vertices[None]"
        )
    return checked


def height_and_width(image_size: object) -> tuple[int, int]:
    """Pixels of an image: from a pair, or from one number, which may be a whole float or an array
    without axes.
    """
    if isinstance(image_size, (np.generic, np.ndarray, Tensor)) and image_size.ndim == 0:
        image_size = image_size.item()
    if isinstance(image_size, float) and image_size.is_integer():
        image_size = int(image_size)
    return check_image_size(image_size, LARGEST_IMAGE)


def integer_faces(faces: object, vertices: Tensor) -> Tensor:
    """``faces`` as int64 ``[B, F, 3]``, or as ``[F, 3]`` if all meshes share them, on the device of
    ``vertices [B, V, 3]``.

    Whole numbers in a float tensor or in an array are accepted, too, and several faces of one mesh.
    """
    if isinstance(faces, np.ndarray):
        faces = torch.from_numpy(faces)
    if isinstance(faces, Tensor) and faces.is_floating_point():
        whole = faces.long()
        if not torch.equal(whole.to(faces.dtype), faces):
            raise ValueError(f"faces must be vertex numbers, got {describe(faces)} with fractions")
        faces = whole
    batch = len(vertices)
    if batch == 1 and isinstance(faces, Tensor) and faces.ndim == 3:
        batch = len(faces)
    return check_faces(faces, batch, vertices.device)


def check_textures(textures: object, batch: int, num_faces: int) -> Tensor:
    """``textures``, which must be ``[B or 1, F, ts, ts, ts, C]``."""
    if not isinstance(textures, Tensor) or not textures.is_floating_point():
        raise TypeError(
            f"textures must be a float tensor [B, F, ts, ts, ts, 3], got {describe(textures)}"
        )
    if textures.ndim != 6 or len(set(textures.shape[2:5])) != 1 or 0 in textures.shape[2:]:
        raise ValueError(
            f"textures must have shape [B, F, ts, ts, ts, 3], got {describe(textures)}"
        )
    if (textures.shape[0] not in (1, batch) and batch != 1) or textures.shape[1] != num_faces:
        raise ValueError(
            f"textures must have the batch size (or 1) and the number of faces of the mesh, [{batch}, {num_faces}, "
            f"ts, ts, ts, 3], got {describe(textures)}"
        )
    return textures
