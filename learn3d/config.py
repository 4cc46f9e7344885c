"""What a training run is: one frozen dataclass, filled in from a preset, with its checks and its JSON form."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, SkipValidation

from learn3d.data.augment import Augmentation
from learn3d.data.layouts import LAYOUTS, Layout, check_options
from learn3d.data.sampling import Sampling
from learn3d.files import limits
from learn3d.files.findings import DamagedFile
from learn3d.files.reading import parse_json, read_bytes
from learn3d.methods import LRSchedule, MethodSettings, TrainingSchedule
from learn3d.presets import PRESETS
from learn3d.settings import Count, FilePath, Items, Step, checked

DEFAULT_PRESET = "plus-kato"

_FROM_PRESET = ("settings", "layout", "sampling", "augment", "iterations", "batch_size", "lr_schedule")
_FROM_PRESET += ("warmup_steps", "ema_decay")  # options that the preset decides where they are None


def _known_preset(name: str) -> str:
    if name not in PRESETS:
        raise ValueError(f"must be one of {', '.join(PRESETS)}, got {name!r}")
    return name


@checked
class TrainConfig:
    """One training run. It is saved with the run (config.json and in every checkpoint)."""

    data: FilePath
    """Folder with the data set's files, such as 02691156_train_images.npz (what `learn3d make-dataset` writes)."""
    category: Annotated[str, Field(min_length=1)]
    """Object class to train on: a name such as airplane or chair, a synset id, or the file prefix of your own set.
    Several, separated by commas, are trained on together."""
    output: FilePath
    """Folder of this run: checkpoints, metrics, pictures. It must be new or empty unless you resume or overwrite."""
    preset: Annotated[str, AfterValidator(_known_preset)] = DEFAULT_PRESET
    """Published experiment whose settings apply where nothing else is said."""
    settings: Annotated[MethodSettings | None, SkipValidation] = None
    """Settings of the method. None: the preset's."""
    layout: Layout | None = None
    """Layout of the data set. None: the preset's."""
    view_bins: str | None = None
    """Pose classes as cells of azimuth and elevation in degrees, such as 15x20. None: the layout's own, 15x20
    for kar; where cameras are fixed, one class for each."""
    views_per_object: Count | None = None
    """Train on so many views of every object (kar, r2n2: the first; else drawn at random, the same in every run). None:
    what the layout's protocol uses, one for Kar's, else all."""
    sampling: Sampling | None = None
    """What a batch is made of: views (each on its own), pairs (two views of an object) or classes (drawn uniformly).
    None: the preset's."""
    augment: Annotated[tuple[Augmentation, ...], Items] | None = None
    """Random changes of the training images. None: the preset's."""
    iterations: Step | None = None
    """Number of training steps. None: the preset's."""
    batch_size: Annotated[int, Field(ge=1, le=65_536)] | None = None
    """Images per step. None: the preset's."""
    lr_schedule: LRSchedule | None = None
    """How the learning rate changes over the run. linear, cosine: it falls to 0. step: to a tenth in the last 5 % of
    all iterations. None: the preset's, constant for most."""
    warmup_steps: Annotated[int, Field(ge=0, le=10**9)] | None = None
    """Steps over which the learning rate grows from 0 at the beginning. None: the preset's, 0 for most, and
    never more than a tenth of the iterations."""
    ema_decay: Annotated[float, Field(ge=0, lt=1)] | None = None
    """Also keep an exponential moving average of all weights, with this decay a step, such as 0.999. Validation, the
    best checkpoint, evaluation and reconstruction use it. 0: no average. None: the preset's, 0 for most."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of the initial weights and of the order of the images."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the networks run. Rendering runs on the CPU."""
    precision: Literal["auto", "bf16", "fp32"] = "auto"
    """Arithmetic of the networks. auto: bf16 where it is faster (CUDA, CPUs with bf16 instructions), else fp32."""
    threads: Annotated[int, Field(ge=1, le=4096)] | None = None
    """Number of CPU threads. None: one or all, whichever makes the steps faster, tried at the beginning and when steps
    become slow."""
    val_split: Literal["val", "test"] = "val"
    """Split used for validation during training (and for choosing the best checkpoint)."""
    validate_every: Step = 2000
    """Steps between validations (voxel IoU and MMD); the last step is always validated."""
    max_val_images: Count | None = None
    """Validate on this many images, spread evenly over the objects and views of the split. None: all."""
    pictures_every: Step = 1000
    """Steps between picture grids."""
    checkpoint_every: Step = 1000
    """Steps between saves of the last checkpoint."""
    keep_checkpoints: Step = 2
    """Number of checkpoints to keep: last.safetensors and the ones before it, in checkpoints/."""
    log_every: Step = 50
    """Steps between logged losses. A method that trains its networks in turns logs the losses of the last two steps."""

    def __post_init__(self) -> None:
        preset = PRESETS[self.preset]
        given_warmup = self.warmup_steps is not None
        for name in _FROM_PRESET:
            if getattr(self, name) is None:
                object.__setattr__(self, name, getattr(preset, name))
        if not given_warmup:
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
        """What the method must know about the run."""
        return TrainingSchedule(self.iterations, self.lr_schedule, self.warmup_steps, self.ema_decay)


