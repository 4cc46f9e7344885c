"""Soft silhouettes and soft colours."""

import pytest
import reference
import torch
from scenes import random_soup

import nmr


def soup(seed, dtype=torch.float64, num_faces=10):
    """Random triangles in renderer space, some of them partly off the screen, some thin."""
    g = torch.Generator().manual_seed(seed)
    centre = torch.rand(num_faces, 1, 3, generator=g) * 2 - 1
    corners = centre + 0.4 * torch.randn(num_faces, 3, 3, generator=g)
    corners[0, 2] = corners[0, :2].mean(0) + 0.002
    corners[..., 2] = 1 + torch.rand(num_faces, 3, generator=g)
    return corners.view(-1, 3).to(dtype), torch.arange(num_faces * 3).view(-1, 3)


@pytest.mark.parametrize("image_size", [24, (16, 40), (33, 17)])
@pytest.mark.parametrize("sigma", [1e-5, 1e-3, 0.1])
@pytest.mark.parametrize("fill_back", [False, True])
def test_equals_the_slow_definition(image_size, sigma, fill_back):
    vertices, faces = soup(0)
    vertices.requires_grad_()
    options = {"sigma": sigma, "fill_back": fill_back}
    alpha = nmr.render_soft_silhouette(vertices, faces, image_size=image_size, **options)[0]
    wanted = reference.soft_silhouette(vertices, faces, image_size, **options)
    torch.testing.assert_close(alpha, wanted, rtol=0, atol=1e-12)
    upstream = torch.randn(
        alpha.shape, dtype=alpha.dtype, generator=torch.Generator().manual_seed(1)
    )
    grad, slow = (torch.autograd.grad(image, vertices, upstream)[0] for image in (alpha, wanted))
    torch.testing.assert_close(grad, slow, rtol=1e-9, atol=1e-9 * float(slow.abs().max()))
    assert slow.any() and not grad[:, 2].any()
    single = vertices.detach().float().requires_grad_()
    image = nmr.render_soft_silhouette(single, faces, image_size=image_size, **options)[0]
    # A float32 distance of 1e-7 moves D by 1e-7 d / sigma.
    torch.testing.assert_close(image.double(), alpha, rtol=0, atol=max(2e-6, 2e-8 / sigma))
    (single_grad,) = torch.autograd.grad(image, single, upstream.float())
    assert (single_grad - grad).norm() < 1e-3 * grad.norm()


def test_a_face_of_one_vertex_is_none():
    vertices, faces = soup(2)
    more = torch.cat([faces, torch.zeros(5, 3, dtype=torch.int64)])
    images = [
        nmr.render_soft_silhouette(vertices, f, sigma=0.1, image_size=16)[0] for f in (faces, more)
    ]
    assert torch.equal(*images)
    torch.testing.assert_close(images[1], reference.soft_silhouette(vertices, more, 16, sigma=0.1))


@pytest.mark.parametrize("anti_aliasing", [False, True])
def test_gradients_are_the_derivative(anti_aliasing):
    vertices, faces = soup(1)
    camera = nmr.LookAt([0.0, 0.0, -2.0], half_fov_deg=25.0)

    def draw(vertices, sigma):  # faces are left out nowhere, so that the image is smooth
        options = {
            "sigma": sigma,
            "dist_eps": 1e-30,
            "image_size": (5, 8),
            "anti_aliasing": anti_aliasing,
        }
        return nmr.render_soft_silhouette(vertices, faces[1:], camera, **options)

    given = vertices.requires_grad_(), torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(draw, given, eps=1e-6, atol=1e-6, rtol=1e-5)


