"""Soft silhouettes and soft colours."""

import math

import pytest
import reference
import torch
from scenes import (
    assert_near,
    double,
    leaf_of,
    random_soup,
    square,
    uniform,
    value_and_gradients,
)
from torch.autograd import gradcheck
from torch.testing import assert_close

import nmr


def soup(seed, num_faces=10):
    """Random triangles in renderer space, some of them partly off the screen, some thin."""
    vertices, faces = random_soup(seed, 1, num_faces, size=0.4)
    vertices[0, 2] = vertices[0, :2].mean(0) + 0.002
    vertices[0, 2, 2] = 1.5
    return vertices[0], faces


@pytest.mark.parametrize("image_size", [24, (16, 40), (33, 17)])
@pytest.mark.parametrize("sigma", [1e-5, 1e-3, 0.1])
def test_equals_the_slow_definition(image_size, sigma, fill_back):
    vertices, faces = soup(0)
    how = dict(sigma=sigma, fill_back=fill_back)

    def fast(x):
        return nmr.render_soft_silhouette(x, faces, image_size=image_size, **how)[0]

    def slow(x):
        return reference.soft_silhouette(x, faces, image_size, **how)

    (alpha, grad), (wanted, slow_grad), (single, single_grad) = (
        value_and_gradients(fast, vertices),
        value_and_gradients(slow, vertices),
        value_and_gradients(fast, vertices.float()),
    )
    assert_close(alpha, wanted, rtol=0, atol=1e-12)
    assert_near(grad, slow_grad, 1e-9)
    assert grad.any() and not grad[:, 2].any()
    # A float32 distance of 1e-7 moves D by 1e-7 d / sigma.
    assert_close(single.double(), alpha, rtol=0, atol=max(2e-6, 2e-8 / sigma))
    assert (single_grad - grad).norm() < 1e-3 * grad.norm()


def test_a_face_of_one_vertex_is_none():
    vertices, faces = soup(2)
    more = torch.cat([faces, torch.zeros(5, 3, dtype=torch.int64)])
    plain, image = (
        nmr.render_soft_silhouette(vertices, f, sigma=0.1, image_size=16) for f in (faces, more)
    )
    assert torch.equal(plain, image)
    assert_close(image[0], reference.soft_silhouette(vertices, more, 16, sigma=0.1))


def test_gradients_are_the_derivative(anti_aliasing):
    vertices, faces = soup(1)
    # faces are left out nowhere, so that the image is smooth
    how = dict(dist_eps=1e-30, image_size=(5, 8), anti_aliasing=anti_aliasing)
    how["camera"] = nmr.LookAt([0.0, 0.0, -2.0], half_fov_deg=25.0)

    def draw(vertices, sigma):
        return nmr.render_soft_silhouette(vertices, faces[1:], sigma=sigma, **how)

    given = leaf_of(vertices), leaf_of(double(0.05))
    gradcheck(draw, given, eps=1e-6, atol=1e-6, rtol=1e-5)


def test_published_constants():
    # One vertical border at x = 0: D = 0.5 there, sigmoid(-+d^2 / sigma) beside it, 0 beyond the distance of dist_eps.
    vertices, face = double([[0, -9, 1], [9, 0, 1], [0, 9, 1]]), torch.tensor([[0, 1, 2]])
    alpha = nmr.render_soft_silhouette(vertices, face, image_size=(1, 1001))[0, 0]
    assert alpha[500].item() == pytest.approx(0.5)
    vertices = vertices / double([900.0, 9.0, 1.0])  # in a square of 400 pixels
    alpha = nmr.render_soft_silhouette(vertices, face, image_size=400)[0, 200, :200]
    wanted = torch.sigmoid(-((2 * torch.arange(200).double() - 399) / 400).square() / 1e-5)
    wanted[wanted < 1e-4] = 0
    assert_close(alpha, wanted, rtol=1e-6, atol=1e-12)
    assert 0 < alpha[alpha > 0].min() < 1e-2


def test_with_a_small_sigma_it_is_the_silhouette():
    camera = nmr.LookAt.from_angles(2.732, 30.0, [0.0, 70.0], half_fov_deg=30.0)
    mesh = *nmr.icosphere(3), camera
    for image_size in (64, (48, 80)):
        soft = nmr.render_soft_silhouette(*mesh, sigma=1e-9, image_size=image_size)
        hard = nmr.render_silhouette(*mesh, image_size=image_size, anti_aliasing=False)
        assert ((soft - hard).abs() > 0.01).float().mean() < 0.01
    averaged = nmr.render_soft_silhouette(*mesh, image_size=32, anti_aliasing=True)
    fine = nmr.render_soft_silhouette(*mesh, image_size=64)
    assert_close(averaged, torch.nn.functional.avg_pool2d(fine, 2), rtol=0, atol=1e-6)


