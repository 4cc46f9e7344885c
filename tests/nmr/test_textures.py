"""Colours of meshes: read back what was painted, against slow definitions; gradients; bad input."""

import math

import pytest
import torch

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
        (lambda: nmr.VertexColors(torch.zeros(4, 3).byte()), TypeError, r"got uint8 \[4, 3\].*\.float\(\)"),
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
