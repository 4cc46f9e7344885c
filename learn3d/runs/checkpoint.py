"""Checkpoints: all tensors of a run in one safetensors file, everything else as JSON in its header. No pickle.

The header holds three texts: "learn3d", the JSON of `Metadata`; "metadata_crc32" of its bytes; "tensors_crc32" of the
names, types, shapes and bytes of all tensors in the order of their names.
"""

from __future__ import annotations

import dataclasses
import errno
import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BeforeValidator, Field
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from learn3d.config import TrainConfig, config_from_dict
from learn3d.data.dataset import ViewDataset
from learn3d.data.layouts import load_dataset
from learn3d.device import resolve_precision
from learn3d.files import limits, writing
from learn3d.files.reading import check_file, parse_json
from learn3d.methods import DatasetInfo, Method, create_method
from learn3d.settings import Count, Share, Weight, checked

FORMAT = 3
AnyStep = Annotated[int, Field(ge=0, le=10**9)]


class DamagedError(ValueError):
    """A checkpoint that is cut short or changed, or a file that is none; another checkpoint of the run may be whole."""


@checked
class Progress:
    """Where a run stands."""

    step: AnyStep = 0  # steps taken
    best_iou: Annotated[float, Field(ge=-1, le=1)] = -1.0  # best validation IoU so far; -1 before the first validation
    best_step: AnyStep = 0
    seconds: Weight = 0.0  # spent in training, over all resumptions
    object_share: Share = 0.0  # side of the objects' bounding squares over that of the pictures, training mean
    threads: Count | None = None  # CPU threads that the run has chosen by itself; None: fixed, or not chosen yet
    losses: dict[str, float] = dataclasses.field(default_factory=dict)  # of the last step, however large


@checked
class DataFingerprint:
    """What decides the next steps besides the options and the saved state; a resumed run must find it as it was."""

    samples: Count  # training images: their number decides the order
    images: str  # `ViewDataset.digest` of the training images: them, their masks, poses and classes
    precision: Literal["bf16", "fp32"]  # what "auto" came to


def _from_json(build: Callable[[Any], Any]) -> BeforeValidator:
    return BeforeValidator(lambda value: value if dataclasses.is_dataclass(value) else build(value))


def _by_name(kind: type) -> BeforeValidator:
    return _from_json(lambda value: kind(**value) if isinstance(value, dict) else value)


@checked
class Metadata:
    """All that a checkpoint holds besides its tensors."""

    config: Annotated[TrainConfig, _from_json(config_from_dict)]
    info: Annotated[DatasetInfo, _by_name(DatasetInfo)]
    progress: Annotated[Progress, _by_name(Progress)]
    fingerprint: Annotated[DataFingerprint, _by_name(DataFingerprint)]
    versions: dict[str, str | None]  # of the code that wrote it
    optimizers: dict[str, dict[str, dict[str, Any]]]  # what they keep beside tensors, by parameter


def save(path: Path, tensors: dict[str, Tensor], metadata: Metadata) -> None:
    """Write tensors and metadata; the file appears under its name only when complete and on the disk.

    Raises OSError where it cannot be written (no permission, no room).
    """
    text = json.dumps({"format": FORMAT} | dataclasses.asdict(metadata), default=str)
    flat = {name: tensor.detach().cpu().contiguous() for name, tensor in sorted(tensors.items())}
    header = {"learn3d": text, "metadata_crc32": _crc(text), "tensors_crc32": _tensors_crc(flat)}
    try:
        with writing.replacing(path, sync=True) as temporary:
            temporary.touch()
            mode = temporary.stat().st_mode
            save_file(flat, temporary, header)  # which gives the file to its owner alone
            temporary.chmod(mode)
    except (OSError, SafetensorError) as error:
        said = getattr(error, "strerror", None) or error
        raise OSError(f"cannot write the checkpoint {path}: {said}") from error


def _crc(text: str) -> str:
    return f"{zlib.crc32(text.encode()):08x}"


def _tensors_crc(tensors: dict[str, Tensor]) -> str:
    """CRC-32 of names, types, shapes and bytes, in the order of the names."""
    crc = 0
    for name, tensor in sorted(tensors.items()):
        crc = zlib.crc32(f"{name} {tensor.dtype} {list(tensor.shape)}".encode(), crc)
        crc = zlib.crc32(tensor.reshape(-1).view(torch.uint8).numpy(), crc)
    return f"{crc:08x}"


