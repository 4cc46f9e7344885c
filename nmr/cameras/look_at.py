"""Cameras given by a position and a direction: LookAt, Look, Orthographic."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from .._validate import as_numbers, callers_level, check_flag, holds_for_all
from .projection import (
    Numbers,
    Projection,
    SquarePixels,
    as_parameter,
    common_batch,
    warn_if_not_finite,
)

Scalars = float | Sequence[float] | Tensor

# a vector whose squared length is smaller was shorter than 1e-5, and not stretched (look_at.cpp)
_UNIT = 1 - 1e-6
_NARROWEST_DEG = 1e-9  # float32 can still represent 1 / tan of this angle


def points_from_angles(distance: Scalars, elevation_deg: Scalars, azimuth_deg: Scalars) -> Tensor:
    """Points on a sphere around the origin: ``(d cos e sin a, d sin e, -d cos e cos a)``, ``[3]``
    or ``[B, 3]``.

    Single numbers and sequences or tensors of one length broadcast; different lengths raise a
    ValueError, values that are not numbers a TypeError. At azimuth 0 and elevation 0 the point is
    ``(0, 0, -d)``.

    Examples
    --------
    >>> [round(x, 2) for x in nmr.cameras.points_from_angles(2.0, 0.0, 90.0).tolist()]
    [2.0, 0.0, -0.0]
    """
    d, e, a = (
        x if x.is_floating_point() else x.double()
        for x in (
            as_numbers(distance, "distance", "a number or [B]"),
            as_numbers(elevation_deg, "elevation_deg", "a number or [B]"),
            as_numbers(azimuth_deg, "azimuth_deg", "a number or [B]"),
        )
    )
    if len({x.shape for x in (d, e, a) if x.ndim}) > 1:
        raise ValueError(
            "distance, elevation_deg and azimuth_deg must be single numbers or have one length, got shapes "
            f"{list(d.shape)}, {list(e.shape)}, {list(a.shape)}"
        )
    d, e, a = torch.broadcast_tensors(d, e * (math.pi / 180), a * (math.pi / 180))
    return torch.stack([d * e.cos() * a.sin(), d * e.sin(), -d * e.cos() * a.cos()], dim=-1)


def _scalar(value: Scalars, name: str, low: float, high: float, wanted: str) -> float | Tensor:
    """A number, or a float tensor [] or [B], strictly between low and high."""
    if isinstance(value, (int, float)):
        inside = low < value < high  # no tensor: torch.compile could not read its value
    else:
        value = as_parameter(value, name)
        try:
            inside = torch.compiler.is_compiling() or bool(((low < value) & (value < high)).all())
        except RuntimeError:  # inside torch.func.vmap values cannot be read
            inside = True
    if not inside:
        raise ValueError(f"{name} must lie {wanted}, got {value}")
    return value


class _Placed(SquarePixels):
    """Base class of cameras given by an eye, a target or direction, an up vector and a field of
    view or scale.
    """

    eye: Tensor
    up: Tensor
    right_handed: bool
    perspective = True
    _names = ("at", "half_fov_deg")  # the fields of the target and of the view
    _along = False  # the target is a direction

    def _check(self, low: float, high: float, wanted: str) -> None:
        """Stores the vectors as tensors, and the view; their batch sizes must agree."""
        target, view = self._names
        names = ("eye", target, "up")
        parameters = {name: as_parameter(getattr(self, name), name, 3) for name in names}
        parameters[view] = _scalar(getattr(self, view), view, low, high, wanted)
        parameters["right_handed"] = check_flag(self.right_handed, "right_handed")
        for name, value in parameters.items():
            object.__setattr__(self, name, value)
        scale = parameters[view]
        as_tensor = (
            scale
            if isinstance(scale, Tensor)
            else torch.tensor(scale, dtype=torch.float64, device="cpu")
        )
        object.__setattr__(self, "_view", as_tensor)
        common_batch(
            **{
                n: x
                for n, x in parameters.items()
                if isinstance(x, Tensor) and x.ndim == 1 + (n in names)
            }
        )
        self._warn_if_it_sees_nothing(*names)

    def _warn_if_it_sees_nothing(self, *names: str) -> None:
        """Warns of a pose that is not finite, and of cameras that look along their up vector or
        at their own place.

        Not when compiled, traced or on a GPU.
        """
        if torch.compiler.is_compiling() or not all(x.is_cpu for x in self._parameters()):
            return
        with torch.no_grad():
            matrix = self.projection().matrix
        # 1, but less if up x forward is too short to be stretched
        sideways = matrix[:, 0].square().sum(1)
        if holds_for_all(sideways > _UNIT):
            return
        warn_if_not_finite(self, *names)
        which = (sideways <= _UNIT).nonzero().flatten().tolist()
        if which:
            warnings.warn(
                f"camera {which[0]} of {len(matrix)} looks along its up vector, or at its own place "
                f"({len(which)} in all): it has no left and right. Its image is squeezed to a part of its width, or "
                "empty. Give it another up, for example up=(0, 0, 1) to look straight down, or another place.",
                stacklevel=callers_level(),
            )

    def _parameters(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.eye, getattr(self, self._names[0]), self.up, self._view

    def _given(self, dtype: torch.dtype) -> tuple:
        pose = (x.to("cpu", torch.float64) for x in self._parameters())
        how = self._along, self.right_handed, self.perspective
        return *pose, None, None, None, None, None, *how

    def projection(self, dtype: torch.dtype = torch.float64) -> Projection:
        _, rows, _ = self._project(torch.empty(1, 0, 3, dtype=dtype, device="cpu"), 1, None)
        matrix, intrinsics, origin, extent = rows.split([12, 6, 3, 1], dim=1)
        matrix, intrinsics = matrix.unflatten(1, (3, 4)), intrinsics.unflatten(1, (2, 3))
        return Projection(matrix, intrinsics, None, self.perspective, origin, extent.squeeze(1))


_FOV = _NARROWEST_DEG, 90.0, "between 0 and 90 degrees"


@dataclass(frozen=True, eq=False)
class LookAt(_Placed):
    """A perspective camera at ``eye`` that looks at ``at``.

    A vertex v maps to ``u = R (v - eye)``, then to ``(u_x / (u_z tan a), u_y / (u_z tan a), u_z)``.
    The rows of R are ``x = n(up x z)``, ``y = n(z x x)`` and ``z = n(at - eye)``, with
    ``n(v) = v / max(abs(v), 1e-5)``.
    An eye straight above or below ``at`` gives x = y = 0, as published: an empty image, and a
    UserWarning. The world is left-handed (x right, y up, z away), as published, and mesh files
    appear mirrored.

    Parameters
    ----------
    eye, at, up : [3] or [B, 3], tensors or sequences, world units
        A camera whose pose is not finite, or farther away than 1e15, sees nothing.
    half_fov_deg : float, or Tensor [] or [B]
        a: half of the field of view across the shorter side of the image (the published
        ``viewing_angle``).
    right_handed : bool
        The world is right-handed, as that of mesh files: ``x = n(z x up)``, and the outside of
        counter-clockwise faces is their front.

    Differentiable in every parameter that is given as a tensor.

    Raises
    ------
    TypeError, ValueError
        For values that are not numbers, wrong shapes, different batch sizes, or half_fov_deg
        outside (0, 90).

    Examples
    --------
    >>> camera = nmr.LookAt([[0.0, 0.0, -2.0], [2.0, 0.0, 0.0]], half_fov_deg=15.0)
    >>> camera.transform(torch.zeros(1, 1, 3))[:, 0, 2]
    tensor([2., 2.])
    """

    eye: Numbers
    at: Numbers = (0.0, 0.0, 0.0)
    up: Numbers = (0.0, 1.0, 0.0)
    half_fov_deg: Scalars = 30.0
    right_handed: bool = False

    def __post_init__(self) -> None:
        self._check(*_FOV)

    @classmethod
    def from_angles(
        cls,
        distance: Scalars,
        elevation_deg: Scalars,
        azimuth_deg: Scalars,
        *,
        up: Numbers = (0.0, 1.0, 0.0),
        half_fov_deg: Scalars = 30.0,
        right_handed: bool = False,
    ) -> LookAt:
        """The camera that looks at the origin from :func:`points_from_angles`; straight down
        needs another ``up``.
        """
        eye = points_from_angles(distance, elevation_deg, azimuth_deg)
        return cls(eye=eye, up=up, half_fov_deg=half_fov_deg, right_handed=right_handed)


@dataclass(frozen=True, eq=False)
class Look(_Placed):
    """A perspective camera at ``eye`` that looks along ``direction`` (of any length).

    ``z = n(direction)``; everything else is as in :class:`LookAt`.

    Raises
    ------
    TypeError, ValueError
        As :class:`LookAt`.

    Examples
    --------
    >>> camera = nmr.Look([0.0, 0.0, -2.0], direction=[0.0, 0.0, 5.0])
    >>> camera.transform(torch.tensor([[0.0, 0.5, 0.0]]))[0, 0, 2]
    tensor(2.)
    """

    eye: Numbers
    direction: Numbers = (0.0, 0.0, 1.0)
    up: Numbers = (0.0, 1.0, 0.0)
    half_fov_deg: Scalars = 30.0
    right_handed: bool = False
    _names = ("direction", "half_fov_deg")
    _along = True

    def __post_init__(self) -> None:
        self._check(*_FOV)


@dataclass(frozen=True, eq=False)
class Orthographic(_Placed):
    """A camera without perspective, posed as :class:`LookAt`: ``(scale u_x, scale u_y, u_z)``.

    ``scale``: a positive number, or a Tensor [] or [B]; 1 / scale is half the extent of the view
    across the shorter side of the image, in world units (published: 1). Differentiable in every
    parameter given as a tensor.

    Raises
    ------
    TypeError, ValueError
        For values that are not numbers, wrong shapes, different batch sizes, or a scale not
        positive and finite.

    Examples
    --------
    >>> camera = nmr.Orthographic([0.0, 0.0, -2.0], scale=0.5)
    >>> camera.transform(torch.tensor([[1.0, 0.0, 3.0]]))
    tensor([[[0.5000, 0.0000, 5.0000]]])
    """

    eye: Numbers
    at: Numbers = (0.0, 0.0, 0.0)
    up: Numbers = (0.0, 1.0, 0.0)
    scale: Scalars = 1.0
    right_handed: bool = False
    perspective = False
    _names = ("at", "scale")

    def __post_init__(self) -> None:
        self._check(0, math.inf, "between 0 and infinity")
