"""Mirror images at the vertical plane that a camera of an azimuth looks along."""

from __future__ import annotations

import math

import torch


def reflected(points: torch.Tensor, azimuth_deg: float) -> torch.Tensor:
    """Points [..., 3] mirrored at the plane through the y axis and the camera at an azimuth."""
    angle = math.radians(azimuth_deg)
    normal = torch.tensor([math.cos(angle), 0.0, math.sin(angle)])
    return points - 2 * (points @ normal)[..., None] * normal