def load(path: Path) -> tuple[dict[str, Tensor], Metadata]:
    """Read what `save` wrote, on the CPU, and compare it with its checksums.

    A truncated, changed or foreign file is a DamagedError; a missing one, or one of another version, a ValueError; one
    that cannot be reached (no permission, a network drive that is away) an OSError.
    """
    return _read(path, tensors=True)


def load_metadata(path: Path) -> Metadata:
    """The metadata of a checkpoint alone, without reading its tensors; raises as `load` does."""
    return _read(path, tensors=False)[1]


def _read(path: Path, *, tensors: bool) -> tuple[dict[str, Tensor], Metadata]:
    path = Path(path)
    if not path.is_file():
        raise ValueError(
            f"there is no checkpoint {path}; a run folder holds last.safetensors and, from the first validation that "
            "measured an IoU, best.safetensors"
        )
    try:
        check_file(path, limits.CHECKPOINT_BYTES, "a checkpoint")
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
    _check_crc(path, header.get("metadata_crc32"), _crc(header["learn3d"]))
    if tensors:
        _check_crc(path, header.get("tensors_crc32"), _tensors_crc(contents))
    return contents, _parse(path, header["learn3d"])


def _check_crc(path: Path, written: str | None, found: str) -> None:
    if written != found:
        raise DamagedError(
            f"{path} has changed since it was written (CRC-32 {written}, now {found}): the disk or a copy damaged it; "
            "use another checkpoint of the run, or a copy"
        )


def _parse(path: Path, text: str) -> Metadata:
    try:
        values = parse_json(text)
        if not isinstance(values, dict):
            raise ValueError(f"its metadata must be a JSON object, got {type(values).__name__}")
        if (version := values.pop("format", None)) == FORMAT:
            return Metadata(**values)
    except ValueError as error:
        raise DamagedError(f"{path} is no checkpoint that can be used: {error}; use another one of the run") from None
    raise ValueError(
        f"{path} has checkpoint format {version}, this version of learn3d reads format {FORMAT}; use the version of "
        "learn3d that wrote it"
    )


def network_tensors(method: Method) -> dict[str, Tensor]:
    """Parameters and buffers of all networks, named network.<encoder|generator|...>.<parameter>.

    Their averages have the same names with "ema" in place of "network".
    """
    return {
        f"network.{name}.{key}": tensor
        for name, network in method.networks.items()
        for key, tensor in network.state_dict().items()
    }


def restore_networks(method: Method, tensors: dict[str, Tensor], source: Path, kind: str = "network") -> None:
    """Copy the weights of a checkpoint, or with the kind "ema" their averages, into the networks of a method.

    Weights at half precision (`runs.export`) become float32. Raises ValueError where they do not fit.
    """
    for name, network in method.networks.items():
        state = starting_with(f"{kind}.{name}.", tensors)
        try:
            for key, own in network.state_dict().items():
                if key in state and (state[key].dtype, own.dtype) == (torch.float16, torch.float32):
                    state[key] = state[key].float()
                if key in state and state[key].dtype != own.dtype:
                    raise ValueError(f"{name}.{key} is {state[key].dtype}, wanted {own.dtype}")
            check_finite(name, state)
            network.load_state_dict(state)
        except (RuntimeError, ValueError, FloatingPointError) as error:
            raise ValueError(f"{source} does not fit the {name}: {error}") from None


