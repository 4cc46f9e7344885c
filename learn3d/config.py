"""What a training run is: one frozen dataclass, filled in from a preset, with its checks and its JSON form."""

from __future__ import annotations

import dataclasses
import json
import typing
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, Field, SkipValidation

from learn3d.data.augment import Augmentation
from learn3d.data.layouts import LAYOUTS, Layout, check_options
from learn3d.data.sampling import Sampling
from learn3d.files import limits
from learn3d.files.findings import DamagedFile
from learn3d.files.reading import parse_json, read_bytes
from learn3d.methods import LRSchedule, MethodSettings, TrainingSchedule
from learn3d.presets import PRESETS, full_name
from learn3d.settings import Count, FilePath, Items, Rare, Step, checked

DEFAULT_PRESET = "plus-kato"

#: Options that the preset decides if they are None.
FROM_PRESET = ("settings", "layout", "sampling", "augment", "iterations", "batch_size", "lr_schedule", "warmup_steps")
FROM_PRESET += ("ema_decay",)

T = TypeVar("T")
_MAY_DIFFER = "a resumed run may have another value"  # it decides how to compute or report, not what is learnt
MayDiffer = Annotated[T, _MAY_DIFFER]


@checked
class TrainConfig:
    """One training run. It is saved with the run (config.json and in every checkpoint)."""

    data: MayDiffer[FilePath]
    """Folder with the data set's files, such as 02691156_train_images.npz (what `learn3d make-dataset` writes)."""
    category: Annotated[str, Field(min_length=1)]
    """Object category to train on: a name such as airplane or chair, a synset id, or the file prefix of your own set.
    Several, separated by commas, are trained on together."""
    output: MayDiffer[FilePath]
    """Folder of this run: checkpoints, metrics, pictures. It must be new or empty unless you resume or overwrite."""
    preset: Annotated[str, AfterValidator(full_name)] = DEFAULT_PRESET
    """Method, or preset of a method for other data, that decides the defaults of the other options."""
    settings: Rare[Annotated[MethodSettings | None, SkipValidation]] = None
    """Settings of the method (default: the preset's)."""
    layout: Layout | None = None
    """Arrangement of the files of the data set, see docs/data-sets.md."""
    view_bins: Rare[str | None] = None
    """View classes as cells of azimuth and elevation in degrees, such as 15x20 (default: 15x20 for kar; one class for
    each camera if cameras are fixed)."""
    views_per_object: Rare[Count | None] = None
    """Number of views of each object to train on: the first ones for kar and r2n2, else drawn at random, the same in
    every run (default: the layout's protocol, one for kar, else all)."""
    sampling: Rare[Sampling | None] = None
    """How a batch is drawn: views (each on its own), pairs (two views of an object) or classes (categories drawn
    uniformly)."""
    augment: Rare[Annotated[tuple[Augmentation, ...], Items] | None] = None
    """Random changes of the training images (--augment without a name: none)."""
    iterations: MayDiffer[Step | None] = None
    """Number of training steps."""
    batch_size: Annotated[int, Field(ge=1, le=65_536)] | None = None
    """Images per training step."""
    lr_schedule: Rare[LRSchedule | None] = None
    """Course of the learning rate over the run. linear, cosine: it falls to 0. step: it falls to a tenth for the last
    5 % of all iterations."""
    warmup_steps: Rare[Annotated[int, Field(ge=0, le=10**9)] | None] = None
    """Steps over which the learning rate grows from 0 at the beginning (default: the preset's, and never more than a
    tenth of the iterations)."""
    ema_decay: Rare[Annotated[float, Field(ge=0, lt=1)] | None] = None
    """Decay, for each step, of an exponential moving average of all weights, which validation, the best checkpoint,
    evaluation and reconstruction use. 0: no average."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of the initial weights and of the order of the images."""
    device: MayDiffer[Literal["cpu", "cuda"]] = "cpu"
    """Device on which the networks run. Rendering runs on the CPU."""
    precision: Rare[Literal["auto", "bf16", "fp32"]] = "auto"
    """Arithmetic of the networks. auto: bf16 if it is faster (CUDA, CPUs with bf16 instructions), else fp32."""
    threads: MayDiffer[Annotated[int, Field(ge=1, le=4096)] | None] = None
    """Number of CPU threads (default: one or all, whichever makes the steps faster, tried at the beginning and when
    steps become slow)."""
    val_split: Rare[MayDiffer[Literal["val", "test"]]] = "val"
    """Split for validation during training, and for choosing the best checkpoint."""
    validate_every: MayDiffer[Step] = 2000
    """Steps between validations (voxel IoU and MMD); the last step is always validated."""
    max_val_images: Rare[MayDiffer[Count | None]] = None
    """Number of images to validate on, spread evenly over the objects and views of the split (default: all)."""
    pictures_every: Rare[MayDiffer[Step]] = 1000
    """Steps between picture grids."""
    checkpoint_every: Rare[MayDiffer[Step]] = 1000
    """Steps between saves of the last checkpoint."""
    keep_checkpoints: Rare[MayDiffer[Step]] = 2
    """Number of checkpoints to keep: last.safetensors and the ones before it, in checkpoints/."""
    log_every: Rare[MayDiffer[Step]] = 50
    """Steps between logged losses. A method that trains its networks in turns logs the losses of the last two steps."""

    def __post_init__(self) -> None:
        preset = PRESETS[self.preset]
        chosen = {name: getattr(preset, name) for name in FROM_PRESET if getattr(self, name) is None}
        for name, value in chosen.items():
            object.__setattr__(self, name, value)
        if "warmup_steps" in chosen:
            object.__setattr__(self, "warmup_steps", min(self.warmup_steps, self.iterations // 10))
        if type(self.settings) is not type(preset.settings):
            raise ValueError(
                f"preset {self.preset!r} takes {type(preset.settings).__name__}, got {type(self.settings).__name__}"
            )
        check_options(self.layout, image_size=self.settings.image_size, view_bins=self.view_bins)
        if self.val_split == "val" and not LAYOUTS[self.layout].validation:
            raise ValueError(f"the layout {self.layout!r} has no split val; validate on test (val_split test)")
        if "flip" in self.augment and self.settings.reads_view_ids:
            raise ValueError(
                "augment 'flip' moves the camera into another view class, but "
                f"{self.preset!r} learns with the class of the original; leave 'flip' out"
            )
        if self.sampling == "pairs" and self.batch_size % 2:
            raise ValueError(
                f"sampling 'pairs' takes two views of each object: batch_size must be even, got {self.batch_size}"
            )
        self.settings.check_run(iterations=self.iterations, batch_size=self.batch_size)
        self.schedule  # noqa: B018 (it checks itself)

    @property
    def schedule(self) -> TrainingSchedule:
        """Course of the training, which the method follows."""
        return TrainingSchedule(self.iterations, self.lr_schedule, self.warmup_steps, self.ema_decay)


def config_to_dict(config: TrainConfig) -> dict[str, Any]:
    """The configuration as plain JSON values; the method's settings are a dictionary under "settings"."""
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))


