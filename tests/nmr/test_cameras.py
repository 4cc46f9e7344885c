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
from hypothesis import strategies as st
from vectors import load_vector

import nmr
import nmr.neural_renderer
from nmr.cameras import Projection, points_from_angles


def test_the_origin_is_at_the_centre_at_the_eye_distance():
    camera = nmr.LookAt.from_angles(2.5, [0.0, 30.0, -40.0], [0.0, 77.0, 200.0])
    out = camera.transform(torch.zeros(1, 1, 3))
    torch.testing.assert_close(
        out, torch.tensor([[[0.0, 0.0, 2.5]]]).expand(3, 1, 3), atol=1e-6, rtol=0
    )


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
        torch.testing.assert_close(camera.transform(points), expected, atol=1e-6, rtol=0)


def test_orthographic_keeps_sizes():
    camera = nmr.Orthographic([0.0, 0.0, -2.0], scale=0.5)
    points = torch.tensor([[0.4, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 2.0, 7.0]])
    expected = torch.tensor([[[0.2, 0.0, 2.0], [0.0, 1.0, 2.0], [0.0, 1.0, 9.0]]])
    torch.testing.assert_close(camera.transform(points), expected, atol=1e-6, rtol=0)


# (crossed along the batch) and no vertex on the optical axis (NaN). Those two are tested further down.


def identity_intrinsics(camera, dtype=torch.float32):
    """The same camera without perspective: what `look_at` and `look` return on their own."""
    return replace(camera.projection(dtype), perspective=False, extent=None)


VECTOR_CAMERAS = {
    "look_at": lambda a: identity_intrinsics(nmr.LookAt(a["eye"])),
    "look_at_1d": lambda a: nmr.Orthographic(a["eye"]),
    "look_at_full": lambda a: nmr.Orthographic(a["eye"], a["at"], a["up"]),
    "look": lambda a: identity_intrinsics(nmr.Look(a["eye"], a["direction"])),
    "look_up": lambda a: identity_intrinsics(nmr.Look(a["eye"], a["direction"], a["up"])),
    "perspective_30": lambda a: nmr.LookAt([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], half_fov_deg=30.0),
    "perspective_15": lambda a: nmr.LookAt([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], half_fov_deg=15.0),
    "perspective_14.9314": lambda a: nmr.Look(
        [0.0, 0.0, 0.0], half_fov_deg=torch.tensor([14.9314])
    ),
    "projection": lambda a: nmr.Pinhole(a["K"], a["R"], a["t"], a["dist_coeffs"], orig_size=256),
}


@pytest.mark.parametrize("name", VECTOR_CAMERAS)
def test_published_values_and_gradients(name):
    v = load_vector("cameras")
    prefix = f"{name}_in_"
    arguments = {
        key.removeprefix(prefix): torch.from_numpy(v[key]).requires_grad_()
        for key in v
        if key.startswith(prefix)
    }
    camera, wanted = VECTOR_CAMERAS[name](arguments), v[f"{name}_out"]
    out = camera.transform(arguments["vertices"])
    out.backward(torch.from_numpy(v["upstream"]))
    if name == "projection":  # the published one rounds pixels, this one does not
        np.testing.assert_allclose(out.detach().numpy(), wanted, rtol=0, atol=1e-6)
    elif name.startswith(
        "perspective"
    ):  # the published tangent is rounded up or down, ours to the nearest number
        plain = camera.projection(torch.float32)
        tangents = [plain.extent] + [plain.extent.nextafter(torch.tensor(x)) for x in (0.0, 9.0)]
        outs = [
            replace(plain, extent=x).transform(arguments["vertices"]).detach().numpy()
            for x in tangents
        ]
        assert np.array_equal(out.detach().numpy(), outs[0])
        assert any(np.array_equal(x, wanted) for x in outs)
    else:
        assert np.array_equal(out.detach().numpy(), wanted)
    for key, argument in arguments.items():
        expected = v[f"{name}_grad_{key}"]
        error = np.linalg.norm(argument.grad.numpy() - expected) / np.linalg.norm(expected)
        assert error < 5e-6, (key, error)


