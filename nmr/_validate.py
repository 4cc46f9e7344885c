"""Checks that the public functions share. Each error says what was wanted, what came and what to do."""

from __future__ import annotations

import operator

import torch
from torch import Tensor

_INTEGERS = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)


def describe(value: object) -> str:
    """A tensor as ``float32 [2, 3]``, anything else by its type."""
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} {list(value.shape)}"
    return type(value).__name__


def check_vertices(vertices: object) -> Tensor:
    """``vertices`` as ``[B, V, 3]`` float32 or float64."""
    if not isinstance(vertices, Tensor):
        raise TypeError(
            f"vertices must be a float tensor [B, V, 3] or [V, 3], got {describe(vertices)}; use torch.as_tensor()"
        )
    if vertices.ndim not in (2, 3) or vertices.shape[-1] != 3:
        raise ValueError(f"vertices must have shape [B, V, 3] or [V, 3], got {describe(vertices)}")
    if vertices.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"vertices must be float32 or float64, got {describe(vertices)}; call vertices.float()")
    return vertices if vertices.ndim == 3 else vertices.unsqueeze(0)


def check_faces(faces: object, batch: int, device: torch.device) -> Tensor:
    """``faces`` as int64 ``[F, 3]`` or ``[B, F, 3]`` on ``device``; their indices are checked by the kernels."""
    if not isinstance(faces, Tensor):
        raise TypeError(
            f"faces must be an integer tensor [F, 3] or [B, F, 3], got {describe(faces)}; use torch.as_tensor()"
        )
    if faces.dtype not in _INTEGERS:
        raise TypeError(
            f"faces must be an integer tensor [F, 3] or [B, F, 3], got {describe(faces)}; call faces.long()"
        )
    if faces.ndim not in (2, 3) or faces.shape[-1] != 3:
        raise ValueError(f"faces must have shape [F, 3] or [B, F, 3], got {describe(faces)}")
    if faces.ndim == 3 and faces.shape[0] != batch:
        raise ValueError(
            f"faces [B, F, 3] must have the batch size of the vertices, {batch}, got {describe(faces)}; "
            "share one [F, 3] among all meshes, or expand it"
        )
    return faces.to(device=device, dtype=torch.int64)


def check_size(value: object, name: str, largest: int) -> int:
    """An integer in 1..largest."""
    if not isinstance(value, torch.SymInt):
        if isinstance(value, bool) or not hasattr(value, "__index__") or isinstance(value, Tensor):
            raise TypeError(f"{name} must be an integer, got {describe(value)}")
        value = operator.index(value)
    if not 1 <= value <= largest:
        raise ValueError(f"{name} must lie in 1..{largest}, got {value}")
    return value


def check_depth_range(near: float, far: float) -> None:
    """0 <= near < far, both finite."""
    if not (0 <= near < far < float("inf")):
        raise ValueError(f"near and far must be finite with 0 <= near < far, got near={near}, far={far}")
