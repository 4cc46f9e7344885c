"""Cameras of several poses: their number, single ones, several joined; and points from depth."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

from .._packing import is_list
from .._validate import check_values, describe, holds_for_all

if TYPE_CHECKING:
    from .projection import ProjectingCamera

C = TypeVar("C", bound="ProjectingCamera")

# parameters that may differ between poses, and the axes that they have in one pose
_AXES = {"eye": 1, "at": 1, "up": 1, "direction": 1, "half_fov_deg": 0, "scale": 0}
_AXES |= {"K": 2, "R": 2, "t": 1, "dist_coeffs": 1}
_AXES |= {"matrix": 2, "intrinsics": 2, "distortion": 1, "origin": 1, "extent": 0}


class Poses:
    """The part of a camera that counts, selects and inverts its poses."""

    def __len__(self) -> int:
        """The number of poses."""
        return next((len(x) for x in _parameters(self).values() if len(x) != 1), 1)

    def __getitem__(self: C, index: int | slice | Sequence[int] | Tensor) -> C:
        """Some of the poses, as a camera of the same class; a number gives one with one pose.

        Gradients reach the parameters of the whole camera.
        """
        count = len(self)
        number = _as_number(index)
        if number is not None:
            index = number
            if not -count <= index < count:
                raise IndexError(f"pose {index} of a camera with {count} poses")
            index = [index]
        elif not isinstance(index, slice):
            index = _as_rows(index)
        return replace(self, **{name: x[index] for name, x in _parameters(self, count).items()})

    def unproject(self: ProjectingCamera, points: Tensor) -> Tensor:
        """The inverse of :meth:`transform`: points from renderer space to world space.

        Parameters
        ----------
        points : float Tensor [B, N, 3] or [N, 3]
            x right and y up, both in [-1, 1] across the image; z is the depth. For a camera with
            square pixels and an image that is not square, call
            ``camera.for_image(height, width).unproject(points)``.

        Returns
        -------
        Tensor [B, N, 3]
            In the dtype of ``points``; a B of 1 grows to the number of poses. Differentiable in
            the points and in the camera's parameters.

        Raises
        ------
        TypeError, ValueError
            For wrong types and shapes, another batch size than that of the poses, a camera with
            lens distortion, and a pose that sees nothing.

        Examples
        --------
        >>> camera, points = nmr.LookAt([1.0, 2.0, -3.0]), torch.rand(5, 3)
        >>> (camera.unproject(camera.transform(points)) - points).abs().max() < 1e-5
        tensor(True)
        """
        given = check_values(points, "points", "N, 3")
        if is_list(given) or given.shape[-1] != 3:
            raise ValueError(f"points must be a tensor [B, N, 3] or [N, 3], got {describe(points)}")
        camera = self.projection().plain()
        if camera.distortion is not None and camera.perspective:
            raise ValueError(
                "a camera with lens distortion has no unproject; undistort the pixels (cv2.undistortPoints) and drop "
                "dist_coeffs"
            )
        matrix, intrinsics = (x.to(points.device) for x in (camera.matrix, camera.intrinsics))
        if len(given) != 1 and camera.batch not in (1, len(given)):
            raise ValueError(
                f"points must have batch size 1 or {camera.batch}, that of the poses, got {describe(points)}"
            )
        place, depth = given.double().split([2, 1], dim=-1)
        place = (place - intrinsics[:, None, :, 2]) @ _inverse(intrinsics[:, :, :2]).mT
        place = place * depth if camera.perspective else place
        seen = torch.cat([place, depth.expand(*place.shape[:2], 1)], dim=-1)
        world = (seen - matrix[:, None, :, 3]) @ _inverse(matrix[:, :, :3]).mT
        return world.to(points)

    def unproject_depth(self: ProjectingCamera, depth: Tensor) -> Tensor:
        """The points that the pixels of a depth image see, in world space.

        Parameters
        ----------
        depth : float Tensor [B, h, w] or [h, w]
            As :func:`nmr.render_depth` draws it. Without anti-aliasing it is exact; on background
            it is ``far``.

        Returns
        -------
        Tensor [B, h, w, 3]
            The world point at the centre of the pixel in row y from the top and column x.
            Differentiable in depth and in the camera's parameters.

        Raises
        ------
        TypeError, ValueError
            As :meth:`unproject`.

        Examples
        --------
        >>> vertices, faces = nmr.icosphere(3)
        >>> camera = nmr.LookAt([0.0, 0.0, -3.0])
        >>> depth = nmr.render_depth(vertices, faces, camera, image_size=64, anti_aliasing=False)
        >>> points = camera.unproject_depth(depth)[depth < 100]
        >>> (points.norm(dim=-1) - 1).abs().max() < 0.02  # they lie on the sphere
        tensor(True)
        """
        given = check_values(depth, "depth", "h, w")
        if is_list(given):
            raise TypeError("depth must be a tensor [B, h, w], got a list; use torch.stack()")
        height, width = given.shape[1:]
        x, y = (
            (2 * torch.arange(n, dtype=torch.float64, device=given.device) + 1) / n - 1
            for n in (width, height)
        )
        grid = torch.stack([x.expand(height, width), -y[:, None].expand(height, width)], dim=-1)
        grid = grid.to(given).expand(len(given), -1, -1, -1)
        points = torch.cat([grid, given.unsqueeze(-1)], dim=-1)
        camera = self.for_image(height, width)
        return camera.unproject(points.flatten(1, 2)).unflatten(1, (height, width))


def _as_number(index: object) -> int | None:
    """An integer of Python, NumPy or a tensor []; None for anything else."""
    if isinstance(index, bool) or getattr(index, "shape", ()) != ():
        return None
    try:
        return operator.index(index)
    except TypeError:
        return None


def _as_rows(index: object) -> Tensor:
    """Numbers of poses, or for each pose whether it is taken."""
    try:
        rows = torch.as_tensor(index, device="cpu")
    except (TypeError, ValueError, RuntimeError):
        rows = None
    if rows is None or rows.ndim != 1 or (len(rows) and not _is_whole(rows)):
        got = describe(index) if rows is None else describe(rows)
        raise TypeError(
            f"poses are chosen by a number, a slice, or several numbers or bools [N], got {got}"
        )
    return rows if len(rows) else rows.long()


def _is_whole(rows: Tensor) -> bool:
    return not (rows.is_floating_point() or rows.is_complex())


def _inverse(matrices: Tensor) -> Tensor:
    """The inverses of the matrices ``[B, n, n]`` of cameras."""
    inverse, failed = torch.linalg.inv_ex(matrices)
    known = (failed == 0) & inverse.isfinite().flatten(1).all(1)
    if not holds_for_all(known):
        raise ValueError(
            f"pose {int((~known).nonzero()[0])} of the camera sees nothing (it is not finite, or has no left and "
            "right), so its points are not known"
        )
    return inverse


def cat(cameras: Sequence[C]) -> C:
    """One camera with the poses of several, one after the other.

    Parameters
    ----------
    cameras : sequence of at least one camera of nmr's, all of one class

    Returns
    -------
    camera of the same class
        ``cat([a, b])[i]`` is ``a[i]`` for i below ``len(a)``. Differentiable in all parameters.

    Raises
    ------
    TypeError, ValueError
        For cameras of different classes, and if one has a parameter that another lacks, or
        another handedness, image size or perspective.

    Examples
    --------
    >>> front, sides = nmr.LookAt([0.0, 0.0, -3.0]), nmr.LookAt([[3.0, 0, 0], [-3.0, 0, 0]])
    >>> len(nmr.cameras.cat([front, sides]))
    3
    """
    cameras = list(cameras)
    if not cameras or not all(isinstance(x, Poses) for x in cameras):
        raise TypeError(f"cat takes a list of nmr's cameras, got {[describe(x) for x in cameras]}")
    if len({type(x) for x in cameras}) > 1:
        raise TypeError(
            f"the cameras must be of one class, got {[describe(x) for x in cameras]}; "
            "camera.for_image(height, width).projection() makes a Projection of any"
        )
    first, rows = cameras[0], [_parameters(x, len(x)) for x in cameras]
    for field in fields(first):
        if any((field.name in row) != (field.name in rows[0]) for row in rows):
            raise ValueError(f"{field.name} is None in some of the cameras")
        values = [getattr(x, field.name) for x in cameras]
        if field.name not in rows[0] and any(x != values[0] for x in values):
            raise ValueError(f"{field.name} differs between the cameras: {values}")
    joined = {name: [row[name] for row in rows] for name in rows[0]}
    return replace(
        first,
        **{name: (cat if isinstance(x[0], Poses) else torch.cat)(x) for name, x in joined.items()},
    )


def _parameters(camera: object, count: int | None = None) -> dict[str, Tensor]:
    """The parameters ``[1 or B, ...]`` that a camera has, or with a row for each of ``count``
    poses; of a camera within a camera, that one.
    """
    found = {}
    for field in fields(camera):
        value, axes = getattr(camera, field.name), _AXES.get(field.name)
        if not isinstance(value, Poses):
            if axes is None or value is None:
                continue
            if not isinstance(value, Tensor):
                value = torch.tensor(value, dtype=torch.float64, device="cpu")
            value = value if value.ndim > axes else value.unsqueeze(0)
            value = value if count is None else value.expand(count, *value.shape[1:])
        found[field.name] = value
    return found
