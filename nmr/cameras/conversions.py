"""Converts cameras from and to the conventions of OpenCV, OpenGL and PyTorch3D. Differentiable;
results are float64.

The worlds of these libraries are right-handed. Their cameras, converted to nmr, show the same
picture. :class:`nmr.LookAt`, :class:`nmr.Look` and :class:`nmr.Orthographic` treat the world as
left-handed, as the published renderer does, and show a mirror image of it; with
``right_handed=True`` they are ordinary right-handed cameras. Converted to another library, both
put every vertex on the same pixel. The rotation of a left-handed one then has determinant -1. If
you need a proper rotation for it, give the other renderer mirrored vertices ``v * (1, 1, -1)``
and ``R @ diag(1, 1, -1)`` (PyTorch3D: ``diag(1, 1, -1) @ R``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .._validate import as_numbers, check_number, describe, holds_for_all
from .pinhole import Pinhole
from .projection import (
    Numbers,
    ProjectingCamera,
    Projection,
    SquarePixels,
    as_parameter,
    batched,
    common_batch,
    height_and_width,
)

# Camera axes here: x right, y down, z away (OpenCV). OpenGL: right, up, towards the viewer;
# PyTorch3D: left, up, away.
_HOST = {
    "dtype": torch.float64,
    "device": "cpu",
}  # cameras are computed there, whatever the default device is
_OPENGL_AXES = torch.tensor([[1.0], [-1.0], [-1.0]], **_HOST)
_PYTORCH3D_AXES = torch.tensor([[-1.0], [-1.0], [1.0]], **_HOST)


def _row(*entries: Tensor | float) -> Tensor:
    """``[B, len(entries)]`` of tensors ``[B]`` and numbers."""
    batch = max((x.shape[0] for x in entries if isinstance(x, Tensor)), default=1)
    return torch.stack([torch.as_tensor(x, **_HOST).expand(batch) for x in entries], dim=-1)


def _image_size(image_size: tuple[float, float] | None, in_ndc: bool) -> tuple[float, float]:
    if image_size is None and not in_ndc:
        raise ValueError("image_size=(height, width) is needed with in_ndc=False")
    return height_and_width((1, 1) if image_size is None else image_size, "image_size")


def _plain(camera: ProjectingCamera, height: float, width: float) -> Projection:
    """The camera for an image of this shape."""
    if not isinstance(camera, ProjectingCamera):
        raise TypeError(
            f"camera must be one of nmr's (nmr.cameras.ProjectingCamera), got {describe(camera)}"
        )
    plain = camera.for_image(height, width).projection().plain()
    expanded = (
        None if x is None else x.expand(plain.batch, *x.shape[1:]) for x in plain.parameters()
    )
    matrix, intrinsics, distortion, *_ = expanded
    return Projection(matrix, intrinsics, distortion, plain.perspective)


def _without_distortion(
    camera: ProjectingCamera, target: str, height: float, width: float
) -> Projection:
    projection = _plain(camera, height, width)
    if projection.distortion is not None and projection.perspective and projection.distortion.any():
        raise ValueError(
            f"{target} has no lens distortion; undistort the images and drop dist_coeffs"
        )
    return projection


# --- OpenCV


def from_opencv(
    K: Numbers,
    R: Numbers,
    t: Numbers,
    dist_coeffs: Numbers | None = None,
    *,
    height: float,
    width: float,
    pixel_center: float = 0.0,
    fisheye: bool = False,
) -> Pinhole:
    """A camera of OpenCV: ``c = R v + t``, distorted, ``(u, v) = K (c_x / c_z, c_y / c_z, 1)`` in
    pixels.

    Parameters
    ----------
    K, R : [3, 3] or [B, 3, 3]
        For a rotation vector use ``cv2.Rodrigues`` first.
    t : [3], [3, 1], [B, 3] or [B, 3, 1]
    dist_coeffs : [4], [5] or [8], or [B, 4] and so on, also as a column, optional
        k1, k2, p1, p2, then k3, then k4, k5, k6. Beyond the reach of the formula the image goes
        on straight, as :class:`nmr.Pinhole` says.
    height, width : number
        The image that K belongs to. The rendered image shows all of it, stretched if it has
        another shape.
    pixel_center : float
        Coordinate of the centre of the first pixel: 0 in OpenCV, 0.5 if pixel coordinates begin
        at its corner (COLMAP; :class:`nmr.Pinhole` itself).
    fisheye : bool
        dist_coeffs are the k1, k2, k3, k4 of ``cv2.fisheye``.

    Returns
    -------
    Pinhole
        At ``image_size=(height, width)``, a vertex that OpenCV projects to (u, v) is drawn in row
        v, column u.

    Raises
    ------
    TypeError, ValueError
        For values that are not numbers, and wrong shapes, including those of OpenCV's longer
        distortion models.

    Examples
    --------
    >>> K = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]
    >>> camera = nmr.cameras.from_opencv(K, torch.eye(3), [0.0, 0.0, 3.0], height=480, width=640)
    >>> vertices, faces = nmr.icosphere(3)
    >>> nmr.render_silhouette(vertices, faces, camera, image_size=(480, 640)).shape
    torch.Size([1, 480, 640])
    """
    height, width = height_and_width((height, width), "height and width")
    K = batched(as_parameter(K, "K", 3, 3), torch.float64, 3, 3)
    if not holds_for_all(K[:, 2, :2].abs() < 1e-3):
        raise ValueError("the last row of K must be (0, 0, 1); is it transposed?")
    shift = torch.zeros(3, 3, **_HOST)
    shift[:2, 2] = 0.5 - pixel_center
    t = as_numbers(t, "t", "numbers of shape [3], [3, 1], [B, 3] or [B, 3, 1]")
    t = t.squeeze(-1) if t.shape[-1:] == (1,) else t
    if dist_coeffs is not None:
        d = as_numbers(dist_coeffs, "dist_coeffs", "4, 5 or 8 numbers")
        d = d.squeeze(-1) if d.ndim > 1 and d.shape[-1] == 1 else d
        if d.ndim not in (1, 2) or d.shape[-1] not in ((4,) if fisheye else (4, 5, 8)):
            wanted = (
                "k1, k2, k3, k4 of a fisheye"
                if fisheye
                else "k1, k2, p1, p2, also with k3, also with k4, k5, k6"
            )
            raise ValueError(
                f"dist_coeffs must be {wanted}, got shape {list(d.shape)}; OpenCV's models with 12 and 14 numbers are "
                "not supported"
            )
        dist_coeffs = (
            d
            if fisheye or d.shape[-1] != 4
            else torch.cat([d, torch.zeros_like(d[..., :1])], dim=-1)
        )
    elif fisheye:
        dist_coeffs = torch.zeros(4, **_HOST)
    return Pinhole(K + shift, R, t, dist_coeffs, orig_size=(height, width))


def to_opencv(
    camera: ProjectingCamera, *, height: float, width: float, pixel_center: float = 0.0
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """``K [B, 3, 3]``, ``R [B, 3, 3]``, ``t [B, 3]`` and ``dist_coeffs [B, 5]`` ([B, 8]; [B, 4]
    of a fisheye) or None, as :func:`from_opencv` takes.

    A vertex keeps its pixel in images of ``image_size=(height, width)``. The determinant of R is
    -1 for the cameras of a left-handed world (see above). An orthographic camera raises a
    ValueError.

    Examples
    --------
    >>> camera = nmr.LookAt.from_angles(2.732, 30.0, 45.0, half_fov_deg=15.0, right_handed=True)
    >>> K, R, t, dist_coeffs = nmr.cameras.to_opencv(camera, height=256, width=256)
    >>> K.shape, R.shape, t.shape, dist_coeffs
    (torch.Size([1, 3, 3]), torch.Size([1, 3, 3]), torch.Size([1, 3]), None)
    """
    height, width = height_and_width((height, width), "height and width")
    projection = _plain(camera, height, width)
    if not projection.perspective:
        raise ValueError("OpenCV has no orthographic camera; use to_opengl or to_pytorch3d")
    x, y = projection.intrinsics.unbind(1)
    corner = torch.tensor([0.0, 0.0, 1.0], **_HOST)
    shift = (0.5 - pixel_center) * corner
    third = corner.expand_as(x)
    K = torch.stack(
        [width / 2 * (corner + x) - shift, height / 2 * (corner - y) - shift, third], dim=1
    )
    matrix = projection.matrix
    return K, matrix[:, :, :3], matrix[:, :, 3], projection.distortion


# --- OpenGL


def from_opengl(view: Numbers, projection: Numbers) -> Projection:
    """A camera of OpenGL: ``clip = projection @ view @ (v, 1)``, ``(x, y) = clip_xy / clip_w``.

    Parameters
    ----------
    view, projection : [4, 4] or [B, 4, 4]
        For column vectors, as in the specification (a flat array in OpenGL's memory order is the
        transpose). The last row of ``projection`` is (0, 0, -1, 0) for a perspective and (0, 0,
        0, 1) for an orthographic camera.

    Returns
    -------
    Projection
        x and y are OpenGL's normalized device coordinates. z is the distance ``-z_eye`` from the
        plane of the eye, and not OpenGL's depth: near and far of ``projection`` are arguments of
        the rendering functions here.

    Raises
    ------
    TypeError, ValueError
        For values that are not numbers, wrong shapes, or matrices of another form.

    Examples
    --------
    >>> view = torch.eye(4)
    >>> view[2, 3] = -3.0  # the eye at z = 3, looking along -z
    >>> perspective = [[2.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, -1.02, -0.202], [0, 0, -1.0, 0]]
    >>> camera = nmr.cameras.from_opengl(view, perspective)
    >>> camera.transform(torch.tensor([[[0.5, 0.0, 1.0]]])).tolist()  # x, y, distance
    [[[0.5, 0.0, 2.0]]]
    """
    view = batched(as_parameter(view, "view", 4, 4), torch.float64, 4, 4)
    clip = batched(as_parameter(projection, "projection", 4, 4), torch.float64, 4, 4)
    last = torch.tensor([[0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]], **_HOST)
    perspective = bool((clip[:, 3] == last[0]).all())
    if not (view[:, 3] == last[1]).all():
        raise ValueError("the last row of view must be (0, 0, 0, 1); are the matrices transposed?")
    if not perspective and not (clip[:, 3] == last[1]).all():
        raise ValueError(
            "the last row of projection must be (0, 0, -1, 0) or (0, 0, 0, 1); is it transposed?"
        )
    offset, shear = (
        (clip[:, :2, 3], clip[:, :2, 2]) if perspective else (clip[:, :2, 2], clip[:, :2, 3])
    )
    if offset.any():
        column = 3 if perspective else 2
        raise ValueError(f"projection[0:2, {column}] must be 0: nmr's cameras have no such term")
    third = -shear if perspective else shear
    intrinsics = torch.stack([clip[:, :2, 0], -clip[:, :2, 1], third], dim=-1)
    return Projection(_OPENGL_AXES * view[:, :3], intrinsics, perspective=perspective)


def to_opengl(
    camera: ProjectingCamera,
    *,
    near: float,
    far: float,
    image_size: tuple[float, float] | None = None,
) -> tuple[Tensor, Tensor]:
    """``view`` and ``projection``, ``[B, 4, 4]``, as :func:`from_opengl` takes them; near and far
    map to -1 and 1 in z.

    ``image_size`` (height, width) is that of the images to come; it must be given if they are not
    square. The determinant of ``view`` is -1 for the cameras of a left-handed world (see above);
    the winding of a face on the screen is the same as here. A distorted camera raises a
    ValueError.

    Examples
    --------
    >>> camera = nmr.LookAt.from_angles(2.732, 30.0, 45.0, half_fov_deg=15.0, right_handed=True)
    >>> view, projection = nmr.cameras.to_opengl(camera, near=0.1, far=10.0)
    >>> view.shape, projection.shape
    (torch.Size([1, 4, 4]), torch.Size([1, 4, 4]))
    """
    near, far = check_number(near, "near"), check_number(far, "far")
    if not 0 <= near < far < float("inf"):
        raise ValueError(
            f"near and far must be finite with 0 <= near < far, got near={near}, far={far}"
        )
    camera = _without_distortion(camera, "OpenGL", *_image_size(image_size, True))
    matrix, intrinsics = camera.matrix, camera.intrinsics
    last = torch.tensor([[[0.0, 0.0, 0.0, 1.0]]], **_HOST)
    view = torch.cat([_OPENGL_AXES * matrix, last.expand(matrix.shape[0], 1, 4)], dim=1)
    x, y, third = intrinsics.unbind(-1)
    zero, depth = torch.zeros_like(x), far - near
    if camera.perspective:
        top = torch.stack([x, -y, -third, zero], dim=-1)
        bottom = [[0.0, 0.0, -(far + near) / depth, -2 * far * near / depth], [0.0, 0.0, -1.0, 0.0]]
    else:
        top = torch.stack([x, -y, zero, third], dim=-1)
        bottom = [[0.0, 0.0, -2 / depth, -(far + near) / depth], [0.0, 0.0, 0.0, 1.0]]
    return view, torch.cat([top, torch.tensor([bottom], **_HOST).expand(len(top), 2, 4)], dim=1)


# --- PyTorch3D


def _pairs(value: Numbers, name: str) -> Tensor:
    """``[B, 2]`` from a number, ``[B]`` or ``[B, 2]``."""
    value = as_numbers(value, name, "a number, [B] or [B, 2]")
    if value.ndim > 2 or (value.ndim == 2 and value.shape[1] != 2):
        raise ValueError(
            f"{name} must be a number or have shape [B] or [B, 2], got {list(value.shape)}"
        )
    value = value.to("cpu", torch.float64)
    return value if value.ndim == 2 else value.reshape(-1, 1).expand(-1, 2)


def from_pytorch3d(
    R: Numbers,
    T: Numbers,
    focal_length: Numbers = 1.0,
    principal_point: Numbers = 0.0,
    *,
    in_ndc: bool = True,
    image_size: tuple[float, float] | None = None,
    orthographic: bool = False,
) -> Projection:
    """A ``PerspectiveCameras`` or ``OrthographicCameras`` of PyTorch3D.

    There ``(X, Y, Z) = v R + T`` with row vectors and X left, Y up, Z away;
    ``x_ndc = fx X / Z + px`` (``fx X + px`` if orthographic), y likewise; +1 is the left and the
    upper border of a square image, and of the shorter side of any other.

    Parameters
    ----------
    R : [3, 3] or [B, 3, 3]
    T : [3] or [B, 3]
    focal_length, principal_point : number, [B] or [B, 2]
    in_ndc : bool
        False: in pixels from the upper left corner of the image; ``image_size`` is then needed.
    image_size : (height, width), optional
        The image of these numbers. The rendered image shows all of it, stretched if it has
        another shape. Without it, they are taken for those of the rendered image, whatever its
        shape.
    orthographic : bool

    Returns
    -------
    Projection
        With the same picture; z is PyTorch3D's depth Z.

    Raises
    ------
    TypeError, ValueError
        For values that are not numbers, wrong shapes, or a missing or impossible image_size.

    Examples
    --------
    >>> camera = nmr.cameras.from_pytorch3d(torch.eye(3), [0.0, 0.0, 2.0], focal_length=2.0)
    >>> camera.transform(torch.tensor([[[0.5, 0.25, 0.0]]])).tolist()  # +1 is the right border here, the left one there
    [[[-0.5, 0.25, 2.0]]]
    """
    R = batched(as_parameter(R, "R", 3, 3), torch.float64, 3, 3)
    T = batched(as_parameter(T, "T", 3), torch.float64, 3, 1)
    batch = common_batch(R=R, T=T)
    matrix = torch.cat([R.transpose(1, 2).expand(batch, 3, 3), T.expand(batch, 3, 1)], dim=-1)
    focal, centre = _pairs(focal_length, "focal_length"), _pairs(principal_point, "principal_point")
    height, width = _image_size(image_size, in_ndc)
    shorter, size = min(height, width), torch.tensor([width, height], **_HOST)
    if not in_ndc:
        focal, centre = focal * (2 / shorter), -(centre - size / 2) * (2 / shorter)
    focal, centre = focal * (shorter / size), centre * (shorter / size)
    # x = -x_ndc, and X of the camera axes also changes its sign: only the principal point needs a
    # minus.
    intrinsics = torch.stack(
        [_row(focal[:, 0], 0, -centre[:, 0]), _row(0, -focal[:, 1], centre[:, 1])], dim=1
    )
    kind = _SquareProjection if image_size is None else Projection
    return kind(_PYTORCH3D_AXES * matrix, intrinsics, perspective=not orthographic)


@dataclass(frozen=True, eq=False)
class _SquareProjection(Projection, SquarePixels):
    """A projection whose [-1, 1] belongs to the shorter side of an image."""


def from_pytorch3d_fov(
    R: Numbers,
    T: Numbers,
    fov: Numbers = 60.0,
    aspect_ratio: float = 1.0,
    *,
    degrees: bool = True,
    image_size: tuple[float, float] | None = None,
) -> Projection:
    """A ``FoVPerspectiveCameras`` of PyTorch3D: ``fov``, a number or [B], is the WHOLE vertical
    field of view.

    Its focal lengths are ``1 / (aspect_ratio tan(fov / 2))`` and ``1 / tan(fov / 2)``; the rest
    is :func:`from_pytorch3d`.

    Examples
    --------
    >>> camera = nmr.cameras.from_pytorch3d_fov(torch.eye(3), [0.0, 0.0, 2.0], fov=90.0)
    >>> [round(x, 4) for x in camera.transform(torch.tensor([[[-0.5, 0.25, 0.0]]])).flatten().tolist()]
    [0.25, 0.125, 2.0]
    """
    fov = as_parameter(fov, "fov").to("cpu", torch.float64).reshape(-1)
    half = (torch.deg2rad(fov) if degrees else fov) / 2
    if not holds_for_all((half > 0) & (half < math.pi / 2)):
        raise ValueError(f"fov must lie between 0 and 180 degrees, got {fov.tolist()}")
    focal, aspect_ratio = 1 / torch.tan(half), check_number(aspect_ratio, "aspect_ratio")
    return from_pytorch3d(
        R, T, torch.stack([focal / aspect_ratio, focal], dim=-1), image_size=image_size
    )


def to_pytorch3d(
    camera: ProjectingCamera, *, image_size: tuple[float, float] | None = None, in_ndc: bool = True
) -> dict[str, Tensor | bool]:
    """Arguments of ``PerspectiveCameras(**...)``, or of ``OrthographicCameras`` for an
    orthographic camera.

    ``R [B, 3, 3]``, ``T [B, 3]``, ``focal_length [B, 2]``, ``principal_point [B, 2]``,
    ``in_ndc``, and ``image_size [1, 2]`` (height, width) if given: it must be, for an image that
    is not square, and with ``in_ndc=False``. The determinant of R is -1 for the cameras of a
    left-handed world (see above).

    Raises
    ------
    TypeError, ValueError
        For anything but a camera of nmr, a camera with distortion or skew, or a missing or
        impossible image_size.

    Examples
    --------
    >>> camera = nmr.LookAt.from_angles(2.732, 30.0, 45.0, half_fov_deg=15.0, right_handed=True)
    >>> sorted(nmr.cameras.to_pytorch3d(camera))
    ['R', 'T', 'focal_length', 'in_ndc', 'principal_point']
    """
    height, width = _image_size(image_size, in_ndc)
    camera = _without_distortion(camera, "PyTorch3D", height, width)
    shorter, size = min(height, width), torch.tensor([width, height], **_HOST)
    intrinsics, matrix = camera.intrinsics, _PYTORCH3D_AXES * camera.matrix
    if intrinsics[:, 0, 1].any() or intrinsics[:, 1, 0].any():
        raise ValueError(
            "PyTorch3D's focal_length and principal_point cannot express the skew of this camera"
        )
    focal = torch.stack([intrinsics[:, 0, 0], -intrinsics[:, 1, 1]], dim=-1) * (size / shorter)
    centre = torch.stack([-intrinsics[:, 0, 2], intrinsics[:, 1, 2]], dim=-1) * (size / shorter)
    if not in_ndc:
        focal, centre = focal * (shorter / 2), size / 2 - centre * (shorter / 2)
    arguments = dict(
        R=matrix[:, :, :3].transpose(1, 2),
        T=matrix[:, :, 3],
        focal_length=focal,
        principal_point=centre,
        in_ndc=in_ndc,
    )
    return (
        arguments
        if image_size is None
        else arguments | {"image_size": torch.tensor([[height, width]], device="cpu")}
    )
