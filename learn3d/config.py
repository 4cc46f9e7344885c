"""What a training run is: one frozen dataclass, the two presets of the method, and their checks."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

Method = Literal["proposed", "vanilla"]
Preset = Literal["released", "paper"]


@dataclass(frozen=True)
class LossForms:
    """The places where the published code and the printed equations disagree."""

    adversarial: Literal["log", "probability"]  # squares of log-probability or of probability differences (eq. 4)
    prior: Literal["squared", "norm"]  # squared length of the codes, or their length (eq. 5)


#: "released" is what the published code computes (and what the paper's tables were made with); "paper" is every
#: equation as printed, with the sign slip of the projection loss corrected (1 - IoU is minimised, not IoU). Both place
#: the vertices at 0.5 * (unit sphere + displacement), as the published code does: the text's unit sphere is larger than
#: the image at the data set's camera, so that no edge is visible and the silhouette gives no gradient.
PRESETS: dict[str, LossForms] = {
    "released": LossForms(adversarial="log", prior="squared"),
    "paper": LossForms(adversarial="probability", prior="norm"),
}


@dataclass(frozen=True)
class LossSettings:
    """Forms and weights of the terms of L_tot; a weight of 0 means that the term is not computed."""

    forms: LossForms
    smoothness: float  # lambda_1
    classification: float  # lambda_2
    adversarial: float  # lambda_3
    prior: float  # lambda_4


@dataclass(frozen=True)
class TrainConfig:
    """One training run. It is saved with the run (config.json and in every checkpoint)."""

    data: Path
    """Folder with the data set's files, such as 02691156_train_images.npz (what tools/make_dataset.py writes)."""
    category: str
    """Object class to train on: a name such as airplane or chair, a synset id, or the file prefix of your own set."""
    output: Path
    """Folder of this run: checkpoints, metrics, pictures. It must be new or empty unless you resume or overwrite."""
    method: Method = "proposed"
    """proposed: with pose confusion and the Gaussian prior. vanilla: Vanilla-AE, the same with both at zero."""
    preset: Preset = "released"
    """released: the published code's losses. paper: equations as printed, but the generator keeps the factor 0.5."""
    iterations: int = 20_000
    """Number of training steps."""
    batch_size: int = 128
    """Images per step."""
    learning_rate: float = 1e-4
    """Adam's step size, the same for the three networks and constant."""
    lambda_smooth: float = 0.001
    """Weight of the smoothness loss (lambda_1)."""
    lambda_classification: float | None = None
    """Weight of the discriminator's own loss (lambda_2). None: 1 for proposed, 0 for vanilla."""
    lambda_adversarial: float | None = None
    """Weight of the pose confusion loss (lambda_3). None: 1 for proposed, 0 for vanilla."""
    lambda_prior: float | None = None
    """Weight of the Gaussian prior on the codes (lambda_4). None: 1 for proposed, 0 for vanilla."""
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
    validate_every: int = 1000
    """Steps between validations (voxel IoU and MMD); the last step is always validated."""
    max_val_images: int | None = None
    """Validate on this many images, spread evenly over the objects and views of the split. None: all."""
    pictures_every: int = 1000
    """Steps between picture grids."""
    checkpoint_every: int = 1000
    """Steps between saves of the last checkpoint."""
    log_every: int = 50
    """Steps between logged losses."""

    def __post_init__(self) -> None:
        for name in ("data", "output"):
            object.__setattr__(self, name, Path(getattr(self, name)))
        _check_choice("method", self.method, ("proposed", "vanilla"))
        _check_choice("preset", self.preset, tuple(PRESETS))
        _check_choice("device", self.device, ("cpu", "cuda"))
        _check_choice("precision", self.precision, ("auto", "bf16", "fp32"))
        _check_choice("val_split", self.val_split, ("val", "test"))
        if not self.category:
            raise ValueError("category must be a class name such as 'airplane', got an empty string")
        for name in ("iterations", "batch_size", "validate_every", "pictures_every", "checkpoint_every", "log_every"):
            _check_positive_int(name, getattr(self, name))
        for name in ("threads", "max_val_images"):
            if getattr(self, name) is not None:
                _check_positive_int(name, getattr(self, name))
        if not isinstance(self.seed, int) or self.seed < 0:
            raise ValueError(f"seed must be a whole number >= 0, got {self.seed!r}")
        if not (math.isfinite(self.learning_rate) and self.learning_rate > 0):
            raise ValueError(f"learning_rate must be a positive number, got {self.learning_rate!r}")
        for name in ("lambda_smooth", "lambda_classification", "lambda_adversarial", "lambda_prior"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} must be a number >= 0, got {value!r}")
            if self.method == "vanilla" and name != "lambda_smooth" and value not in (None, 0):
                raise ValueError(
                    f"{name}={value} conflicts with method 'vanilla', which is defined by having that term at 0; "
                    f"leave {name} out or choose method 'proposed'"
                )

    def loss_settings(self) -> LossSettings:
        """Forms from the preset, weights from the options, with 1 (proposed) or 0 (vanilla) where none was given."""
        default = 1.0 if self.method == "proposed" else 0.0
        classification, adversarial, prior = (
            default if value is None else float(value)
            for value in (self.lambda_classification, self.lambda_adversarial, self.lambda_prior)
        )
        return LossSettings(PRESETS[self.preset], float(self.lambda_smooth), classification, adversarial, prior)


#: Options that a resumed run may change: they say where and how long to compute and what to report, not what to learn.
RESUME_MAY_CHANGE = frozenset(
    {"data", "output", "iterations", "device", "threads"}
    | {"validate_every", "max_val_images", "pictures_every", "checkpoint_every", "log_every"}
)


def config_to_dict(config: TrainConfig) -> dict[str, Any]:
    """The configuration as plain JSON values."""
    return {k: str(v) if isinstance(v, Path) else v for k, v in dataclasses.asdict(config).items()}


def config_from_dict(values: dict[str, Any], source: str = "config") -> TrainConfig:
    """Build a TrainConfig from plain values; an unknown or missing option is a ValueError that names it."""
    known = {f.name: f for f in dataclasses.fields(TrainConfig)}
    if unknown := sorted(set(values) - set(known)):
        raise ValueError(f"{source} has unknown options {unknown}; known ones are {sorted(known)}")
    required = [name for name, f in known.items() if f.default is dataclasses.MISSING]
    if missing := [name for name in required if name not in values]:
        raise ValueError(f"{source} lacks the options {missing}")
    return TrainConfig(**values)


def load_config(path: Path) -> TrainConfig:
    """Read the config.json of a run."""
    try:
        values = json.loads(Path(path).read_text())
    except FileNotFoundError:
        raise ValueError(f"no {path}: is this the folder of a training run?") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is not valid JSON: {error}") from None
    return config_from_dict(values, source=str(path))


def check_resume(config: TrainConfig, saved: TrainConfig) -> None:
    """Raise a ValueError naming every option whose change would make the resumed run a different one."""
    changed = [
        f"{f.name}: {getattr(saved, f.name)!r} in the run, {getattr(config, f.name)!r} asked for"
        for f in dataclasses.fields(TrainConfig)
        if f.name not in RESUME_MAY_CHANGE and getattr(config, f.name) != getattr(saved, f.name)
    ]
    if changed:
        raise ValueError("cannot resume with different options (" + "; ".join(changed) + "); start a new run for that")


def _check_choice(name: str, value: Any, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")


def _check_positive_int(name: str, value: Any) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ValueError(f"{name} must be a whole number >= 1, got {value!r}")
