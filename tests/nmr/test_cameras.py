"""Cameras: geometry, published values and gradients, batches, packed meshes, vertices without an image, errors."""

import functools
import math
import warnings
from dataclasses import replace

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from scenes import any_number, double, leaf_of, same_bits, uniform, value_and_gradients
from torch.autograd import gradcheck
from torch.testing import assert_close
from vectors import load_vector, tensors_of

import nmr
import nmr.neural_renderer as nr
from nmr.cameras import Projection, points_from_angles


@pytest.mark.parametrize("fov", [30.0, torch.tensor(30.0), torch.tensor([30.0]), [30.0]])
def test_axes_from_azimuth_zero(fov):
    """The eye is on -z: x points right, y up, and the edge of the field of view maps to 1."""
    edge = 2.0 * math.tan(math.radians(30.0))
    points = torch.tensor([[edge, 0.0, 0.0], [0.0, edge, 0.0], [0.0, 0.0, 1.0]])
    expected = torch.tensor([[[1.0, 0.0, 2.0], [0.0, 1.0, 2.0], [0.0, 0.0, 3.0]]])
    for camera in (
        nmr.LookAt.from_angles(2.0, 0.0, 0.0, half_fov_deg=fov),
        nmr.Look([0.0, 0.0, -2.0], [0.0, 0.0, 0.1], half_fov_deg=fov),
    ):
        assert_close(camera.transform(points), expected, atol=1e-6, rtol=0)


def test_orthographic_keeps_sizes():
    camera = nmr.Orthographic([0.0, 0.0, -2.0], scale=0.5)
    points = torch.tensor([[0.4, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 2.0, 7.0]])
    expected = torch.tensor([[[0.2, 0.0, 2.0], [0.0, 1.0, 2.0], [0.0, 1.0, 9.0]]])
    assert_close(camera.transform(points), expected, atol=1e-6, rtol=0)


def identity_intrinsics(camera, dtype=torch.float32):
    """The same camera without perspective: what `look_at` and `look` return on their own."""
    return replace(camera.projection(dtype), perspective=False, extent=None)


ORIGIN, FORWARD = [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]
VECTOR_CAMERAS = {
    "look_at": lambda a: identity_intrinsics(nmr.LookAt(a["eye"])),
    "look_at_1d": lambda a: nmr.Orthographic(a["eye"]),
    "look_at_full": lambda a: nmr.Orthographic(a["eye"], a["at"], a["up"]),
    "look": lambda a: identity_intrinsics(nmr.Look(a["eye"], a["direction"])),
    "look_up": lambda a: identity_intrinsics(nmr.Look(a["eye"], a["direction"], a["up"])),
    "perspective_30": lambda a: nmr.LookAt(ORIGIN, FORWARD, half_fov_deg=30.0),
    "perspective_15": lambda a: nmr.LookAt(ORIGIN, FORWARD, half_fov_deg=15.0),
    "perspective_14.9314": lambda a: nmr.Look(ORIGIN, half_fov_deg=torch.tensor([14.9314])),
    "projection": lambda a: nmr.Pinhole(a["K"], a["R"], a["t"], a["dist_coeffs"], orig_size=256),
}
DROP_IN = {
    "look": nr.look,
    "look_at": nr.look_at,
    "perspective": nr.perspective,
    "perspective_15": functools.partial(nr.perspective, angle=15),
    "perspective_14.9314": functools.partial(nr.perspective, angle=14.9314),
    "projection": functools.partial(nr.projection, orig_size=256.0),
}