def test_the_tangent_is_rounded_to_nearest():
    """In torch, that of a float32 depends on the processor. The angle is rounded to float32 first, as published."""
    degrees = [0.5 + 0.37 * k for k in range(240)]
    wanted = np.tan(np.radians(degrees).astype(np.float32).astype(np.float64)).astype(np.float32)
    many = nmr.LookAt([0.0, 0.0, -1.0], half_fov_deg=torch.tensor(degrees, dtype=torch.float64))
    assert np.array_equal(many.projection(torch.float32).extent.numpy(), wanted)
    each = [
        nmr.LookAt([0.0, 0.0, -1.0], half_fov_deg=x).projection(torch.float32).extent.item()
        for x in degrees
    ]
    assert np.array_equal(np.float32(each), wanted)


def test_published_degenerate_poses():
    """The eye on the up axis, or at the target: rows of zeros, not an error."""
    v = load_vector("cameras_degenerate")
    eye = torch.from_numpy(v["eye"]).requires_grad_()
    out = nmr.Orthographic(eye).transform(torch.from_numpy(v["vertices"]))
    assert np.array_equal(out.detach().numpy(), v["look_at_out"])
    out.sum().backward()
    assert eye.grad.isfinite().all()


def parameter(values):
    return torch.tensor(values, dtype=torch.float64, requires_grad=True)


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
    torch.manual_seed(0)
    points = torch.rand(1, 5, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda points, *parameters: make(*parameters).transform(points),
        (points, *map(parameter, values)),
    )


def test_a_batch_of_three_is_three_cameras():
    """Upstream crosses along the batch axis when it is 3 (defect 5, fixed)."""
    eye = torch.tensor([[0.3, 1.0, -3.0], [2.0, 0.5, 1.0], [-1.0, 2.0, 0.5]])
    points = torch.rand(3, 4, 3)
    one_by_one = [nmr.LookAt(e).transform(p[None]) for e, p in zip(eye, points, strict=True)]
    assert torch.equal(nmr.LookAt(eye).transform(points), torch.cat(one_by_one))


CAMERAS = {
    "LookAt": lambda e: nmr.LookAt(e),
    "Look": lambda e: nmr.Look(e, -e.detach(), half_fov_deg=torch.full(e.shape[:-1], 40.0)),
    "Orthographic": lambda e: nmr.Orthographic(e),
    "Pinhole": lambda e: nmr.Pinhole(
        CALIBRATION[0], torch.eye(3), e + 4.0, [0.1, 0, 0, 0.1, 0.2], orig_size=256
    ),
}


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("one_camera", [False, True])
def test_packed_is_one_by_one(name, one_camera):
    """Bit for bit, images and gradients; one of the meshes is empty."""
    torch.manual_seed(0)
    sizes = [5, 600, 0, 33]
    meshes = [torch.rand(n, 3) - 0.5 for n in sizes]
    eye = (
        torch.tensor([[0.0, 0.0, -2.0]]) + 0.1 * torch.randn(1 if one_camera else 4, 3)
    ).requires_grad_()
    vertices = torch.cat(meshes).requires_grad_()
    first = torch.tensor([0, *np.cumsum(sizes)])
    starts = torch.stack([first, torch.tensor([0, 3, 9, 9, 20])], dim=1)
    upstream = torch.randn(len(vertices), 3)
    camera = CAMERAS[name]
    packed = camera(eye).transform(vertices, starts)
    packed.backward(upstream)
    eye_sum = torch.zeros_like(eye)
    for b, mesh in enumerate(meshes):
        rows = slice(first[b], first[b + 1])
        alone = mesh.clone().requires_grad_()
        own_eye = eye[0 if one_camera else b].detach().clone().requires_grad_()
        out = camera(own_eye).transform(alone)
        out.backward(upstream[None, rows])
        assert torch.equal(out[0], packed[rows]) and torch.equal(alone.grad, vertices.grad[rows])
        eye_sum[0 if one_camera else b] += own_eye.grad
    torch.testing.assert_close(eye.grad, eye_sum, rtol=1e-5, atol=1e-5)


