"""Checkpoints: all tensors of a run in one safetensors file, everything else as JSON in its header. No pickle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from learn3d import files
from learn3d.config import TrainConfig, config_from_dict, config_to_dict
from learn3d.networks import Networks, create_networks

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
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no checkpoint {path}; a run folder holds last.safetensors and best.safetensors")
    try:
        with safe_open(path, framework="pt") as file:
            header = (file.metadata() or {}).get("learn3d")
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError) as error:
        raise ValueError(
            f"{path} cannot be read as a checkpoint ({error}); it is damaged or was cut short: "
            "use another checkpoint of the run, or a copy"
        ) from None
    if header is None:
        raise ValueError(f"{path} is a safetensors file, but not a checkpoint of learn3d")
    metadata = json.loads(header)
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path} has checkpoint format {metadata.get('format')}, this version reads format {FORMAT}")
    return tensors, metadata


def network_tensors(networks: Networks) -> dict[str, Tensor]:
    """Parameters of all networks, named network.<encoder|generator|discriminator>.<parameter>."""
    return {
        f"network.{name}.{key}": tensor
        for name, network in networks.items()
        for key, tensor in network.state_dict().items()
    }


def restore_networks(networks: Networks, tensors: dict[str, Tensor], source: Path) -> None:
    """Copy the parameters of a checkpoint into networks of the same shape, or raise a ValueError."""
    for name, network in networks.items():
        prefix = f"network.{name}."
        state = {key.removeprefix(prefix): tensor for key, tensor in tensors.items() if key.startswith(prefix)}
        try:
            network.load_state_dict(state)
        except RuntimeError as error:
            raise ValueError(f"{source} does not fit the {name}: {error}") from None


def optimizer_tensors(name: str, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Adam's state, named optimizer.<name>.<parameter index>.<step|exp_avg|exp_avg_sq>."""
    return {
        f"optimizer.{name}.{index}.{key}": value
        for index, state in optimizer.state_dict()["state"].items()
        for key, value in state.items()
    }


def restore_optimizer(name: str, optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Put back what `optimizer_tensors` gave.

    Each tensor takes the memory layout of its parameter again (channels last, for convolutions): the fused kernel walks
    through parameter, gradient and state by position in memory and would mix up weights of different layouts.
    """
    prefix = f"optimizer.{name}."
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for key, tensor in tensors.items():
        if key.startswith(prefix):
            index, field = key.removeprefix(prefix).split(".")
            parameter = parameters[int(index)]
            if tensor.shape == parameter.shape:
                tensor = torch.empty_like(parameter, device="cpu").copy_(tensor)
            state.setdefault(int(index), {})[field] = tensor
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def find(path: Path, which: str = "last") -> Path:
    """The checkpoint file of a run folder (`which`: last or best), or `path` itself when it is a file."""
    path = Path(path)
    return path / f"{which}.safetensors" if path.is_dir() else path


def load_networks(path: Path, *, device: str = "cpu") -> tuple[Networks, TrainConfig, dict[str, Any]]:
    """Trained networks for evaluation, from a checkpoint file: (networks in eval mode, configuration, metadata)."""
    tensors, metadata = load(path)
    config = config_from_dict(metadata["config"], source=str(path))
    with torch.random.fork_rng(devices=[]):
        networks = create_networks(
            metadata["num_views"], discriminator=metadata["has_discriminator"], device=device, seed=0
        )
    restore_networks(networks, tensors, path)
    for _, network in networks.items():
        network.eval().requires_grad_(False)
    return networks, config, metadata


def networks_metadata(networks: Networks, config: TrainConfig) -> dict[str, Any]:
    """What `load_networks` needs to know besides the tensors."""
    discriminator = networks.discriminator
    last = [module for module in (discriminator.layers if discriminator else []) if isinstance(module, nn.Linear)]
    return {
        "config": config_to_dict(config),
        "has_discriminator": discriminator is not None,
        "num_views": last[-1].out_features if last else 0,
    }
