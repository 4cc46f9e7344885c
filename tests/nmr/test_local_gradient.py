"""gradient="local" of silhouettes and colours: against the slow definition, by hand, its reach, ends of surfaces."""

import pytest
import reference
import torch
from scenes import double, leaf_of, normal, random_soup, square, value_and_gradients
from torch.testing import assert_close

import nmr


def gradient_of(vertices, faces, upstream, **kwargs):
    size = tuple(upstream.shape[-2:])
    how = {"image_size": size, "gradient": "local", **kwargs}
    return value_and_gradients(
        lambda x: nmr.render_silhouette(x, faces, **how), vertices, upstream=upstream
    )[1]


# It covers columns 1..4 and rows 1..4 of 8 x 8 pixels (2 / R = 1/4): its right end lies between columns 4 and 5.
BLOCK = (-0.75, -0.25, 0.25, 0.75)


def one_pixel(values):
    upstream = torch.zeros(8, 8, dtype=torch.float64)
    for pixel, value in values.items():
        upstream[pixel] = value
    return upstream


@pytest.mark.parametrize(
    "values, expected",
    [
        ({(2, 5): -1.0}, (-4.0, 0.0)),  # the pixel to the right is wanted: moves right
        ({(2, 4): 3.0}, (12.0, 0.0)),  # the last pixel is not wanted: moves left
        ({(2, 5): -1.0, (2, 4): 3.0}, (12.0, 0.0)),  # both: left is better
        ({(2, 5): -3.0, (2, 4): 1.0}, (-12.0, 0.0)),
        ({(2, 5): -2.0, (2, 4): 2.0}, (0.0, 0.0)),  # a tie
        ({(2, 5): -2.0, (2, 4): 1.99998}, (0.0, 0.0)),  # rates 8 and 7.99992, less than eps apart
        ({(2, 5): 1.0, (2, 4): -3.0}, (0.0, 0.0)),  # neither way is better than to stay
        ({(2, 0): -1.0}, (4.0, 0.0)),  # the same on the left
        ({(2, 1): 3.0}, (-12.0, 0.0)),
        ({(0, 3): -1.0}, (0.0, -4.0)),  # above: y points up
        ({(1, 3): 3.0}, (0.0, 12.0)),
        ({(5, 3): -1.0}, (0.0, 4.0)),
        ({(4, 3): 3.0}, (0.0, -12.0)),
        ({(1, 4): 1.0}, (4.0, 4.0)),  # a corner: left and down
        ({(2, 6): -1.0}, (0.0, 0.0)),  # out of reach
        ({(2, 3): 1.0}, (0.0, 0.0)),  # within the object, on the diagonal between its faces
    ],
)
def test_by_hand(values, expected):
    vertices, faces = square(*BLOCK)
    grad = gradient_of(vertices, faces, one_pixel(values), anti_aliasing=False)
    assert nmr.render_silhouette(vertices, faces, image_size=8, anti_aliasing=False).sum() == 16
    assert_close(grad.sum(0), double([*expected, 0.0]), rtol=0, atol=1e-9)


def test_corners_share_by_their_weights_at_the_pixels_centre():
    vertices, faces = square(*BLOCK)
    grad = gradient_of(vertices, faces, one_pixel({(3, 5): -1.0}), anti_aliasing=False)
    # The centre of row 3, column 4 is (1/8, 1/8): in the lower face, weights 1/8, 1/2, 3/8 of (left, bottom), ...
    assert_close(grad[:, 0], -4 * double([1 / 8, 1 / 2, 3 / 8, 0.0]), rtol=0, atol=1e-12)
    assert not grad[:, 1:].any()


@pytest.mark.parametrize(
    "values, expected",
    [
        ({(3, 6): -1.0}, -4.0),
        ({(3, 5): 1.0}, 0.0),  # itself not wanted: either way is as good
        ({(3, 4): -1.0}, 4.0),
        ({(3, 6): -1.0, (3, 5): 1.0}, -8.0),
    ],
)
def test_a_pixel_between_two_ends_adds_both(values, expected):
    """A strip one pixel wide: moving it right covers one neighbour and uncovers itself."""
    vertices, faces = square(0.25, -0.75, 0.5, 0.75)  # column 5 of 8
    grad = gradient_of(vertices, faces, one_pixel(values), anti_aliasing=False)
    assert float(grad[:, 0].sum()) == pytest.approx(expected, abs=1e-9)


def test_the_border_of_the_image_is_no_end():
    assert not gradient_of(*square(-1.5, -1.5, 1.5, 1.5), normal(8, 8)).any()


def colors_gradient(
    vertices, faces, index, image, upstream, anti_aliasing=False, perspective=True, background=None
):
    settings = anti_aliasing, 1e-4, True, perspective
    return value_and_gradients(
        lambda x: nmr.ops.resolve(image, background, x, faces, None, index, *settings),
        vertices,
        upstream=upstream,
    )[1]


def spheres():
    """Two spheres in renderer space, one behind the other, with faces smaller than a pixel."""
    ball, faces = nmr.icosphere(5)
    pair = [0.6 * ball.double() + double(at) for at in ([-0.2, 0.1, 2.0], [0.3, -0.1, 3.5])]
    return torch.cat(pair)[None], torch.cat([faces, faces + len(ball)])