def test_fields_of_view_and_scales_under_vmap():
    points, values = torch.rand(1, 5, 3), torch.tensor([20.0, 30.0])
    for make in (
        lambda x: nmr.LookAt([0.0, 0.0, -3.0], half_fov_deg=x),
        lambda x: nmr.Orthographic([0.0, 0.0, -3.0], scale=x),
    ):
        many = torch.func.vmap(lambda x, make=make: make(x).transform(points))(values)
        assert torch.equal(many, torch.stack([make(x).transform(points) for x in values]))


def test_an_eye_at_the_place_that_it_looks_at_warns():
    with pytest.warns(UserWarning, match="or at its own place"):
        nmr.LookAt([[0.0, 1.0, 2.0], [0.0, 0.0, 0.0]])


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
    left, right = make(), make(right_handed=True)
    size = dict(image_size=32)
    assert torch.equal(
        right.transform(vertices), left.transform(vertices) * torch.tensor([-1.0, 1.0, 1.0])
    )
    depth = nmr.render_depth(vertices, faces, left, **size)
    assert depth.min() < 90
    torch.testing.assert_close(nmr.render_depth(vertices, faces, right, **size), depth.flip(2))
    assert nmr.render_silhouette(vertices, faces, right, fill_back=False, **size).any()
    front = nmr.render_depth(vertices, faces, right, fill_back=False, **size)
    torch.testing.assert_close(front, depth.flip(2))
    normals = nmr.render_normals(vertices, faces, right, **size)
    torch.testing.assert_close(normals, nmr.render_normals(vertices, faces, left, **size).flip(2))
    if not isinstance(right, nmr.Orthographic):
        rotation = nmr.cameras.to_opencv(right, height=32, width=32)[1]
        torch.testing.assert_close(
            torch.linalg.det(rotation), torch.ones(len(rotation), dtype=rotation.dtype)
        )


def test_warnings_name_the_line_that_made_the_camera():
    for make in (
        lambda: nmr.LookAt([0.0, 3.0, 0.0]),
        lambda: nmr.LookAt.from_angles(3.0, 90.0, 0.0),
        lambda: nmr.neural_renderer.look_at(torch.rand(1, 4, 3), [0.0, 3.0, 0.0]),
    ):
        with pytest.warns(UserWarning, match="up vector") as warned:
            make()
        assert warned[0].filename == __file__


