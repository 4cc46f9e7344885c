"""Checkpoints: all tensors of a run in one safetensors file, everything else as JSON in its
header. No pickle.

The header has two entries: "learn3d", the JSON of `Metadata`, and "crc32", the CRC-32 of that
JSON and of the names, dtypes, shapes and bytes of all tensors.
"""

import contextlib
import dataclasses
import functools
import importlib.metadata
import json
import math
import subprocess
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import BeforeValidator, Field
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from learn3d.config import TrainConfig
from learn3d.data.dataset import DatasetInfo, ViewDataset
from learn3d.data.layouts import LAYOUTS, Layout, load_dataset
from learn3d.device import resolve_precision
from learn3d.files import limits, writing
from learn3d.files.reading import DamagedFile, parse_json
from learn3d.methods import create_method
from learn3d.methods.method import Method
from learn3d.presets import config_from_dict
from learn3d.settings import Count, NonNegative, Share, checked, split_names


@functools.cache
def versions() -> dict[str, str | None]:
    """Versions of the package and of torch, and the git commit of the code at the first call
    (None if unknown).
    """
    try:
        package = importlib.metadata.version("nmr-learn3d")
    except importlib.metadata.PackageNotFoundError:
        package = None
    return {"nmr-learn3d": package, "torch": torch.__version__, "commit": _git_commit()}


def _git_commit() -> str | None:
    """The commit that the package was built from, or of the checkout of this file ("-dirty" if it
    has changes).
    """
    built_from = Path(__file__).parents[1] / "commit.txt"
    sources = Path(__file__).parents[2]
    if built_from.exists():  # CMakeLists.txt wrote it
        return built_from.read_text().strip() or None
    if not (
        sources / ".git"
    ).exists():  # a copy of the sources, perhaps inside of another repository
        return None
    command = [
        "git",
        "-C",
        str(sources),
        "describe",
        "--always",
        "--dirty",
        "--abbrev=40",
        "--exclude=*",
    ]
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


# a checkpoint has at most so many numbers for each of its networks: weights, EMA, two moments of Adam
_FILE_SHARE = 6
_USE_ANOTHER = "use another checkpoint of the run"
AnyStep = Annotated[int, Field(ge=0, le=10**9)]


@checked
class Progress:
    """The progress of a run."""

    step: AnyStep = 0  # last step taken
    best_iou: Annotated[
        float, Field(ge=-1, le=1)
    ] = -1.0  # best validation IoU so far; -1 before the first validation
    best_step: AnyStep = 0  # step of best_iou
    seconds: NonNegative = 0.0  # training time, over all resumptions
    object_share: Share = 0.0  # `ViewDataset.mean_object_size` of the training images
    # CPU threads that the run has chosen; None: fixed, or not chosen yet
    threads: Count | None = None
    losses: dict[str, float] = dataclasses.field(default_factory=dict)  # losses of the last step


def _from_dict(build: Callable[[dict[str, Any]], Any]) -> BeforeValidator:
    return BeforeValidator(lambda value: build(value) if isinstance(value, dict) else value)


@checked
class Metadata:
    """Everything in a checkpoint besides its tensors."""

    config: Annotated[TrainConfig, _from_dict(config_from_dict)]
    info: Annotated[DatasetInfo, _from_dict(lambda values: DatasetInfo(**values))]
    progress: Annotated[Progress, _from_dict(lambda values: Progress(**values))]
    data: str  # `runs.run.describe_images` of the training images
    versions: dict[str, str | None]  # `versions` of the code that wrote the file


