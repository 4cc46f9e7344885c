"""The raster-level vectors through the functions of the drop-in: faces doubled by hand, as its callers do."""

import itertools

import numpy as np
import pytest
import torch
from scenes import same_bits, uniform, value_and_gradients
from vectors import gradient_tolerance, load_vector, vector_names

import nmr.neural_renderer as nr

DEPTHS, COLORS = (vector_names(pattern) for pattern in ("depth_*", "rgb_*"))
assert len(DEPTHS) >= 22 and len(COLORS) >= 12


def settings_of(v):
    names = ("image_size", "anti_aliasing", "near", "far", "eps")
    return {name: v[name].item() for name in names}


def corners_of(v, vertices):
    faces = torch.from_numpy(v["faces"])[None].expand(len(vertices), -1, -1)
    if v["fill_back"]:
        faces = torch.cat([faces, faces.flip(2)], dim=1)
    return nr.vertices_to_faces(vertices, faces)


def textures_of(v, textures):
    cubes = [textures, textures.permute(0, 1, 4, 3, 2, 5)]
    return torch.cat(cubes, dim=1) if v["fill_back"] else textures


def assert_image(image, v, name):
    image, expected = image.detach().numpy(), v[name]
    assert image.shape == expected.shape
    close = np.isclose(image, expected, rtol=1e-5, atol=1e-5)
    if f"fragile_{name}" in v:
        close[tuple(v[f"fragile_{name}"].T)] = True
    assert close.all(), f"{name}: {np.argwhere(~close)[:5]}"


def assert_gradient(gradient, expected, tolerance):
    scale = np.linalg.norm(expected)
    if np.isfinite(tolerance):
        assert np.linalg.norm(gradient.numpy() - expected) <= tolerance * scale


@pytest.mark.parametrize("name", DEPTHS)
def test_depth(name):
    v = load_vector(name)
    depth, grad = value_and_gradients(
        lambda vertices: nr.rasterize_depth(corners_of(v, vertices), **settings_of(v)),
        torch.from_numpy(v["vertices"]),
        upstream=torch.from_numpy(v["grad_depth"]),
    )
    assert np.array_equal(depth, v["depth"])  # fragile pixels included
    assert_gradient(grad, v["grad_vertices"], gradient_tolerance(name))


@pytest.mark.parametrize("name", COLORS)
def test_colors(name):
    v = load_vector(name)
    leaves = [torch.from_numpy(v[key]).requires_grad_() for key in ("vertices", "textures")]
    given = corners_of(v, leaves[0]), textures_of(v, leaves[1])
    settings = settings_of(v) | {"background_color": v["background"]}
    if str(v["mode"]) == "rgbad":
        images = nr.rasterize_rgbad(*given, **settings)
    else:
        images = {"rgb": nr.rasterize(*given, **settings)}
    upstream = [torch.from_numpy(v[f"grad_{output}"]) for output in images]
    grad, of_textures = torch.autograd.grad([*images.values()], leaves, upstream)
    for output, image in images.items():
        assert_image(image, v, output)
    assert_gradient(grad, v["grad_vertices"], gradient_tolerance(name))
    most = max(5 * v["grad_textures_fma_maxdiff"], 1e-5)
    assert np.abs(of_textures.numpy() - v["grad_textures"]).max() <= most


def scene():
    corners = 2 * uniform(2, 9, 3, 3, dtype=torch.float32) - 1
    corners[..., 2] = corners[..., 2] * 0.4 + 2
    return corners, uniform(2, 9, 2, 2, 2, 3, seed=1, dtype=torch.float32)


@pytest.mark.parametrize("size", [8.0, np.int64(8), np.float32(8), torch.tensor(8)])
def test_sizes_that_are_whole_numbers(size):
    corners, _ = scene()
    assert torch.equal(*(nr.rasterize_silhouettes(corners, n) for n in (size, 8)))


@pytest.mark.parametrize("flags", [*itertools.product((False, True), repeat=3)])
def test_outputs_that_are_not_wanted_are_none(flags):
    scale = 8, True, 0.1, 100, 1e-4, (0, 0, 0)
    images = nr.rasterize_rgbad(*scene(), *scale)
    assert list(images) == ["rgb", "alpha", "depth"]
    shapes = [tuple(image.shape) for image in images.values()]
    assert shapes == [(2, 3, 8, 8), (2, 8, 8), (2, 8, 8)]
    some = nr.rasterize_rgbad(*scene(), *scale, *flags)
    for flag, one, all_of_them in zip(flags, some.values(), images.values(), strict=True):
        assert torch.equal(one, all_of_them) if flag else one is None


def test_module_returns_rasters_from_the_bottom_up():
    corners, textures = scene()
    settings = 8, 0.1, 100, 1e-4, (0, 0, 0)
    rgb, *others = nr.Rasterize(*settings, True, True, True)(corners, textures)
    images = nr.rasterize_rgbad(corners, textures, 8, False)
    rasters = rgb.permute(0, 3, 1, 2).flip(2), *(x.flip(1) for x in others)
    assert same_bits(rasters, images.values())
    rgb, alpha, depth = nr.Rasterize(*settings, return_alpha=True)(corners)
    assert rgb.numel() == depth.numel() == 0 and alpha.shape == (2, 8, 8)


def test_one_texture_for_all_images_and_other_channels():
    corners, textures = scene()
    one, copies, plain = (
        nr.rasterize(corners, x, 8) for x in (textures[:1], textures[[0, 0]], textures)
    )
    assert torch.equal(one, copies)
    five = torch.cat([textures, textures[..., :2]], dim=-1)
    images = nr.rasterize(corners, five, 8, background_color=[0] * 5)
    assert torch.equal(images[:, :3], plain) and images.shape[1] == 5
