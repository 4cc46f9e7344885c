"""Fits a predicted shape to the mask of a framed picture: the camera (`camera.py`), the code, then the vertices."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

import nmr
from learn3d.fitting.camera import View, find_view, minimize
from learn3d.methods import MeshMethod

CODE_STEPS, VERTEX_STEPS = 45, 45
PULL = 0.1  # weight of the squared relative distance between the code and the predicted one
SMOOTHNESS = 3e-4  # weight of the smoothness loss
STIFFNESS = 10.0  # weight of the Laplacian loss of the vertices' displacements

Progress = Callable[[str, float], object]  # called with the name of each stage and the share (0 .. 1) that is done


class Fit(NamedTuple):
    """A shape, and the view at which it fits a picture."""

    vertices: Tensor  # float32 [V, 3], object frame
    faces: Tensor  # int64 [F, 3]
    view: View  # one view
    iou: float  # IoU of mask and silhouette in this view


class Prediction(NamedTuple):
    """What a method predicts for a picture."""

    code: Tensor  # float32 [1, C]
    azimuths: Tensor | None  # float32 [AZIMUTHS], see `camera.find_view`
    shape: Fit


@torch.no_grad()
def predict(method: MeshMethod, image: Tensor, mask: Tensor) -> Prediction:
    """The shape of a stored image uint8 [4, S, S] and its view, from the framed mask float32 [64, 64].

    If the method predicts azimuths, they decide between views with similar outlines.
    """
    code, found = method.encode(image[None]), method.view_probabilities(image[None])
    (vertices,), azimuths = method.generator(code), None if found is None else found[0]
    shape = Fit(vertices, method.faces, *find_view(vertices, method.faces, mask, azimuths))
    return Prediction(code, azimuths, shape)


@torch.no_grad()
def fit(method: MeshMethod, predicted: Prediction, mask: Tensor, progress: Progress = lambda *_: None) -> Fit:
    """Fit a predicted shape to its framed mask float32 [64, 64]: the code, then the vertices, each with the camera."""
    progress("shape", 0.3)
    start, code = predicted.code, predicted.code.clone().requires_grad_()
    size = start.square().sum().clamp(min=1e-6)

    def loss(view: View, vertices: Tensor) -> Tensor:
        fitted = 1 - view.ious(vertices, method.faces, mask).sum()
        return fitted + SMOOTHNESS * nmr.losses.smoothness_loss(vertices, method.edges)

    def code_loss(view: View) -> Tensor:
        return loss(view, method.generator(code)) + PULL * (code - start).square().sum() / size

    rate = 0.07 * float(start.square().mean().sqrt())
    view = minimize(code_loss, predicted.shape.view, CODE_STEPS, (0.01, rate), code)
    progress("surface", 0.7)
    decoded = method.generator(code)
    move = torch.zeros_like(decoded).requires_grad_()

    def moved() -> Tensor:
        return method.generator.symmetrized(decoded + move)

    def vertex_loss(view: View) -> Tensor:
        vertices = moved()
        fitted = loss(view, vertices)
        return fitted + STIFFNESS * nmr.losses.laplacian_loss(vertices - decoded, method.edges)

    view = minimize(vertex_loss, view, VERTEX_STEPS, (0.003, 0.004), move)
    vertices = moved()
    return Fit(vertices[0], method.faces, view, float(view.ious(vertices, method.faces, mask)))