def test_published_constants():
    # One vertical border at x = 0: D = 0.5 there, sigmoid(-+d^2 / sigma) beside it, 0 beyond the distance of dist_eps.
    vertices = torch.tensor(
        [[0.0, -9.0, 1.0], [9.0, 0.0, 1.0], [0.0, 9.0, 1.0]], dtype=torch.float64
    )
    alpha = nmr.render_soft_silhouette(vertices, torch.tensor([[0, 1, 2]]), image_size=(1, 1001))[
        0, 0
    ]
    torch.testing.assert_close(alpha[500], torch.tensor(0.5, dtype=torch.float64))
    vertices = vertices / torch.tensor([900.0, 9.0, 1.0])  # in a square of 400 pixels
    alpha = nmr.render_soft_silhouette(vertices, torch.tensor([[0, 1, 2]]), image_size=400)[0, 200]
    d = (2 * torch.arange(400, dtype=torch.float64) - 399) / 400
    left = d < 0
    wanted = torch.sigmoid(-d.square() / 1e-5)
    wanted[wanted < 1e-4] = 0
    torch.testing.assert_close(alpha[left], wanted[left], rtol=1e-6, atol=1e-12)
    assert 0 < alpha[left & (alpha > 0)].min() < 1e-2


def test_with_a_small_sigma_it_is_the_silhouette():
    vertices, faces = nmr.icosphere(3)
    camera = nmr.LookAt.from_angles(2.732, 30.0, [0.0, 70.0], half_fov_deg=30.0)
    for image_size in (64, (48, 80)):
        soft = nmr.render_soft_silhouette(
            vertices, faces, camera, sigma=1e-9, image_size=image_size
        )
        hard = nmr.render_silhouette(
            vertices, faces, camera, image_size=image_size, anti_aliasing=False
        )
        assert ((soft - hard).abs() > 0.01).float().mean() < 0.01
    averaged = nmr.render_soft_silhouette(
        vertices, faces, camera, image_size=32, anti_aliasing=True
    )
    fine = nmr.render_soft_silhouette(vertices, faces, camera, image_size=64)
    torch.testing.assert_close(averaged, fine.view(2, 32, 2, 32, 2).mean((2, 4)), rtol=0, atol=1e-6)


@pytest.mark.parametrize("shift", [-3.0, 200.0])
def test_faces_out_of_range_draw_nothing(shift):
    vertices, faces = soup(2)
    away = vertices + torch.tensor([0.0, 0.0, shift])
    assert not nmr.render_soft_silhouette(away, faces, image_size=16, clip=False).any()


NEAR, FAR = 0.5, 20.0
PARALLEL = nmr.cameras.Projection(torch.eye(3, 4)[None], torch.eye(2, 3)[None], perspective=False)


def noise(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def scene(seed, num_faces=8):
    """Random triangles that overlap, their colours, a background, sigma and gamma."""
    vertices, faces = random_soup(seed, 1)
    vertices, faces = vertices[0, : 3 * num_faces], torch.arange(3 * num_faces).view(-1, 3)
    leaves = (
        vertices,
        noise(len(vertices), 2),
        noise(2, seed=1),
        torch.tensor(0.02),
        torch.tensor(0.05),
    )
    return faces, [x.double().clone().requires_grad_() for x in leaves]


@pytest.mark.parametrize("camera", [None, PARALLEL], ids=["perspective", "parallel"])
@pytest.mark.parametrize("size, layers", [((9, 14), 50), ((12, 7), 3)])
@pytest.mark.parametrize("seed", range(3))
def test_image_and_gradients_equal_the_slow_definition(seed, size, layers, camera):
    faces, leaves = scene(seed)
    vertices, colors, background, sigma, gamma = leaves
    how = dict(
        sigma=sigma,
        gamma=gamma,
        faces_per_pixel=layers,
        near=NEAR,
        far=FAR,
        image_size=size,
        clip=False,
    )
    colored = dict(colors=nmr.VertexColors(colors), background=background)
    rgb, alpha = nmr.render_soft(vertices, faces, camera, **colored, **how)
    wanted = reference.soft_colors(
        vertices,
        faces,
        colors,
        background,
        size,
        sigma,
        gamma,
        layers,
        NEAR,
        FAR,
        perspective=camera is None,
    )
    upstream = [noise(*size, 2, seed=2), noise(*size, seed=3)]
    for image, slow in zip((rgb[0], alpha[0]), wanted, strict=True):
        torch.testing.assert_close(image, slow, rtol=0, atol=1e-12)
    fast = torch.autograd.grad([rgb[0], alpha[0]], leaves, upstream)
    slow = torch.autograd.grad(wanted, leaves, upstream)
    assert all(x.any() for x in slow) and slow[0][:, 2].any()
    for a, b in zip(fast, slow, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-7, atol=1e-8 * float(b.abs().max()))


def test_gradients_of_colors_are_the_derivative():
    faces, leaves = scene(1, 4)

    def draw(
        vertices, colors, background, sigma, gamma
    ):  # no face is left out, so that the image is smooth
        how = dict(
            sigma=sigma,
            gamma=gamma,
            dist_eps=1e-30,
            near=1e-3,
            image_size=(5, 6),
            anti_aliasing=True,
        )
        colors = nmr.VertexColors(colors)
        return (
            *nmr.render_soft(
                vertices, faces, colors=colors, background=background, **how, clip=False
            ),
        )

    leaves[3:] = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (0.3, 0.4)]
    assert torch.autograd.gradcheck(draw, leaves, eps=1e-7, atol=1e-5, rtol=1e-4)


