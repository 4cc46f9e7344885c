"""Colours of meshes: read back what was painted, against slow definitions; gradients; bad input."""

import math
from dataclasses import replace

import pytest
import torch
from scenes import for_threads

import nmr


def screen(depth=(1.0, 1.0, 1.0, 1.0), half=1.0):
    """Two float64 triangles that fill the screen, corners: bottom left, bottom right, top right, top left."""
    xy = [(-half, -half), (half, -half), (half, half), (-half, half)]
    vertices = torch.tensor([[x, y, z] for (x, y), z in zip(xy, depth, strict=True)], dtype=torch.float64)
    return vertices, torch.tensor([[0, 1, 2], [0, 2, 3]])


CORNERS = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], dtype=torch.float64)


def uniform(*shape, seed=0, dtype=torch.float64):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def draw(colors, mesh=None, size=8, **kwargs):
    return nmr.render_rgb(*(mesh or screen()), colors=colors, image_size=size, anti_aliasing=False, **kwargs)


# --- an image


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_an_image_on_the_screen_is_read_back(channels):
    """Texel centres meet pixel centres: row 0 of the image is the top, uv (0, 0) its bottom left corner."""
    image = uniform(8, 8, channels)
    torch.testing.assert_close(draw(nmr.UVTexture(image, CORNERS))[0], image)


def test_a_checker_is_read_back_in_perspective():
    """On a floor that recedes, the colour at each pixel is that of the checker at the point seen there."""
    points = torch.tensor(
        [[-2.0, -1.0, 1.0], [2.0, -1.0, 1.0], [2.0, -1.0, 5.0], [-2.0, -1.0, 5.0]], dtype=torch.float64
    )
    vertices = torch.cat([points[:, :2] / points[:, 2:], points[:, 2:]], dim=1)
    checker = (torch.arange(4).view(-1, 1, 1) + torch.arange(4).view(1, -1, 1)) % 2 * 1.0
    checker = checker.repeat_interleave(64, 0).repeat_interleave(64, 1).double()  # sharp: 64 texels per square
    fragments = nmr.render_fragments(vertices, screen()[1], image_size=32)
    rgb = draw(nmr.UVTexture(checker, CORNERS), (vertices, screen()[1]), size=32)[0, ..., 0]
    centre = (2 * torch.arange(32, dtype=torch.float64) + 1 - 32) / 32
    x, y = torch.meshgrid(centre, -centre, indexing="xy")
    depth = -1 / y  # of the plane Y = -1
    u, v = (x * depth + 2) / 4, (depth - 1) / 4
    expected = ((4 * u).floor() + (4 * (1 - v)).floor()) % 2
    inside = fragments.covered[0]
    assert inside.sum() > 200
    # Away from the lines between squares, where bilinear sampling mixes.
    clear = inside & ((4 * u - (4 * u).round()).abs() > 0.02) & ((4 * v - (4 * v).round()).abs() > 0.02)
    assert clear.sum() > 150 and expected[clear].mean() not in (0, 1)
    torch.testing.assert_close(rgb[clear], expected[clear])


def texel(image, column, row, wrap):
    size = image.shape[1], image.shape[0]
    index = []
    for n, s in zip((column, row), size, strict=True):
        if wrap == "repeat":
            n = n % s
        elif wrap == "clamp":
            n = min(max(n, 0), s - 1)
        else:
            while not 0 <= n < s:  # bounce off the borders
                n = -1 - n if n < 0 else 2 * s - 1 - n
        index.append(n)
    return image[index[1], index[0]]


@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
def test_bilinear_sampling_beyond_the_image(wrap):
    image, corners = uniform(3, 5, 2), 5 * CORNERS - 2.3
    rgb = draw(nmr.UVTexture(image, corners, wrap=wrap), size=14)[0]
    for row in range(14):
        for column in range(14):
            u, v = 5 * (column + 0.5) / 14 - 2.3, 5 * (1 - (row + 0.5) / 14) - 2.3
            x, y = u * 5 - 0.5, (1 - v) * 3 - 0.5
            c, r = math.floor(x), math.floor(y)
            expected = sum(
                (1 - abs(x - c - i)) * (1 - abs(y - r - j)) * texel(image, c + i, r + j, wrap)
                for i in (0, 1)
                for j in (0, 1)
            )
            torch.testing.assert_close(rgb[row, column], expected, rtol=1e-9, atol=1e-9)


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
            colors = colors + share_y * share_x * image[line, slow_wrapped(column.long() + dx, width, wrap)]
    return colors


