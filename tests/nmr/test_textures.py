"""Colours of meshes: read back what was painted, against slow definitions; gradients; bad input."""

import functools
import itertools
import math
from dataclasses import replace

import pytest
import torch
from scenes import bumpy_sphere, double, leaf_of, normal, square, uniform, value_and_gradients
from torch.autograd import gradcheck
from torch.testing import assert_close

import nmr
import nmr.nvdiffrast.torch as dr

TILTED = square(depth=(1.0, 2.0, 4.0, 3.0))  # fills the screen, as `square()` does


CORNERS = double([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def draw(colors, mesh=None, size=8, **how):
    how |= dict(image_size=size, anti_aliasing=False)
    return nmr.render_rgb(*(mesh or square()), colors=colors, **how)


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_an_image_on_the_screen_is_read_back(channels):
    """Texel centres meet pixel centres: row 0 of the image is the top, uv (0, 0) its bottom left corner."""
    image = uniform(8, 8, channels)
    assert_close(draw(nmr.UVTexture(image, CORNERS))[0], image)


# The same in plain torch operations. `level` is a constant.


def slow_wrapped(index, size, wrap):
    if wrap == "repeat":
        return index % size
    if wrap in ("clamp", "zero"):
        return index.clamp(0, size - 1)
    index = index % (2 * size)
    return torch.minimum(index, 2 * size - 1 - index)


def slow_bilinear(image, uv, wrap):
    """[H, W, C] at uv [..., 2]."""
    height, width = image.shape[:2]
    uv = torch.where(uv.detach().abs() < 1e6, uv, torch.zeros_like(uv))
    x, y = uv[..., :1] * width - 0.5, (1 - uv[..., 1:]) * height - 0.5
    column, row = x.detach().floor(), y.detach().floor()
    colors = 0
    for dy, dx in itertools.product((0, 1), repeat=2):
        share = (1 - (x - column - dx).abs()) * (1 - (y - row - dy).abs())
        line = slow_wrapped(row.long() + dy, height, wrap)
        place = slow_wrapped(column.long() + dx, width, wrap)
        if wrap == "zero":
            share = share * (line == row + dy) * (place == column + dx)
        colors = colors + share * image[line, place].squeeze(-2)
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
    for b, places in enumerate(uv):
        mip = image[b % len(image)]
        color = slow_bilinear(mip, places, wrap) * (1 if level is None else share_of(0, level[b]))
        for n in range(1, 1 if level is None else 4):
            mip = slow_half(mip)
            color = color + share_of(n, level[b]) * slow_bilinear(mip, places, wrap)
        colors.append(color)
    return torch.stack(colors)


def share_of(n, level):
    """Of mipmap n in the mixture of two."""
    return (1 - (level - n).abs()).clamp_min(0).unsqueeze(-1)


def textured_fragments(per_image, perspective):
    """Two views of a bumpy sphere; an image, and uv that exceed [0, 1]."""
    vertices, faces = bumpy_sphere(1, least=0.8)
    camera = nmr.LookAt.from_angles(2.4, 20.0, [0.0, 130.0])
    camera = camera if perspective else nmr.Orthographic(camera.eye)
    batch = (2,) if per_image else ()
    uv = 0.8 * vertices[:, :2] + 0.3 * uniform(*batch, 42, 2, seed=3)
    fragments = nmr.render_fragments(vertices, faces, camera, image_size=24)
    return fragments, uniform(*batch, 7, 12, 3, seed=2), uv


@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
@pytest.mark.parametrize("filter", ["bilinear", "mipmap"])
def test_values_and_gradients_equal_torch_operations(wrap, per_image, filter, perspective):
    fragments, image, uv = textured_fragments(per_image, perspective)
    level = None
    if filter == "mipmap":
        level = slow_level(fragments, uv.expand(2, -1, -1), (7, 12), 3)

    def fast(image, uv, weights):
        colors = nmr.UVTexture(image, uv, wrap=wrap, filter=filter)
        return colors.sample(replace(fragments, weights=weights))

    def slow(image, uv, weights):
        places = replace(fragments, weights=weights).interpolate(uv)
        images = image if per_image else image.unsqueeze(0)
        colors = slow_uv(images, places, level, wrap)
        return torch.where(fragments.covered.unsqueeze(-1), colors, 0.0)

    (color, *grads), (wanted, *slow_grads) = (
        value_and_gradients(function, image, uv, fragments.weights) for function in (fast, slow)
    )
    assert all(x.any() for x in slow_grads)
    assert_close(color, wanted, rtol=1e-9, atol=1e-9)
    assert_close(grads, slow_grads, rtol=1e-7, atol=1e-9)

    def sampled(image, uv, weights):
        places = replace(fragments, weights=weights).interpolate(uv)
        return fragments.covered.unsqueeze(-1) * nmr.sample_texture(image, places, wrap=wrap)

    if filter == "bilinear":
        results = value_and_gradients(sampled, image, uv, fragments.weights)
        assert_close(results, [wanted, *slow_grads])


def slow_level(fragments, uv, size, most):
    """OpenGL's level from differences: the same face, seen a hundred-thousandth of a pixel further on."""
    height, width = fragments.face_index.shape[1:]
    corners = fragments.faces[fragments.face_index.clamp_min(0).long()]  # [B, H, W, 3]
    image = torch.arange(len(uv)).view(-1, 1, 1, 1)
    x, y, z = fragments.vertices[image, corners].unbind(-1)
    z = z if fragments.camera.projection().perspective else torch.ones_like(z)
    planes = torch.stack([x * z, y * z, z], dim=-2)
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")

    def texel_at(dx, dy):
        x = 2 * (column.double() + dx + 0.5) / width - 1
        y = 1 - 2 * (row.double() + dy + 0.5) / height
        point = torch.stack([x, y, torch.ones_like(x)], -1)
        weights = torch.linalg.solve(planes, point.unsqueeze(-1)).squeeze(-1)
        weights = weights / weights.sum(-1, keepdim=True)
        return (weights.unsqueeze(-1) * uv[image, corners]).sum(-2) * torch.tensor(size[::-1])

    lengths = [
        ((texel_at(dx, dy) - texel_at(-dx, -dy)) / 2e-5).norm(dim=-1)
        for dx, dy in ((1e-5, 0), (0, 1e-5))
    ]
    return torch.where(fragments.covered, torch.maximum(*lengths).log2().clamp(0, most), 0.0)


def test_a_mipmap_shows_the_mean_of_what_a_pixel_covers():
    """A picture of noise, drawn eight times smaller: its 8 x 8 means, where bilinear sampling shows single texels."""
    noise = uniform(64, 64, 1)
    means = noise.view(8, 8, 8, 8, 1).mean((1, 3))
    mipmapped, grad = value_and_gradients(
        lambda x: draw(nmr.UVTexture(x, CORNERS, filter="mipmap"))[0],
        noise,
        upstream=torch.ones_like(means),
    )
    assert_close(mipmapped, means, rtol=1e-9, atol=1e-9)
    assert (draw(nmr.UVTexture(noise, CORNERS))[0] - means).abs().max() > 0.2
    assert_close(grad, torch.full_like(noise, 1 / 64))


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (6, 1), (7, 16)])
def test_mipmaps_keep_the_mean_whatever_the_size(size):
    image = uniform(*size, 2)
    colors = nmr.UVTexture(image, 1000 * CORNERS, filter="mipmap")  # the last level
    assert_close(draw(colors)[0, 3, 3], image.mean((0, 1)))