@pytest.mark.parametrize("shift", [-3.0, 200.0])
def test_faces_out_of_range_draw_nothing(shift):
    vertices, faces = soup(2)
    away = vertices + torch.tensor([0.0, 0.0, shift])
    assert not nmr.render_soft_silhouette(away, faces, image_size=16, clip=False).any()


NEAR, FAR = 0.5, 20.0
PARALLEL = nmr.cameras.Projection(torch.eye(3, 4)[None], torch.eye(2, 3)[None], perspective=False)


def rgba(images):
    rgb, alpha = images
    return torch.cat([rgb, alpha[..., None]], dim=-1)


def scene(seed, num_faces=8, sigma=0.02, gamma=0.05):
    """Random triangles that overlap: faces; vertices, their colours, a background, sigma and gamma."""
    vertices, faces = random_soup(seed, 1, num_faces)
    vertices = vertices[0]
    return faces, [
        vertices,
        uniform(len(vertices), 2),
        uniform(2, seed=1),
        double(sigma),
        double(gamma),
    ]


@pytest.mark.parametrize("camera", [None, PARALLEL], ids=["perspective", "parallel"])
@pytest.mark.parametrize("size, layers", [((9, 14), 50), ((12, 7), 3)])
@pytest.mark.parametrize("seed", range(3))
def test_image_and_gradients_equal_the_slow_definition(seed, size, layers, camera):
    faces, inputs = scene(seed)

    def fast(vertices, colors, background, sigma, gamma):
        how = dict(sigma=sigma, gamma=gamma, background=background, colors=nmr.VertexColors(colors))
        how |= dict(faces_per_pixel=layers, near=NEAR, far=FAR, image_size=size, clip=False)
        return rgba(nmr.render_soft(vertices, faces, camera, **how))[0]

    def slow(vertices, colors, background, sigma, gamma):
        given = vertices, faces, colors, background, size, sigma, gamma, layers, NEAR, FAR
        return rgba(reference.soft_colors(*given, perspective=camera is None))

    (image, *grads), (wanted, *slow_grads) = (
        value_and_gradients(function, *inputs) for function in (fast, slow)
    )
    assert_close(image, wanted, rtol=0, atol=1e-12)
    assert all(x.any() for x in slow_grads) and slow_grads[0][:, 2].any()
    assert_near(grads, slow_grads, 1e-7)


def test_gradients_of_colors_are_the_derivative():
    faces, inputs = scene(1, 4, 0.3, 0.4)

    def draw(vertices, colors, background, sigma, gamma):
        # no face is left out, so that the image is smooth
        how = dict(dist_eps=1e-30, near=1e-3, image_size=(5, 6), anti_aliasing=True, clip=False)
        how |= dict(sigma=sigma, gamma=gamma, background=background)
        return (*nmr.render_soft(vertices, faces, colors=nmr.VertexColors(colors), **how),)

    gradcheck(draw, [leaf_of(x) for x in inputs], eps=1e-7, atol=1e-5, rtol=1e-4)


def test_a_face_shows_its_colour_beyond_its_border_and_the_background_behind():
    mesh, red, blue = square(-0.5, -0.5, 0.0, 0.5), double([1.0, 0, 0]), double([0.0, 0, 1.0])
    how = dict(colors=nmr.VertexColors(red.expand(4, 3)), background=blue, sigma=1e-3)
    rgb, alpha = nmr.render_soft(*mesh, image_size=100, **how)
    row, reach = rgb[0, 50], (1e-3 * math.log(1e4 - 1)) ** 0.5
    x = (torch.arange(100).double() + 0.5) / 50 - 1
    near_border, beyond = (x > 0) & (x < reach), x > reach
    assert_close(row[near_border], red.expand_as(row[near_border]), rtol=0, atol=1e-6)
    assert_close(alpha[0, 50, 50], torch.sigmoid(-(x[50] ** 2) / 1e-3), rtol=1e-6, atol=0)
    assert torch.equal(row[beyond], blue.expand_as(row[beyond]))
    # now D counts: more blue farther out
    soft, _ = nmr.render_soft(*mesh, image_size=100, gamma=0.5, **how)
    assert (soft[0, 50, near_border, 2].diff() > 0).all() and soft[0, 50, 25, 2] < 0.3


