"""Cameras of other libraries, and the camera operators."""

import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scenes import double, for_threads, normal, same_bits, uniform, value_and_gradients
from torch.autograd import gradcheck
from torch.testing import assert_close

import nmr
from nmr import cameras, ops

SIZE = 48  # pixels of a square image


def rotation(seed):
    """A proper rotation."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.linalg.det(q)


def points(seed=0, n=20):
    return np.random.default_rng(seed).uniform(-0.5, 0.5, size=(n, 3))


def pixels(camera, vertices, size=SIZE):
    """(column, row, depth) where `camera` puts vertices in our images: centres of pixels are integers, row 0 = top."""
    x, y, z = camera.transform(torch.from_numpy(vertices)[None])[0].detach().numpy().T
    return np.stack([((x + 1) * size - 1) / 2, ((1 - y) * size - 1) / 2, z], axis=1)


K = np.array([[60.0, 2.0, 22.0], [0.0, 55.0, 26.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([0.1, -0.05, 0.01, -0.02, 0.03])
T = np.array([0.1, -0.2, 3.0])


def batch_of(*arrays):
    """Arrays as tensors [1, ...]."""
    return [torch.as_tensor(np.asarray(x))[None] for x in arrays]


def opencv_pixels(vertices, K, R, t, d):
    """The formulas of OpenCV's calib3d page; centres of pixels are integers."""
    origin, extent = np.zeros(3), 1.0
    arguments = vertices, np.column_stack([R, t]), K[:2], d, origin, extent
    return chain(*batch_of(*arguments), True)[0].numpy()


@pytest.mark.parametrize("column", [False, True])
@pytest.mark.parametrize("count", [0, 4, 5])
def test_opencv_pixels(count, column):
    d, t = DISTORTION * (np.arange(5) < count), T
    given = d[:count] if count else None
    if column:
        t, given = t[:, None], given[:, None] if count else None
    camera = cameras.from_opencv(K, rotation(1), t, given, height=SIZE, width=SIZE)
    wanted = opencv_pixels(points(), K, rotation(1), T, d)
    assert_allclose(pixels(camera, points()), wanted, atol=1e-10)


def test_pixel_center_is_where_counting_begins():
    """A calibration that counts from the corner of the first pixel is what Pinhole itself takes."""
    given, how = (K, rotation(1), T), dict(height=SIZE, width=SIZE, pixel_center=0.5)
    plain = nmr.Pinhole(*given, orig_size=SIZE)
    camera = cameras.from_opencv(*given, **how)
    assert_allclose(pixels(camera, points()), pixels(plain, points()), atol=1e-12)
    for back, value in zip(cameras.to_opencv(plain, **how), given, strict=False):
        assert_allclose(back[0], value, atol=1e-12)


def opengl_pixels(vertices, view, projection):
    """clip = P V (X, 1), divided by w; the viewport has its origin at the lower left, centres at half-integers."""
    eye = np.column_stack([vertices, np.ones(len(vertices))]) @ view.T
    clip = eye @ projection.T
    from_left, from_below = ((clip[:, k] / clip[:, 3] + 1) / 2 * SIZE for k in (0, 1))
    return np.column_stack([from_left - 0.5, SIZE - from_below - 0.5, -eye[:, 2]])


def gl_view(seed=3):
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = rotation(seed), [0.1, 0.2, -3.0]
    return view


def gl_frustum(left, right, bottom, top, n, f):
    """As glFrustum documents it."""
    width, height, depth = right - left, top - bottom, f - n
    return np.array(
        [
            [2 * n / width, 0, (right + left) / width, 0],
            [0, 2 * n / height, (top + bottom) / height, 0],
            [0, 0, -(f + n) / depth, -2 * f * n / depth],
            [0, 0, -1, 0],
        ]
    )


def gl_ortho(left, right, bottom, top, n, f):
    """As glOrtho documents it."""
    size = np.array([right - left, top - bottom, f - n])
    matrix = np.diag([*(np.array([2, 2, -2]) / size), 1])
    matrix[:3, 3] = -np.array([right + left, top + bottom, f + n]) / size
    return matrix


@pytest.mark.parametrize("make", [gl_frustum, gl_ortho])
def test_opengl_pixels_and_round_trip(make):
    given = gl_view(), make(-0.3, 0.2, -0.1, 0.4, 0.5, 20.0)
    camera = cameras.from_opengl(*given)
    assert_allclose(pixels(camera, points()), opengl_pixels(points(), *given), atol=1e-10)
    for back, value in zip(cameras.to_opengl(camera, near=0.5, far=20.0), given, strict=True):
        assert_allclose(back[0], value, atol=1e-12)