def test_seams():
    """Both faces show the whole width of the image: the shared vertices 0 and 2 have two uv each."""
    image, uv = torch.arange(8.0).double().view(1, 8, 1), double([[0.0, 0.5], [1.0, 0.5]])
    corners = torch.tensor([[0, 1, 1], [1, 1, 0]])
    colors = nmr.UVTexture(image, uv, corners, wrap="clamp")
    fragments = nmr.render_fragments(*square(), image_size=9)
    rgb, b = draw(colors, size=9)[0, ..., 0], fragments.weights[0]
    u = torch.where(fragments.face_index[0] == 0, b[..., 1] + b[..., 2], b[..., 0] + b[..., 1])
    assert_close(rgb, (8 * u - 0.5).clamp(0, 7))


@pytest.mark.parametrize("filter", ["bilinear", "mipmap"])
@pytest.mark.parametrize("moving", [False, True])
def test_uv_that_are_not_numbers_spoil_nothing(filter, moving):
    vertices, faces = TILTED
    uv = CORNERS.clone()
    uv[3, 0] = math.nan

    def rgb(image, uv, vertices):
        colors = nmr.UVTexture(image, uv, filter=filter)
        return draw(colors, (vertices, faces), interpolation_gradient=moving)

    results = value_and_gradients(rgb, uniform(4, 4, 3), uv, vertices)
    assert all(x.isfinite().all() for x in results) and results[1].any()
    assert bool(results[3][:, 2].any()) == moving  # edges move x and y in any case