def slow_half(image):
    """The next mipmap: means of the areas that the texels cover, row by row and column by column."""
    for axis in (0, 1):
        n = image.shape[axis]
        m = max(n // 2, 1)
        edges = torch.arange(m + 1, dtype=torch.float64) * n / m
        texel = torch.arange(n, dtype=torch.float64)
        overlap = torch.minimum(edges[1:, None], texel + 1) - torch.maximum(edges[:-1, None], texel)
        image = torch.tensordot(overlap.clamp_min(0).to(image) * m / n, image, ([1], [axis])).movedim(0, axis)
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
            color = color + (1 - (level[b] - n).abs()).clamp_min(0).unsqueeze(-1) * slow_bilinear(mip, uv[b], wrap)
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
    image, noise = uniform(*batch, 7, 12, 3, seed=2, dtype=dtype), uniform(*batch, 42, 2, seed=3, dtype=dtype)
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
            point = torch.stack([2 * (x + 0.5) / width - 1, 1 - 2 * (y + 0.5) / height, torch.ones_like(x)], -1)
            columns = torch.stack([at[..., 0] * at[..., 2], at[..., 1] * at[..., 2], at[..., 2]], dim=-2)
            weights = torch.linalg.solve(columns, point)
            weights = weights / weights.sum(-1, keepdim=True)
            return (weights.unsqueeze(-1) * uv[b][corners]).sum(-2) * torch.tensor([size[1], size[0]])

        x, y = column.double(), row.double()
        lengths = [
            ((uv_at(x + dx, y + dy) - uv_at(x - dx, y - dy)) / (2 * step)).norm(dim=-1)
            for dx, dy in ((step, 0), (0, step))
        ]
        images.append(torch.maximum(*lengths).log2().clamp(0, most))
    return torch.where(fragments.covered, torch.stack(images), 0.0)


def test_the_level_is_that_of_opengl():
    fragments, _, uv = textured_fragments()
    grids = torch.tensor([[[0, 7, 12], [84, 3, 6], [102, 1, 3], [105, 1, 1]]])
    at = uv.unsqueeze(0), fragments.faces, fragments.sided_face_index, fragments.weights, None
    level = nmr.ops.uv_levels(*fragments.mesh[:3], *at, grids)
    torch.testing.assert_close(level, slow_level(fragments, uv.expand(2, -1, -1), (7, 12), 3), rtol=1e-4, atol=1e-4)
    covered = level[fragments.covered]
    assert covered.max() == 3 and (covered == 0).sum() > 10 and (covered > 0).sum() > 100


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


@pytest.mark.parametrize("filter", ["bilinear", "mipmap"])
@pytest.mark.parametrize("per_image", [False, True])
@pytest.mark.parametrize("image_size", [24, 150])  # one block, and several
def test_same_bits_for_any_number_of_threads(filter, per_image, image_size):
    fragments, image, uv = textured_fragments(torch.float32, image_size, per_image, True)

    def gradients():
        sampled = nmr.UVTexture(image, uv, filter=filter).sample(fragments)
        return sampled, *torch.autograd.grad(sampled.square().sum(), (image, uv, fragments.weights))

    results = for_threads((1, 2, 5), gradients)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("filter", ["bilinear", "mipmap"])
def test_packed_meshes_with_images_of_different_sizes_equal_one_by_one(filter):
    meshes = [nmr.icosphere(n) for n in (1, 0)]
    images = [uniform(5, 9, 2, seed=1).float(), uniform(16, 2, 2, seed=2).float()]
    camera = nmr.LookAt([0.0, 0.0, -3.0])
    lists = [list(part) for part in zip(*meshes, strict=True)]
    leaves = [image.clone().requires_grad_() for image in images]
    colors = nmr.UVTexture(leaves, [v[:, :2].contiguous() for v in lists[0]], lists[1], "mirror", filter)
    together = nmr.render_rgb(*lists, camera, colors=colors, image_size=20)
    together.square().sum().backward()
    for b, (vertices, faces) in enumerate(meshes):
        leaf = images[b].clone().requires_grad_()
        own = nmr.UVTexture(leaf, vertices[:, :2], wrap="mirror", filter=filter)
        one = nmr.render_rgb(vertices, faces, camera, colors=own, image_size=20)
        one.square().sum().backward()
        assert torch.equal(one[0], together[b]) and torch.equal(leaf.grad, leaves[b].grad)


@pytest.mark.parametrize("per_image", [False, True])
def test_opcheck(per_image):
    fragments, image, uv = textured_fragments(image_size=6, per_image=per_image, grad=True)
    if not per_image:
        image, uv = image[None], uv[None]
    grids = torch.tensor([[[84 * b, 7, 12]] for b in range(len(image))])
    at = uv, fragments.faces, fragments.sided_face_index, fragments.weights, None
    texels = image.detach().reshape(-1, 3).requires_grad_()
    torch.library.opcheck(nmr.ops.sample_uv, (texels, grids, None, *at, 0))
    grids = torch.tensor([[[84, 1, 12], [96, 1, 6]], [[0, 7, 12], [102, 3, 6]]])[: len(image)]
    level = uniform(*fragments.sided_face_index.shape)
    at = tuple(x.detach() if isinstance(x, torch.Tensor) else x for x in at)
    grad = uniform(*fragments.sided_face_index.shape, 3)
    texels = uniform(120, 3)
    torch.library.opcheck(nmr.ops.sample_uv_backward, (texels, grids, level, *at, 1, grad, [True, False, True]))
    torch.library.opcheck(nmr.ops.uv_levels, (*fragments.mesh[:3], *at, grids))
    grids = torch.tensor([[[0, 4, 6], [24, 2, 3], [30, 1, 1]]])
    torch.library.opcheck(nmr.ops.mipmaps, (uniform(24, 2).requires_grad_(), grids, 31))
    torch.library.opcheck(nmr.ops.mipmaps_backward, (uniform(31, 2), grids, 24))


def test_no_call_reads_or_writes_outside_an_array():
    fragments, image, uv = textured_fragments(image_size=6)
    arrays = dict(
        texels=image.reshape(-1, 3),
        grids=torch.tensor([[[0, 7, 12]]]),
        level=None,
        uv=uv[None],
        corners=fragments.faces,
        face_index=fragments.sided_face_index,
        weights=fragments.weights,
        starts=None,
        wrap=0,
    )
    nmr.ops.sample_uv(*arrays.values())
    for change, words in (
        (dict(grids=torch.tensor([[[1, 7, 12]]])), "lies outside the 84 texels"),
        (dict(grids=torch.tensor([[[0, 0, 12]]])), "lies outside"),
        (dict(grids=torch.tensor([[[-1, 1, 1]]])), "lies outside"),
        (dict(grids=torch.tensor([[0, 7, 12]])), r"grids must have shape \[I, L, 3\]"),
        (dict(grids=torch.tensor([[[0, 7, 12]]]).expand(3, 1, 3)), "one texture or 2, got 3"),
        (dict(level=torch.zeros(2, 6, 5).double()), r"level must have shape \[2, 6, 6\]"),
        (dict(uv=uniform(1, 42, 3)), "uv must have 2 channels"),
        (dict(uv=uniform(1, 41, 2)), "corners refer to attribute 41"),
        (dict(corners=fragments.faces[:50]), "does not belong"),
        (dict(wrap=3), "wrap must be 0, 1 or 2"),
    ):
        with pytest.raises(ValueError, match=words):
            nmr.ops.sample_uv(*{**arrays, **change}.values())
    with pytest.raises(ValueError, match="half its size"):
        nmr.ops.mipmaps(uniform(24, 2), torch.tensor([[[0, 4, 6], [24, 2, 2]]]), 28)


def test_seams():
    """Both faces show the whole width of the image: the shared vertices 0 and 2 have two uv each."""
    image = torch.arange(8.0, dtype=torch.float64).view(1, 8, 1)
    uv = torch.tensor([[0.0, 0.5], [1.0, 0.5], [1.0, 0.5], [1.0, 0.5], [1.0, 0.5], [0.0, 0.5]], dtype=torch.float64)
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
        rgb = draw(nmr.UVTexture(image, uv.requires_grad_(), filter=filter), (leaf, faces), interpolation_gradient=True)
        rgb.square().sum().backward()
        assert rgb.isfinite().all() and leaf.grad.isfinite().all() and uv.grad.isfinite().all() and leaf.grad.any()


# --- vertices, faces, cubes


def test_vertex_colours_in_perspective():
    """A colour equal to the camera-space position shows the position seen at each pixel."""
    mesh = screen((1.0, 2.0, 4.0, 3.0))
    position = torch.cat([mesh[0][:, :2] * mesh[0][:, 2:], mesh[0][:, 2:]], dim=1)
    rgb = draw(nmr.VertexColors(position), mesh)[0]
    centre = (2 * torch.arange(8, dtype=torch.float64) + 1 - 8) / 8
    torch.testing.assert_close(rgb[..., 0], centre.expand(8, 8) * rgb[..., 2])
    torch.testing.assert_close(rgb[..., 1], -centre.view(-1, 1) * rgb[..., 2])
    torch.testing.assert_close(rgb[..., 2], nmr.render_depth(*mesh, image_size=8, anti_aliasing=False)[0])


def test_face_colours_are_exact():
    vertices, faces = nmr.icosphere(1)
    camera, colors = nmr.LookAt.from_angles(3.0, 10.0, [0.0, 90.0]), uniform(80, 4, dtype=torch.float32)
    for values in (colors, torch.stack([colors, colors.flip(0)])):
        rgb = draw(nmr.FaceColors(values), (vertices, faces), 16, camera=camera)
        index = nmr.render_face_index(vertices, faces, camera, image_size=16).long()
        for b in range(2):
            expected = values[b] if values.ndim == 3 else values
            assert torch.equal(rgb[b][index[b] >= 0], expected[index[b][index[b] >= 0]])
            assert not rgb[b][index[b] < 0].any()


def test_the_corners_of_cubes_are_the_colours_of_vertices():
    """A cube with a colour at each end of its three axes and linear between equals colours of vertices."""
    mesh, ts = screen((1.0, 2.0, 4.0, 3.0)), 4
    at_corners = uniform(2, 3, 3)  # face, corner, channel
    axis = torch.arange(ts, dtype=torch.float64) / (ts - 1)
    share = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    cubes = torch.einsum("ijkn,fnc->fijkc", share, at_corners)
    fragments = nmr.render_fragments(*mesh, image_size=8)
    expected = fragments.interpolate(at_corners.reshape(6, 3), torch.arange(6).view(2, 3))
    torch.testing.assert_close(draw(nmr.TextureCubes(cubes), mesh, eps=1e-9), expected, rtol=1e-6, atol=1e-6)


# --- all of them

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
        lambda x: nmr.render_rgb(vertices, faces, colors=make(x), background=0.2, image_size=3), values, atol=1e-6
    )


