"""Methods, one file each with its own training step; `create_method` builds the one that settings belong to."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import torch

from learn3d.device import check_device
from learn3d.methods.method import DataShape, Grids, Meshes, Method

if TYPE_CHECKING:
    from learn3d.presets import Settings

__all__ = ["DataShape", "Grids", "Meshes", "Method", "create_method"]


def create_method(
    settings: Settings, shape: DataShape, *, device: str, precision: Literal["bf16", "fp32"], seed: int
) -> Method:
    """The method of `settings`, with PyTorch's default initialisation of its networks from `seed`."""
    from learn3d.methods.multi_view import MultiView, MultiViewSettings
    from learn3d.methods.pose_invariant import PoseInvariant, PoseInvariantSettings
    from learn3d.methods.prgan import PrGAN, PrGANSettings
    from learn3d.methods.vpl import VPL, VPLSettings

    methods: dict[type, type[Method]] = {
        PoseInvariantSettings: PoseInvariant,
        MultiViewSettings: MultiView,
        VPLSettings: VPL,
        PrGANSettings: PrGAN,
    }
    check_device(device)
    if device == "cuda":
        torch.backends.cudnn.allow_tf32 = False  # torch's default for convolutions; fp32 is to mean fp32
    torch.manual_seed(seed)
    return methods[type(settings)](settings, shape, device, precision)
