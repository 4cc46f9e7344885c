"""The options of a training run: a frozen dataclass, its checks and its JSON form.

`presets` has instances of it.
"""

import dataclasses
import json
import typing
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, SkipValidation

from learn3d.data.layouts import LAYOUTS, Layout, check_options
from learn3d.data.sampling import VIEWS_OF_OBJECT, Augmentation, Sampling
from learn3d.methods.method import MethodSettings
from learn3d.methods.optimization import LRSchedule, TrainingSchedule
from learn3d.settings import Count, FilePath, Items, OpenInPresets, Step, checked

T = TypeVar("T")
_MAY_DIFFER = "a resumed run may have another value"
# an option that changes how a run computes or reports, not its result
MayDiffer = Annotated[T, _MAY_DIFFER]


@checked
class TrainConfig:
    """One training run. config.json and every checkpoint hold it."""

    data: MayDiffer[OpenInPresets[FilePath]]
    """Folder of the data set. In the layout kato its files are 02691156_train_images.npz and so
    on."""
    category: OpenInPresets[Annotated[str, Field(min_length=1)]]
    """Categories to train on together, separated by commas: names (chair), synset ids, or names
    of your own."""
    output: MayDiffer[OpenInPresets[FilePath]]
    """Folder of this run: checkpoints, metrics, pictures. It must be new or empty without
    --resume or --overwrite."""
    preset: str
    """Method, or preset of a method for other data. It sets the defaults of the other options."""
    label: MayDiffer[str]
    """Name of the method in tables and figures."""
    settings: Annotated[MethodSettings, SkipValidation]
    """Settings of the method; their type decides the method."""
    layout: Layout
    """Arrangement of the files of the data set, see docs/data-sets.md."""
    iterations: MayDiffer[Step]
    """Number of training steps."""
    batch_size: Annotated[int, Field(ge=1, le=65_536)]
    """Images per training step."""
    view_bins: str | None = None
    """Size of the view classes, azimuth x elevation in degrees. None: 15x20 for kar; one class
    for each fixed camera."""
    views_per_object: Count | None = None
    """Training views per object: the first ones for kar, else random ones, the same in every run.
    If not given: one for kar, else all."""
    poses: MayDiffer[FilePath | None] = None
    """Table of poses from learn3d estimate-poses, instead of the poses of the data set."""
    pose_updates: Annotated[int, Field(ge=0, le=16)] = 3
    """Number of times a run reweights the candidates of --poses by the IoU of its own shapes:
    after 1/2, 1/4, ... of all steps. 0: never."""
    sampling: Sampling = "views"
    """How batches are drawn. views: single images. pairs: two views of each object. groups: five
    views of each object."""
    augment: Annotated[tuple[Augmentation, ...], Items] = ()
    """Random augmentations of the training images (--augment without a name: none)."""
    lr_schedule: LRSchedule = "constant"
    """Learning-rate schedule. linear, cosine: decay to 0. step: a tenth in the last 5 % of all
    steps."""
    warmup_steps: Annotated[int, Field(ge=0, le=10**9)] = 0
    """Steps over which the learning rate ramps up from 0, but at most a tenth of the run."""
    ema_decay: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Decay per step of the EMA of all weights; evaluation and reconstruction use the EMA. 0: no
    EMA."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of the initial weights and of the order of the images."""
    device: MayDiffer[Literal["cpu", "cuda"]] = "cpu"
    """Device on which the networks run. Rendering runs on the CPU."""
    precision: Literal["auto", "bf16", "fp32"] = "auto"
    """Arithmetic of the networks. auto: bf16 where it is faster (CUDA, AMX, AMD), else fp32."""
    threads: MayDiffer[Annotated[int, Field(ge=1, le=4096)] | None] = None
    """Number of CPU threads. If not given: one or all, whichever is faster at the start."""
    log: MayDiffer[Literal["tensorboard", "wandb"]] = "tensorboard"
    """Second log besides metrics.jsonl; wandb sends the metrics to your account there (pip
    install wandb)."""
    val_split: MayDiffer[Literal["val", "test"]] = "val"
    """Split for validation during training and for choosing the best checkpoint."""
    validate_every: MayDiffer[Step] = 2000
    """Steps between validations (IoU of voxels or silhouettes, and MMD); the last step is always
    validated."""
    max_val_images: MayDiffer[Count | None] = None
    """Number of images to validate on, evenly from all objects and views of the split. None: all."""
    pictures_every: MayDiffer[Step] = 1000
    """Steps between picture grids."""
    checkpoint_every: MayDiffer[Step] = 1000
    """Steps between saves of the last checkpoint."""
    log_every: MayDiffer[Step] = 50
    """Steps between logged losses."""

    def __post_init__(self) -> None:
        if not isinstance(self.settings, MethodSettings):
            raise ValueError(f"settings must be those of a method, got {self.settings!r:.200}")
        check_options(self.layout, image_size=self.settings.image_size, view_bins=self.view_bins)
        if self.val_split == "val" and not LAYOUTS[self.layout].validation:
            raise ValueError(
                f"the layout {self.layout!r} has no split val; validate on test (val_split test)"
            )
        if "flip" in self.augment and self.settings.reads_view_ids:
            raise ValueError(
                f"augment 'flip' changes the view class, but {self.preset!r} learns with the class of the original"
            )
        needed = self.settings.sampling
        if needed not in (None, self.sampling):
            raise ValueError(
                f"{self.preset!r} needs sampling {needed!r}, got {self.sampling!r}; leave sampling out"
            )
        size = VIEWS_OF_OBJECT[self.sampling]
        if self.batch_size % size:
            raise ValueError(
                f"with sampling {self.sampling!r} batch_size must be a multiple of {size}, got {self.batch_size}"
            )
        self.settings.check_run(iterations=self.iterations, batch_size=self.batch_size)

    @property
    def schedule(self) -> TrainingSchedule:
        """Length, learning-rate schedule and EMA of the training."""
        warmup_steps = min(self.warmup_steps, self.iterations // 10)
        return TrainingSchedule(self.iterations, self.lr_schedule, warmup_steps, self.ema_decay)


def config_to_dict(config: TrainConfig) -> dict[str, Any]:
    """The configuration as JSON values, with the method's settings under "settings"."""
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))