@pytest.mark.parametrize("kind", ["vertices", "image", "uv"])
def test_colours_move_vertices_by_true_derivatives_on_request(kind):
    """The faces are larger than the screen: no edge to sweep, but for the diagonal between two equal sides."""
    make, shape = MAKERS[kind]
    vertices, faces = screen((1.0, 1.4, 2.0, 1.5), half=3.0)
    vertices, faces = vertices[:3] * torch.tensor([1.0, 1.0, 1.0]) + torch.tensor([-0.9, 0.8, 0.0]), faces[:1]
    values = uniform(*shape)
    values = values[:3] if kind in ("vertices", "uv") else values

    def rgb(v):
        colors = nmr.UVTexture(values, CORNERS[:3]) if kind == "image" else make(values)
        return nmr.render_rgb(v, faces, colors=colors, image_size=3, interpolation_gradient=True)

    assert torch.autograd.gradcheck(rgb, vertices.requires_grad_(), atol=1e-5)


@pytest.mark.parametrize("kind", MAKERS)
def test_a_batch_equals_one_by_one(kind):
    make, shape = MAKERS[kind]
    vertices, faces = screen((1.0, 2.0, 4.0, 3.0))
    vertices = torch.stack([vertices, 0.8 * vertices])
    values = uniform(*shape) if kind == "images" else torch.stack([uniform(*shape), uniform(*shape, seed=1)])
    together = draw(make(values), (vertices, faces))
    for b in range(2):
        assert torch.equal(together[b], draw(make(values[b]), (vertices[b], faces))[0])


