"""Pinhole cameras with lens distortion."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nmr._validate import as_numbers
from nmr.cameras import Pinhole
from nmr.neural_renderer._convert import Numbers, check_batch


def projection(
    vertices: Tensor,
    K: Numbers,
    R: Numbers,
    t: Numbers,
    dist_coeffs: Numbers | None,
    orig_size: Numbers,
    eps: float = 1e-9,
) -> Tensor:
    """Vertices seen by calibrated cameras, in renderer space: x, y in [-1, 1] across the image,
    z = depth.

    ``u = R v + t``; ``p = (u_x / u_z, u_y / u_z)``, distorted as OpenCV does; pixel
    ``(x, y) = K (p, 1)`` with row 0 at the top; then ``(2 x / s - 1, 1 - 2 y / s, u_z)`` with
    s = orig_size. See :class:`nmr.Pinhole`.

    Parameters
    ----------
    vertices : Tensor [B, V, 3]
    K : [3, 3] or [B, 3, 3]
        Intrinsics in pixels. Like R, t and dist_coeffs a tensor, an array or lists; gradients
        reach tensors.
    R : [3, 3] or [B, 3, 3]
    t : [3], [B, 3] or [B, 1, 3]
    dist_coeffs : [5] or [B, 5], or None
        k1, k2, p1, p2, k3.
    orig_size : number, (height, width), or Tensor or array [B] or [B, 1]
        Pixels of the image that K describes. An array of two numbers is a pair if K has one
        matrix.
    eps : float
        Not used; the published one was added to the depth. A vertex in the plane of the eye gets
        x = y = inf here, so that its faces are not drawn.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes.

    >>> nr.projection(vertices, K, R, t, None, 256)
    """
    K = as_numbers(K, "K", "[3, 3] or [B, 3, 3]")
    if (
        isinstance(orig_size, np.ndarray)
        and orig_size.shape == (2,)
        and (K.ndim == 2 or len(K) == 1)
    ):
        orig_size = orig_size.tolist()  # a pair
    if isinstance(orig_size, (Tensor, np.ndarray)):
        # One size per image goes into K, which then describes images of size 1.
        K = K / torch.as_tensor(orig_size).reshape(-1, 1, 1)
        orig_size = 1
    return Pinhole(K, R, t, dist_coeffs, orig_size=orig_size).transform(check_batch(vertices))