def pytorch3d_pixels(focal, principal, height, width, orthographic=False):
    """NDC as the page on cameras documents it: X left, Y up; the shorter side of the image spans [-1, 1]."""
    x, y, z = (points() @ rotation(4) + T).T
    depth = 1.0 if orthographic else z
    ndc = np.array([focal[0] * x / depth + principal[0], focal[1] * y / depth + principal[1]])
    from_left, from_top = np.array([[width], [height]]) / 2 - ndc * min(height, width) / 2
    # our square image shows all of theirs
    return np.column_stack([from_left / width * SIZE - 0.5, from_top / height * SIZE - 0.5, z])


FOCAL, PRINCIPAL = [1.3, 1.1], [0.2, -0.1]


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("height, width", [(48, 48), (40, 60), (60, 40)])
def test_pytorch3d_pixels_and_round_trip(height, width, orthographic):
    given = dict(R=rotation(4), T=T, focal_length=[FOCAL], principal_point=[PRINCIPAL])
    size = dict(image_size=(height, width))
    camera = cameras.from_pytorch3d(**given, **size, orthographic=orthographic)
    wanted = pytorch3d_pixels(FOCAL, PRINCIPAL, height, width, orthographic)
    assert_allclose(pixels(camera, points()), wanted, atol=1e-10)
    back = cameras.to_pytorch3d(camera, **size)
    assert back.pop("in_ndc") is True and back.pop("image_size").tolist() == [[height, width]]
    for name, value in back.items():
        assert_allclose(value, np.reshape(given[name], value.shape), atol=1e-12)


@pytest.mark.parametrize("height, width", [(40, 60), (60, 40)])
def test_pytorch3d_screen_space(height, width):
    """f_ndc = 2 f / s, p_ndc = -(p - size / 2) 2 / s with s the shorter side."""
    focal, principal = np.array([50.0, 45.0]), np.array([27.0, 22.0])
    how = dict(in_ndc=False, image_size=(height, width))
    camera = cameras.from_pytorch3d(rotation(4), T, [focal], [principal], **how)
    scale = 2 / min(height, width)
    ndc = -(principal - np.array([width, height]) / 2) * scale
    wanted = pytorch3d_pixels(focal * scale, ndc, height, width)
    assert_allclose(pixels(camera, points()), wanted, atol=1e-10)
    back = cameras.to_pytorch3d(camera, **how)
    assert_allclose(back["focal_length"][0], focal)
    assert_allclose(back["principal_point"][0], principal)


@pytest.mark.parametrize("degrees", [True, False])
def test_pytorch3d_field_of_view(degrees):
    """The whole vertical angle; a wider aspect ratio makes x smaller."""
    fov = 50.0 if degrees else math.radians(50.0)
    camera = cameras.from_pytorch3d_fov(rotation(4), T, fov, 1.25, degrees=degrees)
    focal = 1 / math.tan(math.radians(25.0))
    wanted = pytorch3d_pixels([focal / 1.25, focal], [0, 0], SIZE, SIZE)
    assert_allclose(pixels(camera, points()), wanted, atol=1e-10)


UPRIGHT = K * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]  # without skew, which PyTorch3D cannot express
CAMERAS = {
    "LookAt": nmr.LookAt.from_angles(2.0, [10.0, 20.0], [30.0, 200.0], half_fov_deg=[25.0, 30.0]),
    "Look": nmr.Look([0.1, 0.2, -2.0], [0.0, -0.1, 1.0]),
    "Orthographic": nmr.Orthographic([0.1, 0.2, -2.0], scale=0.8),
    "Pinhole": nmr.Pinhole(UPRIGHT, rotation(1), T, orig_size=48),
}


def through(camera, convention, size=(40, 60)):
    if convention == "opencv":
        how = dict(height=size[0], width=size[1])
        return cameras.from_opencv(*cameras.to_opencv(camera, **how), **how)
    if convention == "opengl":
        how = dict(near=0.1, far=10.0, image_size=size)
        return cameras.from_opengl(*cameras.to_opengl(camera, **how))
    how = dict(orthographic=not camera.projection().perspective, image_size=size)
    return cameras.from_pytorch3d(**cameras.to_pytorch3d(camera, image_size=size) | how)


@pytest.mark.parametrize("size", [(48, 48), (40, 60), (60, 40)])
@pytest.mark.parametrize("convention", ["opencv", "opengl", "pytorch3d"])
@pytest.mark.parametrize("name", CAMERAS)
def test_every_camera_survives_every_convention(name, convention, size):
    """Cameras with square pixels keep them in other libraries."""
    camera, vertices = CAMERAS[name], torch.from_numpy(points())[None]
    if (name, convention) == ("Orthographic", "opencv"):
        pytest.skip("OpenCV has no orthographic camera")
    expected = camera.for_image(*size).transform(vertices)
    assert_close(through(camera, convention, size).transform(vertices), expected)


