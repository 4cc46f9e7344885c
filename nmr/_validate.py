"""Checks shared by the public functions. Each error names the expected value, the given one, and
a remedy.
"""

from __future__ import annotations

import inspect
import operator
import sys
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

_INTEGERS = (
    torch.uint8,
    torch.int8,
    torch.int16,
    torch.int32,
    torch.int64,
    torch.uint16,
    torch.uint32,
    torch.uint64,
)
_FLOATS = (torch.float32, torch.float64)
GRADIENTS = ("nmr", "local", "none")  # definitions of the gradient at edges


def describe(value: object) -> str:
    """A tensor as ``float32 [2, 3]``, anything else by its type."""
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} {list(value.shape)}"
    return type(value).__name__


def callers_level() -> int:
    """``stacklevel`` for a warning that is to name the line outside of this package which called
    it.
    """
    level, frame = 1, sys._getframe(1)
    while (
        frame.f_back is not None
        and frame.f_globals.get("__name__", "").partition(".")[0] == __package__
    ):
        level, frame = level + 1, frame.f_back
    return level


def cast_under_autocast(tensor: object) -> object:
    """Half precision becomes float32 inside ``torch.autocast``, as for torch's own functions that
    need float32.
    """
    half = isinstance(tensor, Tensor) and tensor.dtype in (torch.float16, torch.bfloat16)
    if half and torch.is_autocast_enabled(tensor.device.type):
        return tensor.float()
    return tensor


def check_vertices(vertices: object, otherwise: str = "") -> Tensor:
    """``vertices`` as ``[B, V, 3]`` float32 or float64; ``otherwise``: other accepted types, for
    the error.
    """
    if not isinstance(vertices, Tensor):
        remedy = (
            ", or one call for each mesh if their sizes differ"
            if isinstance(vertices, (list, tuple))
            else ""
        )
        raise TypeError(
            f"vertices must be a float tensor [B, V, 3] or [V, 3]{otherwise}, got {describe(vertices)}; "
            f"use torch.as_tensor(){remedy}"
        )
    if vertices.ndim not in (2, 3) or vertices.shape[-1] != 3:
        raise ValueError(f"vertices must have shape [B, V, 3] or [V, 3], got {describe(vertices)}")
    if vertices.layout != torch.strided or vertices.device.type == "meta":
        kind = (
            "without values (device meta)"
            if vertices.device.type == "meta"
            else f"of layout {vertices.layout}"
        )
        raise TypeError(f"vertices must be an ordinary tensor, got one {kind}")
    vertices = cast_under_autocast(vertices)
    if vertices.dtype not in _FLOATS:
        raise TypeError(
            f"vertices must be float32 or float64, got {describe(vertices)}; call vertices.float()"
        )
    return vertices if vertices.ndim == 3 else vertices.unsqueeze(0)


def check_faces(faces: object, batch: int, device: torch.device, name: str = "faces") -> Tensor:
    """``faces`` as int64 ``[F, 3]`` or ``[B, F, 3]`` on ``device``; their indices are checked by
    the kernels.

    ``[1, F, 3]`` is shared by all meshes.
    """
    if not isinstance(faces, Tensor):
        raise TypeError(
            f"{name} must be an integer tensor [F, 3] or [B, F, 3], got {describe(faces)}; use torch.as_tensor()"
        )
    if faces.dtype not in _INTEGERS:
        raise TypeError(
            f"{name} must be an integer tensor [F, 3] or [B, F, 3], got {describe(faces)}; call {name}.long()"
        )
    if faces.ndim not in (2, 3) or faces.shape[-1] != 3:
        raise ValueError(f"{name} must have shape [F, 3] or [B, F, 3], got {describe(faces)}")
    if faces.ndim == 3 and faces.shape[0] == 1 and batch != 1:
        faces = faces[0]
    if faces.ndim == 3 and faces.shape[0] != batch:
        raise ValueError(
            f"{name} [B, F, 3] must have the batch size of the vertices, {batch}, got {describe(faces)}; "
            "share one [F, 3] among all meshes, or expand it"
        )
    return faces.to(device=device, dtype=torch.int64)


def check_indices(
    indices: Tensor,
    count: int,
    name: str = "faces",
    row: str = "vertex",
    table: str = "a mesh",
    rows: str = "vertices",
) -> None:
    """Raise a ValueError if an index is outside 0..count-1. (Values are unknown when compiled or
    under vmap.)
    """
    if torch.compiler.is_compiling() or indices.numel() == 0:
        return
    try:
        low, high = (int(x) for x in indices.aminmax())
    except RuntimeError:  # inside torch.func.vmap values cannot be read
        return
    if low < 0 or high >= count:
        raise ValueError(
            f"{name} refer to {row} {low if low < 0 else high}, but {table} has {count} {rows} (the first is 0)"
        )


