import copy
import inspect
import math
import pickle

import numpy as np
import pytest
import torch
from vectors import load_vector, vector_names

import nmr
import nmr.neural_renderer as nr

RENDERERS = vector_names("renderer_*")
OUTPUTS = {
    "rgb": ("rgb",),
    "silhouettes": ("alpha",),
    "depth": ("depth",),
    "all": ("rgb", "depth", "alpha"),
}


def sphere(batch=2):
    vertices, faces = nmr.icosphere(1)
    return vertices.expand(batch, -1, -1), faces.expand(batch, -1, -1)


@pytest.mark.parametrize("name", RENDERERS)
def test_vectors(name):
    v = load_vector(name)
    renderer = nr.Renderer(camera_mode=str(v["camera_mode"]))
    for key in v:
        if key.startswith("renderer_"):
            setattr(renderer, key.removeprefix("renderer_"), v[key].tolist())
    inputs = {key: torch.from_numpy(v[key]).requires_grad_() for key in ("vertices", "textures")}
    inputs |= {
        key.removeprefix("param_"): torch.from_numpy(v[key]).requires_grad_()
        for key in v
        if key.startswith("param_")
    }
    for key in set(inputs) - {"vertices", "textures"}:
        setattr(renderer, key, inputs[key])
    faces = torch.from_numpy(v["faces"]).expand(len(v["vertices"]), -1, -1)
    mode = str(v["output"])
    images = renderer(
        inputs["vertices"], faces, inputs["textures"], mode=None if mode == "all" else mode
    )
    images = dict(zip(OUTPUTS[mode], images if mode == "all" else [images], strict=True))
    torch.autograd.backward(
        list(images.values()), [torch.from_numpy(v[f"upstream_{o}"]) for o in images]
    )
    for output, image in images.items():
        close = np.isclose(image.detach().numpy(), v[f"out_{output}"], rtol=1e-5, atol=1e-5)
        close[tuple(v[f"fragile_{output}"].T)] = True
        assert close.all(), f"{output}: {np.argwhere(~close)[:5]}"
    for key in inputs:
        if f"grad_{key}" in v:
            expected = v[f"grad_{key}"]
            # How far a contracted multiply-add moves the published gradient says how far rounding may.
            latitude = np.linalg.norm(
                v.get(f"grad_{key}_fma", expected) - expected
            ) / np.linalg.norm(expected)
            error = np.linalg.norm(inputs[key].grad.numpy() - expected) / np.linalg.norm(expected)
            # The camera rounds otherwise, too: its published formula in float64 moves gradients by up to 2e-4.
            assert error <= max(5 * latitude, 1e-3), f"{key}: {error}, latitude {latitude}"


