"""Cameras of other libraries, and the camera operators."""

import math

import numpy as np
import pytest
import torch

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


def opencv_pixels(vertices, K, R, t, d):
    """The formulas of OpenCV's calib3d page; centres of pixels are integers."""
    k1, k2, p1, p2, k3 = d
    out = []
    for X in vertices:
        x, y, z = R @ X + t
        a, b = x / z, y / z
        r2 = a * a + b * b
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
        v = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
        out.append([K[0, 0] * u + K[0, 1] * v + K[0, 2], K[1, 1] * v + K[1, 2], z])
    return np.array(out)


T = np.array([0.1, -0.2, 3.0])


@pytest.mark.parametrize("column", [False, True])
@pytest.mark.parametrize("count", [0, 4, 5])
def test_opencv_pixels(count, column):
    d = np.zeros(5)
    d[:count] = DISTORTION[:count]
    shape = (-1, 1) if column else (-1,)
    camera = cameras.from_opencv(
        K,
        rotation(1),
        T.reshape(shape),
        d[:count].reshape(shape) if count else None,
        height=SIZE,
        width=SIZE,
    )
    np.testing.assert_allclose(
        pixels(camera, points()), opencv_pixels(points(), K, rotation(1), T, d), atol=1e-10
    )


def test_pixel_center_is_where_counting_begins():
    """A calibration that counts from the corner of the first pixel is what Pinhole itself takes."""
    camera = cameras.from_opencv(K, rotation(1), T, height=SIZE, width=SIZE, pixel_center=0.5)
    plain = nmr.Pinhole(K, rotation(1), T, orig_size=SIZE)
    np.testing.assert_allclose(pixels(camera, points()), pixels(plain, points()), atol=1e-12)
    back = cameras.to_opencv(plain, height=SIZE, width=SIZE, pixel_center=0.5)
    for a, b in zip(back[:3], (K, rotation(1), T), strict=True):
        np.testing.assert_allclose(a[0], b, atol=1e-12)


def opengl_pixels(vertices, view, projection):
    """clip = P V (X, 1), divided by w; the viewport has its origin at the lower left, centres at half-integers."""
    out = []
    for X in vertices:
        eye = view @ [*X, 1.0]
        clip = projection @ eye
        x, y = clip[:2] / clip[3]
        from_left, from_below = (x + 1) / 2 * SIZE, (y + 1) / 2 * SIZE
        out.append([from_left - 0.5, SIZE - from_below - 0.5, -eye[2]])
    return np.array(out)


def gl_view(seed=3):
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = rotation(seed), [0.1, 0.2, -3.0]
    return view


def gl_frustum(left, right, bottom, top, n, f):
    """As glFrustum documents it."""
    return np.array(
        [
            [2 * n / (right - left), 0, (right + left) / (right - left), 0],
            [0, 2 * n / (top - bottom), (top + bottom) / (top - bottom), 0],
            [0, 0, -(f + n) / (f - n), -2 * f * n / (f - n)],
            [0, 0, -1, 0],
        ]
    )


def gl_ortho(left, right, bottom, top, n, f):
    """As glOrtho documents it."""
    return np.array(
        [
            [2 / (right - left), 0, 0, -(right + left) / (right - left)],
            [0, 2 / (top - bottom), 0, -(top + bottom) / (top - bottom)],
            [0, 0, -2 / (f - n), -(f + n) / (f - n)],
            [0, 0, 0, 1],
        ]
    )


@pytest.mark.parametrize("make", [gl_frustum, gl_ortho])
def test_opengl_pixels_and_round_trip(make):
    projection = make(-0.3, 0.2, -0.1, 0.4, 0.5, 20.0)
    camera = cameras.from_opengl(gl_view(), projection)
    np.testing.assert_allclose(
        pixels(camera, points()), opengl_pixels(points(), gl_view(), projection), atol=1e-10
    )
    view, back = cameras.to_opengl(camera, near=0.5, far=20.0)
    np.testing.assert_allclose(view[0], gl_view(), atol=1e-12)
    np.testing.assert_allclose(back[0], projection, atol=1e-12)


def pytorch3d_pixels(vertices, R, T, focal, principal, height, width, orthographic=False):
    """NDC as the page on cameras documents it: X left, Y up; the shorter side of the image spans [-1, 1]."""
    out = []
    for X in vertices:
        x, y, z = X @ R + T
        depth = 1.0 if orthographic else z
        x_ndc, y_ndc = focal[0] * x / depth + principal[0], focal[1] * y / depth + principal[1]
        shorter = min(height, width)
        from_left, from_top = width / 2 - x_ndc * shorter / 2, height / 2 - y_ndc * shorter / 2
        # our square image shows all of theirs
        out.append([from_left / width * SIZE - 0.5, from_top / height * SIZE - 0.5, z])
    return np.array(out)


