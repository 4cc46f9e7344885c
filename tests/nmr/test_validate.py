"""Checks and conversions of arguments that all public functions share: dtypes, depth range, default device."""

import numpy as np
import pytest
import torch
from scenes import same_bits, value_and_gradients

import nmr
import nmr.neural_renderer as nr
from nmr import cameras

SPHERE, FACES = nmr.icosphere(1)
CAMERA = nmr.LookAt([0.5, 0.3, -3.0])
COLORS = torch.linspace(0, 1, SPHERE.numel()).view_as(SPHERE)
SIZE = {"image_size": 16}
MATRICES = (
    torch.eye(4, dtype=torch.float64),
    torch.tensor([[2.0, 0, 0, 0], [0, 2, 0, 0], [0, 0, -1, -2], [0, 0, -1, 0]]),
)
INTRINSICS = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]
PINHOLE = nmr.Pinhole(INTRINSICS, torch.eye(3), [0.0, 0.0, 2.0], orig_size=(480, 640))


T = [0.0, 0.0, 2.0]


def silhouette(vertices=SPHERE, faces=FACES, camera=CAMERA, **how):
    return nmr.render_silhouette(vertices, faces, camera, **how, **SIZE)


def opencv(*distortion):
    how = dict(height=480, width=640)
    return cameras.from_opencv(INTRINSICS, np.eye(3), T, distortion, **how)


def rgb(vertices, colors=COLORS, lights=None):
    return nmr.render_rgb(
        vertices, FACES, CAMERA, colors=nmr.VertexColors(colors), lights=lights, **SIZE
    )


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_cast_under_autocast(dtype):
    """As the output of a Linear: the image and the gradient are those of the vertices in float32."""
    half, colors = SPHERE.to(dtype), COLORS.to(dtype)
    ramp = torch.linspace(-1, 1, 16)
    (wanted, wanted_grad), plain = (
        value_and_gradients(silhouette, half.float(), upstream=ramp),
        rgb(half.float(), colors.float()),
    )
    with torch.autocast("cpu", torch.bfloat16):
        got, grad = value_and_gradients(silhouette, half, upstream=ramp)
        packed = silhouette([half, half[:12]], [FACES, FACES[:0]])
        colored = rgb(half, colors)
        fragments = nmr.render_fragments(half, FACES, CAMERA, **SIZE)
        resolved = fragments.resolve(fragments.interpolate([colors]).to(dtype))
        smooth = nmr.losses.smoothness_loss(half, nmr.edge_table(FACES))
    assert got.dtype == colored.dtype == resolved.dtype == smooth.dtype == torch.float32
    assert torch.equal(got, wanted) and torch.equal(packed[:1], wanted)
    assert torch.equal(colored, plain)
    assert grad.any() and torch.equal(grad, wanted_grad.to(dtype))


def test_points_and_the_drop_in_under_autocast():
    half = SPHERE.half()
    with torch.autocast("cpu", torch.bfloat16):
        assert nmr.metrics.chamfer_distance(half, half) == 0
        drawn = nr.Renderer(16, camera_mode="look_at").render_silhouettes(half[None], FACES[None])
    assert drawn.any()


@pytest.mark.parametrize("dtype", [torch.uint16, torch.uint32, torch.uint64])
def test_faces_may_be_unsigned(dtype):
    faces = torch.from_numpy(FACES.numpy().astype(str(dtype).removeprefix("torch.")))
    assert torch.equal(silhouette(faces=faces), silhouette())


def test_one_set_of_faces_may_have_a_batch_axis():
    two = torch.stack([SPHERE, 0.5 * SPHERE])
    assert torch.equal(silhouette(two, FACES[None]), silhouette(two))
    image, uv = torch.rand(4, 4, 3), torch.rand(12, 2)
    colors = [nmr.UVTexture(image, uv, uv_faces=faces % 12) for faces in (FACES, FACES[None])]
    assert torch.equal(
        *(nmr.render_rgb(two, FACES, CAMERA, colors=color, **SIZE) for color in colors)
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_parameters_of_cameras_are_copies_of_arrays(dtype):
    eye, matrix = np.array([0.0, 0.0, -3.0], dtype), np.array(INTRINSICS, dtype)
    made = nmr.LookAt(eye), nmr.Pinhole(matrix, np.eye(3), T, orig_size=(480, 640))
    before = [x.transform(SPHERE) for x in made]
    eye[2], matrix[0, 0] = -9.0, 1.0
    assert same_bits([x.transform(SPHERE) for x in made], before)


def test_spheres_are_made_on_the_default_device():
    with torch.device("meta"):
        vertices, faces = nmr.icosphere(1)
    assert (vertices.device.type, faces.device.type) == ("meta", "meta")
    assert (vertices.shape, faces.shape) == (SPHERE.shape, FACES.shape)