def test_a_face_shows_its_colour_beyond_its_border_and_the_background_behind():
    vertices = torch.tensor(
        [[-0.5, -0.5, 2.0], [0.0, -0.5, 2.0], [0.0, 0.5, 2.0], [-0.5, 0.5, 2.0]]
    ).double()
    faces, red = torch.tensor([[0, 1, 2], [0, 2, 3]]), torch.tensor([[1.0, 0.0, 0.0]]).expand(4, 3)
    how = dict(colors=nmr.VertexColors(red), background=(0.0, 0.0, 1.0), sigma=1e-3, image_size=100)
    rgb, alpha = nmr.render_soft(vertices, faces, **how)
    row, reach = rgb[0, 50], (1e-3 * torch.log(torch.tensor(1e4 - 1))).sqrt()
    x = (torch.arange(100) + 0.5) / 50 - 1
    near_border = (x > 0) & (x < reach)
    torch.testing.assert_close(
        row[near_border], red[:1].expand(int(near_border.sum()), 3).double(), rtol=0, atol=1e-6
    )
    torch.testing.assert_close(
        alpha[0, 50, 50], torch.sigmoid(-(x[50].double() ** 2) / 1e-3), rtol=1e-6, atol=0
    )
    assert torch.equal(
        row[x > reach], torch.tensor([[0.0, 0.0, 1.0]]).expand(int((x > reach).sum()), 3).double()
    )
    # now D counts: more blue farther out
    soft, _ = nmr.render_soft(vertices, faces, gamma=0.5, **how)
    assert (soft[0, 50, near_border, 2].diff() > 0).all() and soft[0, 50, 25, 2] < 0.3


def test_fragments_of_a_blur_know_the_distance():
    vertices, faces = random_soup(2, 1)
    fragments = nmr.render_fragments(
        vertices, faces, image_size=16, blur_radius=0.05, faces_per_pixel=30, clip=False
    )
    sharp = nmr.render_fragments(vertices, faces, image_size=16, faces_per_pixel=30, clip=False)
    outside = fragments.covered & (fragments.distances > 0)
    assert (
        outside.any()
        and (fragments.distances[outside] < 0.05).all()
        and (fragments.weights >= 0).all()
    )
    inside = fragments.distances < 0
    assert torch.equal(inside.sum(-1), sharp.covered.sum(-1))
    index, order = torch.where(inside, fragments.face_index, 9999).sort(-1)
    wanted, other = torch.where(sharp.covered, sharp.face_index, 9999).sort(-1)
    assert torch.equal(index, wanted)
    depths = torch.where(inside, fragments.depth, FAR).gather(-1, order)
    torch.testing.assert_close(
        depths, torch.where(sharp.covered, sharp.depth, FAR).gather(-1, other)
    )
    assert torch.equal(
        fragments.is_back.gather(-1, order)[inside.gather(-1, order)],
        sharp.is_back.gather(-1, other)[sharp.covered.gather(-1, other)],
    )
    with pytest.raises(ValueError, match="only the nearest surfaces"):
        fragments.layer(0).resolve(fragments.interpolate(vertices)[..., 0, :])