def save(path: Path, tensors: dict[str, Tensor], metadata: Metadata) -> None:
    """Write tensors and metadata; the file gets its name when it is complete and on the disk.

    Raises OSError if it cannot be written, FloatingPointError if a value is not finite.
    """
    for name, tensor in tensors.items():
        if not bool(tensor.isfinite().all()):
            raise FloatingPointError(f"{name} has values that are not finite, and is not saved")
    text = json.dumps(dataclasses.asdict(metadata), default=str)
    flat = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    header = {"learn3d": text, "crc32": _checksum(text, flat)}
    try:
        with writing.replacing(path, sync=True) as temporary:
            save_file(flat, temporary, header)
    except (OSError, SafetensorError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OSError(f"cannot write the checkpoint {path}: {reason}") from error


def _checksum(text: str, tensors: dict[str, Tensor]) -> str:
    crc = zlib.crc32(text.encode())
    for name, tensor in sorted(tensors.items()):
        crc = zlib.crc32(f"{name} {tensor.dtype} {list(tensor.shape)}".encode(), crc)
        crc = zlib.crc32(tensor.reshape(-1).view(torch.uint8).numpy(), crc)
    return f"{crc:08x}"


def load(
    path: Path, which: str = "last", *, with_tensors: bool = True
) -> tuple[dict[str, Tensor], Metadata]:
    """Read the tensors, on the CPU, and the metadata of a checkpoint, and verify their checksum.

    path: a file, or a run folder with the checkpoint `which`. with_tensors: if False, neither
    tensors nor checksum are read. Raises DamagedFile if the file is truncated, changed or of
    another kind; ValueError if it is missing or from another version of learn3d; OSError if it
    cannot be read.
    """
    path = find(path, which)
    if not path.is_file():
        held = (
            "last.safetensors and, from the first validation that measured an IoU, best.safetensors"
        )
        raise ValueError(f"there is no checkpoint {path}; a run folder holds {held}")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()} if with_tensors else {}
    except (SafetensorError, ValueError) as error:
        raise DamagedFile(path, f"is damaged or was cut short ({error}); {_USE_ANOTHER}") from None
    if "learn3d" not in header:
        raise DamagedFile(path, "is a safetensors file, but not a checkpoint of learn3d")
    text = header["learn3d"]
    if with_tensors and _checksum(text, tensors) != header.get("crc32"):
        raise DamagedFile(
            path, f"has changed since it was written (another CRC-32); {_USE_ANOTHER}"
        )
    try:
        return tensors, Metadata(**parse_json(text))
    except (TypeError, ValueError) as error:  # TypeError: not a JSON object
        if not with_tensors and path.stat().st_size < limits.WEIGHTS_BYTES:
            load(path)  # perhaps the file has changed, which is the better message
        raise ValueError(f"{path} is no checkpoint of this version of learn3d: {error}") from None


def load_metadata(path: Path, which: str = "last") -> Metadata:
    """Read only the metadata of a checkpoint, see `load`."""
    return load(path, which, with_tensors=False)[1]


def find(path: Path, which: str = "last") -> Path:
    """The checkpoint file of a run folder (`which`: last or best), or `path` itself if it is a
    file.
    """
    path = Path(path)
    return path / f"{which}.safetensors" if path.is_dir() else path


def load_method(
    path: Path, which: str = "last", *, device: str = "cpu", precision: str = "fp32"
) -> tuple[Method, TrainConfig, Metadata]:
    """Open a checkpoint for evaluation or reconstruction, see `load`.

    Returns the method in evaluation mode, with its EMA weights if it has any; its configuration;
    the metadata. The names and sizes of the tensors are compared with the networks before any is
    filled or read.
    """
    path = find(path, which)
    metadata = load_metadata(path)
    shapes = _shapes(path)
    kind = "ema" if starting_with("ema.", shapes) else "network"
    how = {"device": device, "precision": resolve_precision(precision, device), "seed": 0}
    with torch.random.fork_rng(devices=[]), _at_most(starting_with(f"{kind}.", shapes), path):
        method = create_method(metadata.config.settings, metadata.info, **how)
    wanted = {name: tuple(tensor.shape) for name, tensor in network_tensors(method).items()}
    for name, shape in wanted.items():
        if (found := shapes.get(name.replace("network", kind, 1))) != shape:
            raise DamagedFile(path, f"does not fit: {name} is {found}, its networks need {shape}")
    most = _FILE_SHARE * _count(wanted) + limits.WEIGHTS_BYTES // 4
    if _count(shapes) > most:
        raise DamagedFile(path, f"has {_count(shapes)} numbers; its networks have {_count(wanted)}")
    tensors, metadata = load(path)
    restore_networks(method, tensors, path, kind)
    method.networks.eval().requires_grad_(False)
    return method, metadata.config, metadata


def _shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """The shape of each tensor of a checkpoint; no tensor is read."""
    with safe_open(path, framework="pt") as file:
        return {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}


def _count(shapes: dict[str, tuple[int, ...]]) -> int:
    return sum(map(math.prod, shapes.values()))