def test_arguments_and_defaults_of_the_published_interface():
    camera = "K=None, R=None, t=None, dist_coeffs=None, orig_size=None"
    raster = "image_size=256, anti_aliasing=True, near=0.1, far=100, eps=0.0001"
    published = {
        nr.Renderer: "image_size=256, anti_aliasing=True, background_color=(0, 0, 0), fill_back=True, "
        "camera_mode='projection', K=None, R=None, t=None, dist_coeffs=None, orig_size=1024, perspective=True, "
        "viewing_angle=30, camera_direction=(0, 0, 1), near=0.1, far=100, light_intensity_ambient=0.5, "
        "light_intensity_directional=0.5, light_color_ambient=(1, 1, 1), light_color_directional=(1, 1, 1), "
        "light_direction=(0, 1, 0)",
        nr.Renderer.forward: f"self, vertices, faces, textures=None, mode=None, {camera}",
        nr.Renderer.render: f"self, vertices, faces, textures, {camera}",
        nr.Renderer.render_rgb: f"self, vertices, faces, textures, {camera}",
        nr.Renderer.render_silhouettes: f"self, vertices, faces, {camera}",
        nr.Renderer.render_depth: f"self, vertices, faces, {camera}",
        nr.rasterize_rgbad: f"faces, textures=None, {raster}, background_color=(0, 0, 0), return_rgb=True, "
        "return_alpha=True, return_depth=True",
        nr.rasterize: f"faces, textures, {raster}, background_color=(0, 0, 0)",
        nr.rasterize_silhouettes: f"faces, {raster}",
        nr.rasterize_depth: f"faces, {raster}",
        nr.Rasterize: "image_size, near, far, eps, background_color, return_rgb=False, return_alpha=False, "
        "return_depth=False",
        nr.look_at: "vertices, eye, at=(0, 0, 0), up=(0, 1, 0)",
        nr.look: "vertices, eye, direction=(0, 1, 0), up=None",
        nr.perspective: "vertices, angle=30.0",
        nr.projection: "vertices, K, R, t, dist_coeffs, orig_size, eps=1e-09",
        nr.get_points_from_angles: "distance, elevation, azimuth, degrees=True",
        nr.lighting: "faces, textures, intensity_ambient=0.5, intensity_directional=0.5, color_ambient=(1, 1, 1), "
        "color_directional=(1, 1, 1), direction=(0, 1, 0)",
        nr.vertices_to_faces: "vertices, faces",
        nr.load_obj: "filename_obj, normalization=True, texture_size=4, load_texture=False, "
        "texture_wrapping='REPEAT', use_bilinear=True",
        nr.save_obj: "filename, vertices, faces, textures=None",
        nr.Mesh: "vertices, faces, textures=None, texture_size=4",
        nr.Mesh.fromobj: "filename_obj, normalization=True, load_texture=False, texture_size=4",
    }
    for function, expected in published.items():
        parameters = inspect.signature(function).parameters.values()
        plain = [p.replace(annotation=inspect.Parameter.empty) for p in parameters]
        assert ", ".join(map(str, plain)) == expected, function
    assert nr.__version__ == "1.1.3"


def test_faces_that_cross_the_plane_of_the_eye_are_not_clipped():
    """As published: x and y of a vertex behind the eye are divided by a negative depth."""
    vertices = torch.tensor([[[-1.0, -0.5, 0.5], [1, -0.5, 0.5], [0.3, -0.5, -4]]])
    renderer = nr.Renderer(camera_mode="look", image_size=16)
    renderer.eye = [0, 0, -1]
    _, depth, alpha = renderer(vertices, torch.tensor([[[0, 1, 2]]]), torch.ones(1, 1, 2, 2, 2, 3))
    how = dict(outputs=("alpha", "depth"), image_size=16)
    mesh = vertices, torch.tensor([[0, 1, 2]]), nmr.Look(renderer.eye)
    plain, cut = (nmr.render(*mesh, clip=clip, **how) for clip in (False, True))
    assert (
        torch.equal(alpha, plain.alpha)
        and torch.equal(depth, plain.depth)
        and not torch.equal(alpha, cut.alpha)
    )


def test_defaults_of_attributes():
    renderer = nr.Renderer(camera_mode="look_at", viewing_angle=15)
    assert renderer.eye == [0, 0, -(1 / math.tan(math.radians(15)) + 1)]
    assert renderer.rasterizer_eps == 1e-3 and isinstance(renderer, torch.nn.Module)
    assert not list(renderer.parameters()) and not renderer.state_dict()


def test_calibrated_cameras_are_stored_as_published():
    K, R, t = np.eye(3)[None], np.eye(3)[None], np.array([[0.0, 0, 4]])
    renderer = nr.Renderer(K=K, R=R, t=t, dist_coeffs=np.zeros((1, 5)))
    for value, given in (
        (renderer.K, K),
        (renderer.R, R),
        (renderer.t, t),
        (renderer.dist_coeffs, np.zeros((1, 5))),
    ):
        assert (
            isinstance(value, torch.Tensor)
            and value.dtype == torch.float32
            and value.tolist() == given.tolist()
        )
    K[0, 0, 0] = 2  # the array is the caller's
    assert renderer.K[0, 0, 0] == 1
    assert torch.equal(nr.Renderer(K=K, R=R, t=t).dist_coeffs, torch.zeros(1, 5))
    leaf = torch.zeros(1, 3, requires_grad=True)
    assert nr.Renderer(K=K, R=R, t=leaf).t is leaf


