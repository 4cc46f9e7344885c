"""What a training run is: one frozen dataclass, filled in from a preset, with its checks and its JSON form."""

from __future__ import annotations

import dataclasses
import json
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from learn3d.data.augment import Augmentation
from learn3d.data.layouts import LAYOUTS, Layout, check_options
from learn3d.data.sampling import Sampling
from learn3d.files import limits
from learn3d.files.findings import DamagedFile
from learn3d.files.reading import parse_json, read_bytes
from learn3d.presets import PRESETS, Settings

DEFAULT_PRESET = next(iter(PRESETS))


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """One training run. It is saved with the run (config.json and in every checkpoint)."""

    data: Path
    """Folder with the data set's files, such as 02691156_train_images.npz (what tools/make_dataset.py writes)."""
    category: str
    """Object class to train on: a name such as airplane or chair, a synset id, or the file prefix of your own set.
    Several, separated by commas, are trained on together."""
    output: Path
    """Folder of this run: checkpoints, metrics, pictures. It must be new or empty unless you resume or overwrite."""
    preset: str = DEFAULT_PRESET
    """Published experiment whose settings apply where nothing else is said."""
    settings: Settings | None = None
    """Settings of the method. None: the preset's."""
    layout: Layout | None = None
    """Layout of the data set. None: the preset's."""
    view_bins: str | None = None
    """Pose classes as cells of azimuth and elevation in degrees, such as 15x20. None: the preset's, which for data sets
    of fixed views are these views."""
    views_per_object: int | None = None
    """Train on so many views of every object. None: what the layout's protocol uses, one for Kar's, else all."""
    sampling: Sampling | None = None
    """What a batch is made of: views (each on its own), pairs (two views of an object) or classes (drawn uniformly).
    None: the preset's."""
    augment: tuple[Augmentation, ...] | None = None
    """Random changes of the training images. None: the preset's."""
    iterations: int | None = None
    """Number of training steps. None: the preset's."""
    batch_size: int | None = None
    """Images per step. None: the preset's."""
    seed: int = 0
    """Seed of the initial weights and of the order of the images."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the networks run. Rendering runs on the CPU."""
    precision: Literal["auto", "bf16", "fp32"] = "auto"
    """Arithmetic of the networks. auto: bf16 where it is faster (CUDA, CPUs with bf16 instructions), else fp32."""
    threads: int | None = None
    """CPU threads for the networks. None: PyTorch's default, one per core."""
    val_split: Literal["val", "test"] = "val"
    """Split used for validation during training (and for choosing the best checkpoint)."""
    validate_every: int = 2000
    """Steps between validations (voxel IoU and MMD); the last step is always validated. With 2000 and 16,800 images
    they take under 3 % of a run of the default preset."""
    max_val_images: int | None = None
    """Validate on this many images, spread evenly over the objects and views of the split. None: all."""
    pictures_every: int = 1000
    """Steps between picture grids."""
    checkpoint_every: int = 1000
    """Steps between saves of the last checkpoint."""
    keep_checkpoints: int = 2
    """Number of checkpoints to keep: last.safetensors and the ones before it, in checkpoints/."""
    log_every: int = 50
    """Steps between logged losses, each time with those that only the step before computed: methods may alternate."""

    def __post_init__(self) -> None:
        for name in ("data", "output"):
            if not isinstance(value := getattr(self, name), (str, Path)) or "\0" in str(value):
                raise ValueError(f"{name} must be the path of a folder, got {value!r}")
            object.__setattr__(self, name, Path(value))
        _check_choice("preset", self.preset, tuple(PRESETS))
        preset = PRESETS[self.preset]
        for name in ("settings", "layout", "view_bins", "sampling", "augment", "iterations", "batch_size"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, getattr(preset, name))
        if type(self.settings) is not type(preset.settings):
            raise ValueError(
                f"preset {self.preset!r} takes {type(preset.settings).__name__}, got {type(self.settings).__name__}"
            )
        check_fields(self.settings)
        if not isinstance(self.augment, (list, tuple)):
            raise ValueError(f"augment must be a list of names, got {self.augment!r}")
        object.__setattr__(self, "augment", tuple(self.augment))
        _check_choice("sampling", self.sampling, typing.get_args(Sampling))
        for name in self.augment:
            _check_choice("augment", name, typing.get_args(Augmentation))
        if "flip" in self.augment and getattr(self.settings, "reads_view_ids", False):
            raise ValueError(
                "augment 'flip' moves the camera into another view class, but the discriminator of "
                f"{self.preset!r} is told the class of the original; leave 'flip' out"
            )
        _check_choice("device", self.device, ("cpu", "cuda"))
        _check_choice("precision", self.precision, ("auto", "bf16", "fp32"))
        _check_choice("val_split", self.val_split, ("val", "test"))
        if self.view_bins is not None and not isinstance(self.view_bins, str):
            raise ValueError(f"view_bins must be written as AZIMUTHxELEVATION, such as 15x20, got {self.view_bins!r}")
        options = {name: getattr(self, name) for name in ("view_bins", "views_per_object")}
        check_options(self.layout, image_size=self.settings.image_size, **options)
        if self.val_split == "val" and not LAYOUTS[self.layout].validation:
            raise ValueError(f"the layout {self.layout!r} has no split val; validate on test (val_split test)")
        if not isinstance(self.category, str) or not self.category:
            empty = "an empty string" if self.category == "" else repr(self.category)
            raise ValueError(f"category must be a class name such as 'airplane', got {empty}")
        for name in ("iterations", *_REPORTING):
            _check_positive_int(name, getattr(self, name), limits.ITERATIONS)
        _check_positive_int("batch_size", self.batch_size, limits.BATCH_SIZE)
        if self.sampling == "pairs" and self.batch_size % 2:
            raise ValueError(
                f"sampling 'pairs' takes two views of each object: batch_size must be even, got {self.batch_size}"
            )
        if getattr(self.settings, "encoder_from_step", 0) > self.iterations:
            raise ValueError(
                f"encoder_from_step={self.settings.encoder_from_step} lies beyond the {self.iterations} iterations: "
                f"the encoder would never be trained; give a step such as {self.iterations // 2 + 1}"
            )
        for name, most in (("threads", limits.THREADS), ("max_val_images", None), ("views_per_object", None)):
            if getattr(self, name) is not None:
                _check_positive_int(name, getattr(self, name), most)
        if not isinstance(self.seed, int) or isinstance(self.seed, bool) or not 0 <= self.seed <= limits.SEED:
            raise ValueError(f"seed must be a whole number >= 0 and below 2^63, got {self.seed!r}")