def check_camera(camera: object, packed: bool) -> None:
    """A camera must have ``transform(vertices)``; for lists of meshes
    ``transform(vertices, starts)``.
    """
    if isinstance(camera, type):
        raise TypeError(
            f"camera must be an instance, got the class {camera.__name__}; create one: {camera.__name__}(...)"
        )
    if not callable(getattr(camera, "transform", None)):
        several = isinstance(camera, (list, tuple)) and camera and hasattr(camera[0], "transform")
        raise TypeError(
            f"camera must have a method transform(vertices), as nmr.LookAt does, got {describe(camera)}"
            + "; nmr.cameras.cat joins several cameras" * bool(several)
        )
    if packed and "starts" not in inspect.signature(camera.transform).parameters:
        raise TypeError(
            f"for a list of meshes, {type(camera).__name__}.transform must take (vertices [N, 3], starts [B + 1, 2]), "
            "as nmr.LookAt.transform does; it takes only vertices"
        )


def check_transformed(vertices: object, world: Tensor, packed: bool) -> None:
    """The vertices that a camera returned must have type, device and shape of ``world`` (one mesh
    may become B).
    """
    like = isinstance(vertices, Tensor) and (vertices.dtype, vertices.device) == (
        world.dtype,
        world.device,
    )
    grown = not packed and world.shape[0] == 1
    if (
        not like
        or vertices.ndim != world.ndim
        or vertices.shape[int(grown) :] != world.shape[int(grown) :]
    ):
        shape = ["B", *world.shape[1:]] if grown else list(world.shape)
        wanted = f"{str(world.dtype).removeprefix('torch.')} [{', '.join(map(str, shape))}]"
        raise ValueError(
            f"camera.transform must return {'packed ' if packed else ''}vertices {wanted}, like those it receives, "
            f"got {describe(vertices)}"
        )


def check_values(values: object, name: str, axes: str) -> Tensor | tuple[Tensor, ...]:
    """Float values of meshes: a tensor with these axes, with or without a batch axis, or a list
    of one per mesh.

    Returns the tensor with its batch axis, or a tuple of tensors without one. ``axes`` is like
    ``"V, C"``.
    """
    ndim = axes.count(",") + 1
    wanted = f"{name} must be a float tensor [{axes}] or [B, {axes}], or a list of [{axes}], one per mesh"
    if isinstance(values, Sequence) and not isinstance(values, str) and len(values):
        values = tuple(map(cast_under_autocast, values))
        for value in values:
            if not isinstance(value, Tensor) or value.dtype not in _FLOATS:
                raise TypeError(f"{wanted}; the list holds {describe(value)}")
            if (
                value.ndim != ndim
                or value.shape[-1] != values[0].shape[-1]
                or value.dtype != values[0].dtype
            ):
                raise ValueError(
                    f"{wanted}; the list holds {describe(values[0])} and {describe(value)}"
                )
            if value.shape[-1] == 0:
                raise ValueError(
                    f"{wanted}, with at least one channel; the list holds {describe(value)}"
                )
        return values
    values = cast_under_autocast(values)
    if not isinstance(values, Tensor) or values.dtype not in _FLOATS:
        bytes_given = isinstance(values, Tensor) and values.dtype == torch.uint8
        remedy = "divide 0..255 by 255" if bytes_given else "use torch.as_tensor() and .float()"
        raise TypeError(f"{wanted}, got {describe(values)}; {remedy}")
    if values.ndim not in (ndim, ndim + 1) or values.shape[-1] == 0:
        raise ValueError(f"{wanted}, got {describe(values)}")
    return values if values.ndim == ndim + 1 else values.unsqueeze(0)


def as_numbers(value: object, name: str, wanted: str) -> Tensor:
    """A number, nested sequences of numbers or tensors, an array or a tensor, as a tensor;
    numbers become float64.

    Gradients reach tensors, also those inside sequences.
    """
    try:
        tensor = _joined(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name} must be {wanted}, got {describe(value)}: {error}") from error
    if tensor.is_complex():
        raise TypeError(f"{name} must be {wanted} of real numbers, got {describe(tensor)}")
    return tensor