@pytest.mark.parametrize("perspective", [True, False])
@pytest.mark.parametrize("mode", ["look", "look_at"])
def test_up_of_the_camera(mode, perspective):
    """A world whose up is z, as in the forks that render cars: its tip is on top, as if z were y."""
    vertices = torch.tensor([[[0.0, 0.5, 0], [0, -0.5, 0], [0.5, 0, 0], [-0.5, 0, 0], [0, 0, 0.8]]])
    faces = torch.tensor([[[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4]]])
    renderer = nr.Renderer(camera_mode=mode, image_size=32, perspective=perspective)
    assert renderer.camera_up == (0, 1, 0)
    renderer.eye, renderer.camera_direction = [-2, 3, 1], [2, -3, -1]
    upright = renderer.render_silhouettes(vertices.roll(-1, 2), faces)
    assert (upright[0].sum(1) > 0).any() and not torch.equal(upright, upright.flip(1))
    renderer.eye, renderer.camera_direction = [1, -2, 3], [-1, 2, -3]
    for up, expected in (([0, 0, 1], upright), (torch.tensor([[0, 0, -1.0]]), upright.flip(1, 2))):
        renderer.camera_up = up
        assert (renderer.render_silhouettes(vertices, faces) - expected).abs().mean() < 1e-3


def test_modes_of_a_call():
    vertices, faces = sphere()
    textures = torch.rand(2, 80, 2, 2, 2, 3)
    renderer = nr.Renderer(camera_mode="look_at", image_size=16)
    rgb, depth, alpha = renderer(vertices, faces, textures)
    assert torch.equal(renderer(vertices, faces, textures, mode="rgb"), rgb)
    assert torch.equal(renderer(vertices, faces, textures, "".join(["r", "gb"])), rgb)
    assert torch.equal(renderer(vertices, faces, mode="silhouettes"), alpha)
    assert torch.equal(renderer(vertices, faces, mode="depth"), depth)
    with pytest.raises(
        ValueError, match="mode must be None, 'rgb', 'silhouettes' or 'depth', got 'normals'"
    ):
        renderer(vertices, faces, mode="normals")


@pytest.mark.parametrize("mode", ["None", "none", None])
def test_vertices_in_renderer_space(mode):
    vertices, faces = sphere()
    vertices = vertices * 0.5 + torch.tensor([0, 0, 2.0])
    image = nr.Renderer(camera_mode=mode, image_size=16).render_silhouettes(vertices, faces)
    assert torch.equal(image, nmr.render_silhouette(vertices, faces, image_size=16))
    renderer = nr.Renderer(image_size=16)
    renderer.camera_mode = mode
    assert torch.equal(image, renderer.render_silhouettes(vertices, faces))


def test_chainer_default_is_look_at():
    vertices, faces = sphere()
    image = nr.Renderer(image_size=16).render_silhouettes(vertices, faces)
    assert image.any() and torch.equal(
        image, nr.Renderer(image_size=16, camera_mode="look_at").render_silhouettes(vertices, faces)
    )