def check_fields(settings: Settings) -> None:
    """Raise a ValueError naming the setting that is no choice of its kind, negative, or not finite.

    Rates (...learning_rate) must be positive; whole numbers at least 1, and at most what a network of this size can be
    made of (sides of images and channels: 1024; channels that a network multiplies by eight: 512); all other numbers,
    such as weights, at least 0.
    """
    types = typing.get_type_hints(type(settings))
    for field in dataclasses.fields(settings):
        _check_field(field.name, getattr(settings, field.name), types[field.name])


def _check_field(name: str, value: Any, kind: Any) -> None:
    """Raise a ValueError for a value that is not of this kind; kinds that are none of a setting's pass."""
    if typing.get_origin(kind) is Literal:
        _check_choice(name, value, typing.get_args(kind))
    elif kind is bool:
        if not isinstance(value, bool):
            raise ValueError(f"{name} must be true or false, got {value!r}")
    elif kind is int:
        _check_positive_int(name, value, _most(name))
    elif typing.get_origin(kind) is tuple:
        if not isinstance(value, tuple) or len(value) != len(typing.get_args(kind)):
            raise ValueError(f"{name} must be {len(typing.get_args(kind))} whole numbers, got {value!r}")
        for item in value:
            _check_positive_int(name, item, _most(name, several=True))
    elif kind is float:
        positive = "learning_rate" in name
        number = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= limits.NUMBER
        if not number or not (value > 0 if positive else value >= 0):
            raise ValueError(f"{name} must be a {'positive number' if positive else 'number >= 0'}, got {value!r}")
    elif kind == Path | None and not isinstance(value, (str, Path, type(None))):
        raise ValueError(f"{name} must be the path of a file, got {value!r}")


