"""Export: the encoder and generator of a run in one small file to share."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch
from torch import Tensor

from learn3d.fitting.familiarity import KNOWN_CODES, known_codes
from learn3d.fitting.templates import TEMPLATES, learn_templates
from learn3d.methods import MeshMethod
from learn3d.methods.many_views import ManyViewsSettings
from learn3d.methods.pose_invariant import PoseInvariantSettings
from learn3d.runs import checkpoint
from learn3d.terminal import note

_TRAINING_ONLY = ("lambda_classification", "lambda_adversarial", "lambda_novel_view")  # they need more networks


def export(source: Path, target: Path, *, which: str = "last", others: Tensor | None = None) -> int:
    """Write the encoder and generator of a run or checkpoint file in float16; returns the size in bytes.

    The file is a checkpoint for `evaluate` and `reconstruct`, without the paths of the run. If the training data are
    still there, it also holds known codes (`learn3d.fitting.familiarity`), with which reconstruction warns of unknown
    kinds of objects, and templates (`learn3d.fitting.templates`) if they have generated shapes. others: stored images
    uint8 [M, 4, S, S] of other objects, which improve these warnings.
    Raises ValueError for methods other than proposed, Vanilla-AE, Plus and Many views.
    """
    method, config, metadata = checkpoint.load_method(source, which)
    config = trained_on = dataclasses.replace(config, poses=None)
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
    if not trained_on.data.is_dir():
        note(f"note: {trained_on.data} is missing, so reconstruction with this file cannot warn of unknown objects")
    elif isinstance(method, MeshMethod):
        dataset = checkpoint.load_data(trained_on, "train")
        known = dict(zip(KNOWN_CODES, known_codes(method, dataset, others), strict=True))
        if (templates := learn_templates(method, dataset)) is not None:
            known |= dict(zip(TEMPLATES, templates, strict=True))
        tensors |= {k: v.half() if v.is_floating_point() else v for k, v in known.items() if v is not None}
    checkpoint.save(target, tensors, dataclasses.replace(metadata, config=config))
    return target.stat().st_size