def starting_with(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors whose names start with a prefix, without it."""
    return {key.removeprefix(prefix): tensor for key, tensor in tensors.items() if key.startswith(prefix)}


def optimizer_state(name: str, optimizer: torch.optim.Optimizer) -> tuple[dict[str, Tensor], dict[str, dict[str, Any]]]:
    """What any optimizer of torch keeps of each parameter: tensors, named optimizer.<name>.<index>.<key>, and the other
    values by index and key. Its learning rate and the like are not among them: they come from the options.
    """
    tensors, others = {}, {}
    for index, state in optimizer.state_dict()["state"].items():
        for key, value in state.items():
            if isinstance(value, Tensor):
                tensors[f"optimizer.{name}.{index}.{key}"] = value
            else:
                others.setdefault(str(index), {})[key] = value
    return tensors, others


def restore_optimizer(
    name: str,
    optimizer: torch.optim.Optimizer,
    tensors: dict[str, Tensor],
    others: dict[str, dict[str, Any]],
    source: Path | str = "the checkpoint",
) -> None:
    """Put back what `optimizer_state` gave. Raises ValueError where it does not go with the parameters.

    Each tensor takes the memory layout of its parameter again (channels last, for convolutions): the fused kernels walk
    through parameter, gradient and state by position in memory and would mix up weights of different layouts. Nor do
    they look at shapes: they would read and write beyond a tensor that is too small. All are copies: what was loaded is
    the file itself, mapped, which would otherwise take room on the disk when it is deleted.
    """
    parameters = [(p, group) for group in optimizer.param_groups for p in group["params"]]
    state: dict[int, dict[str, Any]] = {}
    try:
        found = {tuple(key.partition(".")[::2]): t for key, t in starting_with(f"optimizer.{name}.", tensors).items()}
        found |= {(index, key): value for index, values in others.items() for key, value in values.items()}
        for (index, key), value in found.items():
            if not index.isdecimal() or int(index) >= len(parameters):
                raise ValueError(f"{index}.{key} belongs to none of the {len(parameters)} parameters")
            parameter, group = parameters[int(index)]
            if isinstance(value, Tensor):
                shape = parameter.shape if key != "step" else torch.Size()
                if group.get("fused") and (value.shape, value.dtype) != (shape, torch.float32):
                    came = f"{value.dtype} {list(value.shape)}"
                    raise ValueError(f"{index}.{key} is {came}, wanted torch.float32 {list(shape)}")
                like = parameter if value.shape == parameter.shape else value
                value = torch.empty_like(like, dtype=value.dtype, device="cpu").copy_(value)
            state.setdefault(int(index), {})[key] = value
        check_finite(name, starting_with(f"optimizer.{name}.", tensors))
        for index, values in state.items():
            if parameters[index][1].get("fused") and values.keys() != next(iter(state.values())).keys():
                raise ValueError(f"the state of parameter {index} has other entries than that of the first")
    except (ValueError, FloatingPointError) as error:
        raise ValueError(f"{source} does not fit the optimizer {name}: {error}") from None
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def check_finite(owner: str, tensors: dict[str, Tensor]) -> None:
    """Raise a FloatingPointError naming the first tensor that has NaN or infinities."""
    for name, tensor in tensors.items():
        if not bool(tensor.isfinite().all()):
            raise FloatingPointError(f"the {owner} has values that are not finite ({name})")


def find(path: Path, which: str = "last") -> Path:
    """The checkpoint file of a run folder (`which`: last or best), or `path` itself when it is a file."""
    path = Path(path)
    return path / f"{which}.safetensors" if path.is_dir() else path


def load_data(config: TrainConfig, split: str, *, data: Path | None = None, category: str | None = None) -> ViewDataset:
    """A split of the data that a run was trained on, or of another folder or category, in the form of its networks.

    Raises ValueError also where some of its shards cannot be read: what is measured is measured on the whole split.
    """
    dataset = load_dataset(
        config.layout,
        data or config.data,
        category or config.category,
        split,
        image_size=config.settings.image_size,
        view_bins=config.view_bins,
    )
    if dataset.notes:
        raise ValueError(f"{split} is not whole: {'; '.join(dataset.notes)}")
    return dataset


def load_method(path: Path, *, device: str = "cpu", precision: str = "fp32") -> tuple[Method, TrainConfig, Metadata]:
    """A trained method ready for use, from a checkpoint file: (method in evaluation mode, configuration, metadata)."""
    tensors, metadata = load(path)
    arithmetic = resolve_precision(precision, device)
    with torch.random.fork_rng(devices=[]):
        method = create_method(metadata.config.settings, metadata.info, device=device, precision=arithmetic, seed=0)
    restore_networks(method, tensors, path, "ema" if starting_with("ema.", tensors) else "network")
    method.set_training(False)
    for network in method.networks.values():
        network.requires_grad_(False)
    return method, metadata.config, metadata
