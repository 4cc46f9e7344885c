"""Methods, each with its own training step; `create_method` builds the method of given settings."""

from typing import Literal

import torch

from learn3d.data.dataset import DatasetInfo
from learn3d.methods.method import Method, MethodSettings
from learn3d.methods.multi_view import ManyViews, ManyViewsSettings, MultiView, MultiViewSettings
from learn3d.methods.optimization import TrainingSchedule
from learn3d.methods.plus import Plus, PlusSettings
from learn3d.methods.pose_invariant import PoseInvariant, PoseInvariantSettings
from learn3d.methods.prgan import PrGAN, PrGANSettings
from learn3d.methods.vpl import VPL, VPLSettings

_METHODS: dict[type[MethodSettings], type[Method]] = {
    PoseInvariantSettings: PoseInvariant,
    PlusSettings: Plus,
    MultiViewSettings: MultiView,
    ManyViewsSettings: ManyViews,
    VPLSettings: VPL,
    PrGANSettings: PrGAN,
}


def create_method(
    settings: MethodSettings,
    info: DatasetInfo,
    *,
    device: str,
    precision: Literal["bf16", "fp32"],
    seed: int,
    schedule: TrainingSchedule = TrainingSchedule(),  # noqa: B008 (it is frozen)
) -> Method:
    """The method of `settings`, with networks initialised from `seed`.

    Raises ValueError if the device is missing, or if the method needs poses and the data set has
    none.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            "device 'cuda' was asked for, but this PyTorch sees no CUDA device; use device 'cpu'"
        )
    if type(settings) not in _METHODS:
        raise ValueError(
            f"no method learns with {type(settings).__name__}; add the pair to learn3d.methods._METHODS"
        )
    if "__dataclass_fields__" not in vars(type(settings)):
        raise ValueError(
            f"{type(settings).__name__} lacks the decorator @checked, so its fields are no options"
        )
    kind = _METHODS[type(settings)]
    if device == "cuda":
        torch.backends.cudnn.allow_tf32 = False  # TF32 convolutions would not be fp32
    torch.manual_seed(seed)
    return kind(settings, info, device, precision, schedule)