def test_face_colours_are_exact(per_image):
    mesh, camera = nmr.icosphere(1), nmr.LookAt.from_angles(3.0, 10.0, [0.0, 90.0])
    colors = uniform(2 if per_image else 1, 80, 4, dtype=torch.float32)
    given = colors if per_image else colors[0]
    rgb = draw(nmr.FaceColors(given), mesh, 16, camera=camera)
    index = nmr.render_face_index(*mesh, camera, image_size=16).long()
    for image, faces, own in zip(rgb, index, colors.expand(2, -1, -1), strict=True):
        assert torch.equal(image, own[faces.clamp_min(0)] * (faces >= 0)[..., None])


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
    vertices, faces = square(-0.83, -0.83, 0.83, 0.83, depth=(1.0, 2.0, 4.0, 3.0))
    mesh, how = (vertices.expand(2, -1, -1), faces), dict(background=0.2, image_size=3)
    gradcheck(
        lambda x: nmr.render_rgb(*mesh, colors=make(x), **how), leaf_of(uniform(*shape)), atol=1e-6
    )


def test_write_your_own():
    class Stripes:
        def sample(self, fragments):
            return (6 * fragments.depth.unsqueeze(-1)).sin()

    depth = nmr.render_depth(*TILTED, image_size=8, anti_aliasing=False)
    assert_close(draw(Stripes(), TILTED)[..., 0], (6 * depth).sin())


# The interface of nvdiffrast, where row 0 is at v = 0.


def texture_inputs(seed=0, cube=False):
    size, places = ((1, 6, 4, 4, 2), 3) if cube else ((2, 8, 4, 3), 2)
    shapes = size, (2, 3, 4, places), (2, 3, 4, 2 * places), (2, 3, 4)
    tex, uv, uv_da, bias = (uniform(*shape, seed=4 * seed + k) for k, shape in enumerate(shapes))
    return tex, places * uv + (uv.shape[-1] == 2) * uv - 1, 0.3 * uv_da, bias