FOCAL, PRINCIPAL = [1.3, 1.1], [0.2, -0.1]


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("height, width", [(48, 48), (40, 60), (60, 40)])
def test_pytorch3d_pixels_and_round_trip(height, width, orthographic):
    camera = cameras.from_pytorch3d(
        rotation(4), T, [FOCAL], [PRINCIPAL], image_size=(height, width), orthographic=orthographic
    )
    wanted = pytorch3d_pixels(
        points(), rotation(4), T, FOCAL, PRINCIPAL, height, width, orthographic
    )
    np.testing.assert_allclose(pixels(camera, points()), wanted, atol=1e-10)
    back = cameras.to_pytorch3d(camera, image_size=(height, width))
    assert back["in_ndc"] is True and back["image_size"].tolist() == [[height, width]]
    for name, value in {
        "R": rotation(4),
        "T": T,
        "focal_length": FOCAL,
        "principal_point": PRINCIPAL,
    }.items():
        np.testing.assert_allclose(back[name][0], value, atol=1e-12)


@pytest.mark.parametrize("height, width", [(40, 60), (60, 40)])
def test_pytorch3d_screen_space(height, width):
    """f_ndc = 2 f / s, p_ndc = -(p - size / 2) 2 / s with s the shorter side."""
    s, focal, principal = min(height, width), np.array([50.0, 45.0]), np.array([27.0, 22.0])
    camera = cameras.from_pytorch3d(
        rotation(4), T, [focal], [principal], in_ndc=False, image_size=(height, width)
    )
    ndc = -(principal - np.array([width, height]) / 2) * 2 / s
    wanted = pytorch3d_pixels(points(), rotation(4), T, focal * 2 / s, ndc, height, width)
    np.testing.assert_allclose(pixels(camera, points()), wanted, atol=1e-10)
    back = cameras.to_pytorch3d(camera, in_ndc=False, image_size=(height, width))
    np.testing.assert_allclose(back["focal_length"][0], focal)
    np.testing.assert_allclose(back["principal_point"][0], principal)


@pytest.mark.parametrize("degrees", [True, False])
def test_pytorch3d_field_of_view(degrees):
    """The whole vertical angle; a wider aspect ratio makes x smaller."""
    fov = 50.0 if degrees else math.radians(50.0)
    camera = cameras.from_pytorch3d_fov(rotation(4), T, fov, 1.25, degrees=degrees)
    focal = 1 / math.tan(math.radians(25.0))
    wanted = pytorch3d_pixels(points(), rotation(4), T, [focal / 1.25, focal], [0, 0], SIZE, SIZE)
    np.testing.assert_allclose(pixels(camera, points()), wanted, atol=1e-10)


CAMERAS = {
    "LookAt": nmr.LookAt.from_angles(2.0, [10.0, 20.0], [30.0, 200.0], half_fov_deg=[25.0, 30.0]),
    "Look": nmr.Look([0.1, 0.2, -2.0], [0.0, -0.1, 1.0]),
    "Orthographic": nmr.Orthographic([0.1, 0.2, -2.0], scale=0.8),
    "Pinhole": nmr.Pinhole(
        np.diag([60.0, 55.0, 1.0]) + [[0, 0, 22], [0, 0, 26], [0, 0, 0]],
        rotation(1),
        T,
        orig_size=48,
    ),
}


def through(camera, convention):
    if convention == "opencv":
        return cameras.from_opencv(
            *cameras.to_opencv(camera, height=40, width=60), height=40, width=60
        )
    if convention == "opengl":
        return cameras.from_opengl(*cameras.to_opengl(camera, near=0.1, far=10.0))
    arguments = cameras.to_pytorch3d(camera)
    return cameras.from_pytorch3d(**arguments, orthographic=not camera.projection().perspective)


@pytest.mark.parametrize("convention", ["opencv", "opengl", "pytorch3d"])
@pytest.mark.parametrize("name", CAMERAS)
def test_every_camera_survives_every_convention(name, convention):
    camera = CAMERAS[name]
    if (name, convention) == ("Orthographic", "opencv"):
        pytest.skip("OpenCV has no orthographic camera")
    vertices = torch.from_numpy(points())[None]
    expected = camera.for_image(40, 60) if convention == "opencv" else camera
    torch.testing.assert_close(
        through(camera, convention).transform(vertices), expected.transform(vertices)
    )


@pytest.mark.parametrize("size", [(40, 60), (60, 40)])
@pytest.mark.parametrize("name", CAMERAS)
def test_images_that_are_not_square(name, size):
    """Cameras with square pixels keep them in other libraries, and PyTorch3D's numbers belong to the shorter side."""
    camera, vertices = CAMERAS[name], torch.from_numpy(points())[None]
    expected = camera.for_image(*size).transform(vertices)
    assert (name == "Pinhole") == torch.equal(expected, camera.transform(vertices))
    opengl = cameras.to_opengl(camera, near=0.1, far=10.0, image_size=size)
    torch.testing.assert_close(cameras.from_opengl(*opengl).transform(vertices), expected)
    arguments = cameras.to_pytorch3d(camera, image_size=size)
    assert arguments.pop("image_size").tolist() == [list(size)]
    arguments["orthographic"] = not camera.projection().perspective
    sized = cameras.from_pytorch3d(**arguments, image_size=size)
    torch.testing.assert_close(sized.transform(vertices), expected)
    free = cameras.from_pytorch3d(**arguments).for_image(*size)
    torch.testing.assert_close(free.transform(vertices), expected)


