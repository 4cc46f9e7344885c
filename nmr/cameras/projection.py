"""The general camera: an affine map, a perspective division, and the map to the image."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from .. import ops
from .._validate import as_numbers, callers_level, check_vertices, describe, holds_for_all
from .poses import Poses

Numbers = float | Sequence | np.ndarray | Tensor


@runtime_checkable
class Camera(Protocol):
    """The interface of cameras: any object that takes vertices to renderer space, differentiably.

    A camera of your own needs only ``transform(vertices)``, for lists of meshes also with
    ``starts``. It may have the attributes ``perspective``, whether x and y were divided by the
    depth (default: True; False: depth, colours and weights are linear on the screen),
    ``right_handed``, the handedness of the world for normals and light (default: False), and, for
    highlights, ``eye``, ``[3]`` or ``[B, 3]``.

    Examples
    --------
    >>> class Upright:  # orthographic, from the front: x and y stay, the depth is 2 - z
    ...     perspective, right_handed = False, True
    ...     def transform(self, vertices):
    ...         return vertices * vertices.new_tensor([1.0, 1.0, -1.0]) + vertices.new_tensor([0.0, 0.0, 2.0])
    >>> vertices, faces = nmr.icosphere(3)
    >>> nmr.render_silhouette(0.5 * vertices[None], faces, Upright(), image_size=64).shape
    torch.Size([1, 64, 64])
    """

    def transform(self, vertices: Tensor, starts: Tensor | None = None) -> Tensor:
        """World to renderer coordinates: ``[B, V, 3]`` to the same; a B of 1 grows to the
        camera's batch.

        Packed vertices ``[N, 3]`` come with ``starts [B + 1, 2]``, with the first vertex of each
        mesh in column 0.
        """
        ...


class ProjectingCamera(Poses):
    """Base class of cameras that define :meth:`projection`; it provides :meth:`transform`."""

    perspective = True
    _stretch = 1.0, 1.0  # see SquarePixels

    def projection(self, dtype: torch.dtype = torch.float64) -> Projection:
        """The camera in its general form, computed in ``dtype`` in host memory; differentiable in
        its parameters.
        """
        raise NotImplementedError

    def _given(self, dtype: torch.dtype) -> tuple:
        """The arguments of :func:`nmr.ops.project` from ``eye`` to ``perspective``."""
        return self.projection(dtype)._given(dtype)

    def for_image(self, height: int, width: int) -> ProjectingCamera:
        """The camera for an image of height x width pixels.

        Cameras with a field of view (LookAt, Look, Orthographic) have square pixels: the field of
        view belongs to the shorter side of the image, and more is seen along the longer one.
        Others stretch theirs over the whole image.
        """
        return self

    def transform(self, vertices: Tensor, starts: Tensor | None = None) -> Tensor:
        """Vertices from world to renderer space, in the dtype of ``vertices``.

        Parameters
        ----------
        vertices : Tensor [B, V, 3] or [V, 3], float32 or float64; or packed [N, 3] with ``starts``
        starts : int64 Tensor [B + 1, 2] in host memory, optional
            First vertex and first face of each packed mesh; last row: N and the number of faces.

        Returns
        -------
        Tensor [B, V, 3], or [N, 3] if packed
            ``x, y`` are in [-1, 1] across the image (x right, y up), z is the depth. One mesh and
            B poses give B meshes. A vertex that has no finite image (not finite itself, or in the
            plane of the eye, or seen by a camera that is not finite) gets x = y = inf, so that
            its faces are not drawn, and no gradient.

        Notes
        -----
        Differentiable in the vertices and in the camera's parameters; there are no second
        derivatives. Results do not depend on the number of threads or on the batch. Gradients are
        NaN only where the upstream gradient is not finite.

        Raises
        ------
        TypeError, ValueError
            For wrong types and shapes, or a camera with another batch size than the vertices.
        """
        return self._project(*_check_batch(vertices, starts), starts)[0]

    def _project(
        self, vertices: Tensor, meshes: int, starts: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """:func:`nmr.ops.project` of checked vertices."""
        return ops.project(vertices, starts, *self._arguments(vertices.dtype, meshes, starts)[0])

    def _arguments(
        self, dtype: torch.dtype, meshes: int, starts: Tensor | None
    ) -> tuple[tuple, int]:
        """The arguments of :func:`nmr.ops.project` from ``eye`` on, and the number of images."""
        given = self._given(dtype)
        batch = ops.count_cameras(*given)
        if batch != meshes and batch != 1 and (meshes != 1 or starts is not None):
            raise ValueError(
                f"vertices and camera must have one batch size (or 1), got {meshes} meshes and {batch} poses"
                + ("" if starts is None else "; packed meshes need one pose each, or one for all")
            )
        return (*given, *self._stretch), meshes if batch == 1 else batch


@dataclass(frozen=True, eq=False)
class Projection(ProjectingCamera):
    """The general camera; every other camera is computed as one of these.

    ``u = A (v - origin) + t``; ``p = (u_x, u_y) / u_z``, distorted;
    ``(x, y) = intrinsics (p / extent, 1)``; the depth is ``u_z``. The camera axes are OpenCV's: x
    right, y down, z away from the viewer. A batch of 1 serves every image; the parameters may mix
    1 and B.

    Parameters
    ----------
    matrix : Tensor [B, 3, 4]
        ``[A | t]``, world to camera axes.
    intrinsics : Tensor [B, 2, 3]
        Maps p / extent to renderer space. Its second row usually changes the sign of y: in
        renderer space y is up.
    distortion : Tensor [B, 4], [B, 5] or [B, 8], optional
        OpenCV's k1, k2, p1, p2, k3; with 8 also k4, k5, k6; with 4 the k1, k2, k3, k4 of a
        fisheye. Not used without perspective. See :class:`nmr.Pinhole` about points beyond the
        reach of the formula.
    perspective : bool
        False: ``p = (u_x, u_y)``.
    origin : Tensor [B, 3], optional
        Position of the camera; 0 by default. It could be part of t, and ``extent`` part of the
        intrinsics. They are separate so that look-at cameras round as the published ones do.
    extent : Tensor [B], optional
        Half the width of the image at depth 1; 1 by default.

    Raises
    ------
    ValueError
        For other shapes.

    Examples
    --------
    >>> matrix = torch.tensor([[[1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, 1.0, 4.0]]])  # y down in the camera
    >>> intrinsics = torch.tensor([[[2.0, 0, 0], [0, -2.0, 0]]])
    >>> camera = nmr.cameras.Projection(matrix, intrinsics)
    >>> camera.transform(torch.tensor([[[1.0, 0.5, 0.0]]])).tolist()
    [[[0.5, 0.25, 4.0]]]
    """

    matrix: Tensor
    intrinsics: Tensor
    distortion: Tensor | None = None
    perspective: bool = True
    origin: Tensor | None = None
    extent: Tensor | None = None

    def __post_init__(self) -> None:
        shapes = (
            ("matrix", (3, 4)),
            ("intrinsics", (2, 3)),
            ("distortion", (5,)),
            ("origin", (3,)),
            ("extent", ()),
        )
        for name, shape in shapes:
            value = getattr(self, name)
            if (
                name == "distortion"
                and isinstance(value, Tensor)
                and value.shape[1:] in ((4,), (8,))
            ):
                shape = value.shape[1:]
            if value is None and name not in ("matrix", "intrinsics"):
                continue
            if (
                not isinstance(value, Tensor)
                or value.ndim != len(shape) + 1
                or value.shape[1:] != shape
            ):
                wanted = ", ".join(["B", *map(str, shape)])
                raise ValueError(
                    f"{name} must be a tensor of shape [{wanted}], got {describe(value)}"
                )
            if not value.is_floating_point():
                object.__setattr__(self, name, value.double())
        _ = self.batch

    @property
    def batch(self) -> int:
        """Number of cameras; 1 serves every image."""
        matrix, intrinsics, distortion, origin, extent = self.parameters()
        return common_batch(
            matrix=matrix,
            intrinsics=intrinsics,
            distortion=distortion,
            origin=origin,
            extent=extent,
        )

    def parameters(self) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None, Tensor | None]:
        """matrix, intrinsics, distortion, origin, extent."""
        return self.matrix, self.intrinsics, self.distortion, self.origin, self.extent

    def projection(self, dtype: torch.dtype = torch.float64) -> Projection:
        """The camera itself, with the intrinsics of its image."""
        if self._stretch == (1.0, 1.0):
            return self
        factors = torch.tensor(self._stretch, dtype=dtype, device="cpu").unsqueeze(1)
        intrinsics = self.intrinsics * factors
        rest = self.distortion, self.perspective, self.origin, self.extent
        return Projection(self.matrix, intrinsics, *rest)

    def _given(self, dtype: torch.dtype) -> tuple:
        matrix, intrinsics, distortion, origin, extent = (
            None if x is None else x.to("cpu", dtype) for x in self.parameters()
        )
        parts = None, None, None, None, matrix, intrinsics, origin, extent, distortion
        return *parts, False, False, self.perspective

    def plain(self) -> Projection:
        """The same camera in float64, without origin and extent."""
        matrix, intrinsics, distortion, origin, extent = (
            None if x is None else x.to("cpu", torch.float64) for x in self.parameters()
        )
        if origin is not None:
            offset = matrix[:, :, 3] - (matrix[:, :, :3] * origin[:, None]).sum(-1)
            rotation = matrix[:, :, :3].expand(offset.shape[0], 3, 3)
            matrix = torch.cat([rotation, offset.unsqueeze(-1)], dim=-1)
        if extent is not None:
            ones = torch.ones_like(extent)
            intrinsics = intrinsics / torch.stack([extent, extent, ones], dim=-1).unsqueeze(1)
        return Projection(matrix, intrinsics, distortion, self.perspective)

    def viewer(self) -> Tensor:
        """Where an image is seen from: float64 ``[B, 5]`` in host memory, without gradient.

        Three numbers and 1: the place of the eye; or three numbers and 0: the direction towards
        the viewer. Then -1 if the camera sees a right-handed world, else 1. In single operations,
        which round alike on every processor.
        """
        matrix, intrinsics, _, origin, _ = (
            None if x is None else x.detach().to("cpu", torch.float64) for x in self.parameters()
        )
        products = cofactors(matrix[:, :, :3]).unbind(1)
        determinant = _sum_of_three(products[2] * matrix[:, 2, :3])
        columns = [product / determinant for product in products]  # of the inverse
        flip = intrinsics[:, 0, 0] * intrinsics[:, 1, 1] - intrinsics[:, 0, 1] * intrinsics[:, 1, 0]
        if self.perspective:
            terms = [column * matrix[:, k, 3:] for k, column in enumerate(columns)]
            place = -(terms[0] + terms[1] + terms[2])
            place = place if origin is None else place + origin
        else:
            place = -columns[2]
        side = torch.where(determinant.sign() * flip.sign()[:, None] < 0, -1.0, 1.0)
        rest = torch.cat([torch.full_like(side, float(self.perspective)), side], dim=1)
        batch = self.batch
        return torch.cat([place.expand(batch, 3), rest.expand(batch, 2)], dim=1)


@dataclass(frozen=True, eq=False)
class SquarePixels(ProjectingCamera):
    """Base class of cameras whose field of view belongs to the shorter side of an image."""

    # factors of x and y in an image that is not square: see for_image
    _stretch: tuple[float, float] = field(default=(1.0, 1.0), repr=False, kw_only=True)

    def for_image(self, height: int, width: int) -> ProjectingCamera:
        """The camera whose x and y count from -1 to 1 across the sides of such an image."""
        if height == width or self._stretch != (1.0, 1.0):
            return self
        shaped, short = copy.copy(self), min(height, width)
        object.__setattr__(shaped, "_stretch", (short / width, short / height))
        return shaped


def cofactors(matrices: Tensor) -> Tensor:
    """``[B, 3, 3]``: the inverse, transposed and times the determinant; in single operations."""
    x, y, z = matrices.unbind(1)
    return torch.stack([_cross(y, z), _cross(z, x), _cross(x, y)], dim=1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a.roll(-1, 1) * b.roll(-2, 1) - a.roll(-2, 1) * b.roll(-1, 1)


def _sum_of_three(terms: Tensor) -> Tensor:
    """``[B, 1]`` of ``[B, 3]``, from left to right."""
    return (terms[:, :1] + terms[:, 1:2]) + terms[:, 2:]


def is_projecting(camera: Camera | None) -> bool:
    """Whether the camera is one of this package, or derived from one without another transform."""
    return getattr(type(camera), "transform", None) is ProjectingCamera.transform


def transform(
    camera: Camera, vertices: Tensor, meshes: int, starts: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """Checked vertices in renderer space, and the least depth of all, if the camera computes it."""
    if is_projecting(camera):
        points, _, nearest = camera._project(vertices, meshes, starts)
        return points, nearest
    return (
        camera.transform(vertices) if starts is None else camera.transform(vertices, starts=starts)
    ), None


def has_perspective(camera: Camera | None) -> bool:
    """Whether x and y are divided by the depth (as without a camera), so that 1 / depth is linear
    on the screen.
    """
    return bool(getattr(camera, "perspective", True))


def _check_batch(vertices: object, starts: object) -> tuple[Tensor, int]:
    """Vertices ``[B, V, 3]``, or packed ``[N, 3]`` with starts, and the number of meshes."""
    if starts is None:
        vertices = check_vertices(vertices)
        return vertices, vertices.shape[0]
    if (
        not isinstance(starts, Tensor)
        or starts.dtype != torch.int64
        or starts.ndim != 2
        or starts.shape[1] != 2
    ):
        raise ValueError(f"starts must be an int64 tensor [B + 1, 2], got {describe(starts)}")
    if not isinstance(vertices, Tensor) or vertices.ndim != 2:
        raise ValueError(f"with starts, vertices must be packed [N, 3], got {describe(vertices)}")
    return check_vertices(vertices)[0], starts.shape[0] - 1


def common_batch(**parameters: Tensor | None) -> int:
    """The batch size that all parameters ``[B or 1, ...]`` share; a ValueError names those that
    differ.
    """
    sizes = {x.shape[0] for x in parameters.values() if x is not None} - {1}
    if len(sizes) > 1:
        shapes = ", ".join(
            f"{name} {list(x.shape)}" for name, x in parameters.items() if x is not None
        )
        raise ValueError(
            f"the parameters of a camera must have one batch size (or 1), got {shapes}"
        )
    return sizes.pop() if sizes else 1


def warn_if_not_finite(camera: ProjectingCamera, *names: str) -> None:
    """Warns of cameras with an infinite or missing number, whose image is empty; not if compiled
    or on a GPU.
    """
    for name in names:
        value = getattr(camera, name)
        if isinstance(value, Tensor) and not holds_for_all(value.detach().isfinite()):
            warnings.warn(
                f"{name} of a {type(camera).__name__} is not finite: its image is empty",
                stacklevel=callers_level(),
            )


def as_parameter(value: Numbers, name: str, *shape: int) -> Tensor:
    """``value`` as a float tensor ``[*shape]`` or ``[B, *shape]``; numbers that are not tensors
    become float64.
    """
    one, many = (", ".join([*first, *map(str, shape)]) for first in ([], ["B"]))
    tensor = as_numbers(value, name, f"numbers of shape [{one}] or [{many}]")
    if (
        tensor.ndim not in (len(shape), len(shape) + 1)
        or tensor.shape[tensor.ndim - len(shape) :] != shape
    ):
        raise ValueError(f"{name} must have shape [{one}] or [{many}], got {list(tensor.shape)}")
    return tensor


def batched(tensor: Tensor, dtype: torch.dtype, *shape: int) -> Tensor:
    """A parameter as ``[B, *shape]`` in host memory: cameras are computed there."""
    return tensor.to("cpu", dtype).reshape(-1, *shape)


def height_and_width(value: object, name: str) -> tuple[float, float]:
    """(height, width) of an image, from a pair or from one number for both."""
    pair = value.tolist() if isinstance(value, (Tensor, np.ndarray)) else value
    pair = pair if isinstance(pair, (tuple, list)) else (pair, pair)
    try:
        size = tuple(float(x) for x in pair)
    except (TypeError, ValueError):
        size = ()
    if len(size) != 2 or not all(0 < x < float("inf") for x in size):
        raise ValueError(
            f"{name} must be positive numbers (height, width), or one number, got {value}"
        )
    return size