def test_a_proper_rotation_for_mirrored_vertices():
    """The recipe of the module's docs: vertices * (1, 1, -1) and R diag(1, 1, -1)."""
    mirror, size = torch.diag(double([1.0, 1.0, -1.0])), dict(height=48, width=48)
    vertices = torch.from_numpy(points())[None]
    K, R, t, _ = cameras.to_opencv(CAMERAS["LookAt"], **size)
    given = cameras.to_pytorch3d(CAMERAS["Look"])
    for name, proper in (
        ("LookAt", cameras.from_opencv(K, R @ mirror, t, **size)),
        ("Look", cameras.from_pytorch3d(**given | {"R": mirror @ given["R"]})),
    ):
        assert_close(proper.transform(vertices @ mirror), CAMERAS[name].transform(vertices))


def test_conversions_are_differentiable():
    vertices, size = torch.from_numpy(points(n=4))[None], dict(height=SIZE, width=SIZE)

    def opencv(*calibration):
        return through(cameras.from_opencv(*calibration, **size), "opencv").transform(vertices)

    def pytorch3d(eye, *camera):
        first = through(cameras.from_pytorch3d(*camera, image_size=(4, 5)), "pytorch3d")
        second = through(nmr.LookAt(eye), "opengl")
        return first.transform(vertices) + through(second, "pytorch3d").transform(vertices)

    def field_of_view(x):
        return cameras.from_pytorch3d_fov(rotation(4), T, x).transform(vertices)

    for function, values in (
        (opencv, (K, rotation(1), T, DISTORTION)),
        (pytorch3d, ([0.1, 0.2, -2.0], rotation(4), T, [FOCAL], [PRINCIPAL])),
        (field_of_view, ([40.0, 50.0],)),
    ):
        leaves = [torch.as_tensor(x, dtype=torch.float64).requires_grad_() for x in values]
        gradcheck(function, leaves)


def chain(vertices, matrix, intrinsics, distortion, origin, extent, perspective):
    """The definition of `project`, for a batch."""
    u = (vertices - origin[:, None]) @ matrix[:, :, :3].mT + matrix[:, None, :, 3]
    x, y = (u[..., :2] / u[..., 2:] if perspective else u[..., :2]).unbind(-1)
    if distortion is not None and perspective:
        k1, k2, p1, p2, k3 = distortion[:, None].unbind(-1)
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        )
    q = torch.stack([x, y], dim=-1) / extent[:, None, None]
    xy = q @ intrinsics[:, :, :2].mT + intrinsics[:, None, :, 2]
    return torch.cat([xy, u[..., 2:]], dim=-1)


def random_arguments(batch, num_vertices, shared, distorted=True):
    """vertices, matrix, intrinsics, distortion, origin, extent: all general, all vertices in front of the camera."""
    vertices = uniform(1 if shared else batch, num_vertices, 3) - 0.5
    matrix, intrinsics = normal(batch, 3, 4), normal(batch, 2, 3, seed=1)
    matrix[:, 2] = torch.tensor([0.1, -0.2, 1.0, 3.0])
    # all vertices are within its reach
    distortion = 0.01 * normal(batch, 5, seed=2) if distorted else None
    origin, extent = 0.1 * normal(batch, 3, seed=3), 0.5 + uniform(batch, seed=1)
    return vertices, matrix, intrinsics, distortion, origin, extent


def project(vertices, matrix, intrinsics, distortion, origin, extent, perspective=True):
    parts = matrix, intrinsics, origin, extent, distortion
    how = False, False, perspective, 1.0, 1.0
    return ops.project(vertices, None, None, None, None, None, *parts, *how)[0]


@pytest.mark.parametrize("distorted", [True, False])
@pytest.mark.parametrize("shared", [False, True])
def test_project_is_the_chain_and_its_gradient(perspective, distorted, shared):
    """1100 vertices: several chunks, and a last group that is not full."""
    arguments = random_arguments(3, 1100, shared, distorted)
    given = [x for x in arguments if x is not None]

    def through_all(function):
        def call(*given):
            rest = iter(given)
            return function(*(None if x is None else next(rest) for x in arguments), perspective)

        return call

    (got, *grads), (wanted, *wanted_grads) = (
        value_and_gradients(through_all(function), *given) for function in (project, chain)
    )
    assert_close(got, wanted, rtol=1e-12, atol=1e-12)
    assert_close(grads, wanted_grads, rtol=1e-10, atol=1e-10)
    given = [x.float() for x in given]
    one, *others = for_threads((1, 2, 5), lambda: value_and_gradients(through_all(project), *given))
    assert all(same_bits(one, other) for other in others)