def test_a_proper_rotation_for_mirrored_vertices():
    """The recipe of the module's docs: vertices * (1, 1, -1) and R diag(1, 1, -1)."""
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    vertices = torch.from_numpy(points())[None]
    K, R, t, _ = cameras.to_opencv(CAMERAS["LookAt"], height=48, width=48)
    proper = cameras.from_opencv(K, R @ mirror, t, height=48, width=48)
    wanted = CAMERAS["LookAt"].transform(vertices)
    torch.testing.assert_close(proper.transform(vertices @ mirror), wanted)
    given = cameras.to_pytorch3d(CAMERAS["Look"])
    proper = cameras.from_pytorch3d(**given | {"R": mirror @ given["R"]})
    torch.testing.assert_close(
        proper.transform(vertices @ mirror), CAMERAS["Look"].transform(vertices)
    )


def test_conversions_are_differentiable():
    def parameter(values):
        return torch.as_tensor(values, dtype=torch.float64).requires_grad_()

    vertices = torch.from_numpy(points(n=4))[None]

    def opencv(K, R, t, d):
        return through(
            cameras.from_opencv(K, R, t, d, height=SIZE, width=SIZE), "opencv"
        ).transform(vertices)

    assert torch.autograd.gradcheck(opencv, tuple(map(parameter, (K, rotation(1), T, DISTORTION))))

    def pytorch3d(R, t, f, p, eye):
        first = cameras.from_pytorch3d(R, t, f, p, image_size=(4, 5))
        second = through(nmr.LookAt(eye), "pytorch3d")
        return through(first, "pytorch3d").transform(vertices) + through(
            second, "opengl"
        ).transform(vertices)

    values = rotation(4), T, [FOCAL], [PRINCIPAL], [0.1, 0.2, -2.0]
    assert torch.autograd.gradcheck(pytorch3d, tuple(map(parameter, values)))
    fov = parameter([40.0, 50.0])
    assert torch.autograd.gradcheck(
        lambda x: cameras.from_pytorch3d_fov(rotation(4), T, x).transform(vertices), fov
    )


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


def random_arguments(
    batch, num_vertices, *, shared=False, distorted=True, dtype=torch.float64, seed=0
):
    """vertices, matrix, intrinsics, distortion, origin, extent: all general, all vertices in front of the camera."""
    torch.manual_seed(seed)
    vertices = torch.rand(1 if shared else batch, num_vertices, 3, dtype=torch.float64) - 0.5
    matrix, intrinsics = torch.randn(batch, 3, 4), torch.randn(batch, 2, 3)
    matrix[:, 2] = torch.tensor([0.1, -0.2, 1.0, 3.0])
    # all vertices are within its reach
    distortion = 0.01 * torch.randn(batch, 5) if distorted else None
    arguments = (
        vertices,
        matrix,
        intrinsics,
        distortion,
        0.1 * torch.randn(batch, 3),
        0.5 + torch.rand(batch),
    )
    return [None if x is None else x.to(dtype) for x in arguments]


def project(
    vertices, matrix, intrinsics, distortion, origin, extent, perspective=True, starts=None
):
    origin = torch.zeros_like(matrix[:, 0, :3]) if origin is None else origin
    extent = torch.ones_like(matrix[:, 0, 0]) if extent is None else extent
    camera = torch.cat(
        [matrix.flatten(1), intrinsics.flatten(1), origin, extent.unsqueeze(1)], dim=1
    )
    return ops.project(vertices, camera, distortion, starts, perspective)


@pytest.mark.parametrize(
    "perspective, distorted", [(True, True), (True, False), (False, False), (False, True)]
)
@pytest.mark.parametrize("shared", [False, True])
def test_project_is_the_chain_and_its_gradient(perspective, distorted, shared):
    """1100 vertices: several chunks, and a last group that is not full."""
    arguments = random_arguments(3, 1100, shared=shared, distorted=distorted)
    inputs = [x.requires_grad_() for x in arguments if x is not None]
    upstream = torch.randn(3, 1100, 3, dtype=torch.float64)
    got, wanted = project(*arguments, perspective), chain(*arguments, perspective)
    torch.testing.assert_close(got, wanted, rtol=1e-12, atol=1e-12)
    kwargs = {"grad_outputs": upstream, "allow_unused": True, "materialize_grads": True}
    for a, b in zip(
        torch.autograd.grad(got, inputs, **kwargs),
        torch.autograd.grad(wanted, inputs, **kwargs),
        strict=True,
    ):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("shared", [False, True])
def test_same_bits_for_any_number_of_threads(shared):
    arguments = random_arguments(5, 1500, shared=shared, dtype=torch.float32)
    upstream, before, results = torch.randn(5, 1500, 3), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            inputs = [x.clone().requires_grad_() for x in arguments]
            out = project(*inputs)
            results.append([out.detach(), *torch.autograd.grad(out, inputs, upstream)])
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
