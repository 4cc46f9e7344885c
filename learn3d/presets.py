"""Presets: the options of each experiment as a TrainConfig, and configurations made from them.

Names are <publication or method>-<data set>[-<variant>].
"""

import shlex
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import tyro

from learn3d.config import TrainConfig, all_options
from learn3d.files import limits
from learn3d.files.reading import read_json
from learn3d.methods.multi_view import ManyViewsSettings, MultiViewSettings
from learn3d.methods.plus import PlusSettings
from learn3d.methods.pose_invariant import PoseInvariantSettings
from learn3d.methods.prgan import PrGANSettings
from learn3d.methods.vpl import VPLSettings
from learn3d.terminal import unknown_name

DEFAULT_PRESET = "plus-kato"
#: Options that a preset leaves open: tyro.MISSING.
PLACES = ("data", "category", "output")

#: Short names of the methods, accepted wherever a preset is: the preset for Kato's data, and a line for `train --help`.
SHORT_NAMES = {
    "plus": ("plus-kato", "the default: proposed, with mirror symmetry and a loss at novel views"),
    "proposed": ("peng2020-kato", "pose-invariant codes from single views (Peng et al. 2020)"),
    "vanilla": ("peng2020-kato-vanilla", "encoder and mesh generator alone, on single views"),
    "multi-view": (
        "multi-view-kato",
        "vanilla on pairs of views of an object (supervision of Kato et al. 2018)",
    ),
    "many-views": (
        "many-views-kato",
        "multi-view supervision: a shape must explain five views of its object",
    ),
    "vpl": (
        "peng2020-kato-vpl",
        "view prior learning: novel views must look real (Kato and Harada 2019)",
    ),
    "prgan": (
        "gadelha2017-kato",
        "a GAN of voxel grids, then an encoder (PrGAN, Gadelha et al. 2017)",
    ),
}


# Peng et al. 2020, section 4, with the losses of their published code.
_KATO = TrainConfig(
    **dict.fromkeys(PLACES, tyro.MISSING),
    preset="peng2020-kato",
    label="Proposed",
    settings=PoseInvariantSettings(),
    layout="kato",
    iterations=20_000,
    batch_size=128,
)
# The same section: one image per object, K = 72.
_KAR = replace(_KATO, layout="kar")
# ResNet-18 starts from random weights in the published code; the setting `pretrained` starts it from ImageNet's.
_ON_PASCAL: dict[str, Any] = {
    "encoder": "resnet18",
    "symmetry": "z",
    "lambda_adversarial": 0.01,
    "lambda_prior": 0.01,
}
# The same section, real-world data; augmentation: published code. The paper gives neither iterations nor batch size:
# 40,000 is the published training script's, 128 its default.
_PASCAL = replace(
    _KATO,
    settings=PoseInvariantSettings(**_ON_PASCAL),
    layout="pascal3d",
    iterations=40_000,
    augment=("crop", "flip-image"),
)
# docs/methods/plus.md
_PLUS = replace(
    _KATO,
    label="Plus",
    settings=PlusSettings(),
    iterations=80_000,
    batch_size=32,
    augment=("colors",),
    lr_schedule="cosine",
    warmup_steps=100,
    ema_decay=0.99,
)
# docs/methods/many-views.md
_MANY_VIEWS = replace(
    _PLUS,
    label="Many views",
    settings=ManyViewsSettings(),
    batch_size=160,
    sampling="groups",
    ema_decay=0.995,
    iterations=20_000,
)


def _vanilla(preset: TrainConfig) -> TrainConfig:
    """The baseline Vanilla-AE: a preset without its losses on codes."""
    zeros = dict.fromkeys(("lambda_classification", "lambda_adversarial", "lambda_prior"), 0.0)
    return replace(preset, label="Vanilla-AE", settings=replace(preset.settings, **zeros))


#: "peng2020-kato" has the losses of the published code, which made the paper's tables. The printed equations (with the
#: sign slip of the projection loss corrected) need adversarial_form "probability" and prior_form "norm".
_NAMED = {
    "peng2020-kato": _KATO,
    "peng2020-kato-vanilla": _vanilla(_KATO),
    "plus-kato": _PLUS,
    "peng2020-kar": _KAR,
    "peng2020-kar-vanilla": _vanilla(_KAR),
    # Cameras differ within a view class, so the class's masks say little about a single camera: docs/methods/plus.md.
    "plus-kar": replace(_PLUS, layout="kar", settings=PlusSettings(lambda_novel_view=0.0)),
    "many-views-kato": _MANY_VIEWS,
    # The model in the package: cameras at unknown distances.
    "many-views-around": replace(
        _MANY_VIEWS,
        settings=ManyViewsSettings(
            encoder="conv-centred", generator="sphere-small", symmetry="x", lambda_view=1.0
        ),
        layout="around",
    ),
    "plus-pascal": replace(  # without "colors", which blanks some images, as resnet18 does not see the mask
        _PLUS,
        settings=PlusSettings(**_ON_PASCAL),
        layout="pascal3d",
        iterations=160_000,
        augment=("crop", "channels"),
    ),
    # Published code of Kato et al. 2018: 64 pairs of views, and the iterations of airplanes, trained alone.
    # docs/methods/many-views.md has the other categories.
    "multi-view-kato": replace(
        _KATO,
        label="Vanilla-AE (multi-view)",
        settings=MultiViewSettings(),
        iterations=200_000,
        sampling="pairs",
        lr_schedule="step",
    ),
    # Published code of Gadelha et al. 2017: 50 epochs of the 2,831 x 24 training images of airplanes
    # for the GAN, then 50 for the encoder. 24 views: Peng et al. 2020, section 4, who do not give the projection.
    "gadelha2017-kato": replace(
        _KATO, label="PrGAN", settings=PrGANSettings(), iterations=106_100, batch_size=64
    ),
    # Published code of Peng et al. 2020: its VPL for Kato's data.
    "peng2020-kato-vpl": replace(_KATO, label="VPL", settings=VPLSettings()),
    "peng2020-pascal": _PASCAL,
    "peng2020-pascal-vanilla": _vanilla(_PASCAL),
}
PRESETS: dict[str, TrainConfig] = {
    name: replace(config, preset=name) for name, config in _NAMED.items()
}