def test_looking_straight_down_warns_and_another_up_shows_the_object():
    sphere, faces = nmr.icosphere(1)
    with pytest.warns(UserWarning, match="camera 1 of 2 looks along its up vector, .* up="):
        camera = nmr.LookAt.from_angles(3.0, [30.0, 90.0], 0.0)
    alpha = nmr.render_silhouette(sphere, faces, camera, image_size=16)
    assert alpha[0].any() and not alpha[1].any()
    with pytest.warns(UserWarning, match="squeezed to a part of its width, or empty"):
        camera = nmr.LookAt.from_angles(3.0, 89.9999, 0.0)
    squeezed = nmr.render_silhouette(sphere, faces, camera, image_size=16)
    assert 0 < squeezed.sum() < 0.5 * alpha[0].sum()
    for down in (
        lambda up: nmr.Look([0.0, 3.0, 0.0], [0.0, -1.0, 0.0], up),
        lambda up: nmr.Orthographic([0.0, 3.0, 0.0], up=up),
        lambda up: nmr.LookAt.from_angles(3.0, -90.0, 0.0, up=up),
    ):
        with pytest.warns(UserWarning, match="camera 0 of 1"):
            down((0.0, 2.0, 0.0))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            camera = down((0.0, 0.0, 1.0))
        assert nmr.render_silhouette(sphere, faces, camera, image_size=16).any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_vertices_without_an_image(dtype):
    """In the plane of the eye, at it, not finite, overflowing: nowhere, and no gradient, not even an upstream NaN."""
    nan, inf = math.nan, math.inf
    bad = [[1.0, 0, -2], [0, 0, -2], [nan, 0, 0], [0, inf, 0], [0, 0, -inf], [1, 0, -1.5]]
    bad = torch.tensor([bad], dtype=dtype)
    bad[0, 5, 0] = torch.finfo(dtype).max
    good = torch.tensor([[[0.1, 0.2, 0.3], [0.3, -0.1, 0.0]]], dtype=dtype)
    eye = torch.tensor([0.0, 0.0, -2.0], dtype=dtype, requires_grad=True)
    fov = torch.tensor(30.0, dtype=dtype, requires_grad=True)
    vertices = torch.cat([bad, good], dim=1).requires_grad_()
    out = nmr.LookAt(eye, half_fov_deg=fov).transform(vertices)
    assert (
        (out[0, :6, :2] == inf).all()
        and out[0, :6, 2].isfinite().all()
        and out[0, 6:].isfinite().all()
    )
    upstream = torch.ones_like(out)
    upstream[0, :6] = nan
    grads = torch.autograd.grad(out, (vertices, eye, fov), upstream)
    assert not grads[0][0, :6].any() and grads[0][0, 6:].all()
    out = nmr.LookAt(eye, half_fov_deg=fov).transform(good)
    for a, b in zip(
        grads[1:], torch.autograd.grad(out, (eye, fov), torch.ones_like(out)), strict=True
    ):
        assert torch.equal(a, b)


def test_the_optical_axis_has_a_gradient():
    """Upstream takes the root of r^2, whose derivative is not finite on the axis (defect 14, fixed)."""
    camera = nmr.Pinhole(
        CALIBRATION, torch.eye(3), [0.0, 0.0, 2.0], [0.1, 0.2, 0.1, 0.2, 0.3], orig_size=256
    )
    vertices = torch.zeros(1, 1, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(camera.transform, vertices)


NASTY = [
    0.0,
    -0.0,
    1.0,
    -1.0,
    1e-45,
    1e-30,
    1e-7,
    1e7,
    1e16,
    1e30,
    -1e30,
    3.4e38,
    math.inf,
    -math.inf,
    math.nan,
]
nasty = st.one_of(st.sampled_from(NASTY), st.floats(-2, 2, width=32), st.floats(width=32))


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([np.float32, np.float64]),
    hnp.arrays(np.float64, (2, 5, 3), elements=nasty),
    hnp.arrays(np.float64, (12,), elements=nasty),
    hnp.arrays(np.float64, (9,), elements=nasty),
    hnp.arrays(np.float64, (5,), elements=nasty),
    hnp.arrays(
        np.float32, (2, 5, 3), elements=st.sampled_from([0.0, 1.0, -3.0, 1e-30, 1e4, 1e20, 3e38])
    ),
)
def test_never_nan(dtype, vertices, pose, calibration, distortion, upstream):
    """Any vertices through any camera, with any finite upstream gradient."""

    def make(array, *shape):
        with np.errstate(over="ignore"):
            return torch.from_numpy(array.astype(dtype)).reshape(shape).requires_grad_()

    vertices, upstream = make(vertices, 2, 5, 3), torch.from_numpy(upstream.astype(dtype))
    eye, at, up, t = (make(x, 3) for x in np.split(pose, 4))
    K, d = make(calibration, 3, 3), make(distortion, 5)
    fov = torch.tensor(40.0, dtype=vertices.dtype, requires_grad=True)
    for camera, parameters in (
        (nmr.LookAt(eye, at, up, fov), (eye, at, up, fov)),
        (nmr.Look(eye, at, up, 1e-8), (eye, at, up)),
        (nmr.Orthographic(eye, at, up), (eye, at, up)),
        (nmr.Pinhole(K, torch.eye(3), t, d, orig_size=2), (K, t, d)),
    ):
        out = camera.transform(vertices)
        assert not out.isnan().any()
        assert out[..., :2].isfinite().all(-1).logical_or((out[..., :2] == math.inf).all(-1)).all()
        grads = torch.autograd.grad(out, (vertices, *parameters), upstream)
        assert not any(grad.isnan().any() for grad in grads)
        assert not grads[0][out[..., 0] == math.inf].any()