def test_transparent_surfaces_are_composited_front_to_back():
    vertices, faces = random_soup(0, 1)
    colors = noise(len(faces), 3).requires_grad_()
    opacity = noise(len(faces), 1, seed=1).requires_grad_()
    background = noise(3, seed=2).requires_grad_()
    values = dict(
        colors=nmr.FaceColors(colors), opacity=nmr.FaceColors(opacity), background=background
    )
    how = dict(image_size=12, faces_per_pixel=40, anti_aliasing=False)
    rgb, alpha = nmr.render_transparent(vertices, faces, **values, **how)
    index = nmr.render_fragments(vertices, faces, **how).face_index[0].reshape(144, 40)
    wanted = []
    for pixel in index.tolist():
        color, clear = background, 1.0
        for face in [f for f in pixel if f >= 0][::-1]:  # from the back, painted over
            color = opacity[face] * colors[face] + (1 - opacity[face]) * color
            clear = clear * (1 - opacity[face])
        wanted.append(torch.cat([color, 1 - clear * torch.ones(1)]))
    wanted = torch.stack(wanted).view(12, 12, 4)
    image = torch.cat([rgb[0], alpha[0, ..., None]], dim=-1)
    torch.testing.assert_close(image, wanted)
    upstream, leaves = noise(12, 12, 4, seed=3), (colors, opacity, background)
    for a, b in zip(
        *(torch.autograd.grad(x, leaves, upstream) for x in (image, wanted)), strict=True
    ):
        torch.testing.assert_close(a, b)


def test_opaque_surfaces_are_those_of_render():
    vertices, faces = random_soup(1, 1)
    vertices, colors = vertices.requires_grad_(), nmr.VertexColors(vertices.detach())
    how = dict(colors=colors, lights=nmr.Lights(), background=0.3, image_size=20)
    images = nmr.render(vertices, faces, outputs=("rgb", "alpha"), **how)
    for layers in (1, 3):
        mine = nmr.render_transparent(vertices, faces, opacity=1.0, faces_per_pixel=layers, **how)
        upstream = noise(1, 20, 20, 3), noise(1, 20, 20, seed=1)
        for a, b in zip(mine, images, strict=True):
            torch.testing.assert_close(a, b)
        grads = [
            torch.autograd.grad([*x], vertices, upstream, retain_graph=True)[0]
            for x in (mine, images)
        ]
        torch.testing.assert_close(*grads)


def test_colours_and_lights_of_layers_are_those_of_each_layer():
    vertices, faces = nmr.icosphere(1)
    uv, image = vertices[:, :2], torch.rand(32, 32, 3)
    layers = nmr.render_fragments(
        vertices, faces, nmr.LookAt([0.1, 0.2, -3.0]), image_size=12, faces_per_pixel=3
    )
    bumps = nmr.NormalMap(image - torch.tensor([0.5, 0.5, -1.0]), uv)
    samplers = [nmr.UVTexture(image, uv), nmr.UVTexture(image, uv, filter="mipmap"), bumps]
    samplers.append(nmr.TextureCubes(torch.rand(len(faces), 2, 2, 2, 3)))
    draws = [x.sample for x in samplers]
    colors = torch.rand(1, 12, 12, 3, 3)
    for lights in (nmr.Lights(specular=0.5), nmr.Lights(normals=bumps, harmonics=torch.rand(9, 3))):
        together = lights.shade(layers, colors)
        for k in range(3):
            torch.testing.assert_close(
                together[..., k, :], lights.shade(layers.layer(k), colors[..., k, :])
            )
    for draw in draws:
        wanted = torch.stack([draw(layers.layer(k)) for k in range(3)], dim=3)
        assert torch.equal(draw(layers), wanted) and wanted[..., 1, :].any()