@pytest.mark.parametrize("drop_in", [False, True])
@pytest.mark.parametrize("name", VECTOR_CAMERAS)
def test_published_values_and_gradients(name, drop_in):
    v = load_vector("cameras")
    arguments, wanted = tensors_of(v, f"{name}_in_"), v[f"{name}_out"]
    published = tensors_of(v, f"{name}_grad_")

    def transform(*values):
        given = dict(zip(arguments, values, strict=True))
        if drop_in:
            return DROP_IN[name if name in DROP_IN else name.rsplit("_", 1)[0]](**given)
        return VECTOR_CAMERAS[name](given).transform(given["vertices"])

    upstream = torch.from_numpy(v["upstream"])
    out, *grads = value_and_gradients(transform, *arguments.values(), upstream=upstream)
    out = out.numpy()
    if drop_in or name == "projection":  # the published one rounds pixels, ours does not
        np.testing.assert_allclose(out, wanted, rtol=1e-6, atol=1e-6)
    elif name.startswith("perspective"):  # the published tangent is rounded up or down
        plain = VECTOR_CAMERAS[name](arguments).projection(torch.float32)
        tangents = [plain.extent.nextafter(torch.tensor(x)) for x in (0.0, 9.0)]
        others = [replace(plain, extent=x).transform(arguments["vertices"]) for x in tangents]
        assert any(np.array_equal(x, wanted) for x in (out, *others))
    else:
        assert np.array_equal(out, wanted)
    for key, grad in zip(arguments, grads, strict=True):
        assert (grad - published[key]).norm() < 5e-6 * published[key].norm(), key


def test_the_tangent_is_rounded_to_nearest():
    """In torch, that of a float32 depends on the processor. The angle is rounded to float32 first, as published."""
    degrees = [0.5 + 0.37 * k for k in range(240)]
    wanted = np.tan(np.radians(degrees).astype(np.float32).astype(np.float64)).astype(np.float32)

    def extent(fov):
        camera = nmr.LookAt([0.0, 0.0, -1.0], half_fov_deg=fov)
        return camera.projection(torch.float32).extent.numpy()

    assert np.array_equal(extent(double(degrees)), wanted)
    assert np.array_equal(np.concatenate([extent(x) for x in degrees]), wanted)


def test_published_degenerate_poses():
    """The eye on the up axis, or at the target: rows of zeros, not an error."""
    v = tensors_of(load_vector("cameras_degenerate"), "")
    out, grad = value_and_gradients(
        lambda eye: nmr.Orthographic(eye).transform(v["vertices"]), v["eye"]
    )
    assert torch.equal(out, v["look_at_out"]) and grad.isfinite().all()


EYES, ATS, UPS = [[0.3, 1.0, -3.0], [2.0, 0.5, 1.0]], [[0.1, 0.0, 0.2]], [0.1, 1.0, 0.2]
CALIBRATION = [[[200.0, 3.0, 120.0], [1.0, 210.0, 130.0], [0.0, 0.0, 1.0]]]
GRADCHECKS = {
    "LookAt": (nmr.LookAt, EYES, ATS, UPS, 25.0),
    "LookAt, a fov each": (nmr.LookAt, EYES, ATS, UPS, [25.0, 30.0]),
    "Look": (nmr.Look, EYES, [[-0.1, -0.3, 1.0], [-1.0, -0.2, -0.4]], UPS, [25.0]),
    "Orthographic": (nmr.Orthographic, EYES, ATS, UPS, [0.7, 0.8]),
    "right-handed": (functools.partial(nmr.LookAt, right_handed=True), EYES, ATS, UPS, 25.0),
    "Pinhole": (
        lambda *a: nmr.Pinhole(*a, orig_size=(240, 256)),
        CALIBRATION,
        [[0.9, 0.1, 0.0], [-0.1, 1.0, 0.2], [0.1, -0.2, 1.0]],
        [[0.1, 0.2, 2.0], [-0.1, 0.1, 3.0]],
        [[0.1, -0.05, 0.01, 0.02, 0.03]],
    ),
}


@pytest.mark.parametrize("name", GRADCHECKS)
def test_gradcheck_in_all_parameters(name):
    make, *values = GRADCHECKS[name]
    gradcheck(
        lambda points, *parameters: make(*parameters).transform(points),
        [leaf_of(x) for x in (uniform(1, 5, 3), *map(double, values))],
    )


@pytest.mark.parametrize("make, name", [(nmr.LookAt, "half_fov_deg"), (nmr.Orthographic, "scale")])
def test_fields_of_view_and_scales_under_vmap(make, name):
    points, values = torch.rand(1, 5, 3), torch.tensor([20.0, 30.0])

    def transform(value):
        return make([0.0, 0.0, -3.0], **{name: value}).transform(points)

    many = torch.func.vmap(transform)(values)
    assert torch.equal(many, torch.stack([transform(x) for x in values]))


