"""Checks and conversions of arguments that all public functions share: dtypes, depth range, default device."""

import functools

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


class Own:
    """A camera that is not one of nmr's."""

    def transform(self, vertices):
        return vertices + torch.tensor([0.0, 0.0, 3.0], device="cpu")


EDGES = nmr.edge_table(FACES)
LOSSES_OF_EDGES = (
    nmr.losses.smoothness_loss,
    nmr.losses.laplacian_loss,
    nmr.losses.edge_length_loss,
    nmr.losses.normal_consistency_loss,
)
LOSSES_OF_FACES = nmr.losses.inflation_loss, nmr.losses.volume_loss, nmr.losses.area_loss
DRAWN = {
    "silhouette": silhouette,
    "cut": lambda: silhouette(camera=nmr.LookAt([0.0, 0.0, -0.5])),
    "list": lambda: silhouette([SPHERE, SPHERE[:12]], [FACES, FACES[:0]]),
    "local": lambda: silhouette(gradient="local"),
    "wide": lambda: CAMERA.for_image(8, 16).transform(SPHERE),
    "depth": lambda: nmr.render_depth(SPHERE, FACES, CAMERA, **SIZE),
    "normals": lambda: nmr.render_normals(SPHERE, FACES, CAMERA, smooth=True, **SIZE),
    "normals of a list": lambda: nmr.render_normals(
        [SPHERE, SPHERE], [FACES, FACES[1:]], CAMERA, **SIZE
    ),
    "face index": lambda: nmr.render_face_index(SPHERE, FACES, CAMERA, **SIZE),
    "rgb": lambda: rgb(SPHERE),
    "normals by a camera of one's own": lambda: nmr.render_normals(SPHERE, FACES, Own(), **SIZE),
    "lit": lambda: rgb(SPHERE, lights=nmr.Lights(direction=[0.0, 1.0, -1.0])),
    "background": lambda: nmr.render_rgb(SPHERE, FACES, CAMERA, background=[0.1, 0.2, 0.3], **SIZE),
    "voxels": lambda: nmr.voxelize(0.3 * SPHERE + 0.5, FACES, 8),
    "edge_table": lambda: nmr.edge_table(FACES),
    "unique_edges": lambda: nmr.unique_edges(FACES),
    "vertex_normals": lambda: nmr.vertex_normals(SPHERE, FACES),
    "soft_iou": lambda: nmr.losses.soft_iou_loss(COLORS, COLORS.round()),
    **{loss.__name__: functools.partial(loss, SPHERE, EDGES) for loss in LOSSES_OF_EDGES},
    **{loss.__name__: functools.partial(loss, SPHERE, FACES) for loss in LOSSES_OF_FACES},
    "look_at": lambda: nmr.LookAt.from_angles(2.0, 30.0, [0.0, 90.0]),
    "look": lambda: nmr.Look([0.0, 0.0, -3.0], half_fov_deg=torch.tensor(20.0, device="cpu")),
    "orthographic": lambda: nmr.Orthographic([0.0, 0.0, -2.0], scale=0.5),
    "pinhole": lambda: nmr.Pinhole(INTRINSICS, np.eye(3), T, orig_size=480),
    "from_opencv": lambda: opencv(0.1, 0.0, 0.0, 0.0),
    "to_opencv": lambda: cameras.to_opencv(PINHOLE, height=480, width=640)[0],
    "from_opengl": lambda: cameras.from_opengl(*MATRICES),
    "to_opengl": lambda: torch.stack(cameras.to_opengl(PINHOLE, near=0.1, far=10.0)),
    "from_pytorch3d": lambda: cameras.from_pytorch3d(np.eye(3), T),
    "from_pytorch3d_fov": lambda: cameras.from_pytorch3d_fov(np.eye(3), T, 40.0),
    "to_pytorch3d": lambda: cameras.to_pytorch3d(CAMERA, image_size=(64, 64))["focal_length"],
}


@pytest.mark.parametrize("function", DRAWN.values(), ids=DRAWN)
def test_the_default_device_does_not_matter(function):
    """Results are on the device of the arguments; the device "meta" has no values, so that any use of it fails."""

    def result():
        made = function()
        return made if isinstance(made, torch.Tensor) else made.transform(SPHERE)

    wanted = result()
    with torch.device("meta"):
        got = result()
    assert got.device.type == "cpu" and torch.equal(got, wanted)


def test_spheres_are_made_on_the_default_device():
    with torch.device("meta"):
        vertices, faces = nmr.icosphere(1)
    assert (vertices.device.type, faces.device.type) == ("meta", "meta")
    assert (vertices.shape, faces.shape) == (SPHERE.shape, FACES.shape)