def test_cameras_of_a_call_win_over_those_of_the_renderer():
    vertices, faces = sphere()
    K = np.diag([64.0, 64, 1]).astype(np.float32)
    R = np.eye(3, dtype=np.float32)
    t = np.array([[[0, 0, 4.0]]])
    K[:2, 2] = 32
    expected = nr.Renderer(16, K=K[None], R=R[None], t=t, orig_size=64).render_silhouettes(
        vertices, faces
    )
    assert 0.05 < expected.mean() < 0.9
    renderer = nr.Renderer(16, K=torch.eye(3)[None], R=torch.eye(3)[None], t=torch.zeros(1, 1, 3))
    given = dict(
        K=torch.from_numpy(K)[None],
        R=torch.from_numpy(R)[None],
        t=torch.from_numpy(t),
        orig_size=64,
    )
    assert torch.equal(renderer(vertices, faces, mode="silhouettes", **given), expected)
    given["orig_size"] = np.array([64, 64])
    assert torch.equal(renderer.render_silhouettes(vertices, faces, **given), expected), (
        "a pair, not two images"
    )
    given["dist_coeffs"] = torch.tensor([[0.5, 0, 0, 0, 0]])
    assert not torch.equal(renderer.render_silhouettes(vertices, faces, **given), expected)


@pytest.mark.parametrize(
    "convert", [list, tuple, np.array, torch.tensor, lambda x: torch.nn.Parameter(torch.tensor(x))]
)
@pytest.mark.parametrize("batch", [False, True])
def test_eyes_and_colours_in_any_container(convert, batch):
    vertices, faces = sphere()
    renderer = nr.Renderer(camera_mode="look", image_size=16)
    textures = torch.rand(2, 80, 2, 2, 2, 3)

    def give(value):
        return convert([value] * 2 if batch else value)

    def images():
        renderer.eye, renderer.camera_direction = give([0.5, 0.6, -3.0]), give([-0.5, -0.6, 3.0])
        renderer.background_color, renderer.light_direction = (
            give([0.1, 0.2, 0.3]),
            give([0.0, 1.0, -1.0]),
        )
        renderer.light_color_ambient = renderer.light_color_directional = give([0.9, 0.8, 0.7])
        return renderer(vertices, faces, textures, mode="rgb")

    out = images()
    batch, convert = False, torch.tensor
    torch.testing.assert_close(images(), out)


def test_different_faces_of_one_set_of_vertices():
    vertices, faces = sphere(2)
    faces = torch.stack([faces[0], faces[1].roll(7, 0)])
    textures = torch.rand(2, 80, 2, 2, 2, 3)
    renderer = nr.Renderer(camera_mode="look_at", image_size=16)
    rgb = renderer.render_rgb(vertices[:1], faces, textures)
    assert torch.equal(rgb, renderer.render_rgb(vertices, faces, textures))


def test_silhouettes_and_depth_have_their_own_range_as_published():
    vertices, faces = sphere()
    renderer = nr.Renderer(camera_mode="look_at", image_size=16, near=1e-3, far=1.5)
    assert (
        renderer.render_silhouettes(vertices, faces).any()
        and renderer.render_depth(vertices, faces).max() == 100
    )
    _, depth, alpha = renderer(vertices, faces, torch.rand(2, 80, 2, 2, 2, 3))
    assert not alpha.any() and torch.all(depth == 1.5)


def test_renderers_can_be_copied_and_nested():
    class Model(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.renderer = nr.Renderer(camera_mode="look_at", image_size=16)
            self.renderer.eye = torch.nn.Parameter(torch.tensor([0.0, 0, -3]))

    model = copy.deepcopy(Model())
    assert [name for name, _ in model.named_parameters()] == ["renderer.eye"]
    model.renderer.eye = nr.get_points_from_angles(2.7, 0, 90)
    assert not list(model.parameters()) and model.renderer.render_silhouettes(*sphere()).any()


def test_a_renderer_saved_whole_by_the_published_code_draws():
    renderer = nr.Renderer(camera_mode="look_at", image_size=16)
    assert "camera_up" not in renderer.__dict__, "which has no such attribute"
    vertices, faces = nmr.icosphere(1)
    again = pickle.loads(pickle.dumps(renderer))
    assert again.render_silhouettes(0.5 * vertices[None], faces[None]).any()
