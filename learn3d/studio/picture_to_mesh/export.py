"""Export: the encoder and generator of a run in one small file to share."""

import dataclasses
from pathlib import Path

from torch import Tensor

from learn3d.methods.multi_view import ManyViewsSettings
from learn3d.methods.pose_invariant import PoseInvariantSettings
from learn3d.runs import checkpoint
from learn3d.studio.picture_to_mesh.familiarity import known_codes
from learn3d.studio.picture_to_mesh.templates import TEMPLATES, learn_templates
from learn3d.terminal import note

#: Settings that are not needed any more, or that ask for networks of the training only.
_UNUSED = {
    "pretrained": None,
    "lambda_classification": 0.0,
    "lambda_adversarial": 0.0,
    "lambda_novel_view": 0.0,
}


def export(source: Path, target: Path, *, which: str = "last", others: Tensor | None = None) -> int:
    """Write the encoder and generator of a run or checkpoint file in float16; returns the size in bytes.

    The file is a checkpoint for `evaluate` and `reconstruct`, without the paths of the run. If
    the training data are still there, it also holds known codes (see `familiarity`), with which
    reconstruction warns of unknown kinds of objects, and `templates` if they have generated
    shapes. others: stored images uint8 [M, 4, S, S] of other objects, which improve these
    warnings. Raises ValueError for methods other than proposed, Vanilla-AE, Plus and Many views.
    """
    method, config, metadata = checkpoint.load_method(source, which)
    config = dataclasses.replace(config, poses=None)
    if not isinstance(config.settings, (PoseInvariantSettings, ManyViewsSettings)):
        names = "proposed, vanilla, plus and many-views"
        raise ValueError(f"only runs of {names} can be exported, this one is of {config.preset}")
    tensors = {
        name: tensor
        for name, tensor in checkpoint.network_tensors(method).items()
        if name.startswith(("network.encoder.", "network.generator.", "network.view_classifier."))
    }
    if not config.data.is_dir():
        note(
            f"note: {config.data} is missing, so reconstruction with this file cannot warn of unknown objects"
        )
    else:
        dataset = checkpoint.load_data(config, "train")
        if others is not None:
            note(f"learning other things ({len(others)} pictures) takes some minutes")
        tensors |= known_codes(method, dataset, others).tensors()
        if (templates := learn_templates(method, dataset)) is not None:
            tensors |= dict(zip(TEMPLATES, templates, strict=True))
        else:
            note(
                "note: the file has no templates: in the training data no shape has a name of make-dataset --procedural"
            )
    settings = {name: value for name, value in _UNUSED.items() if hasattr(config.settings, name)}
    settings = dataclasses.replace(config.settings, **settings)
    config = dataclasses.replace(config, settings=settings, data=Path("data"), output=Path("run"))
    halves = {
        name: tensor.half() if tensor.is_floating_point() else tensor
        for name, tensor in tensors.items()
    }
    checkpoint.save(target, halves, dataclasses.replace(metadata, config=config))
    return target.stat().st_size
