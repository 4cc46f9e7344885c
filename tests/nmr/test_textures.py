"""Colours of meshes: read back what was painted, against slow definitions; gradients; bad input."""

import math
from dataclasses import replace

import pytest
import torch

import nmr


def screen(depth=(1.0, 1.0, 1.0, 1.0), half=1.0):
    """Two float64 triangles that fill the screen, corners: bottom left, bottom right, top right, top left."""
    xy = [(-half, -half), (half, -half), (half, half), (-half, half)]
    vertices = torch.tensor(
        [[x, y, z] for (x, y), z in zip(xy, depth, strict=True)], dtype=torch.float64
    )
    return vertices, torch.tensor([[0, 1, 2], [0, 2, 3]])


CORNERS = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], dtype=torch.float64)


def uniform(*shape, seed=0, dtype=torch.float64):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def draw(colors, mesh=None, size=8, **kwargs):
    return nmr.render_rgb(
        *(mesh or screen()), colors=colors, image_size=size, anti_aliasing=False, **kwargs
    )


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_an_image_on_the_screen_is_read_back(channels):
    """Texel centres meet pixel centres: row 0 of the image is the top, uv (0, 0) its bottom left corner."""
    image = uniform(8, 8, channels)
    torch.testing.assert_close(draw(nmr.UVTexture(image, CORNERS))[0], image)


# The same in plain torch operations. `level` is a constant.


def slow_wrapped(index, size, wrap):
    if wrap == "repeat":
        return index % size
    if wrap == "clamp":
        return index.clamp(0, size - 1)
    index = index % (2 * size)
    return torch.minimum(index, 2 * size - 1 - index)


def slow_bilinear(image, uv, wrap):
    """[H, W, C] at uv [..., 2]."""
    height, width = image.shape[:2]
    uv = torch.where(uv.detach().abs() < 1e6, uv, torch.zeros_like(uv))
    x, y = uv[..., 0] * width - 0.5, (1 - uv[..., 1]) * height - 0.5
    column, row = x.detach().floor(), y.detach().floor()
    right, down = (x - column).unsqueeze(-1), (y - row).unsqueeze(-1)
    colors = 0
    for dy, share_y in ((0, 1 - down), (1, down)):
        line = slow_wrapped(row.long() + dy, height, wrap)
        for dx, share_x in ((0, 1 - right), (1, right)):
            colors = (
                colors
                + share_y * share_x * image[line, slow_wrapped(column.long() + dx, width, wrap)]
            )
    return colors