@pytest.mark.parametrize("mode", ["wrap", "clamp", "zero"])
def test_texture(mode):
    tex, uv, uv_da, bias = texture_inputs()
    levels = [tex]
    while max(levels[-1].shape[1:3]) > 1:
        levels.append(torch.stack([slow_half(image) for image in levels[-1]]))
    sample = functools.partial(dr.texture, tex, uv, boundary_mode=mode)
    plain, nearest = sample(), sample(filter_mode="nearest")
    smooth, stepped = (
        sample(uv_da, bias, filter_mode=f"linear-mipmap-{name}") for name in ("linear", "nearest")
    )
    assert torch.equal(sample(uv_da, bias), smooth)
    assert mode != "wrap" or torch.allclose(dr.texture(tex, uv + 2**22), plain, atol=1e-7)

    def slow(image, uv):
        wrap = "repeat" if mode == "wrap" else mode
        return torch.stack([slow_bilinear(*x, wrap) for x in zip(image.flip(1), uv, strict=True)])

    size = double([4.0, 8.0])
    jacobian = uv_da.view(2, 3, 4, 2, 2) * size.view(2, 1)
    level = (torch.linalg.matrix_norm(jacobian, 2).log2() + bias).clamp(0, 3)
    assert_close(plain, slow(tex, uv))
    assert_close(nearest, slow(tex, ((uv * size).floor() + 0.5) / size))
    for found, at in ((smooth, level), (stepped, level.round())):
        wanted = sum(share_of(n, at) * slow(image, uv) for n, image in enumerate(levels))
        assert_close(found, wanted)
    for mip in (dr.texture_construct_mip(tex), levels[1:]):
        assert_close(sample(uv_da, bias, mip=mip), smooth)
    assert_close(sample(uv_da, bias, max_mip_level=1), sample(uv_da, bias, mip=levels[1:2]))


@pytest.mark.parametrize("mode", ["wrap", "clamp", "zero", "cube"])
def test_gradients_of_texture(mode):
    inputs = [leaf_of(x) for x in texture_inputs(1, mode == "cube")]
    texture = functools.partial(dr.texture, boundary_mode=mode)
    close = dict(eps=1e-7, atol=1e-4, rtol=1e-3)
    gradcheck(texture, inputs, **close)
    gradcheck(texture, inputs[:2], **close)
    gradcheck(lambda tex: texture(tex, inputs[1], filter_mode="nearest"), inputs[0], **close)


def test_cube_map():
    """Texels that show their own direction are a smooth map without seams; faces are OpenGL's."""
    unit = functools.partial(torch.nn.functional.normalize, dim=-1)
    side = (2 * torch.arange(32) + 1) / 32 - 1
    t, s = torch.meshgrid(side, side, indexing="ij")
    one = torch.ones_like(s)
    faces = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    texels = unit(torch.stack([torch.stack(face, -1) for face in faces]))[None]
    toward, steps = (normal(1, 40, 50, 3, seed=seed).float() for seed in (0, 1))
    toward[0, 0, :3] = torch.tensor([[1.0, 1.0, 0.3], [-1.0, 0.2, 1.0], [0.4, -1.0, -1.0]])  # edges
    toward[0, 0, 3:5] = torch.tensor([[1.0, 1.0, 1.0], [-1.0, 1.0, -1.0]])  # corners
    toward = unit(toward)
    sample = functools.partial(dr.texture, texels, boundary_mode="cube")
    seen = sample(3 * toward)
    assert (seen - toward).abs().max() < 0.03
    assert (sample(toward, filter_mode="nearest") - toward).abs().max() < 0.07
    assert (sample(toward + 1e-5 * steps) - seen).abs().max() < 1e-3
    invalid = torch.tensor([[[[0.0, 0.0, 0.0], [float("nan"), 1.0, 0.0]]]])
    colors, grad = value_and_gradients(sample, invalid)
    assert colors.eq(0).all() and grad.eq(0).all()


def test_sample_texture():
    tex, uv, uv_da, _ = texture_inputs(2)
    uv_da[..., [1, 2]] = 0  # the axes of the ellipse are those of the pixel
    assert_close(nmr.sample_texture(tex.flip(1), uv, uv_da), dr.texture(tex, uv, uv_da))
    for error, given, words in (
        (ValueError, (uv, uv), r"derivatives .* \[B, H, W, 4\], got float64 \[2, 3, 4, 2\]"),
        (TypeError, ([0.5, 0.5],), r"uv must be a float tensor \[B, H, W, 2\], got list"),
        (ValueError, (uv[:1],), r"image must be one for all 1 images"),
    ):
        with pytest.raises(error, match=words):
            nmr.sample_texture(tex, *given)
