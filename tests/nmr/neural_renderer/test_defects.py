"""Defects of the published package that only this interface shows; "moving from neural_renderer" lists all of them."""

import numpy as np
import pytest
import torch
from scenes import leaf_of, uniform
from torch.testing import assert_close

import nmr
import nmr.neural_renderer as nr
from nmr.neural_renderer.load_obj import bake_textures


def scene(batch=2, ts=2):
    vertices, faces = nmr.icosphere(1)
    radius = 0.8 + 0.2 * uniform(batch, len(vertices), 1, dtype=torch.float32)
    textures = uniform(batch, len(faces), ts, ts, ts, 3, seed=1, dtype=torch.float32)
    return radius * vertices, faces.expand(batch, -1, -1), textures


def look_at_renderer(**settings):
    renderer = nr.Renderer(camera_mode="look_at", image_size=16, **settings)
    renderer.eye = nr.get_points_from_angles(2.7, 20, 30)
    return renderer


def test_textures_stay_as_they_are(fill_back):
    vertices, faces, textures = scene()
    leaf = leaf_of(textures)
    renderer = look_at_renderer(fill_back=fill_back)
    first, second = (renderer.render_rgb(vertices, faces, leaf) for _ in range(2))
    assert torch.equal(leaf, textures) and torch.equal(first, second)
    second.sum().backward()
    assert leaf.grad.any()
    nr.lighting(nr.vertices_to_faces(vertices, faces), textures)
    assert torch.equal(leaf, textures)


@pytest.mark.parametrize("wrapping", ["REPEAT", "MIRRORED_REPEAT", "CLAMP_TO_EDGE"])
@pytest.mark.parametrize("shift", [0, 2, -4])
def test_texture_coordinates_of_exactly_0_and_1(wrapping, shift):
    if shift and wrapping == "CLAMP_TO_EDGE":
        pytest.skip("there are no coordinates beyond the edge")
    image = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    uv = np.array([[[0, 0], [1, 0], [1, 1]]], dtype=np.float32) + shift
    kept = uv.copy()
    baked = bake_textures(image, uv, 4, wrapping, True)
    assert np.array_equal(uv, kept)
    for k, corner in enumerate([image[1, 0], image[1, 1], image[0, 1]]):
        assert np.array_equal(baked[(0, *(3 * (np.arange(3) == k)))], corner)
    if wrapping == "REPEAT":
        assert np.array_equal(bake_textures(image, uv + 1, 4, wrapping, True), baked)


@pytest.mark.parametrize("light", [0.0, 0.5])
def test_one_texel_is_one_colour(light):
    vertices, faces, textures = scene(ts=1)
    renderer = look_at_renderer(light_intensity_directional=light)
    leaf = leaf_of(textures)
    image = renderer.render_rgb(vertices, faces, leaf)
    larger = renderer.render_rgb(vertices, faces, textures.expand(-1, -1, 4, 4, 4, -1))
    assert_close(image, larger)
    image.sum().backward()
    assert leaf.grad.shape == textures.shape and leaf.grad.any()


def test_textures_of_more_than_two_to_the_31_numbers():
    """Only the last texels are written and read: pages of zeros that nobody touches take no memory."""
    ts = 895
    try:
        textures = np.zeros((1, 1, ts, ts, ts, 3), dtype=np.float32)
    except MemoryError:
        pytest.skip("the system promises no 8 GB")
    assert textures.size > 2**31
    textures[0, 0, -2:, :2, :2] = 1
    # the centre of pixel (2, 1) is all of corner 0
    far_away = torch.tensor([[[[0.0, 0, 2], [1e6, -1, 2], [1e6, 1, 2]]]])
    image = nr.rasterize(far_away, torch.from_numpy(textures), image_size=3, anti_aliasing=False)
    assert image[0, :, 1, 1].tolist() == [1, 1, 1]


@pytest.mark.parametrize("mode", ["rgb", "silhouettes", "depth", None])
def test_no_meshes_at_all(mode):
    images = look_at_renderer()(*(x[:0] for x in scene()), mode=mode)
    for image in images if mode is None else [images]:
        assert image.shape[0] == 0 and image.shape[-2:] == (16, 16)


@pytest.mark.parametrize("mode", ["rgb", "silhouettes", "depth"])
def test_fill_back_without_doubled_faces_is_fill_back(mode):
    vertices, faces, textures = scene()
    faces, textures = (
        faces[:, ::2],
        textures[:, ::2],
    )  # with holes, through which one sees the inside
    doubled = torch.cat([faces, faces.flip(2)], dim=1)
    cubes = torch.cat([textures, textures.permute(0, 1, 4, 3, 2, 5)], dim=1)
    inside, expected, outside = (
        look_at_renderer(fill_back=fill_back)(vertices, *given, mode=mode)
        for fill_back, *given in (
            (True, faces, textures),
            (False, doubled, cubes),
            (False, faces, textures),
        )
    )
    assert_close(inside, expected, rtol=1e-5, atol=1e-6)
    assert not torch.allclose(inside, outside)