def test_a_camera_of_ones_own_can_give_a_projection():
    class Affine(nmr.cameras.ProjectingCamera):
        def projection(self, dtype=torch.float64):
            return Projection(
                torch.eye(3, 4, dtype=dtype)[None],
                torch.eye(2, 3, dtype=dtype)[None],
                perspective=False,
            )

    points = torch.rand(2, 3, 3)
    assert torch.equal(Affine().transform(points), points)
    whole = Projection(torch.eye(3, 4).long()[None], torch.eye(2, 3).long()[None])
    assert whole.matrix.dtype == whole.intrinsics.dtype == torch.float64
    with pytest.raises(NotImplementedError):
        nmr.cameras.ProjectingCamera().transform(points)


EYE, K = [0.0, 0.0, -2.0], torch.eye(3)


def test_tensors_in_lists_keep_their_gradient():
    """torch.as_tensor([tensor, 0.0]) would cut them off without a word."""
    points = torch.rand(2, 3, 3, dtype=torch.float64)
    x = torch.tensor(0.3, requires_grad=True)
    z = torch.tensor(-2.0, dtype=torch.float64, requires_grad=True)
    eye = torch.tensor(
        [[0.3, 0.0, -2.0], [0.0, 1.0, -2.0]], dtype=torch.float64, requires_grad=True
    )
    (expected,) = torch.autograd.grad(nmr.LookAt(eye).transform(points).sum(), eye)
    nested = nmr.LookAt([[x, 0.0, z], torch.tensor([0.0, 1.0, -2.0])])
    grad_x, grad_z = torch.autograd.grad(nested.transform(points).sum(), (x, z))
    torch.testing.assert_close(
        torch.stack([grad_x.double(), grad_z]), expected[0, [0, 2]], atol=1e-6, rtol=1e-6
    )
    distance = torch.tensor(2.0, requires_grad=True)
    points_from_angles([distance, 1.0], 0.0, 0.0).sum().backward()
    assert distance.grad == -1
    t = torch.tensor(2.0, requires_grad=True)
    nmr.Pinhole(K, K, [0.0, 0.0, t], orig_size=2).transform(torch.rand(7, 3))[
        ..., 2
    ].sum().backward()
    assert t.grad == 7


def test_empty_batches():
    camera = nmr.LookAt([0.0, 0.0, -2.0])
    assert camera.transform(torch.zeros(0, 4, 3)).shape == (0, 4, 3)
    assert camera.transform(torch.zeros(0, 3), torch.zeros(1, 2, dtype=torch.int64)).shape == (0, 3)
    points = torch.rand(4, 3, requires_grad=True)
    for camera in (
        nmr.LookAt(torch.rand(0, 3)),
        nmr.Orthographic(EYE, scale=torch.rand(0)),
        nmr.Pinhole(K, K, torch.rand(0, 3), orig_size=2),
        nmr.cameras.from_pytorch3d(K, torch.rand(0, 3)),
    ):
        out = camera.transform(points)
        assert out.shape == (0, 4, 3)
        (grad,) = torch.autograd.grad(out.sum(), points)
        assert not grad.any()
