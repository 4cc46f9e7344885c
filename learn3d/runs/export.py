"""The networks of a run that turn an image into a mesh, in one small file to give away."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch
from torch import Tensor

from learn3d.fitting.familiarity import KNOWN_CODES, known_codes
from learn3d.methods import MeshMethod
from learn3d.methods.many_views import ManyViewsSettings
from learn3d.methods.pose_invariant import PoseInvariantSettings
from learn3d.runs import checkpoint
from learn3d.terminal import note

_TRAINING_ONLY = ("lambda_classification", "lambda_adversarial", "lambda_novel_view")  # weights of further networks


def export(source: Path, target: Path, *, which: str = "last", others: Tensor | None = None) -> int:
    """Write the networks of a run or checkpoint file that turn images into meshes, at half precision.

    Returns the size in bytes. The file is a checkpoint that `evaluate` and `reconstruct` take. Numbers are rounded to
    float16 (three digits); folders of the run are left out. If the training data are still there, the file also says
    which codes are known (`learn3d.fitting.familiarity`), so that reconstruction can warn of pictures of other things.
    others: stored images uint8 [M, 4, S, S] that show other things; the warnings are better with them.
    Raises ValueError for methods other than the pose-invariant ones, Plus and Many views.
    """
    method, config, metadata = checkpoint.load_method(source, which)
    trained_on, data = config, config.data
    if not isinstance(config.settings, (PoseInvariantSettings, ManyViewsSettings)):
        names = "proposed, vanilla, plus and many-views"
        raise ValueError(f"only runs of {names} can be exported, this one is of {config.preset}")
    names = {field.name for field in dataclasses.fields(config.settings)}
    unused = {"pretrained": None, **dict.fromkeys(_TRAINING_ONLY, 0.0)}
    settings = dataclasses.replace(config.settings, **{name: unused[name] for name in names & unused.keys()})
    config = dataclasses.replace(config, settings=settings, data=Path("data"), output=Path("run"))
    tensors = {
        name: tensor.half() if tensor.dtype == torch.float32 else tensor
        for name, tensor in checkpoint.network_tensors(method).items()
        if name.startswith(("network.encoder.", "network.generator.", "network.view_classifier."))
    }
    if not data.is_dir():
        note(f"note: {data} is not there, so the file does not say which codes are known, and nothing is warned of")
    elif isinstance(method, MeshMethod):
        known = known_codes(method, checkpoint.load_data(trained_on, "train"), others)
        tensors |= {name: codes.half() for name, codes in zip(KNOWN_CODES, known, strict=True) if codes is not None}
    checkpoint.save(target, tensors, dataclasses.replace(metadata, config=config))
    return target.stat().st_size