@contextlib.contextmanager
def _at_most(shapes: dict[str, tuple[int, ...]], path: Path) -> Iterator[None]:
    """Context in which networks are built: those with more weights than the file are refused
    before their weights are filled.
    """
    taken: dict[tuple[nn.Module, str], int] = {}
    most = 2 * _count(shapes) + 10**7  # some layers are made and replaced

    def take(module: nn.Module, name: str, weights: nn.Parameter | None) -> None:
        taken[module, name] = 0 if weights is None else weights.numel()
        if sum(taken.values()) > most:
            raise DamagedFile(path, "does not fit: its networks have far more weights than it")

    hook = register_module_parameter_registration_hook(take)
    try:
        yield
    finally:
        hook.remove()


def load_data(
    config: TrainConfig,
    split: str,
    *,
    data: Path | None = None,
    category: str | None = None,
    layout: Layout | None = None,
) -> ViewDataset:
    """A split of a run's data, or of another folder, category or layout, in the form that its
    networks take.

    The run's own data get its options `poses` and, in the training split, `views_per_object`.
    Raises ValueError if the layout inverts colours and the training layout does not, or the other
    way round.
    """
    layout = layout or config.layout
    if layout in LAYOUTS and LAYOUTS[layout].inverted != LAYOUTS[config.layout].inverted:
        raise ValueError(
            f"the networks were trained on colours as the layout {config.layout} has them, not {layout}"
        )
    form = {"image_size": config.settings.image_size}
    if layout == config.layout:
        form["view_bins"] = config.view_bins
    own = data is None and (category is None or category in split_names(config.category))
    if own and layout == config.layout:
        form |= {
            "poses": config.poses,
            "views_per_object": config.views_per_object if split == "train" else None,
        }
    return load_dataset(layout, data or config.data, category or config.category, split, **form)


def network_tensors(method: Method) -> dict[str, Tensor]:
    """Parameters and buffers of all networks, named network.<encoder|generator|...>.<parameter>."""
    networks = method.networks.items()
    return {
        f"network.{name}.{key}": value
        for name, net in networks
        for key, value in net.state_dict().items()
    }


def restore_networks(
    method: Method, tensors: dict[str, Tensor], source: Path, kind: str = "network"
) -> None:
    """Copy the weights of a checkpoint ("network") or their averages ("ema") into the networks of
    a method.

    Raises ValueError if they do not fit.
    """
    for name, network in method.networks.items():
        try:
            network.load_state_dict(starting_with(f"{kind}.{name}.", tensors))
        except RuntimeError as error:
            reason = "; ".join(line.strip() for line in str(error).splitlines()[1:4])
            raise ValueError(f"{source} does not fit the {name}: {reason[:500]}") from None


def starting_with(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors whose names start with `prefix`, by the rest of their names."""
    return {
        key.removeprefix(prefix): tensor
        for key, tensor in tensors.items()
        if key.startswith(prefix)
    }


def optimizer_tensors(name: str, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """The state of an optimizer, named optimizer.<name>.<parameter's index>.<key>, without
    learning rates.
    """
    state = optimizer.state_dict()["state"]
    return {
        f"optimizer.{name}.{index}.{key}": value
        for index, found in state.items()
        for key, value in found.items()
    }


def restore_optimizer(
    name: str, optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor], source: Path
) -> None:
    """Restore the tensors of `optimizer_tensors`.

    Raises ValueError if they do not fit the parameters.

    Fused kernels index parameter, gradient and state by position in memory, so each tensor must
    have its parameter's shape, and is copied to its parameter's memory layout.
    """
    parameters = [
        (p, group.get("fused")) for group in optimizer.param_groups for p in group["params"]
    ]
    state: dict[int, dict[str, Tensor]] = {}
    for place, value in starting_with(f"optimizer.{name}.", tensors).items():
        index, _, key = place.partition(".")
        if not index.isdecimal() or int(index) >= len(parameters):
            raise ValueError(
                f"{source} does not fit the optimizer {name}: {place} belongs to no parameter"
            )
        parameter, fused = parameters[int(index)]
        wanted = torch.Size() if key == "step" else parameter.shape
        if fused and value.shape != wanted:
            came = f"{place} is {list(value.shape)}, wanted {list(wanted)}"
            raise ValueError(f"{source} does not fit the optimizer {name}: {came}")
        like = parameter if value.shape == parameter.shape else value
        state.setdefault(int(index), {})[key] = torch.empty_like(
            like, dtype=value.dtype, device="cpu"
        ).copy_(value)
    optimizer.load_state_dict(optimizer.state_dict() | {"state": state})
