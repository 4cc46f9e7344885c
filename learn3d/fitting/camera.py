"""Finds the camera of a framed picture: the view from which the silhouette of a shape is most like the mask.

A picture is framed if the bounding box of its mask is centred and its object size is `CENTRED_SIZE`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

import nmr
from learn3d.data.dataset import MASK_SIZE
from learn3d.data.poses import wrap_deg
from learn3d.networks.encoders import CENTRED_SIZE

HALF_FOV_DEG = 11.0  # half the field of view of a normal lens; the picture's own is unknown
AZIMUTHS = 24  # azimuth cells from -180 degrees on, whose centres are tried
ELEVATIONS_DEG = (0.0, 12.0, 25.0, 40.0, 55.0)  # elevations that are tried with each azimuth
STARTS = 6  # best of these views, from which the camera is optimised
STEPS = 25
BELIEF = 0.05  # weight of the log-probability of a view, relative to the IoU
# Units of azimuth, elevation, distance and shift as variables: a step moves the outline about equally far for each.
_SCALES = (60.0, 60.0, 1.0, 1.0)

Meshes = Tensor | Sequence[Tensor]


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
        angles = self.elevation_deg, self.azimuth_deg
        return nmr.LookAt.from_angles(self.log_distance.exp(), *angles, half_fov_deg=HALF_FOV_DEG)

    def place(self, vertices: Meshes) -> Meshes:
        """Vertices [N, V, 3] or N tensors [V_n, 3], moved by `shift`."""
        moves = (self.shift[:, :, None] * self.axes()[:, :2]).sum(1)
        if isinstance(vertices, Tensor):
            return vertices + moves[:, None]
        return [shape + move for shape, move in zip(vertices, moves, strict=True)]

    def ious(self, vertices: Meshes, faces: Meshes, mask: Tensor) -> Tensor:
        """Soft IoU [N] of a mask [64, 64] and the silhouettes of shapes [N, V, 3], [1, V, 3] or N tensors [V_n, 3]."""
        placed = self.place(vertices)
        silhouettes = nmr.render_silhouette(placed, faces, self.cameras(), image_size=MASK_SIZE)
        both = (silhouettes * mask).sum((1, 2))
        return both / (silhouettes + mask - silhouettes * mask).sum((1, 2)).clamp(min=1e-6)

    def select(self, rows: Tensor) -> View:
        """The views `rows`."""
        return View(*(part[rows] for part in self))


def frame_view(vertices: Tensor, azimuth_deg: Tensor, elevation_deg: Tensor) -> View:
    """Cameras in N directions, angles [N], at which vertices [V, 3] are framed like pictures."""
    zero, tangent = torch.zeros(len(azimuth_deg)), math.tan(math.radians(HALF_FOV_DEG))
    view = View(azimuth_deg, elevation_deg, zero, torch.zeros(len(zero), 2))
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
def find_view(vertices: Tensor, faces: Tensor, mask: Tensor, probabilities: Tensor | None = None) -> tuple[View, float]:
    """The view at which the silhouette of a shape [V, 3], [F, 3] fits a framed mask [64, 64] best, and their IoU.

    The best of a grid of views, with azimuths more than 20 degrees apart, are optimised. probabilities: float32
    [AZIMUTHS], the probability of each azimuth cell from -180 degrees on, if it is known.
    """
    azimuths = -180 + (torch.arange(AZIMUTHS) + 0.5) * (360 / AZIMUTHS)
    grid = torch.cartesian_prod(azimuths, torch.tensor(ELEVATIONS_DEG))
    view = frame_view(vertices, grid[:, 0], grid[:, 1])
    scores = view.ious(vertices[None], faces, mask) + belief(view.azimuth_deg, probabilities)
    chosen = []
    for row in scores.argsort(descending=True).tolist():
        if all(wrap_deg(grid[row, 0] - grid[other, 0]).abs() > 20 for other in chosen):
            chosen.append(row)
    starts = view.select(torch.tensor(chosen[:STARTS]))
    view = minimize(lambda view: -view.ious(vertices[None], faces, mask).sum(), starts, STEPS, (0.03,))
    ious = view.ious(vertices[None], faces, mask)
    best = (ious + belief(view.azimuth_deg, probabilities)).argmax()[None]
    return view.select(best), float(ious[best])


def belief(azimuth_deg: Tensor, probabilities: Tensor | None) -> Tensor:
    """Bonus float32 [N] to the IoU at azimuths [N] for the probabilities of `find_view`, interpolated between cells."""
    if probabilities is None:
        return torch.zeros_like(azimuth_deg)
    position = (azimuth_deg + 180) / (360 / AZIMUTHS) - 0.5
    low, part = position.floor().long() % AZIMUTHS, position - position.floor()
    log = probabilities.clamp(min=1e-4).log()
    return BELIEF * (log[low] * (1 - part) + log[(low + 1) % AZIMUTHS] * part)


def minimize(
    loss: Callable[[View], Tensor], view: View, steps: int, rates: Sequence[float], *variables: Tensor
) -> View:
    """The view, from `view` on, that minimises a loss together with other variables, by Adam.

    rates: learning rates of the view and of each variable, which fall to a tenth in the end.
    """
    parts = [(part / scale).requires_grad_() for part, scale in zip(view, _SCALES, strict=True)]

    def current() -> View:
        found = View(*(scale * part for part, scale in zip(parts, _SCALES, strict=True)))
        return found._replace(elevation_deg=found.elevation_deg.clamp(-30, 85))

    groups = [{"params": group, "lr": lr} for group, lr in zip((parts, *variables), rates, strict=True)]
    optimizer = torch.optim.Adam(groups)
    for step in range(steps):
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * (1 - 0.9 * step / steps)
        optimizer.zero_grad()
        with torch.enable_grad():
            loss(current()).backward()
        optimizer.step()
    return current()
