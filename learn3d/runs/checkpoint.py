"""Checkpoints: all tensors of a run in one safetensors file, everything else as JSON in its header. No pickle.

The header holds three texts: "learn3d", the JSON; "metadata_crc32" of its bytes; "tensors_crc32" of the names, types,
shapes and bytes of all tensors in the order of their names. Format 1 had the first alone and is still read.
"""

from __future__ import annotations

import dataclasses
import errno
import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from learn3d.config import TrainConfig, config_from_dict, config_to_dict
from learn3d.device import resolve_precision
from learn3d.files import writing
from learn3d.methods import DataShape, Method, create_method
from learn3d.runs import checkpoint_checks

FORMAT = 2


class DamagedError(ValueError):
    """A checkpoint that is cut short or changed, or a file that is none; another checkpoint of the run may be whole."""


def save(path: Path, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Write tensors and JSON metadata; the file appears under its name only when complete and on the disk.

    Raises OSError where it cannot be written (no permission, no room).
    """
    text = json.dumps({"format": FORMAT, **metadata})
    flat = {name: tensor.detach().cpu().contiguous() for name, tensor in sorted(tensors.items())}
    header = {"learn3d": text, "metadata_crc32": _crc(text.encode()), "tensors_crc32": _tensors_crc(flat)}
    try:
        with writing.replacing(path, sync=True) as temporary:
            _write(temporary, flat, header)
    except OSError as error:
        raise OSError(f"cannot write the checkpoint {path}: {error.strerror or error}") from error


_TYPES = {
    torch.float64: "F64",
    torch.float32: "F32",
    torch.bfloat16: "BF16",
    torch.float16: "F16",
    torch.int64: "I64",
    torch.int32: "I32",
    torch.int16: "I16",
    torch.int8: "I8",
    torch.uint8: "U8",
    torch.bool: "BOOL",
}


def _write(path: Path, tensors: dict[str, Tensor], metadata: dict[str, str]) -> None:
    """Write a safetensors file: the length of a JSON header, the header, the tensors one after the other.

    The library's own `save_file` writes beside a temporary file of a name of its own, which a killed process leaves
    behind, and copies all tensors first in versions before 0.6. Large elements come first, so that all are aligned.
    """
    ordered = sorted(tensors.items(), key=lambda item: (-item[1].element_size(), item[0]))
    header, end = {"__metadata__": metadata}, 0
    for name, tensor in ordered:
        start, end = end, end + tensor.nbytes
        header[name] = {"dtype": _TYPES[tensor.dtype], "shape": list(tensor.shape), "data_offsets": [start, end]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with open(path, "wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for _, tensor in ordered:
            file.write(_bytes_of(tensor))


def _bytes_of(tensor: Tensor) -> np.ndarray:
    """The bytes of a contiguous tensor on the CPU, uint8 [n], in the same memory."""
    return tensor.reshape(-1).view(torch.uint8).numpy()


def _crc(content: bytes) -> str:
    return f"{zlib.crc32(content):08x}"


def _tensors_crc(tensors: dict[str, Tensor]) -> str:
    """CRC-32 of names, types, shapes and bytes, in the order of the names."""
    crc = 0
    for name, tensor in sorted(tensors.items()):
        crc = zlib.crc32(f"{name} {tensor.dtype} {list(tensor.shape)}".encode(), crc)
        crc = zlib.crc32(_bytes_of(tensor), crc)
    return f"{crc:08x}"


def load(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save` wrote, on the CPU, and compare it with its checksums.

    A truncated, changed or foreign file is a DamagedError; a missing one, or one of a later version, a ValueError; one
    that cannot be reached (no permission, a network drive that is away) an OSError.
    """
    return _read(path, tensors=True)


def load_metadata(path: Path) -> dict[str, Any]:
    """The metadata of a checkpoint alone, without reading its tensors; raises as `load` does."""
    return _read(path, tensors=False)[1]


def _read(path: Path, *, tensors: bool) -> tuple[dict[str, Tensor], dict[str, Any]]:
    path = Path(path)
    if not path.is_file():
        raise ValueError(
            f"there is no checkpoint {path}; a run folder holds last.safetensors and, from the first validation that "
            "measured an IoU, best.safetensors"
        )
    try:
        checkpoint_checks.check_header(path)
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            contents = {name: file.get_tensor(name) for name in file.keys()} if tensors else {}
    except (SafetensorError, OSError, ValueError) as error:
        if isinstance(error, OSError) and error.errno not in (None, errno.EIO):
            raise  # it cannot be reached: that is no damage
        raise DamagedError(
            f"{path} cannot be read as a checkpoint ({error}); it is damaged or was cut short: "
            "use another checkpoint of the run, or a copy"
        ) from None
    if "learn3d" not in header:
        raise DamagedError(f"{path} is a safetensors file, but not a checkpoint of learn3d")
    if "metadata_crc32" in header:
        _check_crc(path, header["metadata_crc32"], _crc(header["learn3d"].encode()))
    try:
        metadata = checkpoint_checks.parse_metadata(header["learn3d"])
    except ValueError as error:
        raise DamagedError(f"{path} is no checkpoint that can be used: {error}; use another one of the run") from None
    if metadata.get("format") not in (1, FORMAT):
        raise ValueError(
            f"{path} has checkpoint format {metadata.get('format')}, this version reads formats 1 to {FORMAT}; "
            "use the version of learn3d that wrote it, or a later one"
        )
    if metadata["format"] == 2:
        _check_crc(path, header.get("metadata_crc32"), _crc(header["learn3d"].encode()))
        if tensors:
            _check_crc(path, header.get("tensors_crc32"), _tensors_crc(contents))
    return contents, metadata


def _check_crc(path: Path, written: str | None, found: str) -> None:
    if written != found:
        raise DamagedError(
            f"{path} has changed since it was written (CRC-32 {written}, now {found}): the disk or a copy damaged it; "
            "use another checkpoint of the run, or a copy"
        )


def network_tensors(method: Method) -> dict[str, Tensor]:
    """Parameters and buffers of all networks, named network.<encoder|generator|...>.<parameter>."""
    return {
        f"network.{name}.{key}": tensor
        for name, network in method.networks.items()
        for key, tensor in network.state_dict().items()
    }


def average_tensors(method: Method) -> dict[str, Tensor]:
    """The averages of the same tensors, named average.<encoder|generator|...>.<parameter>; {} without an average."""
    return {f"average.{name}": tensor for name, tensor in method.average.tensors.items()} if method.average else {}


def restore_average(method: Method, tensors: dict[str, Tensor], source: Path) -> None:
    """Copy the averages of a checkpoint into a method that keeps some, or raise a ValueError."""
    if method.average is not None:
        with method.averaged():
            restore_networks(method, _averaged(tensors, required=True), source)


def _averaged(tensors: dict[str, Tensor], *, required: bool = False) -> dict[str, Tensor]:
    """The tensors of a checkpoint, where the averages take the place of the networks' own weights, if there are any."""
    averages = {name: tensor for name, tensor in tensors.items() if name.startswith("average.")}
    if not averages and not required:
        return tensors
    return {"network." + name.removeprefix("average."): tensor for name, tensor in averages.items()}


def restore_networks(method: Method, tensors: dict[str, Tensor], source: Path) -> None:
    """Copy the parameters of a checkpoint into the networks of a method of the same shape, or raise a ValueError."""
    for name, network in method.networks.items():
        prefix = f"network.{name}."
        state = {key.removeprefix(prefix): tensor for key, tensor in tensors.items() if key.startswith(prefix)}
        try:
            checkpoint_checks.check_weights(name, network.state_dict(), state)
            network.load_state_dict(state)
        except (RuntimeError, ValueError) as error:
            raise ValueError(f"{source} does not fit the {name}: {error}") from None


def optimizer_tensors(name: str, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Adam's state, named optimizer.<name>.<parameter index>.<step|exp_avg|exp_avg_sq>."""
    return {
        f"optimizer.{name}.{index}.{key}": value
        for index, state in optimizer.state_dict()["state"].items()
        for key, value in state.items()
    }


def restore_optimizer(
    name: str, optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor], source: Path | str = "the checkpoint"
) -> None:
    """Put back what `optimizer_tensors` gave. Raises ValueError where it does not go with the parameters.

    Each tensor takes the memory layout of its parameter again (channels last, for convolutions): the fused kernel walks
    through parameter, gradient and state by position in memory and would mix up weights of different layouts. All are
    copies: what was loaded is the file itself, mapped, which would otherwise take room on the disk when it is deleted.
    """
    prefix = f"optimizer.{name}."
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    try:
        for key, tensor in tensors.items():
            if key.startswith(prefix):
                index, _, field = key.removeprefix(prefix).partition(".")
                if not index.isdecimal() or int(index) >= len(parameters):
                    raise ValueError(f"{key} belongs to none of the {len(parameters)} parameters")
                parameter = parameters[int(index)]
                checkpoint_checks.check_moment(key, field, tensor, parameter)
                like = tensor if field == "step" else parameter
                state.setdefault(int(index), {})[field] = torch.empty_like(like, device="cpu").copy_(tensor)
        if lacking := [index for index, fields in state.items() if len(fields) < 3]:
            raise ValueError(f"{prefix}{lacking[0]} lacks some of step, exp_avg, exp_avg_sq")
    except ValueError as error:
        raise ValueError(f"{source} does not fit the optimizer {name}: {error}") from None
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def random_state(tensors: dict[str, Tensor], source: Path | str) -> Tensor:
    """The state of torch's random numbers in a checkpoint, uint8, of the length that this torch has."""
    found, wanted = tensors.get("random.cpu"), torch.get_rng_state()
    if found is None or found.dtype != torch.uint8 or found.shape != wanted.shape:
        got = "none" if found is None else f"{found.dtype} {list(found.shape)}"
        raise ValueError(
            f"{source} holds no state of the random numbers (random.cpu) as this torch has it: wanted torch.uint8 "
            f"{list(wanted.shape)}, got {got}; is it the last checkpoint of a run?"
        )
    try:
        torch.Generator().set_state(found)
    except RuntimeError as error:
        raise ValueError(f"{source} holds a state of the random numbers that cannot be ({error})") from None
    return found


def find(path: Path, which: str = "last") -> Path:
    """The checkpoint file of a run folder (`which`: last or best), or `path` itself when it is a file."""
    path = Path(path)
    return path / f"{which}.safetensors" if path.is_dir() else path


def load_method(
    path: Path, *, device: str = "cpu", precision: str = "fp32"
) -> tuple[Method, TrainConfig, dict[str, Any]]:
    """A trained method ready for use, from a checkpoint file: (method in evaluation mode, configuration, metadata)."""
    tensors, metadata = load(path)
    checkpoint_checks.require_run(metadata, path)
    config = config_from_dict(metadata["config"], source=str(path))
    with torch.random.fork_rng(devices=[]):
        method = create_method(
            config.settings,
            data_shape(metadata),
            device=device,
            precision=resolve_precision(precision, device),
            seed=0,
        )
    restore_networks(method, _averaged(tensors), path)
    method.set_training(False)
    for network in method.networks.values():
        network.requires_grad_(False)
    return method, config, metadata


def method_metadata(shape: DataShape, config: TrainConfig) -> dict[str, Any]:
    """What `load_method` needs to know besides the tensors."""
    return {"config": config_to_dict(config), "shape": dataclasses.asdict(shape)}


def data_shape(metadata: dict[str, Any]) -> DataShape:
    """The data's shape in a checkpoint's metadata; version 0.1 had the number of views alone."""
    return DataShape(**metadata["shape"]) if "shape" in metadata else DataShape(num_views=metadata["num_views"])
