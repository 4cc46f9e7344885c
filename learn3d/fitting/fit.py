"""Fits a predicted shape to the mask of a picture with an unknown camera: the camera, the code, then the vertices.

The picture must be framed: the bounding box of its mask is centred, and its object size is `CENTRED_SIZE`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

import nmr
from learn3d.data.dataset import MASK_SIZE
from learn3d.data.poses import wrap_deg
from learn3d.device import upload
from learn3d.methods import MeshMethod
from learn3d.networks.encoders import CENTRED_SIZE

HALF_FOV_DEG = 11.0  # half the field of view of a normal lens; the picture's own is unknown
AZIMUTHS = 24  # azimuth cells from -180 degrees on, whose centres are tried
ELEVATIONS_DEG = (0.0, 12.0, 25.0, 40.0, 55.0)  # elevations that are tried with each azimuth
STARTS = 6  # best of these views, from which the camera is optimised
CAMERA_STEPS, CODE_STEPS, VERTEX_STEPS = 25, 45, 45
PULL = 0.1  # weight of the squared relative distance between the code and the predicted one
SMOOTHNESS = 3e-4  # weight of the smoothness loss
STIFFNESS = 10.0  # weight of the Laplacian loss of the vertices' displacements
BELIEF = 0.05  # weight of the log-probability of a view, relative to the IoU

Progress = Callable[[str, float], None]


class View(NamedTuple):
    """N cameras that look at the object."""

    azimuth_deg: Tensor  # float32 [N]
    elevation_deg: Tensor  # float32 [N]
    log_distance: Tensor  # float32 [N]
    shift: Tensor  # float32 [N, 2]: shift of the object to the right and up, in units of the object frame

    def axes(self) -> Tensor:
        """Right, up and forward of each camera in the object frame, float32 [N, 3, 3]."""
        a, e = torch.deg2rad(self.azimuth_deg), torch.deg2rad(self.elevation_deg)
        zero = torch.zeros_like(a)
        right = torch.stack([a.cos(), zero, a.sin()], 1)
        up = torch.stack([-e.sin() * a.sin(), e.cos(), e.sin() * a.cos()], 1)
        forward = torch.stack([-e.cos() * a.sin(), -e.sin(), e.cos() * a.cos()], 1)
        return torch.stack([right, up, forward], 1)

    def cameras(self) -> nmr.LookAt:
        """The cameras, which look at the origin; `place` shifts shapes for them."""
        return nmr.LookAt.from_angles(
            self.log_distance.exp(), self.elevation_deg, self.azimuth_deg, half_fov_deg=HALF_FOV_DEG
        )

    def place(self, vertices: Tensor) -> Tensor:
        """Vertices [N, V, 3], moved by `shift`."""
        return vertices + (self.shift[:, :, None] * self.axes()[:, :2]).sum(1)[:, None]

    def silhouettes(self, vertices: Tensor, faces: Tensor, size: int = MASK_SIZE) -> Tensor:
        """Silhouettes float32 [N, size, size] of vertices [N, V, 3]."""
        return nmr.render_silhouette(self.place(vertices), faces, self.cameras(), image_size=size)

    def select(self, rows: Tensor) -> View:
        """The views `rows`."""
        return View(*(part[rows] for part in self))


class Fit(NamedTuple):
    """A shape that was fitted to a picture, and the IoU of its silhouette and the mask at each stage."""

    vertices: Tensor  # float32 [V, 3], object frame
    view: View  # one view
    predicted_iou: float  # IoU of the predicted shape at the best camera
    code_iou: float  # IoU with the fitted code
    iou: float  # IoU with the fitted vertices


def frame_view(vertices: Tensor, azimuth_deg: Tensor, elevation_deg: Tensor) -> View:
    """Cameras in these directions, angles [N], at which vertices [N, V, 3] are framed like pictures."""
    zero, tangent = torch.zeros(len(vertices)), math.tan(math.radians(HALF_FOV_DEG))
    view = View(azimuth_deg, elevation_deg, zero, torch.zeros(len(vertices), 2))
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
def fit(
    method: MeshMethod,
    image: Tensor,
    mask: Tensor,
    *,
    progress: Progress | None = None,
) -> Fit:
    """Fit the shape of a stored image uint8 [4, S, S] to its framed mask float32 [64, 64].

    If the method predicts azimuths, they decide between views with similar outlines. progress: called with the name of
    each stage and the share (0 .. 1) that is done.
    """
    report = progress or (lambda text, part: None)
    code = method.encode(image[None]).float().cpu()

    def decode(codes: Tensor) -> Tensor:
        with method.autocast():
            return method.generator(upload(codes, method.device)).float().cpu()

    report("camera", 0.0)
    vertices = decode(code)
    found = method.view_probabilities(image[None])
    view, predicted_iou = find_view(vertices[0], method.faces, mask, None if found is None else found[0])
    report("shape", 0.3)
    view, code = _fit_code(view, code, decode, method, mask)
    vertices = decode(code)
    code_iou = float(_ious(view, vertices, method.faces, mask))
    report("surface", 0.7)
    view, vertices = _fit_vertices(view, vertices, method, mask)
    report("done", 1.0)
    return Fit(vertices[0], view, predicted_iou, code_iou, float(_ious(view, vertices, method.faces, mask)))


@torch.no_grad()
def find_view(vertices: Tensor, faces: Tensor, mask: Tensor, probabilities: Tensor | None = None) -> tuple[View, float]:
    """The view at which the silhouette of a shape [V, 3], [F, 3] fits a framed mask [64, 64] best, and their IoU.

    probabilities: float32 [AZIMUTHS], the probability of each azimuth cell from -180 degrees on; None: uniform.
    """
    view = _fit_camera(_search(vertices[None], faces, mask, probabilities), vertices, faces, mask)
    ious = _ious(view, vertices, faces, mask)
    best = (ious + belief(view.azimuth_deg, probabilities)).argmax()[None]
    return view.select(best), float(ious[best])


def _search(vertices: Tensor, faces: Tensor, mask: Tensor, probabilities: Tensor | None) -> View:
    """The `STARTS` best views of a shape [1, V, 3] with azimuths more than 20 degrees apart, best first."""
    azimuths = -180 + (torch.arange(AZIMUTHS) + 0.5) * (360 / AZIMUTHS)
    grid = torch.cartesian_prod(azimuths, torch.tensor(ELEVATIONS_DEG))
    many = vertices.expand(len(grid), -1, -1)
    view = frame_view(many, grid[:, 0], grid[:, 1])
    scores = _ious(view, many, faces, mask) + belief(view.azimuth_deg, probabilities)
    chosen = []
    for row in scores.argsort(descending=True).tolist():
        if all(wrap_deg(grid[row, 0] - grid[other, 0]).abs() > 20 for other in chosen):
            chosen.append(row)
    return view.select(torch.tensor(chosen[:STARTS]))


def belief(azimuth_deg: Tensor, probabilities: Tensor | None) -> Tensor:
    """Bonus float32 [N] to the IoU at azimuths [N] for the probabilities of `find_view`, interpolated between cells."""
    if probabilities is None:
        return torch.zeros_like(azimuth_deg)
    position = (azimuth_deg + 180) / (360 / AZIMUTHS) - 0.5
    low, part = position.floor().long() % AZIMUTHS, position - position.floor()
    log = probabilities.clamp(min=1e-4).log()
    return BELIEF * (log[low] * (1 - part) + log[(low + 1) % AZIMUTHS] * part)


def _ious(view: View, vertices: Tensor, faces: Tensor, mask: Tensor) -> Tensor:
    """Soft IoU of the mask and each silhouette, [N]."""
    silhouettes = view.silhouettes(vertices.expand(len(view.azimuth_deg), -1, -1), faces)
    both = (silhouettes * mask).sum((1, 2))
    return both / (silhouettes + mask - silhouettes * mask).sum((1, 2)).clamp(min=1e-6)


def _parameters(view: View) -> list[Tensor]:
    # With these scales a step of Adam moves the outline about equally far for each parameter.
    scaled = view.azimuth_deg / 60, view.elevation_deg / 60, view.log_distance, view.shift
    return [part.clone().requires_grad_() for part in scaled]


def _view(parameters: list[Tensor]) -> View:
    azimuth, elevation, log_distance, shift = parameters
    return View(60 * azimuth, (60 * elevation).clamp(-30, 85), log_distance, shift)


@torch.enable_grad()
def _minimize(loss: Callable[[], Tensor], groups: list[dict], steps: int) -> None:
    optimizer = torch.optim.Adam(groups)
    full = [group["lr"] for group in groups]
    for step in range(steps):
        for group, rate in zip(optimizer.param_groups, full, strict=True):
            group["lr"] = rate * (1 - 0.9 * step / steps)
        optimizer.zero_grad()
        loss().backward()
        optimizer.step()


def _fit_camera(view: View, vertices: Tensor, faces: Tensor, mask: Tensor) -> View:
    parameters = _parameters(view)
    shapes = vertices.expand(len(view.azimuth_deg), -1, -1)
    _minimize(
        lambda: (1 - _ious(_view(parameters), shapes, faces, mask)).sum(),
        [{"params": parameters, "lr": 0.03}],
        CAMERA_STEPS,
    )
    return View(*(part.detach() for part in _view(parameters)))


def _fit_code(
    view: View, code: Tensor, decode: Callable[[Tensor], Tensor], method: MeshMethod, mask: Tensor
) -> tuple[View, Tensor]:
    parameters, start = _parameters(view), code
    code = code.clone().requires_grad_()
    size = start.square().sum().clamp(min=1e-6)

    def loss() -> Tensor:
        vertices = decode(code)
        fitted = 1 - _ious(_view(parameters), vertices, method.faces, mask).sum()
        smooth = nmr.losses.smoothness_loss(vertices, method.edges)
        return fitted + SMOOTHNESS * smooth + PULL * (code - start).square().sum() / size

    rate = 0.07 * float(start.square().mean().sqrt())
    _minimize(loss, [{"params": [code], "lr": rate}, {"params": parameters, "lr": 0.01}], CODE_STEPS)
    return View(*(part.detach() for part in _view(parameters))), code.detach()


def _fit_vertices(view: View, vertices: Tensor, method: MeshMethod, mask: Tensor) -> tuple[View, Tensor]:
    parameters, start = _parameters(view), vertices
    move = torch.zeros_like(vertices).requires_grad_()

    def moved() -> Tensor:
        return method.generator.symmetrized(start + move)

    def loss() -> Tensor:
        vertices = moved()
        fitted = 1 - _ious(_view(parameters), vertices, method.faces, mask).sum()
        smooth = nmr.losses.smoothness_loss(vertices, method.edges)
        stiff = nmr.losses.laplacian_loss(vertices - start, method.edges)
        return fitted + SMOOTHNESS * smooth + STIFFNESS * stiff

    _minimize(loss, [{"params": [move], "lr": 0.004}, {"params": parameters, "lr": 0.003}], VERTEX_STEPS)
    with torch.no_grad():
        return View(*(part.detach() for part in _view(parameters))), moved().detach()
