"""render_silhouette(gradient="local"): against the slow definition, by hand, its reach, what descent does with it."""

import pytest
import torch
from scenes import random_soup

import nmr
from nmr import reference


def square(left, bottom, right, top, dtype=torch.float64):
    corners = [(left, bottom, 1.0), (right, bottom, 1.0), (right, top, 1.0), (left, top, 1.0)]
    return torch.tensor([corners], dtype=dtype), torch.tensor([[0, 1, 2], [0, 2, 3]])


def gradient_of(vertices, faces, upstream, **kwargs):
    leaf = vertices.clone().requires_grad_()
    alpha = nmr.render_silhouette(leaf, faces, image_size=upstream.shape[-1], **{"gradient": "local", **kwargs})
    alpha.backward(upstream.expand(alpha.shape))
    return leaf.grad


def noise(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("anti_aliasing", [False, True])
@pytest.mark.parametrize("fill_back", [False, True])
def test_equals_the_slow_definition(seed, anti_aliasing, fill_back):
    vertices, faces = random_soup(seed)
    size = 11 if anti_aliasing else 19
    upstream = noise(2, size, size, seed=seed)
    eps = (1e-4, 2.0)[seed % 2]  # 2: many ties
    grad = gradient_of(vertices, faces, upstream, anti_aliasing=anti_aliasing, fill_back=fill_back, eps=eps)
    for b in range(2):
        index = reference.face_index(vertices[b], faces, size * (1 + anti_aliasing), fill_back)
        assert fill_back == bool((index >= len(faces)).any())  # reversed copies own pixels, too
        expected = reference.local_gradient(vertices[b], faces, index, upstream[b], anti_aliasing, eps)
        torch.testing.assert_close(grad[b], expected, rtol=1e-9, atol=1e-9)
    assert grad[..., :2].any() and not grad[..., 2].any()


@pytest.mark.parametrize("size", [(7, 16), (15, 6), (1, 9), (9, 1)])
@pytest.mark.parametrize("anti_aliasing", [False, True])
def test_rectangles_equal_the_slow_definition(size, anti_aliasing):
    vertices, faces = random_soup(2)
    upstream = noise(2, *size)
    raster = tuple(n * (1 + anti_aliasing) for n in size)
    index = torch.stack([reference.face_index(v, faces, raster) for v in vertices])
    face_index = index.flip(1).to(torch.int32).contiguous()
    grad = nmr.ops.local_gradient(vertices, faces, None, face_index, upstream, anti_aliasing, 1e-4)
    for b in range(2):
        expected = reference.local_gradient(vertices[b], faces, index[b], upstream[b], anti_aliasing)
        torch.testing.assert_close(grad[b], expected, rtol=1e-9, atol=1e-9)
    assert grad.any()


def test_the_image_is_the_same():
    vertices, faces = random_soup(0)
    local, published = (nmr.render_silhouette(vertices, faces, image_size=20, gradient=g) for g in ("local", "nmr"))
    assert torch.equal(local, published) and local.any()


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
    torch.testing.assert_close(grad[0].sum(0), torch.tensor([*expected, 0.0], dtype=torch.float64), rtol=0, atol=1e-9)


def test_corners_share_by_their_weights_at_the_pixels_centre():
    vertices, faces = square(*BLOCK)
    grad = gradient_of(vertices, faces, one_pixel({(3, 5): -1.0}), anti_aliasing=False)
    # The centre of row 3, column 4 is (1/8, 1/8): in the lower face, weights 1/8, 1/2, 3/8 of (left, bottom), ...
    expected = torch.tensor([-4 * 1 / 8, -4 * 1 / 2, -4 * 3 / 8, 0.0], dtype=torch.float64)
    torch.testing.assert_close(grad[0, :, 0], expected, rtol=0, atol=1e-12)
    assert not grad[0, :, 1:].any()


def test_a_pixel_between_two_ends_adds_both():
    """A strip one pixel wide: moving it right covers one neighbour and uncovers itself."""
    vertices, faces = square(0.25, -0.75, 0.5, 0.75)  # column 5 of 8
    for at, upstream in (((3, 6), -1.0), ((3, 5), 1.0), ((3, 4), -1.0)):
        expected = {6: -4.0, 5: 0.0, 4: 4.0}[at[1]]  # itself not wanted: either way is as good
        grad = gradient_of(vertices, faces, one_pixel({at: upstream}), anti_aliasing=False)
        torch.testing.assert_close(float(grad[0, :, 0].sum()), expected, rtol=0, atol=1e-9)
    grad = gradient_of(vertices, faces, one_pixel({(3, 6): -1.0, (3, 5): 1.0}), anti_aliasing=False)
    torch.testing.assert_close(float(grad[0, :, 0].sum()), -8.0, rtol=0, atol=1e-9)


def test_the_border_of_the_image_is_no_end():
    vertices, faces = square(-1.5, -1.5, 1.5, 1.5)
    assert not gradient_of(vertices, faces, noise(8, 8)).any()


def test_anti_aliasing_acts_at_the_resolution_of_the_raster():
    """Each of the 2x2 gets a quarter of the gradient, and a pixel of the raster is half as wide."""
    vertices, faces = square(-0.75, -0.25, 0.25, 0.75)  # ends between image pixels of 8 x 8
    upstream = one_pixel({(2, 5): -1.0})
    grad = gradient_of(vertices, faces, upstream, anti_aliasing=True)
    # two raster rows, -1/4 each, times R / 2 = 8
    torch.testing.assert_close(float(grad[0, :, 0].sum()), -4.0, rtol=0, atol=1e-9)


def test_one_pixel_is_its_reach():
    vertices, faces = square(-0.6, -0.4, -0.1, 0.4)
    upstream = torch.zeros(16, 16, dtype=torch.float64)
    upstream[6:10, 10:14] = -1.0
    assert not gradient_of(vertices, faces, upstream).any()
    far = gradient_of(vertices, faces, upstream, gradient="nmr")
    assert far[0, 1:3, 0].max() < 0


def test_reversed_faces_and_their_order_change_nothing():
    vertices, faces = nmr.icosphere(2)
    vertices = (0.5 * vertices + torch.tensor([0.1, 0.0, 2.0])).double()[None]
    upstream = noise(24, 24)
    grad = gradient_of(vertices, faces, upstream)
    order = torch.randperm(len(faces), generator=torch.Generator().manual_seed(0))
    for other in (faces.flip(1), faces[order], faces.roll(1, 1)):
        torch.testing.assert_close(gradient_of(vertices, other, upstream), grad, rtol=1e-9, atol=1e-9)
    assert grad.any()


def test_a_gradient_that_is_not_a_number_is_passed_on():
    vertices, faces = square(*BLOCK)
    assert gradient_of(vertices, faces, one_pixel({(2, 5): float("nan")}), anti_aliasing=False)[..., 0].isnan().any()


def test_together_with_other_images():
    vertices, faces = nmr.icosphere(1)
    vertices = (0.5 * vertices + torch.tensor([0.0, 0.0, 2.0])).requires_grad_()
    ramp = torch.linspace(-1, 1, 16)
    alone = nmr.render_silhouette(vertices, faces, image_size=16, gradient="local")
    (wanted,) = torch.autograd.grad((alone * ramp).sum(), vertices)
    for name in ("alpha", "rgb"):
        outputs = nmr.render(vertices, faces, outputs=(name, "depth"), image_size=16, gradient="local")
        image = outputs.alpha if name == "alpha" else outputs.rgb.mean(-1)
        (got,) = torch.autograd.grad((image * ramp).sum(), vertices)
        torch.testing.assert_close(got, wanted)
    assert wanted.any()
    with pytest.raises(ValueError, match="gradient 'local' is that of silhouettes"):
        colors = nmr.VertexColors(torch.rand(len(vertices), 3))
        nmr.render(vertices, faces, colors=colors, image_size=16, gradient="local")
