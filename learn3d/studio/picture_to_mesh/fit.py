"""Fits a predicted shape to the mask of a framed picture: the camera, the code, then the vertices.

A picture is framed if the bounding box of its mask is centred and its object size is
`CENTRED_SIZE`. Its camera is the view from which the silhouette of the predicted shape is most
like the mask.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.optim.adam import adam

import nmr
from learn3d.data.dataset import MASK_SIZE
from learn3d.data.framing import frame
from learn3d.data.poses import wrap_deg
from learn3d.methods.mesh_method import MeshMethod
from learn3d.networks.encoders import CENTRED_SIZE
from learn3d.studio.picture_to_mesh.options import DEFAULTS, FitOptions

LENS_HALF_FOV_DEG = 11.0  # of a normal lens; the picture's own is unknown
AZIMUTHS = 24  # azimuth cells from -180 degrees on, whose centres are tried
TARGET_SIZE = 256  # side of a target in pixels
# Units of the parts of a view as variables: a step moves the outline about equally far for each.
_SCALES = (60.0, 60.0, 1.0, 1.0)

Shapes = Tensor | Sequence[Tensor]
# called with the name of each stage and the share (0 .. 1) that is done
Report = Callable[[str, float], object]


class Target(NamedTuple):
    """A framed picture of an object, on white: what a shape should look like."""

    pixels: Tensor  # float32 [4, S, S] in 0 .. 1: R, G, B and mask

    def outline(self, size: int = MASK_SIZE) -> Tensor:
        """The mask float32 [size, size]."""
        return F.adaptive_avg_pool2d(self.pixels[3:], size)[0]


def frame_target(colors: np.ndarray, mask: np.ndarray) -> Target:
    """The target of a picture uint8 [H, W, 3] with its mask uint8 [H, W]."""
    framed = frame(colors, mask, TARGET_SIZE, object_size=CENTRED_SIZE, inverted=False)
    return Target(torch.from_numpy(framed).float() / 255)


class View(NamedTuple):
    """N cameras that look at the object."""

    azimuth_deg: Tensor  # float32 [N]
    elevation_deg: Tensor  # float32 [N]
    log_distance: Tensor  # float32 [N]
    shift: Tensor  # float32 [N, 2]: shift of the object to the right and up, in units of the object frame
    roll_deg: Tensor  # float32 [N]: angle by which the camera is turned clockwise about its axis

    def axes(self) -> Tensor:
        """Right, up and forward of each camera in the object frame, float32 [N, 3, 3]."""
        a, e, r = map(torch.deg2rad, (self.azimuth_deg, self.elevation_deg, self.roll_deg))
        zero = torch.zeros_like(a)
        right = torch.stack([a.cos(), zero, a.sin()], 1)
        up = torch.stack([-e.sin() * a.sin(), e.cos(), e.sin() * a.cos()], 1)
        forward = torch.stack([-e.cos() * a.sin(), -e.sin(), e.cos() * a.cos()], 1)
        cos, sin = r.cos()[:, None], r.sin()[:, None]
        return torch.stack([cos * right - sin * up, cos * up + sin * right, forward], 1)

    def cameras(self) -> nmr.Look:
        """The cameras, shifted to the left and down where the object is shifted to the right and up."""
        axes = self.axes()
        origin = torch.cat([self.shift, self.log_distance.exp()[:, None]], 1)  # along their axes
        eye = -(origin[:, :, None] * axes).sum(1)
        return nmr.Look(eye, axes[:, 2], axes[:, 1], LENS_HALF_FOV_DEG)

    def silhouettes(self, vertices: Shapes, faces: Shapes, size: int = MASK_SIZE) -> Tensor:
        """Silhouettes float32 [N, S, S] of shapes [N, V, 3] or N tensors [V_n, 3], or of one [V, 3]."""
        return nmr.render_silhouette(vertices, faces, self.cameras(), image_size=size)

    def ious(self, vertices: Shapes, faces: Shapes, outline: Tensor) -> Tensor:
        """Soft IoU [N] of an outline [S, S] and the `silhouettes` of shapes."""
        return soft_ious(self.silhouettes(vertices, faces, len(outline)), outline)

    def select(self, rows: Tensor) -> View:
        """The views `rows`."""
        return View(*(part[rows] for part in self))


def soft_ious(images: Tensor, outline: Tensor) -> Tensor:
    """Soft IoU [N] of images [N, S, S] and an outline [S, S]."""
    both = (images * outline).sum((1, 2))
    return both / (images + outline - images * outline).sum((1, 2)).clamp(min=1e-6)


def frame_view(
    vertices: Tensor, azimuth_deg: Tensor, elevation_deg: Tensor, roll_deg: float = 0.0
) -> View:
    """Cameras in N directions, angles [N], at which vertices [V, 3] or [N, V, 3] are framed like pictures."""
    zero, tangent = torch.zeros(len(azimuth_deg)), math.tan(math.radians(LENS_HALF_FOV_DEG))
    view = View(azimuth_deg, elevation_deg, zero, torch.zeros(len(zero), 2), zero + roll_deg)
    points = vertices @ view.axes().transpose(1, 2)
    distance, shift = torch.full_like(zero, 1.0 / tangent), view.shift
    for _ in range(6):
        scale = (distance[:, None] + points[..., 2]).clamp(min=0.3) * tangent
        seen = (points[..., :2] + shift[:, None]) / scale[..., None]
        low, high = seen.amin(1), seen.amax(1)
        shift = shift - (low + high) / 2 * distance[:, None] * tangent
        distance = (distance * (high - low).amax(1) / (2 * CENTRED_SIZE)).clamp(0.8, 30.0)
    return view._replace(log_distance=distance.log(), shift=shift)


@torch.no_grad()
def find_view(
    vertices: Tensor,
    faces: Tensor,
    outline: Tensor,
    probabilities: Tensor | None = None,
    roll_deg: float = 0.0,
    options: FitOptions = DEFAULTS.fit,
) -> tuple[View, float]:
    """Find the view in which the silhouette of a shape [V, 3], [F, 3] is most like a framed outline [64, 64].

    The best of a grid of views, with azimuths more than 20 degrees apart, are optimised.
    probabilities: float32 [AZIMUTHS], the probability of each azimuth cell from -180 degrees on;
    None if unknown. roll_deg: of all views. Returns the view and the soft IoU of silhouette and
    outline.
    """
    believed = functools.partial(belief, probabilities=probabilities, weight=options.belief)
    azimuths = -180 + (torch.arange(AZIMUTHS) + 0.5) * (360 / AZIMUTHS)
    grid = torch.cartesian_prod(azimuths, torch.tensor(options.elevations_deg))
    view = frame_view(vertices, grid[:, 0], grid[:, 1], roll_deg)
    scores = view.ious(vertices, faces, outline) + believed(view.azimuth_deg)
    chosen = []
    for row in scores.argsort(descending=True).tolist():
        if all(wrap_deg(grid[row, 0] - grid[other, 0]).abs() > 20 for other in chosen):
            chosen.append(row)
    starts = view.select(torch.tensor(chosen[: options.starts]))
    view = minimize(
        lambda view: -view.ious(vertices, faces, outline).sum(),
        starts,
        options.steps,
        (0.03,),
    )
    ious = view.ious(vertices, faces, outline)
    best = (ious + believed(view.azimuth_deg)).argmax()[None]
    return view.select(best), float(ious[best])


def belief(
    azimuth_deg: Tensor, probabilities: Tensor | None, weight: float = DEFAULTS.fit.belief
) -> Tensor:
    """Bonus float32 [N] to the IoU at azimuths [N] for the probabilities of `find_view`, interpolated between cells."""
    if probabilities is None:
        return torch.zeros_like(azimuth_deg)
    position = (azimuth_deg + 180) / (360 / AZIMUTHS) - 0.5
    low, part = position.floor().long() % AZIMUTHS, position - position.floor()
    log = probabilities.clamp(min=1e-4).log()
    return weight * (log[low] * (1 - part) + log[(low + 1) % AZIMUTHS] * part)


@torch.no_grad()
def minimize(
    loss: Callable[[View], Tensor],
    view: View,
    steps: int,
    rates: Sequence[float],
    *variables: Tensor,
) -> View:
    """The view, from `view` on, that minimises a loss together with other variables, by Adam. Its roll stays.

    rates: learning rates of the view and of each variable, which fall to a tenth in the end.
    """
    parts = [(part / scale).requires_grad_() for part, scale in zip(view, _SCALES, strict=False)]

    def current() -> View:
        changed = (scale * part for part, scale in zip(parts, _SCALES, strict=True))
        found = View(*changed, view.roll_deg)
        return found._replace(elevation_deg=found.elevation_deg.clamp(-30, 85))

    rates = [*[rates[0]] * len(parts), *rates[1:]]
    descend(lambda: loss(current()), [*parts, *variables], rates, steps)
    return current()


@torch.no_grad()
def descend(
    loss: Callable[[], Tensor],
    variables: Sequence[Tensor],
    rates: Sequence[float],
    steps: int,
    last: float = 0.1,
) -> None:
    """Change variables so that they minimise a loss, by Adam with learning rates that fall to the share `last`."""
    moments = [(torch.zeros_like(value), torch.zeros_like(value)) for value in variables]
    for step in range(steps):
        with torch.enable_grad():
            gradients = torch.autograd.grad(loss(), variables)
        for value, gradient, (mean, square), rate in zip(
            variables, gradients, moments, rates, strict=True
        ):
            adam(  # the class Adam would import torch._dynamo, which takes a second
                [value],
                [gradient],
                [mean],
                [square],
                [],
                [torch.tensor(float(step))],
                lr=rate * (1 - (1 - last) * step / steps),
                beta1=0.9,
                beta2=0.999,
                eps=1e-8,
                weight_decay=0.0,
                amsgrad=False,
                maximize=False,
            )


class Fit(NamedTuple):
    """A shape, and the view at which it fits a picture."""

    vertices: Tensor  # float32 [V, 3], object frame
    faces: Tensor  # int64 [F, 3]
    view: View  # one view
    iou: float  # IoU of mask and silhouette in this view


class Prediction(NamedTuple):
    """What a method predicts for a picture."""

    code: Tensor  # float32 [1, C]
    azimuths: Tensor | None  # float32 [AZIMUTHS], see `find_view`
    shape: Fit


@torch.no_grad()
def predict(
    method: MeshMethod,
    image: Tensor,
    outline: Tensor,
    roll_deg: float = 0.0,
    options: FitOptions = DEFAULTS.fit,
) -> Prediction:
    """The shape of a stored image uint8 [4, S, S] and its view, from the framed outline float32 [64, 64].

    If the method predicts azimuths, they decide between views with similar outlines. roll_deg: the
    camera's angle about its axis, by which the image was turned back.
    """
    code, found = method.encode(image[None]), method.view_probabilities(image[None])
    (vertices,), azimuths = method.generator(code), None if found is None else found[0]
    view = find_view(vertices, method.faces, outline, azimuths, roll_deg, options)
    return Prediction(code, azimuths, Fit(vertices, method.faces, *view))


@torch.no_grad()
def fit(
    method: MeshMethod,
    predicted: Prediction,
    outline: Tensor,
    report: Report = lambda *_: None,
    options: FitOptions = DEFAULTS.fit,
) -> Fit:
    """Fit a predicted shape to its framed outline float32 [64, 64]: the code, then the vertices, with the camera."""
    report("shape", 0.3)
    start, code = predicted.code, predicted.code.clone().requires_grad_()
    size = start.square().sum().clamp(min=1e-6)

    def loss(view: View, vertices: Tensor) -> Tensor:
        fitted = 1 - view.ious(vertices, method.faces, outline).sum()
        return fitted + options.smoothness * nmr.losses.smoothness_loss(vertices, method.edges)

    def code_loss(view: View) -> Tensor:
        return (
            loss(view, method.generator(code)) + options.pull * (code - start).square().sum() / size
        )

    rate = options.code_rate * float(start.square().mean().sqrt())
    view = minimize(code_loss, predicted.shape.view, options.code_steps, (0.01, rate), code)
    report("surface", 0.7)
    decoded = method.generator(code)
    move = torch.zeros_like(decoded).requires_grad_()

    def moved() -> Tensor:
        return method.generator.symmetrized(decoded + move)

    def vertex_loss(view: View) -> Tensor:
        vertices = moved()
        fitted = loss(view, vertices)
        return fitted + options.stiffness * nmr.losses.laplacian_loss(
            vertices - decoded, method.edges
        )

    view = minimize(vertex_loss, view, options.vertex_steps, (0.003, options.vertex_rate), move)
    vertices = moved()
    return Fit(vertices[0], method.faces, view, float(view.ious(vertices, method.faces, outline)))