#: Options that a resumed run may change: they say where and how long to compute and what to report, not what to learn.
RESUME_MAY_CHANGE = frozenset(
    {"data", "output", "iterations", "device", "threads", "val_split", "max_val_images", "validate_every"}
    | {"pictures_every", "checkpoint_every", "keep_checkpoints", "log_every"}
)


def config_to_dict(config: TrainConfig) -> dict[str, Any]:
    """The configuration as plain JSON values; the method's settings are a dictionary under "settings"."""
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))


def config_from_dict(values: Any, source: str = "config") -> TrainConfig:
    """Build a TrainConfig from plain values. Raises ValueErrors that name `source` and the option that is wrong."""
    try:
        if not isinstance(values, dict):
            raise ValueError(f"must hold options by name ({{...}}), got {type(values).__name__}")
        preset, settings = values.get("preset", DEFAULT_PRESET), values.get("settings")
        if isinstance(settings, dict) and isinstance(preset, str) and preset in PRESETS:
            values = values | {"settings": type(PRESETS[preset].settings)(**settings)}
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


def differences(config: TrainConfig, saved: TrainConfig) -> list[str]:
    """What makes `config` another run than `saved`: one line per option that a resumed run may not change."""
    old, new = (_flat(c) for c in (saved, config))
    allowed = RESUME_MAY_CHANGE
    dependent = _what_depends_on_iterations(config)
    if dependent is not None:
        allowed -= {"iterations"}
    return [
        f"{name}: {old.get(name)!r} in the run, {new.get(name)!r} asked for"
        + f" ({dependent} depends on it)" * (name == "iterations")
        for name in dict.fromkeys([*old, *new])
        if name not in allowed and old.get(name) != new.get(name)
    ]


def _what_depends_on_iterations(config: TrainConfig) -> str | None:
    """What makes every step depend on the number of steps of the whole run."""
    if config.lr_schedule != "constant":
        return f"the schedule {config.lr_schedule}"
    return config.settings.varies_over_run


def check_resume(config: TrainConfig, saved: TrainConfig) -> None:
    """Raise a ValueError naming every option whose change would make the resumed run a different one."""
    if changed := differences(config, saved):
        raise ValueError("cannot resume with different options (" + "; ".join(changed) + "); start a new run for that")


def _flat(config: TrainConfig) -> dict[str, Any]:
    """Options by name, the method's settings among them. The preset is only where they came from."""
    values = {f.name: getattr(config, f.name) for f in dataclasses.fields(TrainConfig)}
    settings = values.pop("settings")
    del values["preset"]
    return {"method": type(settings).__name__.removesuffix("Settings")} | values | dataclasses.asdict(settings)
