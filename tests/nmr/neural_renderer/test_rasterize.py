"""The raster-level vectors through the functions of the drop-in: faces doubled by hand, as its callers do."""

import numpy as np
import pytest
import torch
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
    return (
        torch.cat([textures, textures.permute(0, 1, 4, 3, 2, 5)], dim=1)
        if v["fill_back"]
        else textures
    )


def assert_image(image, v, name):
    image, expected = image.detach().numpy(), v[name]
    assert image.shape == expected.shape
    close = np.isclose(image, expected, rtol=1e-5, atol=1e-5)
    fragile = v.get(f"fragile_{name}")
    if fragile is not None:
        close[tuple(fragile.T)] = True
    assert close.all(), f"{name}: {np.argwhere(~close)[:5]}"


def assert_gradient(gradient, expected, tolerance):
    scale = np.linalg.norm(expected)
    if np.isfinite(tolerance):
        assert np.linalg.norm(gradient.numpy() - expected) <= tolerance * scale


@pytest.mark.parametrize("name", DEPTHS)
def test_depth(name):
    v = load_vector(name)
    vertices = torch.from_numpy(v["vertices"]).requires_grad_()
    depth = nr.rasterize_depth(corners_of(v, vertices), **settings_of(v))
    depth.backward(torch.from_numpy(v["grad_depth"]))
    assert np.array_equal(depth.detach().numpy(), v["depth"])  # fragile pixels included
    assert_gradient(vertices.grad, v["grad_vertices"], gradient_tolerance(name))


@pytest.mark.parametrize("name", COLORS)
def test_colors(name):
    v = load_vector(name)
    outputs = ("rgb", "alpha", "depth") if str(v["mode"]) == "rgbad" else ("rgb",)
    vertices, textures = (
        torch.from_numpy(v[key]).requires_grad_() for key in ("vertices", "textures")
    )
    corners, cubes = corners_of(v, vertices), textures_of(v, textures)
    settings = settings_of(v) | {"background_color": v["background"]}
    if outputs == ("rgb",):
        images = {"rgb": nr.rasterize(corners, cubes, **settings)}
    else:
        images = nr.rasterize_rgbad(corners, cubes, **settings)
    torch.autograd.backward(
        [images[o] for o in outputs], [torch.from_numpy(v[f"grad_{o}"]) for o in outputs]
    )
    for output in outputs:
        assert_image(images[output], v, output)
    assert_gradient(vertices.grad, v["grad_vertices"], gradient_tolerance(name))
    assert np.abs(textures.grad.numpy() - v["grad_textures"]).max() <= max(
        5 * v["grad_textures_fma_maxdiff"], 1e-5
    )


def scene(batch=2, ts=2, dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    corners = torch.rand(batch, 9, 3, 3, generator=generator, dtype=dtype) * 2 - 1
    corners[..., 2] = corners[..., 2] * 0.4 + 2
    return corners, torch.rand(batch, 9, ts, ts, ts, 3, generator=generator, dtype=dtype)


@pytest.mark.parametrize("size", [8.0, np.int64(8), np.float32(8), torch.tensor(8)])
def test_sizes_that_are_whole_numbers(size):
    corners, _ = scene()
    assert torch.equal(
        nr.rasterize_silhouettes(corners, size), nr.rasterize_silhouettes(corners, 8)
    )


def test_outputs_that_are_not_wanted_are_none():
    corners, textures = scene()
    images = nr.rasterize_rgbad(corners, textures, image_size=8)
    assert list(images) == ["rgb", "alpha", "depth"]
    shapes = [tuple(image.shape) for image in images.values()]
    assert shapes == [(2, 3, 8, 8), (2, 8, 8), (2, 8, 8)]
    for wanted in range(8):
        flags = [bool(wanted & 1), bool(wanted & 2), bool(wanted & 4)]
        some = nr.rasterize_rgbad(corners, textures, 8, True, 0.1, 100, 1e-4, (0, 0, 0), *flags)
        for flag, one, all_of_them in zip(flags, some.values(), images.values(), strict=True):
            assert (one is None) if not flag else torch.equal(one, all_of_them)


def test_module_returns_rasters_from_the_bottom_up():
    corners, textures = scene()
    images = nr.rasterize_rgbad(corners, textures, 8, False)
    rgb, alpha, depth = nr.Rasterize(8, 0.1, 100, 1e-4, (0, 0, 0), True, True, True)(
        corners, textures
    )
    assert torch.equal(rgb.flip(1).permute(0, 3, 1, 2), images["rgb"])
    assert torch.equal(alpha.flip(1), images["alpha"]) and torch.equal(
        depth.flip(1), images["depth"]
    )
    rgb, alpha, depth = nr.Rasterize(8, 0.1, 100, 1e-4, (0, 0, 0), return_alpha=True)(corners)
    assert rgb.numel() == depth.numel() == 0 and alpha.shape == (2, 8, 8)


def test_one_texture_for_all_images_and_other_channels():
    corners, textures = scene()
    shared = nr.rasterize(corners, textures[:1], 8)
    assert torch.equal(shared, nr.rasterize(corners, textures[:1].expand(2, -1, -1, -1, -1, -1), 8))
    five = torch.cat([textures, textures[..., :2]], dim=-1)
    images = nr.rasterize(corners, five, 8, background_color=[0] * 5)
    assert torch.equal(images[:, :3], nr.rasterize(corners, textures, 8)) and images.shape[1] == 5
