"""What the published package gets wrong, one test each; the page "moving from neural_renderer" lists them."""

import numpy as np
import pytest
import torch
from vectors import load_vector, vector_names

import nmr
import nmr.neural_renderer as nr
from nmr.neural_renderer.load_obj import bake_textures


def scene(batch=2, ts=2, dtype=torch.float32):
    vertices, faces = nmr.icosphere(1)
    generator = torch.Generator().manual_seed(0)
    vertices = vertices.to(dtype) * (0.8 + 0.2 * torch.rand(batch, len(vertices), 1, generator=generator, dtype=dtype))
    textures = torch.rand(batch, len(faces), ts, ts, ts, 3, generator=generator, dtype=dtype)
    return vertices, faces.expand(batch, -1, -1), textures


def look_at_renderer(**settings):
    renderer = nr.Renderer(camera_mode="look_at", image_size=16, **settings)
    renderer.eye = nr.get_points_from_angles(2.7, 20, 30)
    return renderer


@pytest.mark.parametrize("name", vector_names("quirk_sil_*"))
def test_slivers_paint_no_stray_pixels(name):
    v = load_vector(name)
    vertices = torch.from_numpy(v["vertices"]).requires_grad_()
    corners = nr.vertices_to_faces(vertices, torch.from_numpy(v["faces"]))
    if v["fill_back"]:
        corners = torch.cat([corners, corners.flip(2)], dim=1)
    settings = {key: v[key].item() for key in ("image_size", "anti_aliasing", "near", "far", "eps")}
    alpha = nr.rasterize_silhouettes(corners, **settings)
    alpha.backward(torch.from_numpy(v["grad_alpha"]))
    assert v["alpha"].any() and not alpha.any() and not vertices.grad.any()


def test_cross_products_run_along_coordinates_in_a_batch_of_three():
    vertices, eyes, targets = torch.rand(3, 5, 3), torch.rand(3, 3) - 3, torch.rand(3, 3)
    together = nr.look_at(vertices, eyes, targets), nr.look(vertices, eyes, targets)
    for b in range(3):
        one = slice(b, b + 1)
        torch.testing.assert_close(together[0][one], nr.look_at(vertices[one], eyes[one], targets[one]))
        torch.testing.assert_close(together[1][one], nr.look(vertices[one], eyes[one], targets[one]))


def test_light_on_three_faces():
    faces, textures = torch.rand(3, 1, 3, 3), torch.rand(3, 1, 2, 2, 2, 3)
    together = nr.lighting(faces, textures, direction=(0.3, 0.5, 0.8))
    for b in range(3):
        one = slice(b, b + 1)
        torch.testing.assert_close(together[one], nr.lighting(faces[one], textures[one], direction=(0.3, 0.5, 0.8)))


def test_each_image_has_its_own_textures():
    vertices, faces, textures = scene()
    renderer = look_at_renderer()
    together = renderer.render_rgb(vertices, faces, textures)
    for b in range(2):
        one = slice(b, b + 1)
        torch.testing.assert_close(together[one], renderer.render_rgb(vertices[one], faces[one], textures[one]))
    assert not torch.equal(together, renderer.render_rgb(vertices, faces, textures[:1]))


@pytest.mark.parametrize("fill_back", [True, False])
def test_textures_stay_as_they_are(fill_back):
    vertices, faces, textures = scene()
    leaf = textures.clone().requires_grad_()
    renderer = look_at_renderer(fill_back=fill_back)
    first, second = (renderer.render_rgb(vertices, faces, leaf) for _ in range(2))
    assert torch.equal(leaf, textures) and torch.equal(first, second)
    second.sum().backward()
    assert leaf.grad.any()
    nr.lighting(nr.vertices_to_faces(vertices, faces), textures)
    assert torch.equal(leaf, textures)


@pytest.mark.parametrize("wrapping", ["REPEAT", "MIRRORED_REPEAT", "CLAMP_TO_EDGE"])
def test_texture_coordinates_of_exactly_0_and_1(wrapping):
    image = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    for shift in (0, 2, -4) if wrapping != "CLAMP_TO_EDGE" else (0,):
        uv = np.array([[[0, 0], [1, 0], [1, 1]]], dtype=np.float32) + shift
        kept = uv.copy()
        baked = bake_textures(image, uv, 4, wrapping, True)
        assert np.array_equal(uv, kept)
        for k, corner in enumerate([image[1, 0], image[1, 1], image[0, 1]]):
            assert np.array_equal(baked[(0, *(3 * (np.arange(3) == k)))], corner)
    if wrapping == "REPEAT":
        odd = np.array([[[1, 1], [2, 1], [2, 2]]], dtype=np.float32)
        assert np.array_equal(
            bake_textures(image, odd, 4, wrapping, True), bake_textures(image, odd - 1, 4, wrapping, True)
        )


