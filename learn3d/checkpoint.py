"""Checkpoints: all tensors of a run in one safetensors file, everything else as JSON in its header. No pickle."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from learn3d import checkpoint_checks, files
from learn3d.config import TrainConfig, config_from_dict, config_to_dict
from learn3d.methods import DataShape, Method, create_method
from learn3d.networks import resolve_precision

FORMAT = 1


def save(path: Path, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Write tensors and JSON metadata; the file appears under its name only when complete and on the disk.

    Raises OSError where it cannot be written (no permission, no room).
    """
    header = {"learn3d": json.dumps({"format": FORMAT, **metadata})}
    contiguous = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    with files.replacing(path, sync=True) as temporary:
        try:
            save_file(contiguous, temporary, metadata=header)
        except SafetensorError as error:
            raise OSError(f"cannot write the checkpoint {path}: {error}") from None
        temporary.chmod(0o644)


def load(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save` wrote, on the CPU. A missing, truncated or foreign file is a ValueError that says so."""
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
            header = (file.metadata() or {}).get("learn3d")
            contents = {name: file.get_tensor(name) for name in file.keys()} if tensors else {}
    except (SafetensorError, OSError, ValueError) as error:
        raise ValueError(
            f"{path} cannot be read as a checkpoint ({error}); it is damaged or was cut short: "
            "use another checkpoint of the run, or a copy"
        ) from None
    if header is None:
        raise ValueError(f"{path} is a safetensors file, but not a checkpoint of learn3d")
    try:
        metadata = checkpoint_checks.parse_metadata(header)
    except ValueError as error:
        raise ValueError(f"{path} is no checkpoint that can be used: {error}; use another one of the run") from None
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path} has checkpoint format {metadata.get('format')}, this version reads format {FORMAT}")
    return contents, metadata


def network_tensors(method: Method) -> dict[str, Tensor]:
    """Parameters and buffers of all networks, named network.<encoder|generator|...>.<parameter>."""
    return {
        f"network.{name}.{key}": tensor
        for name, network in method.networks.items()
        for key, tensor in network.state_dict().items()
    }


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
    through parameter, gradient and state by position in memory and would mix up weights of different layouts.
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
                if field != "step":
                    tensor = torch.empty_like(parameter, device="cpu").copy_(tensor)
                state.setdefault(int(index), {})[field] = tensor
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
    checkpoint_checks.require(metadata, ("config", "step", "num_views" if "shape" not in metadata else "shape"), path)
    config = config_from_dict(metadata["config"], source=str(path))
    settings = config.settings
    if getattr(settings, "pretrained", None) is not None:  # only training starts from that file, which may be gone
        settings = dataclasses.replace(settings, pretrained=None)
    with torch.random.fork_rng(devices=[]):
        method = create_method(
            settings,
            data_shape(metadata),
            device=device,
            precision=resolve_precision(precision, device),
            seed=0,
        )
    restore_networks(method, tensors, path)
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