def slow_half(image):
    """The next mipmap: means of the areas that the texels cover, row by row and column by column."""
    for axis in (0, 1):
        n = image.shape[axis]
        m = max(n // 2, 1)
        edges = torch.arange(m + 1, dtype=torch.float64) * n / m
        texel = torch.arange(n, dtype=torch.float64)
        overlap = torch.minimum(edges[1:, None], texel + 1) - torch.maximum(edges[:-1, None], texel)
        image = torch.tensordot(
            overlap.clamp_min(0).to(image) * m / n, image, ([1], [axis])
        ).movedim(0, axis)
    return image


def slow_uv(image, uv, level, wrap):
    """[B, H, W, C]; level None is bilinear."""
    colors = []
    for b in range(len(uv)):
        mip = image[b % len(image)]
        if level is None:
            colors.append(slow_bilinear(mip, uv[b], wrap))
            continue
        color, n = 0, 0
        while n == 0 or max(mip.shape[:2]) > 1 or n <= level.max():
            mip = slow_half(mip) if n else mip
            color = color + (1 - (level[b] - n).abs()).clamp_min(0).unsqueeze(-1) * slow_bilinear(
                mip, uv[b], wrap
            )
            n += 1
        colors.append(color)
    return torch.stack(colors)


def textured_fragments(dtype=torch.float64, image_size=24, per_image=False, grad=False):
    """Two views of a bumpy sphere, its weights as leaves; an image, and uv that exceed [0, 1]."""
    vertices, faces = nmr.icosphere(1)
    vertices = vertices.to(dtype) * (0.8 + 0.2 * uniform(42, 1, dtype=dtype))
    camera = nmr.LookAt.from_angles(2.4, 20.0, [0.0, 130.0])
    fragments = nmr.render_fragments(vertices, faces, camera, image_size=image_size)
    fragments = replace(fragments, weights=fragments.weights.clone().requires_grad_(grad))
    batch = (2,) if per_image else ()
    image = uniform(*batch, 7, 12, 3, seed=2, dtype=dtype)
    noise = uniform(*batch, 42, 2, seed=3, dtype=dtype)
    uv = 0.8 * vertices[:, :2] + 0.3 * noise
    return fragments, image.requires_grad_(grad), uv.requires_grad_(grad)


@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
@pytest.mark.parametrize("per_image", [False, True])
@pytest.mark.parametrize("filter", ["bilinear", "mipmap"])
def test_values_and_gradients_equal_torch_operations(wrap, per_image, filter):
    fragments, image, uv = textured_fragments(per_image=per_image, grad=True)
    colors = nmr.UVTexture(image, uv, wrap=wrap, filter=filter)
    sampled = colors.sample(fragments)
    level = None
    if filter == "mipmap":
        level = slow_level(fragments, uv.detach().expand(2, -1, -1), (7, 12), 3)
    images = image if per_image else image.unsqueeze(0)
    slow = slow_uv(images, fragments.interpolate(uv), level, wrap)
    slow = torch.where(fragments.covered.unsqueeze(-1), slow, 0.0)
    torch.testing.assert_close(sampled, slow, rtol=1e-9, atol=1e-9)
    upstream, leaves = uniform(*slow.shape, seed=5) - 0.5, (image, uv, fragments.weights)
    fast, slow = (torch.autograd.grad(x, leaves, upstream) for x in (sampled, slow))
    for a, b in zip(fast, slow, strict=True):
        assert b.any()
        torch.testing.assert_close(a, b, rtol=1e-7, atol=1e-9)


def slow_level(fragments, uv, size, most):
    """OpenGL's level from differences: the same face, seen a hundred-thousandth of a pixel further on."""
    height, width = fragments.sided_face_index.shape[1:]
    step, images = 1e-5, []
    for b in range(len(uv)):
        corners = fragments.faces[fragments.face_index[b].clamp_min(0).long()]
        at = fragments.vertices[b][corners]  # [H, W, 3, 3]
        row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")

        def uv_at(x, y, at=at, corners=corners, b=b):
            point = torch.stack(
                [2 * (x + 0.5) / width - 1, 1 - 2 * (y + 0.5) / height, torch.ones_like(x)], -1
            )
            columns = torch.stack(
                [at[..., 0] * at[..., 2], at[..., 1] * at[..., 2], at[..., 2]], dim=-2
            )
            weights = torch.linalg.solve(columns, point)
            weights = weights / weights.sum(-1, keepdim=True)
            return (weights.unsqueeze(-1) * uv[b][corners]).sum(-2) * torch.tensor(
                [size[1], size[0]]
            )

        x, y = column.double(), row.double()
        lengths = [
            ((uv_at(x + dx, y + dy) - uv_at(x - dx, y - dy)) / (2 * step)).norm(dim=-1)
            for dx, dy in ((step, 0), (0, step))
        ]
        images.append(torch.maximum(*lengths).log2().clamp(0, most))
    return torch.where(fragments.covered, torch.stack(images), 0.0)


def test_a_mipmap_shows_the_mean_of_what_a_pixel_covers():
    """A picture of noise, drawn eight times smaller: its 8 x 8 means, where bilinear sampling shows single texels."""
    noise = uniform(64, 64, 1)
    means = noise.view(8, 8, 8, 8, 1).mean((1, 3))
    mipmapped = draw(nmr.UVTexture(noise, CORNERS, filter="mipmap"))[0]
    torch.testing.assert_close(mipmapped, means, rtol=1e-9, atol=1e-9)
    assert (draw(nmr.UVTexture(noise, CORNERS))[0] - means).abs().max() > 0.2
    leaf = noise.clone().requires_grad_()
    draw(nmr.UVTexture(leaf, CORNERS, filter="mipmap")).sum().backward()
    torch.testing.assert_close(leaf.grad, torch.full_like(noise, 1 / 64))


def test_mipmaps_keep_the_mean_whatever_the_size():
    for size in ((1, 1), (5, 3), (6, 1), (7, 16)):
        image = uniform(*size, 2)
        colors = nmr.UVTexture(image, 1000 * CORNERS, filter="mipmap")  # the last level
        torch.testing.assert_close(draw(colors)[0, 3, 3], image.mean((0, 1)))


def test_seams():
    """Both faces show the whole width of the image: the shared vertices 0 and 2 have two uv each."""
    image = torch.arange(8.0, dtype=torch.float64).view(1, 8, 1)
    uv = torch.tensor(
        [[0.0, 0.5], [1.0, 0.5], [1.0, 0.5], [1.0, 0.5], [1.0, 0.5], [0.0, 0.5]],
        dtype=torch.float64,
    )
    colors = nmr.UVTexture(image, uv, torch.tensor([[0, 1, 2], [3, 4, 5]]), wrap="clamp")
    fragments = nmr.render_fragments(*screen(), image_size=9)
    rgb, b = draw(colors, size=9)[0, ..., 0], fragments.weights[0]
    u = torch.where(fragments.face_index[0] == 0, b[..., 1] + b[..., 2], b[..., 0] + b[..., 1])
    torch.testing.assert_close(rgb, (8 * u - 0.5).clamp(0, 7))


def test_uv_that_are_not_numbers_spoil_nothing():
    uv = CORNERS.clone()
    uv[3, 0] = math.nan
    image = uniform(4, 4, 3).requires_grad_()
    rgb = draw(nmr.UVTexture(image, uv))
    rgb.sum().backward()
    assert rgb.isfinite().all() and image.grad.isfinite().all() and image.grad.any()
    vertices, faces = screen((1.0, 2.0, 4.0, 3.0))
    leaf = vertices.clone().requires_grad_()
    for filter in ("bilinear", "mipmap"):
        rgb = draw(
            nmr.UVTexture(image, uv.requires_grad_(), filter=filter),
            (leaf, faces),
            interpolation_gradient=True,
        )
        rgb.square().sum().backward()
        assert (
            rgb.isfinite().all()
            and leaf.grad.isfinite().all()
            and uv.grad.isfinite().all()
            and leaf.grad.any()
        )


def test_vertex_colours_in_perspective():
    """A colour equal to the camera-space position shows the position seen at each pixel."""
    mesh = screen((1.0, 2.0, 4.0, 3.0))
    position = torch.cat([mesh[0][:, :2] * mesh[0][:, 2:], mesh[0][:, 2:]], dim=1)
    rgb = draw(nmr.VertexColors(position), mesh)[0]
    centre = (2 * torch.arange(8, dtype=torch.float64) + 1 - 8) / 8
    torch.testing.assert_close(rgb[..., 0], centre.expand(8, 8) * rgb[..., 2])
    torch.testing.assert_close(rgb[..., 1], -centre.view(-1, 1) * rgb[..., 2])
    torch.testing.assert_close(
        rgb[..., 2], nmr.render_depth(*mesh, image_size=8, anti_aliasing=False)[0]
    )


def test_face_colours_are_exact():
    vertices, faces = nmr.icosphere(1)
    camera = nmr.LookAt.from_angles(3.0, 10.0, [0.0, 90.0])
    colors = uniform(80, 4, dtype=torch.float32)
    for values in (colors, torch.stack([colors, colors.flip(0)])):
        rgb = draw(nmr.FaceColors(values), (vertices, faces), 16, camera=camera)
        index = nmr.render_face_index(vertices, faces, camera, image_size=16).long()
        for b in range(2):
            expected = values[b] if values.ndim == 3 else values
            assert torch.equal(rgb[b][index[b] >= 0], expected[index[b][index[b] >= 0]])
            assert not rgb[b][index[b] < 0].any()


MAKERS = {
    "vertices": (nmr.VertexColors, (4, 3)),
    "faces": (nmr.FaceColors, (2, 3)),
    "cubes": (nmr.TextureCubes, (2, 2, 2, 2, 3)),
    "image": (lambda image: nmr.UVTexture(image, 1.7 * CORNERS), (3, 2, 3)),
    "uv": (lambda uv: nmr.UVTexture(uniform(3, 4, 2), uv), (4, 2)),
    "images": (lambda images: nmr.UVTexture(images, 1.7 * CORNERS), (2, 3, 2, 3)),
}


@pytest.mark.parametrize("kind", MAKERS)
def test_colours_have_true_derivatives(kind):
    make, shape = MAKERS[kind]
    vertices, faces = screen((1.0, 2.0, 4.0, 3.0), half=0.83)
    vertices = vertices.expand(2, -1, -1)
    values = uniform(*shape).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: nmr.render_rgb(vertices, faces, colors=make(x), background=0.2, image_size=3),
        values,
        atol=1e-6,
    )


