"""The networks of a run that turn an image into a mesh, in one small file to give away."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from learn3d.methods.pose_invariant import PoseInvariantSettings
from learn3d.runs import checkpoint

SMALL_MODEL = Path(__file__).parents[1] / "models" / "small.safetensors"  # the one that comes with the package
_TRAINING_ONLY = ("lambda_classification", "lambda_adversarial", "lambda_novel_view")  # weights of further networks


def export(source: Path, target: Path, *, which: str = "last") -> int:
    """Write encoder and generator of a run (or checkpoint file) at half precision; returns the size in bytes.

    The file is a checkpoint that `evaluate` and `reconstruct` take. Numbers are rounded to float16 (three digits);
    folders of the run are left out. Raises ValueError for methods other than the pose-invariant ones and Plus.
    """
    method, config, metadata = checkpoint.load_method(source, which)
    if not isinstance(config.settings, PoseInvariantSettings):
        raise ValueError(f"only runs of proposed, vanilla and plus can be exported, this one is of {config.preset}")
    names = {field.name for field in dataclasses.fields(config.settings)} & set(_TRAINING_ONLY)
    settings = dataclasses.replace(config.settings, pretrained=None, **dict.fromkeys(names, 0.0))
    config = dataclasses.replace(config, settings=settings, data=Path("data"), output=Path("run"))
    tensors = {
        name: tensor.half() if tensor.dtype == torch.float32 else tensor
        for name, tensor in checkpoint.network_tensors(method).items()
        if name.startswith(("network.encoder.", "network.generator."))
    }
    checkpoint.save(target, tensors, dataclasses.replace(metadata, config=config))
    return target.stat().st_size