@pytest.mark.parametrize("light", [0.0, 0.5])
def test_one_texel_is_one_colour(light):
    vertices, faces, textures = scene(ts=1)
    renderer = look_at_renderer(light_intensity_directional=light)
    leaf = textures.clone().requires_grad_()
    image = renderer.render_rgb(vertices, faces, leaf)
    larger = renderer.render_rgb(vertices, faces, textures.expand(-1, -1, 4, 4, 4, -1))
    torch.testing.assert_close(image, larger)
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
    far_away = torch.tensor(
        [[[[0.0, 0, 2], [1e6, -1, 2], [1e6, 1, 2]]]]
    )  # the centre of pixel (2, 1) is all of corner 0
    image = nr.rasterize(far_away, torch.from_numpy(textures), image_size=3, anti_aliasing=False)
    assert image[0, :, 1, 1].tolist() == [1, 1, 1]


@pytest.mark.parametrize("mode", ["rgb", "silhouettes", "depth"])
def test_float64(mode):
    vertices, faces, textures = scene(dtype=torch.float64)
    vertices.requires_grad_()
    image = look_at_renderer()(vertices, faces, textures, mode=mode)
    image.sum().backward()
    assert image.dtype == vertices.grad.dtype == torch.float64 and vertices.grad.any()
    single = look_at_renderer()(vertices.float(), faces, textures.float(), mode=mode)
    torch.testing.assert_close(image.float(), single, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("mode", ["rgb", "silhouettes", "depth", None])
def test_no_meshes_at_all(mode):
    vertices, faces, textures = scene()
    images = look_at_renderer()(vertices[:0].requires_grad_(), faces[:0], textures[:0], mode=mode)
    for image in images if mode is None else [images]:
        assert image.shape[0] == 0 and image.shape[-2:] == (16, 16)


@pytest.mark.parametrize("mode", ["rgb", "silhouettes", "depth"])
def test_fill_back_without_doubled_faces_is_fill_back(mode):
    vertices, faces, textures = scene()
    faces = faces[:, ::2]  # with holes, through which one sees the inside
    textures = textures[:, ::2]
    inside = look_at_renderer(fill_back=True)(vertices, faces, textures, mode=mode)
    doubled = torch.cat([faces, faces.flip(2)], dim=1)
    cubes = torch.cat([textures, textures.permute(0, 1, 4, 3, 2, 5)], dim=1)
    expected = look_at_renderer(fill_back=False)(vertices, doubled, cubes, mode=mode)
    torch.testing.assert_close(inside, expected, rtol=1e-5, atol=1e-6)
    outside = look_at_renderer(fill_back=False)(vertices, faces, textures, mode=mode)
    assert not torch.allclose(inside, outside)


def test_gradients_do_not_change_from_run_to_run():
    def gradients(threads):
        torch.set_num_threads(threads)
        vertices, faces, textures = scene(batch=3)
        leaves = vertices.requires_grad_(), textures.requires_grad_()
        renderer = nr.Renderer(camera_mode="look_at", image_size=64)
        rgb, depth, alpha = renderer(vertices, faces, textures)
        generator = torch.Generator().manual_seed(1)
        torch.autograd.backward(
            [rgb, depth, alpha], [torch.randn(x.shape, generator=generator) for x in (rgb, depth, alpha)]
        )
        return [leaf.grad for leaf in leaves]

    before = torch.get_num_threads()
    try:
        expected = gradients(1)
        for threads in (1, 2, 4):
            for gradient, one in zip(gradients(threads), expected, strict=True):
                assert torch.equal(gradient, one)
    finally:
        torch.set_num_threads(before)


def test_projection_of_a_vertex_on_the_optical_axis():
    vertices = torch.tensor([[[0.0, 0, 2], [0.1, 0.2, 2]]], requires_grad=True)
    K, dist_coeffs = torch.tensor([[9.0, 0, 4], [0, 9, 4], [0, 0, 1]]), torch.tensor([[0.1, 0.2, 0.01, 0.02, 0.3]])
    nr.projection(vertices, K, torch.eye(3), torch.zeros(3), dist_coeffs, 8).sum().backward()
    torch.testing.assert_close(vertices.grad[0, 0], torch.tensor([9 / 8, -9 / 8, 1]))


def test_edges_that_are_side_2_0_of_both_faces():
    """The published smoothness loss is not part of the package; ``nmr.edge_table`` is what replaces its table."""
    tetrahedron = torch.tensor(
        [[0, 1, 2], [3, 0, 2], [1, 3, 2], [1, 0, 3]]
    )  # side 2-0 of the first two faces is 0-2, 3-2
    edges = nmr.edge_table(tetrahedron)
    assert sorted(map(tuple, edges[:, :2].sort(1).values.tolist())) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