def test_write_your_own():
    class Stripes:
        def sample(self, fragments):
            return (6 * fragments.depth.unsqueeze(-1)).sin()

    mesh = screen((1.0, 2.0, 4.0, 3.0))
    depth = nmr.render_depth(*mesh, image_size=8, anti_aliasing=False)
    torch.testing.assert_close(draw(Stripes(), mesh)[..., 0], (6 * depth).sin())


def test_colours_take_the_type_of_the_vertices():
    vertices, faces = screen()
    rgb = draw(nmr.VertexColors(uniform(4, 3, dtype=torch.float32)), (vertices, faces))
    assert rgb.dtype == torch.float64
    assert draw(nmr.UVTexture(uniform(4, 4, 3), CORNERS), (vertices.float(), faces)).dtype == torch.float32


@pytest.mark.parametrize(
    "make, error, words",
    [
        (lambda: nmr.VertexColors([[0.0]]), TypeError, r"colors must be a float tensor \[V, C\].*the list holds list"),
        (lambda: nmr.VertexColors("red"), TypeError, "got str; use torch.as_tensor"),
        (lambda: nmr.VertexColors([]), TypeError, "got list"),
        (lambda: nmr.VertexColors(torch.zeros(4, 3).byte()), TypeError, r"got uint8 \[4, 3\]; divide 0..255 by 255"),
        (lambda: nmr.VertexColors(torch.zeros(4)), ValueError, r"\[V, C\] or \[B, V, C\].*got float32 \[4\]"),
        (lambda: nmr.VertexColors(torch.zeros(4, 0)), ValueError, r"got float32 \[4, 0\]"),
        (lambda: nmr.FaceColors(torch.zeros(2)), ValueError, r"colors must be a float tensor \[F, C\]"),
        (lambda: nmr.TextureCubes(torch.zeros(2, 4, 4, 3)), ValueError, r"\[F, ts, ts, ts, C\]"),
        (lambda: nmr.TextureCubes(torch.zeros(2, 4, 4, 2, 3)), ValueError, r"cubes .* of one size ts >= 2"),
        (lambda: nmr.TextureCubes(torch.zeros(2, 1, 1, 1, 3)), ValueError, "ts >= 2"),
        (lambda: nmr.TextureCubes([torch.zeros(2, n, n, n, 3) for n in (2, 3)]), ValueError, "of one size"),
        (lambda: nmr.UVTexture(torch.zeros(4, 3), CORNERS), ValueError, r"image must be a float tensor \[H, W, C\]"),
        (lambda: nmr.UVTexture(torch.zeros(0, 4, 3), CORNERS), ValueError, "image must have texels"),
        (lambda: nmr.UVTexture(torch.zeros(4, 4, 3), torch.zeros(4, 3)), ValueError, r"uv must have shape \[T, 2\]"),
        (lambda: nmr.UVTexture(torch.zeros(4, 4, 3), CORNERS, wrap="tile"), ValueError, "wrap must be .*got 'tile'"),
        (lambda: nmr.UVTexture(torch.zeros(4, 4, 3), CORNERS, filter=2), ValueError, "filter must be .*, got 2"),
        (lambda: nmr.UVTexture(torch.zeros(4, 4, 3), CORNERS, 3), TypeError, "uv_faces must be .* got int"),
        (lambda: nmr.UVTexture(torch.zeros(4, 4, 3), CORNERS, CORNERS), TypeError, r"call uv_faces.long\(\)"),
        (
            lambda: nmr.UVTexture(torch.zeros(4, 4, 3), CORNERS, torch.zeros(2).long()),
            ValueError,
            r"uv_faces .*\[F, 3\]",
        ),
    ],
)
def test_errors_say_what_was_wanted(make, error, words):
    with pytest.raises(error, match=words):
        make()


@pytest.mark.parametrize(
    "colors, words",
    [
        (nmr.VertexColors(uniform(5, 3)), r"colors must have one row per vertex .4., got float64 \[1, 5, 3\]"),
        (nmr.VertexColors(uniform(2, 4, 3)), r"colors must have batch size 1"),
        (nmr.FaceColors(uniform(3, 3)), "colors must have one row per face .2"),
        (nmr.TextureCubes(uniform(3, 2, 2, 2, 3)), "textures must have one row per face .2"),
        (nmr.UVTexture(uniform(4, 4, 3), uniform(3, 2)), "uv must have one row per vertex .4"),
        (nmr.UVTexture(uniform(3, 4, 4, 3), CORNERS), "image must be .* got 3"),
        (nmr.UVTexture(uniform(4, 4, 3), CORNERS, torch.zeros(3, 3).long()), "uv_faces must have one row per face .2"),
        (nmr.UVTexture(uniform(4, 4, 3), CORNERS, torch.full((2, 3), 4)), "refer to"),
    ],
)
def test_errors_of_colours_that_do_not_fit(colors, words):
    with pytest.raises(ValueError, match=words):
        draw(colors)