_MAY_DIFFER_NAMES = {
    name
    for name, hint in typing.get_type_hints(TrainConfig, include_extras=True).items()
    if _MAY_DIFFER in getattr(hint, "__metadata__", ())
}


def differences(config: TrainConfig, saved: TrainConfig) -> list[str]:
    """A line for each option that must not change, but differs from the run `saved`."""
    old, new = (
        {"method": type(c.settings).__name__.removesuffix("Settings"), **all_options(c)}
        for c in (saved, config)
    )
    schedule = f"the schedule {config.lr_schedule}" if config.lr_schedule != "constant" else ""
    updates = "pose_updates" if config.poses is not None and config.pose_updates > 0 else ""
    # the ramp of a short run is shorter, see `TrainConfig.schedule`
    ramp = "warmup_steps" if config.schedule.warmup_steps != saved.schedule.warmup_steps else ""
    varies = schedule or config.settings.varies_over_run or updates or ramp
    # a preset only sets defaults
    allowed = (_MAY_DIFFER_NAMES | {"preset"}) - ({"iterations"} if varies else set())
    return [
        f"{name}: {old.get(name)!r} in the run, {new.get(name)!r} asked for"
        + f" ({varies} depends on it)" * (name == "iterations")
        for name in dict.fromkeys([*old, *new])
        if name not in allowed and old.get(name) != new.get(name)
    ]


def check_resume(config: TrainConfig, saved: TrainConfig) -> None:
    """Raise a ValueError that names every option that must not change when a run is resumed."""
    if changed := differences(config, saved):
        raise ValueError(
            "cannot resume with different options ("
            + "; ".join(changed)
            + "); start a new run for that"
        )


def all_options(config: TrainConfig) -> dict[str, Any]:
    """All options by name, with those of the method in place of `settings`."""
    values = dataclasses.asdict(config)
    return values | values.pop("settings")
