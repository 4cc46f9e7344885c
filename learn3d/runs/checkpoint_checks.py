"""What a checkpoint must be before anything is made of it: a header that can be, metadata of the right kinds, tensors
that fit. Raises ValueErrors that say what is wrong; `checkpoint` says in which file.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from learn3d.files import limits
from learn3d.files.reading import check_file, parse_json


def check_header(path: Path) -> None:
    """Compare the size that the file says its header has with the file's, and both with the limits.

    That tensors lie within the file, do not overlap and leave no gap is checked by safetensors.
    """
    size = check_file(path, limits.CHECKPOINT_BYTES, "a checkpoint")
    with open(path, "rb") as file:
        start = file.read(8)
    if len(start) < 8:
        raise ValueError(f"it has {size} bytes")
    (header,) = struct.unpack("<Q", start)
    if header > min(limits.CHECKPOINT_HEADER_BYTES, size - 8):
        raise ValueError(f"it says that its header has {header} bytes, of {size} in the file")


def parse_metadata(text: str) -> dict[str, Any]:
    """The metadata in the header. What is known by name is of the right kind then; the rest may be anything."""
    metadata = parse_json(text)
    if not isinstance(metadata, dict):
        raise ValueError(f"its metadata is no set of values by name, but {type(metadata).__name__}")
    for name, (fits, wanted) in _KINDS.items():
        if name in metadata and not fits(metadata[name]):
            raise ValueError(f"its {name} must be {wanted}, got {repr(metadata[name])[:80]}")
    return metadata


def require(metadata: dict[str, Any], names: Sequence[str], source: Path | str) -> None:
    """Raise a ValueError where the metadata of a checkpoint lacks one of the names."""
    if missing := [name for name in names if name not in metadata]:
        raise ValueError(f"{source} is no checkpoint of a training run: its metadata lacks {', '.join(missing)}")


def require_run(metadata: dict[str, Any], source: Path | str) -> None:
    """Raise a ValueError where the metadata is not that of a training run: options, steps, shape of the data."""
    require(metadata, ("config", "step", "shape" if "shape" in metadata else "num_views"), source)


def _count(most: int) -> Callable[[Any], bool]:
    return lambda value: type(value) is int and 0 <= value <= most


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= limits.NUMBER


def _is_shape(value: Any) -> bool:
    if not isinstance(value, dict) or "num_views" not in value:
        return False
    numbers = {name: item for name, item in value.items() if name != "inverted"}
    if not set(numbers) <= set(_SHAPE) or not isinstance(value.get("inverted", False), bool):
        return False
    return all(_count(_SHAPE[name])(number) for name, number in numbers.items())


def _are_losses(value: Any) -> bool:
    """However large: a run that goes on with such losses must be able to resume, too."""
    numbers = isinstance(value, dict) and all(type(item) in (int, float) for item in value.values())
    return numbers and all(math.isfinite(item) for item in value.values())


def _are_conditions(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(item, (str, int, float)) for item in value.values())


_SHAPE = {"num_views": limits.VIEW_CLASSES, "num_classes": limits.CLASSES, "pose_features": 64}
_STEP = (_count(limits.ITERATIONS), "a number of steps")
_NUMBER = (_is_number, "a finite number")
_BY_NAME = (lambda value: isinstance(value, dict), "a set of values by name")
_KINDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "step": _STEP,
    "best_step": _STEP,
    "seconds": _NUMBER,
    "best_iou": _NUMBER,
    "object_share": (lambda value: _is_number(value) and 0 <= value <= 1, "a share, 0 .. 1"),
    "losses": (_are_losses, "a set of finite numbers by name"),
    "config": _BY_NAME,
    "versions": _BY_NAME,
    "conditions": (_are_conditions, "a set of numbers and words by name"),
    "shape": (_is_shape, f"at most {_SHAPE}"),
    "num_views": (_count(limits.VIEW_CLASSES), f"a number of view classes, at most {limits.VIEW_CLASSES}"),
}


def check_weights(name: str, own: dict[str, Tensor], state: dict[str, Tensor]) -> None:
    """Raise a ValueError for a parameter of another type than the network's own, or with NaN or infinities.

    Names and shapes are compared by `load_state_dict`.
    """
    for key, tensor in state.items():
        if key in own and tensor.dtype != own[key].dtype:
            raise ValueError(f"{name}.{key} is {tensor.dtype}, wanted {own[key].dtype}")
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise ValueError(f"{name}.{key} has values that are not finite")


def check_moment(key: str, field: str, tensor: Tensor, parameter: Tensor) -> None:
    """Raise a ValueError where one tensor of Adam's state does not go with its parameter.

    PyTorch does not look, and its fused kernel reads and writes beyond a tensor that is too small.
    """
    shape = torch.Size() if field == "step" else parameter.shape
    if field not in ("step", "exp_avg", "exp_avg_sq"):
        raise ValueError(f"{key} is nothing that Adam keeps (step, exp_avg, exp_avg_sq)")
    if tensor.shape != shape or tensor.dtype != torch.float32:
        raise ValueError(f"{key} is {tensor.dtype} {list(tensor.shape)}, wanted torch.float32 {list(shape)}")
    if not bool(tensor.isfinite().all()):
        raise ValueError(f"{key} has values that are not finite")