def _joined(value: object) -> Tensor:
    if isinstance(value, Tensor):
        return value
    # torch.as_tensor would detach the tensors in a sequence.
    if isinstance(value, (list, tuple)) and any(
        isinstance(part, (Tensor, np.ndarray, list, tuple)) for part in value
    ):
        return torch.stack([_joined(part) for part in value])
    return torch.tensor(value, dtype=torch.float64, device="cpu")  # a copy, also of an array


def as_floats(value: object, name: str, wanted: str) -> Tensor:
    """As :func:`as_numbers`, but a tensor must already have a float dtype."""
    tensor = as_numbers(value, name, wanted)
    if not tensor.is_floating_point():
        raise TypeError(f"{name} must be {wanted} of floats, got {describe(tensor)}; call .float()")
    return tensor


def check_size(value: object, name: str, largest: int, wanted: str = "an integer") -> int:
    """An integer in 1..largest."""
    if not isinstance(value, torch.SymInt):
        if isinstance(value, bool) or not hasattr(value, "__index__") or isinstance(value, Tensor):
            raise TypeError(f"{name} must be {wanted}, got {describe(value)}")
        value = operator.index(value)
    if not 1 <= value <= largest:
        raise ValueError(f"{name} must lie in 1..{largest}, got {value}")
    return value


def check_image_size(value: object, largest: int) -> tuple[int, int]:
    """(height, width): an integer for a square image, or a pair of integers, each in 1..largest."""
    if isinstance(value, (Tensor, np.ndarray)) and value.shape == (2,):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        if len(value) != 2:
            raise ValueError(
                f"image_size must be an integer or a pair (height, width), got {value!r}"
            )
        height, width = (check_size(size, "image_size", largest) for size in value)
        return height, width
    size = check_size(value, "image_size", largest, "an integer or a pair (height, width)")
    return size, size


def check_choice(value: object, name: str, choices: tuple[str, ...]) -> None:
    """``value`` must be one of ``choices``."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} must be {' or '.join(map(repr, choices))}, got {value!r}")


def check_flag(value: object, name: str) -> bool:
    """True or False, or 0 or 1, also of NumPy."""
    if isinstance(value, (bool, int, float, np.generic)) and value in (0, 1):
        return bool(value)
    raise TypeError(f"{name} must be True or False, got {value!r}")


def holds_for_all(condition: Tensor) -> bool:
    """Whether all values are true; also true if they cannot be read, in torch.compile and
    torch.func.vmap.
    """
    if torch.compiler.is_compiling() or condition.device.type != "cpu":
        return True
    try:
        return bool(condition.all())
    except RuntimeError:
        return True


def check_number(value: object, name: str) -> float:
    """A Python or NumPy number, or a tensor with one element and without a gradient, as float."""
    if isinstance(value, Tensor) and value.requires_grad:
        raise TypeError(f"{name} has no gradient here; pass {name}.item(), or a number")
    if isinstance(value, (str, bytes)):
        raise TypeError(f"{name} must be a number, got {value!r}")
    try:
        return float(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name} must be a number, got {describe(value)}") from error


def as_positive(value: object, name: str, dtype: torch.dtype) -> Tensor:
    """A number, or a float tensor with one element, which may want a gradient, as a tensor
    ``[]``.
    """
    tensor = as_floats(value, name, "a number or a tensor []")
    if tensor.numel() != 1:
        raise ValueError(f"{name} must be a number or a tensor [], got {describe(tensor)}")
    if not holds_for_all((tensor >= torch.finfo(dtype).tiny) & (tensor < float("inf"))):
        raise ValueError(f"{name} must be positive in {dtype} and finite, got {value}")
    return tensor.reshape([])


def check_depth_range(near: float, far: float, dtype: torch.dtype) -> None:
    """0 <= near < far; the sum of 2x2 pixels of depth far must be finite in the dtype."""
    near, far = check_number(near, "near"), check_number(far, "far")
    largest = torch.finfo(dtype).max / 4
    if not 0 <= near < far <= largest:
        raise ValueError(
            f"near and far must be finite with 0 <= near < far <= {largest:.4g} (for {dtype}), "
            f"got near={near}, far={far}"
        )


def check_eps(eps: float, dtype: torch.dtype) -> None:
    """eps must be finite, and positive when rounded to the dtype."""
    eps = check_number(eps, "eps")
    if not torch.finfo(dtype).tiny <= eps < float("inf"):
        raise ValueError(f"eps must be positive in {dtype} and finite, got {eps}")