def test_fragments_of_a_blur_know_the_distance():
    vertices, faces = random_soup(2, 1)
    how = dict(image_size=16, faces_per_pixel=30, clip=False)
    blurred = nmr.render_fragments(vertices, faces, blur_radius=0.05, **how)
    sharp = nmr.render_fragments(vertices, faces, **how)
    outside, inside = blurred.covered & (blurred.distances > 0), blurred.distances < 0
    assert outside.any() and (blurred.distances[outside] < 0.05).all()
    assert (blurred.weights >= 0).all()

    def surfaces(fragments, counts):
        """Faces, depths and sides at each pixel, by the number of the face."""
        index, order = torch.where(counts, fragments.face_index, 9999).sort(-1)
        values = torch.where(counts, fragments.depth, FAR), fragments.is_back & counts
        return index, *(x.gather(-1, order) for x in values)

    assert_close(surfaces(blurred, inside), surfaces(sharp, sharp.covered))
    with pytest.raises(ValueError, match="only the nearest surfaces"):
        blurred.layer(0).resolve(blurred.interpolate(vertices)[..., 0, :])


def test_transparent_surfaces_are_composited_front_to_back():
    vertices, faces = random_soup(0, 1)
    how = dict(image_size=12, faces_per_pixel=40, anti_aliasing=False)
    index = nmr.render_fragments(vertices, faces, **how).face_index[0].view(144, 40)

    def fast(colors, opacity, background):
        layers = dict(colors=nmr.FaceColors(colors), opacity=nmr.FaceColors(opacity))
        images = nmr.render_transparent(vertices, faces, background=background, **layers, **how)
        return rgba(images)[0]

    def slow(colors, opacity, background):
        pixels = []
        for pixel in index.tolist():
            color, clear = background, torch.ones(1).double()
            for face in [f for f in pixel if f >= 0][::-1]:  # from the back, painted over
                color = opacity[face] * colors[face] + (1 - opacity[face]) * color
                clear = clear * (1 - opacity[face])
            pixels.append(torch.cat([color, 1 - clear]))
        return torch.stack(pixels).view(12, 12, 4)

    inputs = uniform(len(faces), 3), uniform(len(faces), 1, seed=1), uniform(3, seed=2)
    assert_close(*(value_and_gradients(function, *inputs) for function in (fast, slow)))


@pytest.mark.parametrize("layers", [1, 3])
def test_opaque_surfaces_are_those_of_render(layers):
    vertices, faces = random_soup(1, 1)
    how = dict(
        colors=nmr.VertexColors(vertices), lights=nmr.Lights(), background=0.3, image_size=20
    )

    def opaque(x):
        return rgba(nmr.render_transparent(x, faces, opacity=1.0, faces_per_pixel=layers, **how))

    def plain(x):
        return rgba(nmr.render(x, faces, outputs=("rgb", "alpha"), **how))

    assert_close(*(value_and_gradients(draw, vertices) for draw in (opaque, plain)))


def test_colours_and_lights_of_layers_are_those_of_each_layer():
    vertices, faces = nmr.icosphere(1)
    uv, image, colors = vertices[:, :2], torch.rand(32, 32, 3), torch.rand(1, 12, 12, 3, 3)
    how = dict(image_size=12, faces_per_pixel=3)
    layers = nmr.render_fragments(vertices, faces, nmr.LookAt([0.1, 0.2, -3.0]), **how)
    each = [layers.layer(k) for k in range(3)]
    bumps = nmr.NormalMap(image - torch.tensor([0.5, 0.5, -1.0]), uv)
    for lights in (nmr.Lights(specular=0.5), nmr.Lights(normals=bumps, harmonics=torch.rand(9, 3))):
        wanted = [lights.shade(layer, colors[..., k, :]) for k, layer in enumerate(each)]
        assert_close(lights.shade(layers, colors), torch.stack(wanted, dim=3))
    cubes = nmr.TextureCubes(torch.rand(len(faces), 2, 2, 2, 3))
    textures = nmr.UVTexture(image, uv), nmr.UVTexture(image, uv, filter="mipmap")
    for sampler in (*textures, bumps, cubes):
        wanted = torch.stack([sampler.sample(layer) for layer in each], dim=3)
        assert torch.equal(sampler.sample(layers), wanted) and wanted[..., 1, :].any()
