import copy
import inspect
import math
import pickle

import numpy as np
import pytest
import torch
from scenes import same_bits
from torch.testing import assert_close
from vectors import load_vector, tensors_of, vector_names

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


def textured_sphere(batch=2):
    return *sphere(batch), torch.rand(batch, 80, 2, 2, 2, 3)


def drop_in(v, vertices, textures, parameters, setting):
    renderer = nr.Renderer(camera_mode=str(v["camera_mode"]))
    for key, value in ({key: x.tolist() for key, x in setting.items()} | parameters).items():
        setattr(renderer, key, value)
    faces = torch.from_numpy(v["faces"]).expand(len(vertices), -1, -1)
    if str(v["output"]) == "all":
        return renderer(vertices, faces, textures)
    return [renderer(vertices, faces, textures, str(v["output"]))]


def camera_of(mode, parameters, setting):
    if mode == "projection":
        K, R, t, distortion = (parameters[name] for name in ("K", "R", "t", "dist_coeffs"))
        return nmr.Pinhole(K, R, t, distortion, orig_size=parameters["orig_size"].item())
    angle = float(setting["viewing_angle"])
    if mode == "look":
        return nmr.Look(parameters["eye"], parameters["camera_direction"], half_fov_deg=angle)
    return nmr.LookAt(parameters["eye"], half_fov_deg=angle)


def own(v, vertices, textures, parameters, setting):
    mode, outputs = str(v["camera_mode"]), OUTPUTS[str(v["output"])]
    direction = setting["light_direction"]
    if mode == "projection":  # the published one lights mirrored worlds from behind
        direction = -direction
    lights = nmr.Lights(
        setting["light_intensity_ambient"],
        setting["light_intensity_directional"],
        direction,
        setting["light_color_ambient"],
        setting["light_color_directional"],
    )
    how = dict(near=float(setting["near"]), far=float(setting["far"]), eps=1e-3)
    if "rgb" not in outputs:  # the published functions use other constants
        how = {}
    images = nmr.render(
        vertices,
        torch.from_numpy(v["faces"]),
        camera_of(mode, parameters, setting),
        outputs=outputs,
        colors=nmr.TextureCubes(textures),
        lights=lights,
        background=setting["background_color"],
        image_size=int(setting["image_size"]),
        anti_aliasing=bool(setting["anti_aliasing"]),
        fill_back=bool(setting["fill_back"]),
        **how,
    )
    return [x.permute(0, 3, 1, 2) if x.ndim == 4 else x for x in images]


# How far rounding may move gradients: in float64 the camera's formula moves them by up to 2e-4.
@pytest.mark.parametrize(
    "name, draw, least",
    [
        *((name, drop_in, 1e-3) for name in RENDERERS),
        *((name, own, 1e-4) for name in RENDERERS if name.count("_") == 3),
    ],
)
def test_published_renderer(name, draw, least):
    """The whole of it: camera, lights, texture cubes, background, depth and alpha, and every gradient."""
    v = load_vector(name)
    setting, grads = tensors_of(v, "renderer_"), tensors_of(v, "grad_")
    given = [torch.from_numpy(v[key]).requires_grad_() for key in ("vertices", "textures")]
    parameters = {key: x.requires_grad_() for key, x in tensors_of(v, "param_").items()}
    images, outputs = draw(v, *given, parameters, setting), OUTPUTS[str(v["output"])]
    torch.autograd.backward(images, [torch.from_numpy(v[f"upstream_{o}"]) for o in outputs])
    for output, image in zip(outputs, images, strict=True):
        close = np.isclose(image.detach().numpy(), v[f"out_{output}"], rtol=1e-5, atol=1e-5)
        close[tuple(v[f"fragile_{output}"].T)] = True
        assert close.all(), f"{output}: {np.argwhere(~close)[:5]}"
    if draw is own and "K" in parameters:  # its projection rounds otherwise, 1 / distance amplifies
        least = 2e-3
    leaves = dict(vertices=given[0], **parameters)
    leaves |= dict(textures=given[1]) if "rgb" in outputs else {}
    for key in leaves.keys() & grads.keys():
        expected = grads[key]
        # How far a contracted multiply-add moves the published gradient says how far rounding may.
        latitude = 5 * (grads.get(f"{key}_fma", expected) - expected).norm()
        error = (leaves[key].grad - expected).norm()
        assert error <= max(latitude, least * expected.norm()), f"{key}: {error}, {latitude}"


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
    faces = torch.tensor([[0, 1, 2]])
    renderer = nr.Renderer(camera_mode="look", image_size=16)
    renderer.eye = [0, 0, -1]
    _, depth, alpha = renderer(vertices, faces[None], torch.ones(1, 1, 2, 2, 2, 3))
    how = dict(camera=nmr.Look(renderer.eye), outputs=("alpha", "depth"), image_size=16)
    plain, cut = (nmr.render(vertices, faces, clip=clip, **how) for clip in (False, True))
    assert same_bits((alpha, depth), plain) and not torch.equal(alpha, cut.alpha)


def test_defaults_of_attributes():
    renderer = nr.Renderer(camera_mode="look_at", viewing_angle=15)
    assert renderer.eye == [0, 0, -(1 / math.tan(math.radians(15)) + 1)]
    assert renderer.rasterizer_eps == 1e-3 and isinstance(renderer, torch.nn.Module)
    assert not list(renderer.parameters()) and not renderer.state_dict()


