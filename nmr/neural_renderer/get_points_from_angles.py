"""Positions of a camera on a sphere."""

from __future__ import annotations

import numbers

import torch
from torch import Tensor

from nmr._validate import as_numbers
from nmr.cameras import points_from_angles
from nmr.neural_renderer._convert import Numbers


def get_points_from_angles(
    distance: Numbers, elevation: Numbers, azimuth: Numbers, degrees: bool = True
) -> tuple[float, float, float] | Tensor:
    """Points ``(d cos e sin a, d sin e, -d cos e cos a)``: see
    :func:`nmr.cameras.points_from_angles`.

    Three numbers give a tuple of three floats. If any argument is a tensor, list or array, the
    result is a tensor ``[B, 3]``, and gradients reach the tensors. ``degrees=False`` takes the
    angles in radians.

    >>> renderer.eye = nr.get_points_from_angles(2.732, 30, 45)
    """
    given = (distance, elevation, azimuth)
    dtype = next(
        (x.dtype for x in given if isinstance(x, Tensor) and x.is_floating_point()), torch.float64
    )
    names = ("distance", "elevation", "azimuth")
    d, e, a = (
        as_numbers(x, name, "a number or [B]").to(dtype)
        for x, name in zip(given, names, strict=True)
    )
    points = (
        points_from_angles(d, e, a)
        if degrees
        else points_from_angles(d, torch.rad2deg(e), torch.rad2deg(a))
    )
    return tuple(points.tolist()) if all(isinstance(x, numbers.Real) for x in given) else points
