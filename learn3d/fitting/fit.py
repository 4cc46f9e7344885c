"""Fits a predicted shape to the mask of a framed picture: the camera (`camera.py`), the code, then the vertices."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

import nmr
from learn3d.device import upload
from learn3d.fitting.camera import View, find_view, minimize
from learn3d.methods import MeshMethod

CODE_STEPS, VERTEX_STEPS = 45, 45
PULL = 0.1  # weight of the squared relative distance between the code and the predicted one
SMOOTHNESS = 3e-4  # weight of the smoothness loss
STIFFNESS = 10.0  # weight of the Laplacian loss of the vertices' displacements

Progress = Callable[[str, float], None]  # called with the name of each stage and the share (0 .. 1) that is done


def silent(stage: str, done: float) -> None:
    """A `Progress` that reports nothing."""


class Prediction(NamedTuple):
    """What a method predicts for a picture, and the view at which the shape fits its mask best."""

    code: Tensor  # float32 [1, C]
    vertices: Tensor  # float32 [1, V, 3], object frame
    azimuths: Tensor | None  # float32 [AZIMUTHS], see `camera.find_view`
    view: View  # one view
    iou: float  # IoU of mask and silhouette in this view


class Fit(NamedTuple):
    """A shape that was fitted to a picture."""

    vertices: Tensor  # float32 [V, 3], object frame
    faces: Tensor  # int64 [F, 3]
    view: View  # one view
    iou: float  # IoU of mask and silhouette in this view


@torch.no_grad()
def predict(method: MeshMethod, image: Tensor, mask: Tensor) -> Prediction:
    """The shape of a stored image uint8 [4, S, S] and its view, from the framed mask float32 [64, 64].

    If the method predicts azimuths, they decide between views with similar outlines.
    """
    code = method.encode(image[None]).float().cpu()
    vertices = _decode(method, code)
    found = method.view_probabilities(image[None])
    azimuths = None if found is None else found[0]
    return Prediction(code, vertices, azimuths, *find_view(vertices[0], method.faces, mask, azimuths))


@torch.no_grad()
def fit(method: MeshMethod, predicted: Prediction, mask: Tensor, progress: Progress = silent) -> Fit:
    """Fit a predicted shape to its framed mask float32 [64, 64]."""
    progress("shape", 0.3)
    view, vertices = _fit_code(predicted, method, mask)
    progress("surface", 0.7)
    view, vertices = _fit_vertices(view, vertices, method, mask)
    return Fit(vertices[0], method.faces, view, float(view.ious(vertices, method.faces, mask)))


def _decode(method: MeshMethod, codes: Tensor) -> Tensor:
    with method.autocast():
        return method.generator(upload(codes, method.device)).float().cpu()


def _fit_code(predicted: Prediction, method: MeshMethod, mask: Tensor) -> tuple[View, Tensor]:
    parameters, start = predicted.view.parameters(), predicted.code
    code = start.clone().requires_grad_()
    size = start.square().sum().clamp(min=1e-6)

    def loss() -> Tensor:
        vertices = _decode(method, code)
        fitted = 1 - View.from_parameters(parameters).ious(vertices, method.faces, mask).sum()
        smooth = nmr.losses.smoothness_loss(vertices, method.edges)
        return fitted + SMOOTHNESS * smooth + PULL * (code - start).square().sum() / size

    rate = 0.07 * float(start.square().mean().sqrt())
    minimize(loss, [{"params": [code], "lr": rate}, {"params": parameters, "lr": 0.01}], CODE_STEPS)
    return View.from_parameters(parameters), _decode(method, code)


def _fit_vertices(view: View, vertices: Tensor, method: MeshMethod, mask: Tensor) -> tuple[View, Tensor]:
    parameters, start = view.parameters(), vertices
    move = torch.zeros_like(vertices).requires_grad_()

    def moved() -> Tensor:
        return method.generator.symmetrized(start + move)

    def loss() -> Tensor:
        vertices = moved()
        fitted = 1 - View.from_parameters(parameters).ious(vertices, method.faces, mask).sum()
        smooth = nmr.losses.smoothness_loss(vertices, method.edges)
        stiff = nmr.losses.laplacian_loss(vertices - start, method.edges)
        return fitted + SMOOTHNESS * smooth + STIFFNESS * stiff

    minimize(loss, [{"params": [move], "lr": 0.004}, {"params": parameters, "lr": 0.003}], VERTEX_STEPS)
    return View.from_parameters(parameters), moved()