@pytest.mark.parametrize(
    "make",
    [
        lambda **how: nmr.LookAt.from_angles(3.0, 30.0, [20.0, 90.0], **how),
        lambda **how: nmr.Look([1.0, 1.0, -3.0], [-0.3, -0.3, 1.0], **how),
        lambda **how: nmr.Orthographic([1.0, 1.0, -3.0], scale=0.7, **how),
    ],
)
def test_a_right_handed_camera_shows_the_picture_flipped(make):
    """It sees mesh files as they are: the outside of their faces is the front, and rotations are proper."""
    vertices, faces = nmr.icosphere(2)
    vertices = vertices * (1 + 0.5 * torch.tensor([1.0, 0.3, 0.1]) * (vertices[:, :1] > 0))
    left, right, size = make(), make(right_handed=True), dict(image_size=32)
    mirror = torch.tensor([-1.0, 1.0, 1.0])
    assert torch.equal(right.transform(vertices), left.transform(vertices) * mirror)
    for draw in (nmr.render_depth, nmr.render_normals):
        image = draw(vertices, faces, left, **size)
        assert image.min() < 90
        assert_close(draw(vertices, faces, right, **size), image.flip(2))
    front, both = (
        nmr.render_depth(vertices, faces, right, fill_back=fill_back, **size)
        for fill_back in (False, True)
    )
    assert_close(front, both)
    if not isinstance(right, nmr.Orthographic):
        rotation = nmr.cameras.to_opencv(right, height=32, width=32)[1]
        assert_close(torch.linalg.det(rotation), torch.ones(len(rotation)).to(rotation))


def test_looking_straight_down_warns():
    def alpha(elevations, words):
        with pytest.warns(UserWarning, match=words):
            camera = nmr.LookAt.from_angles(3.0, elevations, 0.0)
        return nmr.render_silhouette(*nmr.icosphere(1), camera, image_size=16)

    plain, above = alpha([30.0, 90.0], "camera 1 of 2 looks along its up vector, .* up=")
    assert plain.any() and not above.any()
    squeezed = alpha(89.9999, "squeezed to a part of its width, or empty")
    assert 0 < squeezed.sum() < 0.5 * plain.sum()