def test_calibrated_cameras_are_stored_as_published():
    given = dict(K=np.eye(3)[None], R=np.eye(3)[None], t=np.array([[0.0, 0, 4]]))
    given["dist_coeffs"] = np.zeros((1, 5))
    renderer = nr.Renderer(**given)
    for name, array in given.items():
        stored = getattr(renderer, name)
        assert stored.dtype == torch.float32 and stored.tolist() == array.tolist()
    given["K"][0, 0, 0] = 2  # the array is the caller's
    assert renderer.K[0, 0, 0] == 1
    del given["dist_coeffs"]
    assert torch.equal(nr.Renderer(**given).dist_coeffs, torch.zeros(1, 5))
    leaf = torch.zeros(1, 3, requires_grad=True)
    assert nr.Renderer(**given | {"t": leaf}).t is leaf


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
    vertices, faces, textures = textured_sphere()
    renderer = nr.Renderer(camera_mode="look_at", image_size=16)
    rgb, depth, alpha = renderer(vertices, faces, textures)
    for mode, image in (
        ("rgb", rgb),
        ("".join(["r", "gb"]), rgb),
        ("silhouettes", alpha),
        ("depth", depth),
    ):
        given = textures if image is rgb else None
        assert torch.equal(renderer(vertices, faces, given, mode), image)


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
    plain, look_at = (
        nr.Renderer(image_size=16, **mode).render_silhouettes(*sphere())
        for mode in ({}, {"camera_mode": "look_at"})
    )
    assert plain.any() and torch.equal(plain, look_at)


def test_cameras_of_a_call_win_over_those_of_the_renderer():
    mesh = sphere()
    K = torch.tensor([[[64.0, 0, 32], [0, 64, 32], [0, 0, 1]]])
    given = dict(K=K, R=torch.eye(3)[None], t=torch.tensor([[[0, 0, 4.0]]]), orig_size=64)
    arrays = {key: np.asarray(value) for key, value in given.items()} | {"orig_size": 64}
    expected = nr.Renderer(16, **arrays).render_silhouettes(*mesh)
    assert 0.05 < expected.mean() < 0.9
    renderer = nr.Renderer(16, K=torch.eye(3)[None], R=torch.eye(3)[None], t=torch.zeros(1, 1, 3))
    assert torch.equal(renderer(*mesh, mode="silhouettes", **given), expected)
    given["orig_size"] = np.array([64, 64])
    assert torch.equal(renderer.render_silhouettes(*mesh, **given), expected), (
        "a pair, not two images"
    )
    given["dist_coeffs"] = torch.tensor([[0.5, 0, 0, 0, 0]])
    assert not torch.equal(renderer.render_silhouettes(*mesh, **given), expected)


@pytest.mark.parametrize(
    "convert", [list, tuple, np.array, torch.tensor, lambda x: torch.nn.Parameter(torch.tensor(x))]
)
@pytest.mark.parametrize("batch", [False, True])
def test_eyes_and_colours_in_any_container(convert, batch):
    mesh, renderer = textured_sphere(), nr.Renderer(camera_mode="look", image_size=16)
    values = dict(
        eye=[0.5, 0.6, -3.0],
        camera_direction=[-0.5, -0.6, 3.0],
        background_color=[0.1, 0.2, 0.3],
        light_direction=[0.0, 1.0, -1.0],
        light_color_ambient=[0.9, 0.8, 0.7],
        light_color_directional=[0.9, 0.8, 0.7],
    )

    def drawn_with(give):
        for name, value in values.items():
            setattr(renderer, name, give(value))
        return renderer(*mesh, mode="rgb")

    image = drawn_with(lambda value: convert([value] * 2 if batch else value))
    assert_close(image, drawn_with(torch.tensor))


def test_different_faces_of_one_set_of_vertices():
    vertices, faces, textures = textured_sphere()
    faces = torch.stack([faces[0], faces[1].roll(7, 0)])
    renderer = nr.Renderer(camera_mode="look_at", image_size=16)
    rgb = renderer.render_rgb(vertices[:1], faces, textures)
    assert torch.equal(rgb, renderer.render_rgb(vertices, faces, textures))


def test_silhouettes_and_depth_have_their_own_range_as_published():
    *mesh, textures = textured_sphere()
    renderer = nr.Renderer(camera_mode="look_at", image_size=16, near=1e-3, far=1.5)
    assert renderer.render_silhouettes(*mesh).any() and renderer.render_depth(*mesh).max() == 100
    _, depth, alpha = renderer(*mesh, textures)
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
    assert pickle.loads(pickle.dumps(renderer)).render_silhouettes(*sphere()).any()


@pytest.mark.parametrize("size", [(16, 32), [16, 32], np.array([16, 32]), torch.tensor([16, 32])])
@pytest.mark.parametrize("mode", ["look", "look_at"])
def test_wide_images_show_more_at_the_sides(size, mode, perspective):
    mesh, renderer = textured_sphere(), nr.Renderer(16, camera_mode=mode, perspective=perspective)
    square = renderer(*mesh)
    renderer.image_size = size
    for image, wide in zip(square, renderer(*mesh), strict=True):
        assert wide.shape[-2:] == (16, 32)
        assert_close(wide[..., 8:24], image, atol=1e-5, rtol=1e-5)
