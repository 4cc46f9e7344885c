"""Cameras of several poses: counted, selected, joined; points from renderer space back to the world."""

import numpy as np
import pytest
import torch
from scenes import bumpy_sphere, leaf_of, normal, uniform
from torch.autograd import gradcheck
from torch.testing import assert_close

import nmr
from nmr import cameras

VERTICES, FACES = bumpy_sphere(1)
EYES = torch.tensor([[0.0, 0.5, -2.5], [1.5, 0.0, -2.0], [-1.0, 1.0, 2.0]]).double()
K = torch.tensor([[50.0, 0.1, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]]).double()
TURNS = torch.linalg.qr(normal(3, 3, 3))[0]
OPENCV = dict(orig_size=(48, 64))
CAMERAS = {
    "look at": nmr.LookAt(EYES, half_fov_deg=12.345, right_handed=True),
    "look": nmr.Look(EYES, -EYES, half_fov_deg=uniform(3) + 20),
    "orthographic": nmr.Orthographic(EYES[0], scale=uniform(3) + 0.5),
    "pinhole": nmr.Pinhole(K, TURNS, EYES + 3, **OPENCV),
    "distorted": nmr.Pinhole(K, TURNS, EYES + 3, [0.1, 0.02, 0.01, 0.01, 0.0], **OPENCV),
    "projection": nmr.LookAt(EYES).projection(),
    "wide": nmr.LookAt(EYES, [0.1, 0.2, 0.3]).for_image(32, 64),
    "one": nmr.LookAt(EYES[0], half_fov_deg=12.345),
    "one of each": nmr.Pinhole(K, TURNS[:1], [0.1, 0.5, 3.0], **OPENCV),
}
EACH = pytest.mark.parametrize("name", CAMERAS)


@EACH
def test_a_camera_is_the_sequence_of_its_poses(name):
    camera = CAMERAS[name]
    whole = camera.transform(VERTICES)
    assert len(camera) == len(whole) and len(list(camera)) == len(whole)
    for index in (0, -1, slice(1, None), [0, 0], torch.tensor([0])):
        some = camera[index]
        wanted = whole[[index] if isinstance(index, int) else index]
        assert type(some) is type(camera) and len(some) == len(wanted)
        assert not len(wanted) or torch.equal(some.transform(VERTICES), wanted)
    joined = cameras.cat([camera, camera[0], *camera])
    assert torch.equal(joined.transform(VERTICES), torch.cat([whole, whole[:1], whole]))
    assert len(nmr.LookAt(torch.zeros(0, 3))) == 0
    with pytest.raises(IndexError, match=f"pose {len(whole)} of a camera with {len(whole)} poses"):
        camera[len(whole)]


def test_gradients_reach_the_parameters_of_all_poses():
    eyes = leaf_of(EYES)
    part = cameras.cat([nmr.LookAt(eyes)[1:], nmr.LookAt(eyes)[0]])
    upstream = normal(3, len(VERTICES), 3)
    (grad,) = torch.autograd.grad(part.transform(VERTICES), eyes, upstream)
    (wanted,) = torch.autograd.grad(nmr.LookAt(eyes).transform(VERTICES), eyes, upstream.roll(1, 0))
    assert torch.equal(grad, wanted)


@EACH
def test_unproject_is_the_inverse(name):
    camera = CAMERAS[name]
    seen = camera.transform(VERTICES)
    if name == "distorted":
        with pytest.raises(ValueError, match=r"no unproject; undistort the pixels"):
            camera.unproject(seen)
        return
    assert_close(camera.unproject(seen), VERTICES.expand_as(seen))
    assert_close(camera.unproject(seen[:1].float())[0], VERTICES.float(), atol=1e-5, rtol=0)
    assert camera.unproject(seen[0]).shape == seen.shape


def test_the_points_of_a_depth_image_are_those_of_its_pixels():
    for name in ("look at", "one of each", "orthographic"):
        camera = CAMERAS[name]
        how = dict(image_size=(12, 16), far=50.0)
        fragments = nmr.render_fragments(VERTICES, FACES, camera, **how)
        points = camera.unproject_depth(fragments.depth)
        covered = fragments.covered
        assert points.shape == (len(camera), 12, 16, 3) and covered.any((1, 2)).all()
        assert_close(points[covered], fragments.interpolate(VERTICES)[covered])
    assert_close(camera[0].unproject_depth(fragments.depth[0]), points[:1])


def test_unproject_has_true_derivatives():
    def world(eye, points):
        return nmr.LookAt(eye).unproject(points)

    assert gradcheck(world, (leaf_of(EYES), leaf_of(normal(3, 2, 3))))


WRONG = {
    "no camera": (lambda: cameras.cat([]), TypeError, "list of nmr's cameras"),
    "classes": (
        lambda: cameras.cat([CAMERAS["look at"], CAMERAS["pinhole"]]),
        TypeError,
        r"one class, got \['LookAt', 'Pinhole'\]; camera.for_image",
    ),
    "sides": (
        lambda: cameras.cat([CAMERAS["look at"], CAMERAS["one"]]),
        ValueError,
        "right_handed differs between the cameras",
    ),
    "lens": (
        lambda: cameras.cat([CAMERAS["distorted"], CAMERAS["pinhole"]]),
        ValueError,
        "dist_coeffs is None in some of the cameras",
    ),
    "integers": (lambda: CAMERAS["one"].unproject(FACES), TypeError, "float tensor"),
    "shape": (lambda: CAMERAS["one"].unproject(EYES[:, :2]), ValueError, r"a tensor \[B, N, 3\]"),
    "batch": (
        lambda: CAMERAS["look at"].unproject(normal(2, 4, 3)),
        ValueError,
        "batch size 1 or 3, that of the poses",
    ),
    "index": (lambda: CAMERAS["look at"]["first"], TypeError, "by a number, a slice.* got str"),
    "axes": (lambda: CAMERAS["look at"][None], TypeError, "by a number, a slice.* got NoneType"),
    "fraction": (lambda: CAMERAS["look at"][[0.5]], TypeError, r"got float32 \[1\]"),
    "out of range": (lambda: CAMERAS["look at"][np.int64(3)], IndexError, "pose 3 of a camera"),
    "depth": (lambda: CAMERAS["one"].unproject_depth(FACES), TypeError, "float tensor"),
    "depth's shape": (
        lambda: CAMERAS["one"].unproject_depth(EYES[0]),
        ValueError,
        r"\[h, w\] or \[B, h, w\]",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_arguments(name):
    call, kind, said = WRONG[name]
    with pytest.raises(kind, match=said):
        call()


@pytest.mark.parametrize("camera", [CAMERAS["look at"], CAMERAS["look at"].projection()])
def test_numbers_of_numpy_and_torch_choose_a_pose(camera):
    for number in (np.int64(1), torch.tensor(1), np.uint8(1)):
        assert_close(camera[number].transform(EYES), camera[1].transform(EYES), rtol=0, atol=0)
    chosen = np.arange(len(camera)) != 1
    assert len(camera[chosen]) == len(camera[[0, 2]]) == 2 and len(camera[[]]) in (0, 1)


@pytest.mark.filterwarnings("ignore:.*looks along")
def test_a_pose_that_sees_nothing_has_no_points():
    camera = nmr.LookAt([[0.0, 0.0, -3.0], [0.0, 3.0, 0.0]])
    with pytest.raises(ValueError, match="pose 1 of the camera sees nothing"):
        camera.unproject(EYES[:1])
