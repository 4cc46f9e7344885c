"""Cameras: from world space to renderer space (x right, y up, both in [-1, 1] across the image; z = depth)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

# Lengths of vectors up to here neither overflow nor do their derivatives.
_LARGEST = 1e15

Scalars = float | Sequence[float] | Tensor


@runtime_checkable
class Camera(Protocol):
    """Anything that takes vertices into renderer space, differentiably."""

    def transform(self, vertices: Tensor) -> Tensor:
        """``[B, V, 3]`` world to ``[B, V, 3]`` renderer coordinates; B of 1 may grow to the camera's batch."""
        ...


def _normalize(v: Tensor) -> Tensor:
    # As in the published renderer: a vector shorter than 1e-5 stays short, and is no error.
    return v / v.norm(dim=-1, keepdim=True).clamp_min(1e-5)


def points_from_angles(distance: Scalars, elevation_deg: Scalars, azimuth_deg: Scalars) -> Tensor:
    """Points on a sphere around the origin: ``(d cos e sin a, d sin e, -d cos e cos a)``, ``[3]`` or ``[B, 3]``.

    Numbers, sequences and tensors of one length broadcast; other lengths raise a ValueError. At azimuth 0 and
    elevation 0 the point is ``(0, 0, -d)``.
    """
    d, e, a = (
        x if isinstance(x, Tensor) and x.is_floating_point() else torch.as_tensor(x, dtype=torch.float64)
        for x in (distance, elevation_deg, azimuth_deg)
    )
    if len({x.shape for x in (d, e, a) if x.ndim}) > 1:
        raise ValueError(
            "distance, elevation_deg and azimuth_deg must be single numbers or have one length, got shapes "
            f"{list(d.shape)}, {list(e.shape)}, {list(a.shape)}"
        )
    d, e, a = torch.broadcast_tensors(d, e * (math.pi / 180), a * (math.pi / 180))
    return torch.stack([d * e.cos() * a.sin(), d * e.sin(), -d * e.cos() * a.cos()], dim=-1)


@dataclass(frozen=True, eq=False)
class LookAt:
    """A perspective camera at ``eye`` that looks at ``at``.

    ``eye``, ``at``, ``up``: ``[3]`` or ``[B, 3]`` (tensors or sequences, world units); ``half_fov_deg``: half of the
    field of view, in degrees, horizontal = vertical (the published renderer's ``viewing_angle``). A vertex v maps to
    ``u = R (v - eye)`` with rows of R ``x = norm(up x z), y = norm(z x x), z = norm(at - eye)``, then to ``(u_x /
    (u_z tan a), u_y / (u_z tan a), u_z)``. Gradients reach tensors given as eye, at or up.

    Raises
    ------
    ValueError
        For a shape other than [3] or [B, 3], or half_fov_deg outside (0, 90).
    """

    eye: Tensor | Sequence[float]
    at: Tensor | Sequence[float] = (0.0, 0.0, 0.0)
    up: Tensor | Sequence[float] = (0.0, 1.0, 0.0)
    half_fov_deg: float = 30.0

    def __post_init__(self) -> None:
        if isinstance(self.half_fov_deg, Tensor) or not 0 < self.half_fov_deg < 90:
            raise ValueError(f"half_fov_deg must be a number between 0 and 90 degrees, got {self.half_fov_deg}")
        for name in ("eye", "at", "up"):
            value = getattr(self, name)
            tensor = value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=torch.float64)
            if tensor.ndim not in (1, 2) or tensor.shape[-1] != 3:
                raise ValueError(f"{name} must have shape [3] or [B, 3], got {list(tensor.shape)}")
            object.__setattr__(self, name, tensor)

    @classmethod
    def from_angles(
        cls, distance: Scalars, elevation_deg: Scalars, azimuth_deg: Scalars, *, half_fov_deg: float = 30.0
    ) -> LookAt:
        """The camera that looks at the origin from :func:`points_from_angles`."""
        return cls(eye=points_from_angles(distance, elevation_deg, azimuth_deg), half_fov_deg=half_fov_deg)

    def transform(self, vertices: Tensor) -> Tensor:
        """``vertices [B, V, 3]`` (or ``[V, 3]``) to renderer space, ``[B, V, 3]``, in the dtype of ``vertices``.

        A vertex that has no finite image (not finite itself, or in the plane of the eye, or seen by a camera that is
        not finite or farther than 1e15) gets x = y = inf, so that its faces are not drawn, and no gradient.
        """
        if vertices.ndim == 2:
            vertices = vertices.unsqueeze(0)
        eye, at, up = (x.to(vertices).view(-1, 3) for x in (self.eye, self.at, self.up))
        sizes = {vertices.shape[0], eye.shape[0], at.shape[0], up.shape[0]} - {1}
        if len(sizes) > 1:
            raise ValueError(
                f"vertices and camera must have one batch size (or 1), got {vertices.shape[0]} meshes, "
                f"eye {list(self.eye.shape)}, at {list(self.at.shape)}, up {list(self.up.shape)}"
            )
        # What is not finite is replaced before it enters any product: its zero gradient would become 0 * inf there.
        usable = torch.stack(torch.broadcast_tensors(eye, at, up)).abs().amax((0, -1)).unsqueeze(-1) < _LARGEST
        eye, at, up = (torch.where(usable, x, torch.zeros_like(x)) for x in (eye, at, up))
        finite = vertices.isfinite().all(-1, keepdim=True)
        z = _normalize(at - eye)
        x = _normalize(torch.linalg.cross(up.expand_as(z), z, dim=-1))
        y = _normalize(torch.linalg.cross(z, x, dim=-1))
        rotation = torch.stack([x, y, z], dim=-2)
        with torch.autocast(vertices.device.type, enabled=False):
            offset = torch.where(finite, vertices, torch.zeros_like(vertices)) - eye.unsqueeze(-2)
            view = offset @ rotation.transpose(-1, -2)
        depth = view[..., 2:]
        tangent = math.tan(math.radians(self.half_fov_deg))
        # x / z^2 is the largest factor of the backward pass; where it overflows the image is as good as infinite.
        visible = finite & usable.unsqueeze(-2) & (view[..., :2] / depth / depth).isfinite().all(-1, keepdim=True)
        xy = view[..., :2] / torch.where(visible, depth, torch.ones_like(depth)) / tangent
        return torch.cat([torch.where(visible, xy, torch.full_like(xy, math.inf)), depth], dim=-1)