@pytest.mark.parametrize(
    "down",
    [
        lambda up: nmr.Look([0.0, 3.0, 0.0], [0.0, -1.0, 0.0], up),
        lambda up: nmr.Orthographic([0.0, 3.0, 0.0], up=up),
        lambda up: nmr.LookAt.from_angles(3.0, -90.0, 0.0, up=up),
    ],
)
def test_another_up_shows_the_object_from_above(down):
    with pytest.warns(UserWarning, match="camera 0 of 1"):
        down((0.0, 2.0, 0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        camera = down((0.0, 0.0, 1.0))
    assert nmr.render_silhouette(*nmr.icosphere(1), camera, image_size=16).any()


def test_vertices_without_an_image(dtype):
    """In the plane of the eye, at it, not finite, overflowing: nowhere, and no gradient, not even an upstream NaN."""
    nan, inf, most = math.nan, math.inf, torch.finfo(dtype).max
    bad = [[1.0, 0, -2], [0, 0, -2], [nan, 0, 0], [0, inf, 0], [0, 0, -inf], [most, 0, -1.5]]
    good = torch.tensor([[[0.1, 0.2, 0.3], [0.3, -0.1, 0.0]]], dtype=dtype)
    vertices = torch.cat([torch.tensor([bad], dtype=dtype), good], dim=1)
    parameters = torch.tensor([0.0, 0.0, -2.0], dtype=dtype), torch.tensor(30.0, dtype=dtype)
    upstream = torch.ones_like(vertices)
    upstream[0, :6] = nan

    def draw(vertices, eye, fov):
        return nmr.LookAt(eye, half_fov_deg=fov).transform(vertices)

    out, grad, *grads = value_and_gradients(draw, vertices, *parameters, upstream=upstream)
    assert (out[0, :6, :2] == inf).all()
    assert out[..., 2].isfinite().all() and out[0, 6:].isfinite().all()
    assert not grad[0, :6].any() and grad[0, 6:].all()
    assert same_bits(
        grads, value_and_gradients(draw, good, *parameters, upstream=upstream[:, 6:])[2:]
    )


def test_the_optical_axis_has_a_gradient():
    """Upstream takes the root of r^2, whose derivative is not finite on the axis (defect 14, fixed)."""
    camera = nmr.Pinhole(
        CALIBRATION, torch.eye(3), [0.0, 0.0, 2.0], [0.1, 0.2, 0.1, 0.2, 0.3], orig_size=256
    )
    vertices = torch.zeros(1, 1, 3, dtype=torch.float64, requires_grad=True)
    gradcheck(camera.transform, vertices)


@settings(max_examples=60, deadline=None)
@given(
    hnp.arrays(np.float64, (2, 5, 3), elements=any_number),
    hnp.arrays(np.float64, (17,), elements=any_number),
)
def test_a_pinhole_gives_no_nan(vertices, calibration):
    """Any vertices through any calibration; of the other cameras this is a test of the kernels."""
    vertices, calibration = torch.from_numpy(vertices), torch.from_numpy(calibration)
    K, t, d = calibration[:9].view(3, 3), calibration[9:12], calibration[12:]
    out, *grads = value_and_gradients(
        lambda x, K, t, d: nmr.Pinhole(K, torch.eye(3), t, d, orig_size=2).transform(x),
        vertices,
        *(K, t, d),
    )
    nowhere = out[..., 0] == math.inf
    assert not out.isnan().any() and (out[nowhere][:, 1] == math.inf).all()
    assert out[~nowhere][:, :2].isfinite().all()
    assert not any(grad.isnan().any() for grad in grads) and not grads[0][nowhere].any()


def test_a_camera_of_ones_own_can_give_a_projection():
    matrix, intrinsics = torch.eye(3, 4)[None], torch.eye(2, 3)[None]

    class Affine(nmr.cameras.ProjectingCamera):
        def projection(self, dtype=torch.float64):
            return Projection(matrix.to(dtype), intrinsics.to(dtype), perspective=False)

    points = torch.rand(2, 3, 3)
    assert torch.equal(Affine().transform(points), points)
    whole = Projection(matrix.long(), intrinsics.long())
    assert whole.matrix.dtype == whole.intrinsics.dtype == torch.float64
    with pytest.raises(NotImplementedError):
        nmr.cameras.ProjectingCamera().transform(points)


EYE, K = [0.0, 0.0, -2.0], torch.eye(3)


def test_tensors_in_lists_keep_their_gradient():
    """torch.as_tensor([tensor, 0.0]) would cut them off without a word."""
    points, eye = uniform(2, 3, 3), double([[0.3, 0.0, -2.0], [0.0, 1.0, -2.0]])

    def nested(eye):
        (x, _, z), second = eye
        return nmr.LookAt([[x, 0.0, z], second]).transform(points)

    (out, grad), (plain, wanted) = (
        value_and_gradients(draw, eye)
        for draw in (nested, lambda eye: nmr.LookAt(eye).transform(points))
    )
    wanted[0, 1] = 0
    assert_close([out, grad], [plain, wanted])
    two = torch.tensor(2.0)
    _, slope = value_and_gradients(lambda x: points_from_angles([x, 1.0], 0.0, 0.0).sum(), two)
    assert slope == -1
    _, slope = value_and_gradients(
        lambda x: (
            nmr.Pinhole(K, K, [0.0, 0.0, x], orig_size=2).transform(torch.rand(7, 3))[..., 2].sum()
        ),
        two,
    )
    assert slope == 7


def test_empty_batches():
    camera = nmr.LookAt(EYE)
    assert camera.transform(torch.zeros(0, 4, 3)).shape == (0, 4, 3)
    assert camera.transform(torch.zeros(0, 3), torch.zeros(1, 2, dtype=torch.int64)).shape == (0, 3)


@pytest.mark.parametrize(
    "camera",
    [
        nmr.LookAt(torch.rand(0, 3)),
        nmr.Orthographic(EYE, scale=torch.rand(0)),
        nmr.Pinhole(K, K, torch.rand(0, 3), orig_size=2),
        nmr.cameras.from_pytorch3d(K, torch.rand(0, 3)),
    ],
)
def test_no_cameras_at_all(camera):
    out, grad = value_and_gradients(camera.transform, torch.rand(4, 3))
    assert out.shape == (0, 4, 3) and not grad.any()