def full_name(name: str) -> str:
    """The name of a preset, given that name or the short name of a method.

    Raises ValueError for other names.
    """
    preset = SHORT_NAMES[name][0] if str(name) in SHORT_NAMES else name
    if str(preset) not in PRESETS:
        raise ValueError(unknown_name("preset", name, [*SHORT_NAMES, *PRESETS]))
    return preset


def configure(preset: str = DEFAULT_PRESET, **options: Any) -> TrainConfig:
    """The run of a preset with these options in place of its own; data, category and output must
    be among them.

    preset: its name, or the short name of a method. Settings of the method are options, too; they
    may also be given together, as `settings`: an instance, or a dictionary. Raises ValueError for
    an unknown name or a wrong value.
    """
    base = PRESETS[full_name(preset)]
    if missing := [name for name in PLACES if name not in options]:
        raise ValueError(f"the option {' and the option '.join(missing)} is missing")
    settings = options.pop("settings", base.settings)
    if isinstance(settings, dict):
        settings = replace(base.settings, **settings)
    if type(settings) is not type(base.settings):
        wanted = type(base.settings).__name__
        raise ValueError(f"preset {base.preset!r} takes {wanted}, got {type(settings).__name__}")
    own = {field.name for field in fields(settings)} & options.keys()
    settings = replace(settings, **{name: options.pop(name) for name in own})
    known = [field.name for field in (*fields(base), *fields(settings)) if field.name != "preset"]
    if unknown := [name for name in options if name not in known]:
        raise ValueError(unknown_name("option", unknown[0], known))
    return replace(base, settings=settings, **options)


#: Options of older runs of VPL that are gone, with their only value that is still possible.
_GONE = {
    "image_size": 64,
    "vertex_scale": 0.01,
    "object_scale": 0.5,
    "discriminator": "dcgan",
    "class_conditional": False,
    "adversary": "alternating",
    "other_views": "random",
    "silhouette_size": 64,
    "anti_aliasing": True,
    "renderer_gradient": "nmr",
    "silhouette_loss": "iou",
    "adam_beta1": 0.9,
    "lambda_inflation": 0.0,
}


def config_from_dict(values: Any, source: str = "config") -> TrainConfig:
    """Build a TrainConfig from plain values.

    Raises a ValueError that names `source` and the wrong option.
    """
    try:
        if not isinstance(values, dict):
            raise ValueError(f"must hold options by name ({{...}}), got {type(values).__name__}")
        if isinstance(settings := values.get("settings"), dict):
            kept = {
                name: value
                for name, value in settings.items()
                if name not in _GONE or value != _GONE[name]
            }
            values = values | {"settings": kept}
        return configure(**values)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


def load_config(path: Path) -> TrainConfig:
    """Read the config.json of a run.

    Raises MissingFile or ValueError if it is missing or damaged.
    """
    wanted = "the options of a run; to start a new run, leave out --resume"
    return config_from_dict(read_json(path, limits.TEXT_BYTES, wanted), source=str(path))


#: Options of every command line that `command_line` makes.
USUAL_OPTIONS = ("preset", "data", "category", "output", "iterations", "batch_size", "seed")


def command_line(config: TrainConfig, **placeholders: str) -> str:
    """The command that repeats a run, quoted for a POSIX shell. placeholders: words in place of
    options' values.
    """
    values = all_options(config)
    usual = all_options(PRESETS[config.preset])
    names = [
        n
        for n in values
        if n not in (*USUAL_OPTIONS, "device", "threads") and values[n] != usual[n]
    ]
    words = ["learn3d", "train"]
    for name in (*USUAL_OPTIONS, *names):
        option = name.replace("_", "-")
        value = values[name]
        if name in placeholders:
            words += [f"--{option}", placeholders[name]]
        elif isinstance(value, bool):
            words.append(f"--{option}" if value else f"--no-{option}")
        else:
            items = value if isinstance(value, tuple) else (value,)
            words += [f"--{option}", *(shlex.quote(str(item)) for item in items)]
    return " ".join(words)