def config_from_dict(values: Any, source: str = "config") -> TrainConfig:
    """Build a TrainConfig from plain values. Raises ValueErrors that name `source` and the option that is wrong."""
    try:
        if not isinstance(values, dict):
            raise ValueError(f"must hold options by name ({{...}}), got {type(values).__name__}")
        preset, settings = values.get("preset", DEFAULT_PRESET), values.get("settings")
        if isinstance(settings, dict) and isinstance(preset, str):
            values = values | {"settings": type(PRESETS[full_name(preset)].settings)(**settings)}
        return TrainConfig(**values)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


def load_config(path: Path) -> TrainConfig:
    """Read the config.json of a run. Raises ValueError where there is none, or none that can be read."""
    try:
        values = parse_json(read_bytes(path, limits.CONFIG_BYTES, "the options of a run"))
    except FileNotFoundError:
        raise ValueError(f"no {path}: is this the folder of a training run? One begins without --resume") from None
    except DamagedFile:
        raise
    except ValueError as error:
        raise ValueError(f"{path} is not valid JSON: {error}") from None
    return config_from_dict(values, source=str(path))


_MAY_DIFFER_NAMES = {
    name
    for name, hint in typing.get_type_hints(TrainConfig, include_extras=True).items()
    if _MAY_DIFFER in getattr(hint, "__metadata__", ())
}


def differences(config: TrainConfig, saved: TrainConfig) -> list[str]:
    """Reasons why `config` is another run than `saved`: a line for each option that must not differ."""
    old, new = (_flat(c) for c in (saved, config))
    varies = config.settings.varies_over_run
    if config.lr_schedule != "constant":
        varies = f"the schedule {config.lr_schedule}"
    allowed = _MAY_DIFFER_NAMES - ({"iterations"} if varies else set())
    return [
        f"{name}: {old.get(name)!r} in the run, {new.get(name)!r} asked for"
        + f" ({varies} depends on it)" * (name == "iterations")
        for name in dict.fromkeys([*old, *new])
        if name not in allowed and old.get(name) != new.get(name)
    ]


def check_resume(config: TrainConfig, saved: TrainConfig) -> None:
    """Raise a ValueError naming every option whose change would make the resumed run a different one."""
    if changed := differences(config, saved):
        raise ValueError("cannot resume with different options (" + "; ".join(changed) + "); start a new run for that")


def _flat(config: TrainConfig) -> dict[str, Any]:
    """Options by name, the method's settings among them, without the preset, which only says where they came from."""
    values = {f.name: getattr(config, f.name) for f in dataclasses.fields(TrainConfig) if f.name != "preset"}
    settings = values.pop("settings")
    return {"method": type(settings).__name__.removesuffix("Settings")} | values | dataclasses.asdict(settings)