@pytest.mark.parametrize("filter", ["bilinear", "mipmap"])
@pytest.mark.parametrize("kind", ["whole", "turned", "retained", "slice"])
def test_an_image_that_was_expanded_over_the_batch_counts_once(kind, filter):
    """The picture and the gradient are those of copies; only plain expansions are not copied."""
    image = uniform(*((2,) if kind == "slice" else ()), 6, 6, 3).requires_grad_()
    expanded = {"turned": lambda: image.transpose(0, 1), "slice": lambda: image[1]}.get(
        kind, lambda: image
    )()
    expanded = expanded.expand(4, -1, -1, -1)
    if kind == "retained":
        expanded.retain_grad()
    vertices, faces = screen((1.0, 2.0, 4.0, 3.0))
    grads, pictures = [], []
    for each in (expanded, expanded.clone()):
        rgb = draw(nmr.UVTexture(each, CORNERS, filter=filter), (vertices.expand(4, -1, -1), faces))
        weight = uniform(*rgb.shape, seed=1)
        grads.append(torch.autograd.grad((weight * rgb).sum(), image, retain_graph=True)[0])
        pictures.append(rgb)
    assert torch.equal(*pictures)
    torch.testing.assert_close(*grads)
    assert len(nmr.textures._once(expanded)) == (1 if kind == "whole" else 4)
    assert len(nmr.textures._once(expanded.detach())) == 1


def test_write_your_own():
    class Stripes:
        def sample(self, fragments):
            return (6 * fragments.depth.unsqueeze(-1)).sin()

    mesh = screen((1.0, 2.0, 4.0, 3.0))
    depth = nmr.render_depth(*mesh, image_size=8, anti_aliasing=False)
    torch.testing.assert_close(draw(Stripes(), mesh)[..., 0], (6 * depth).sin())