def _most(name: str, *, several: bool = False) -> int:
    """The largest whole number that makes sense for a setting of this name: a step, a side in pixels, or channels.

    several: of each layer, not of the first, which the others are multiples of.
    """
    if name.endswith("_step"):
        return limits.ITERATIONS
    if name.endswith("_size"):
        return limits.INPUT_SIDE
    return limits.CHANNELS if several else limits.BASE_CHANNELS


_REPORTING = ("validate_every", "pictures_every", "checkpoint_every", "keep_checkpoints", "log_every")
#: Options that a resumed run may change: they say where and how long to compute and what to report, not what to learn.
RESUME_MAY_CHANGE = frozenset(
    {"data", "output", "iterations", "device", "threads"} | {"val_split", "max_val_images", *_REPORTING}
)


def config_to_dict(config: TrainConfig) -> dict[str, Any]:
    """The configuration as plain JSON values; the method's settings are a dictionary under "settings"."""
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))


def config_from_dict(values: dict[str, Any], source: str = "config") -> TrainConfig:
    """Build a TrainConfig from plain values; an unknown or missing option is a ValueError that names it.

    Configurations of version 0.1, with a method beside the preset, are understood too.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{source} must hold options by name ({{...}}), got {type(values).__name__}")
    values = dict(values)
    if "method" in values:
        values = _from_first_version(values)
    known = {f.name: f for f in dataclasses.fields(TrainConfig)}
    _check_names(values, known, source)
    required = [name for name, f in known.items() if f.default is dataclasses.MISSING]
    if missing := [name for name in required if name not in values]:
        raise ValueError(f"{source} lacks the options {missing}")
    if not isinstance(settings := values.get("settings"), (dict, Settings, type(None))):
        raise ValueError(f"{source}: settings must be options by name ({{...}}), got {settings!r}")
    if isinstance(settings, dict):
        _check_choice("preset", values.get("preset", DEFAULT_PRESET), tuple(PRESETS))
        kind = type(PRESETS[values.get("preset", DEFAULT_PRESET)].settings)
        _check_names(values["settings"], {f.name for f in dataclasses.fields(kind)}, f"{source}: settings")
        given = {k: tuple(v) if isinstance(v, list) else v for k, v in values["settings"].items()}
        types = typing.get_type_hints(kind)
        try:
            for name, value in given.items():
                _check_field(name, value, types[name])
            values["settings"] = kind(**given)
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from None
    try:
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
    return [
        f"{name}: {old.get(name)!r} in the run, {new.get(name)!r} asked for"
        for name in dict.fromkeys([*old, *new])
        if name not in RESUME_MAY_CHANGE and old.get(name) != new.get(name)
    ]


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


def _from_first_version(values: dict[str, Any]) -> dict[str, Any]:
    """A configuration of version 0.1: method proposed or vanilla, preset released or paper, weights beside them."""
    method, forms = values.pop("method"), values.pop("preset", "released")
    names = {
        ("proposed", "released"): "peng2020-kato",
        ("proposed", "paper"): "peng2020-kato-printed",
        ("vanilla", "released"): "peng2020-kato-vanilla",
        ("vanilla", "paper"): "peng2020-kato-vanilla",
    }
    if not isinstance(method, str) or not isinstance(forms, str) or (method, forms) not in names:
        raise ValueError(f"unknown method and preset {method!r}, {forms!r} in a configuration of version 0.1")
    name = names[method, forms]
    weights = ("lambda_smooth", "lambda_classification", "lambda_adversarial", "lambda_prior", "learning_rate")
    given = {key: value for key in weights if (value := values.pop(key, None)) is not None}
    return values | {"preset": name, "settings": dataclasses.asdict(PRESETS[name].settings) | given}


def _check_names(values: dict[str, Any], known: Any, source: str) -> None:
    if unknown := sorted(set(values) - set(known)):
        raise ValueError(f"{source} has unknown options {unknown}; known ones are {sorted(known)}")


def _check_choice(name: str, value: Any, choices: tuple[Any, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(str, choices))}, got {value!r}")


def _check_positive_int(name: str, value: Any, most: int | None = None) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ValueError(f"{name} must be a whole number >= 1, got {value!r}")
    if most is not None and value > most:
        raise ValueError(f"{name} must be at most {most}, got {value}")
