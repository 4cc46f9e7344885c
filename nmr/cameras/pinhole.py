"""A camera given by a calibration: K, R, t and OpenCV's distortion."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import torch

from .._validate import as_numbers
from .projection import (
    Numbers,
    ProjectingCamera,
    Projection,
    as_parameter,
    batched,
    common_batch,
    height_and_width,
    warn_if_not_finite,
)

# From pixels (u right, v down) to [-1, 1]: x = 2 u / width - 1, y = 1 - 2 v / height.
_CENTRE = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], dtype=torch.float64, device="cpu")


@dataclass(frozen=True, eq=False)
class Pinhole(ProjectingCamera):
    """A calibrated pinhole with OpenCV's distortion; the published renderer's ``projection``
    camera.

    ``c = R v + t``; ``p = (c_x, c_y) / c_z``, distorted; pixel ``(u, v) = K (p_x, p_y, 1)``, u
    right and v DOWN; then ``x = 2 u / width - 1``, ``y = 1 - 2 v / height``, depth ``c_z``. The
    centre of the first pixel is (0.5, 0.5); :func:`nmr.cameras.from_opencv` converts from OpenCV's,
    which has it at (0, 0). Camera axes are x right, y down, z away: a right-handed world is not
    mirrored.

    Parameters
    ----------
    K : [3, 3] or [B, 3, 3]
        Pixels of an image of ``orig_size``; only the first two rows are used.
    R : [3, 3] or [B, 3, 3]
    t : [3], [B, 3] or [B, 1, 3]
    dist_coeffs : [5], [8] or [4], or [B, 5] and so on, optional
        k1, k2, p1, p2, k3; with 8 also k4, k5, k6; with 4 the k1 to k4 of OpenCV's fisheye. Beyond
        the radius at which the formula turns back (or comes near to it, with p1 and p2) the image
        goes on straight, and vertices have no gradient to the coefficients. Edges are drawn
        straight: subdivide large faces.
    orig_size : number or (height, width), keyword only
        The image that K belongs to, stretched over the whole rendered image.

    Tensors are differentiable.

    Raises
    ------
    TypeError, ValueError
        For values that are not numbers, wrong shapes, different batch sizes, or an orig_size that
        is not positive.

    Examples
    --------
    >>> K = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]
    >>> camera = nmr.Pinhole(K, torch.eye(3), [0.0, 0.0, 2.0], orig_size=(480, 640))
    >>> camera.transform(torch.zeros(1, 1, 3))
    tensor([[[0., 0., 2.]]])
    """

    K: Numbers
    R: Numbers
    t: Numbers
    dist_coeffs: Numbers | None = None
    _: KW_ONLY
    orig_size: float | tuple[float, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", as_parameter(self.K, "K", 3, 3))
        object.__setattr__(self, "R", as_parameter(self.R, "R", 3, 3))
        t = as_numbers(self.t, "t", "numbers of shape [3], [B, 3] or [B, 1, 3]")
        t = t.squeeze(1) if t.ndim == 3 and t.shape[1] == 1 else t
        object.__setattr__(self, "t", as_parameter(t, "t", 3))
        if self.dist_coeffs is not None:
            numbers = as_numbers(
                self.dist_coeffs, "dist_coeffs", "numbers of shape [5], [8] or [4], or [B, 5] ..."
            )
            count = numbers.shape[-1] if numbers.ndim and numbers.shape[-1] in (4, 8) else 5
            object.__setattr__(self, "dist_coeffs", as_parameter(numbers, "dist_coeffs", count))
        object.__setattr__(self, "orig_size", height_and_width(self.orig_size, "orig_size"))
        warn_if_not_finite(self, "K", "R", "t", "dist_coeffs")
        named = {
            "K": (self.K, 3),
            "R": (self.R, 3),
            "t": (self.t, 2),
            "dist_coeffs": (self.dist_coeffs, 2),
        }
        common_batch(
            **{name: x for name, (x, ndim) in named.items() if x is not None and x.ndim == ndim}
        )

    def projection(self, dtype: torch.dtype = torch.float64) -> Projection:
        K = batched(self.K, torch.float64, 3, 3)
        R = batched(self.R, dtype, 3, 3)
        t = batched(self.t, dtype, 3, 1)
        batch = common_batch(R=R, t=t)
        matrix = torch.cat([R.expand(batch, 3, 3), t.expand(batch, 3, 1)], dim=-1)
        height, width = self.orig_size
        intrinsics = K[:, :2] * K.new_tensor([[2 / width], [-2 / height]]) + _CENTRE
        distortion = (
            None
            if self.dist_coeffs is None
            else batched(self.dist_coeffs, dtype, self.dist_coeffs.shape[-1])
        )
        return Projection(matrix, intrinsics.to(dtype), distortion)