# in one block of rows, and in several
@pytest.mark.parametrize(
    "scene, size, perspective",
    [(lambda: random_soup(3), (10, 14), True), (spheres, (100, 140), False)],
    ids=["soup", "spheres"],
)
@pytest.mark.parametrize("own_background", [False, True])
def test_colors_equal_the_slow_definition(scene, size, perspective, anti_aliasing, own_background):
    vertices, faces = scene()
    batch, raster = len(vertices), tuple(n * (1 + anti_aliasing) for n in size)
    index = nmr.ops.rasterize(vertices, faces, None, *raster, True, 0.1, 100.0, perspective)
    image, upstream = normal(batch, *raster, 3), normal(batch, *size, 3, seed=1)
    background = normal(batch, 3, seed=2) if own_background else None
    args = vertices, faces, index, image, upstream, anti_aliasing, perspective, background
    grad = colors_gradient(*args)
    if own_background:
        image = torch.where(index[..., None] >= 0, image, background[:, None, None])
    for b in range(batch):
        below, seen = index[b].long().flip(0), image[b].flip(0)
        expected = reference.local_gradient(
            vertices[b], faces, below, upstream[b], anti_aliasing, 1e-4, seen, perspective
        )
        assert_close(grad[b], expected, rtol=1e-9, atol=1e-9)
    assert grad[..., :2].any() and not grad[..., 2].any()


@pytest.mark.parametrize("distance, moves", [(1.0, True), (1e-3, True), (1e-6, False)])
def test_only_the_surface_in_front_moves(distance, moves):
    """The pixel behind its right end should be as bright as the block, so it moves right; the wall stays."""
    block, faces = square(*BLOCK)
    wall = square(-2.0, -2.0, 2.0, 2.0, [1 + distance] * 4)[0]
    colors = nmr.VertexColors(double([[1.0]] * 4 + [[0.25]] * 4))
    how = dict(colors=colors, image_size=8, anti_aliasing=False, gradient="local")
    image, grad = value_and_gradients(
        lambda x: nmr.render_rgb(x, torch.cat([faces, faces + 4]), **how),
        torch.cat([block, wall]),
        upstream=one_pixel({(2, 5): -1.0})[..., None],
    )
    assert image[0, 2, 4] == 1 and image[0, 2, 5] == 0.25
    expected = double([[-0.75 * 4 if moves else 0.0, 0.0, 0.0], [0.0] * 3])
    assert_close(grad.view(2, 4, 3).sum(1), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("subdivisions", [0, 2, 5])
@pytest.mark.parametrize("doubled", [False, True])
def test_a_surface_has_no_end_within(subdivisions, doubled):
    """Neither at seams, where every face has corners of its own, nor if its faces are smaller than pixels."""
    vertices, faces = nmr.icosphere(subdivisions)
    if doubled:
        vertices, faces = vertices[faces].flatten(0, 1), torch.arange(3 * len(faces)).view(-1, 3)
    leaf = (0.9 * vertices + torch.tensor([0.0, 0.0, 2.0])).requires_grad_()
    how = dict(outputs=("rgb", "alpha"), image_size=48, gradient="local")
    colors = nmr.VertexColors(normal(len(vertices), 3).float())
    images = nmr.render(leaf, faces, colors=colors, **how)
    inside = torch.nn.functional.avg_pool2d(images.alpha[None].detach(), 3, 1, 1)[0] == 1
    assert inside.any()
    (images.rgb * inside[..., None] * normal(48, 48, 3)).sum().backward()
    assert not leaf.grad.any()


def test_gradients_of_all_outputs(anti_aliasing):
    """ "none" is the true derivative alone, "local" adds its own to that of each output; the images are the same."""
    ball, faces = nmr.icosphere(2)
    vertices = (0.5 * ball.double() + double([0.1, 0.0, 2.0]))[None]
    size = dict(image_size=16, anti_aliasing=anti_aliasing)
    how = dict(outputs=("rgb", "depth", "normals"), far=3.0, **size)
    how["colors"] = nmr.VertexColors(normal(len(ball), 3))

    def grads(gradient):
        leaf, result = leaf_of(vertices), {}
        images = nmr.render(leaf, faces, gradient=gradient, **how)
        for name, image in zip(how["outputs"], images, strict=True):
            if image.requires_grad:
                upstream = normal(*image.shape)
                (result[name],) = torch.autograd.grad(image, leaf, upstream, retain_graph=True)
        return [*images], result

    (images, local), (same, none), (_, published) = map(grads, ("local", "none", "nmr"))
    assert_close(images, same)
    assert "rgb" not in none and local["rgb"].any()
    fragments = nmr.render(vertices, faces, outputs=("fragments",), **size).fragments
    depth = torch.where(fragments.depth == 100, 3.0, fragments.depth)[..., None]
    for name, raster in (("depth", depth), ("normals", fragments.normals())):
        assert torch.equal(none[name], published[name])
        upstream = normal(1, 16, 16, raster.shape[-1])
        index = fragments.sided_face_index
        edges = colors_gradient(vertices, faces, index, raster, upstream, anti_aliasing)
        assert_close(local[name] - none[name], edges)
        assert edges.any()
