"""gradient="local" of silhouettes and colours: against the slow definition, by hand, its reach, ends of surfaces."""

import pytest
import reference
import torch
from scenes import random_soup

import nmr


def square(left, bottom, right, top, dtype=torch.float64):
    corners = [(left, bottom, 1.0), (right, bottom, 1.0), (right, top, 1.0), (left, top, 1.0)]
    return torch.tensor([corners], dtype=dtype), torch.tensor([[0, 1, 2], [0, 2, 3]])


def gradient_of(vertices, faces, upstream, **kwargs):
    leaf = vertices.clone().requires_grad_()
    alpha = nmr.render_silhouette(
        leaf, faces, image_size=tuple(upstream.shape[-2:]), **{"gradient": "local", **kwargs}
    )
    alpha.backward(upstream.expand(alpha.shape))
    return leaf.grad


RECTANGLES = [(7, 16), (15, 6), (1, 9), (9, 1)]


def noise(*shape, seed=0, dtype=torch.float64):
    return torch.randn(
        *shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    ).to(dtype)


@pytest.mark.parametrize(
    "seed, size", [*((seed, (15, 15)) for seed in range(4)), *((2, size) for size in RECTANGLES)]
)
@pytest.mark.parametrize("anti_aliasing", [False, True])
@pytest.mark.parametrize("fill_back", [False, True])
def test_equals_the_slow_definition(seed, size, anti_aliasing, fill_back):
    vertices, faces = random_soup(seed)
    upstream = noise(2, *size, seed=seed)
    eps = (1e-4, 2.0)[seed % 2]  # 2: many ties
    grad = gradient_of(
        vertices, faces, upstream, anti_aliasing=anti_aliasing, fill_back=fill_back, eps=eps
    )
    for b in range(2):
        index = reference.face_index(
            vertices[b], faces, tuple(n * (1 + anti_aliasing) for n in size), fill_back
        )
        assert fill_back == bool((index >= len(faces)).any())  # reversed copies own pixels, too
        expected = reference.local_gradient(
            vertices[b], faces, index, upstream[b], anti_aliasing, eps
        )
        torch.testing.assert_close(grad[b], expected, rtol=1e-9, atol=1e-9)
    assert grad[..., :2].any() and not grad[..., 2].any()


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
    torch.testing.assert_close(
        grad[0].sum(0), torch.tensor([*expected, 0.0], dtype=torch.float64), rtol=0, atol=1e-9
    )


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
        torch.testing.assert_close(
            gradient_of(vertices, other, upstream), grad, rtol=1e-9, atol=1e-9
        )
    assert grad.any()


def test_a_gradient_that_is_not_a_number_is_passed_on():
    vertices, faces = square(*BLOCK)
    assert (
        gradient_of(vertices, faces, one_pixel({(2, 5): float("nan")}), anti_aliasing=False)[..., 0]
        .isnan()
        .any()
    )


def test_together_with_other_images():
    vertices, faces = nmr.icosphere(1)
    vertices = (0.5 * vertices + torch.tensor([0.0, 0.0, 2.0])).requires_grad_()
    ramp = torch.linspace(-1, 1, 16)
    alone = nmr.render_silhouette(vertices, faces, image_size=16, gradient="local")
    (wanted,) = torch.autograd.grad((alone * ramp).sum(), vertices)
    for name in ("alpha", "rgb"):
        outputs = nmr.render(
            vertices, faces, outputs=(name, "depth"), image_size=16, gradient="local"
        )
        image = outputs.alpha if name == "alpha" else outputs.rgb.mean(-1)
        (got,) = torch.autograd.grad((image * ramp).sum(), vertices)
        torch.testing.assert_close(got, wanted)
    assert wanted.any()


def scene_of(name):
    """Vertices in renderer space [B, V, 3] (of a pair of meshes if packed), faces, and whether depth is perspective."""
    vertices, faces = random_soup(3)
    # one behind the other, without perspective, with faces smaller than a pixel
    if name == "spheres":
        ball, faces = nmr.icosphere(5)
        pair = [
            0.6 * ball.double() + torch.tensor(at) for at in ([-0.2, 0.1, 2.0], [0.3, -0.1, 3.5])
        ]
        vertices, faces = torch.cat(pair)[None], torch.cat([faces, faces + len(ball)])
    return vertices, faces, name != "spheres"


def colors_gradient(
    vertices, faces, index, image, upstream, anti_aliasing=False, perspective=True, background=None
):
    leaf = vertices.clone().requires_grad_()
    settings = anti_aliasing, 1e-4, True, perspective
    nmr.ops.resolve(image, background, leaf, faces, None, index, *settings).backward(upstream)
    return leaf.grad


@pytest.mark.parametrize("name", ["soup", "spheres"])
@pytest.mark.parametrize("anti_aliasing", [False, True])
@pytest.mark.parametrize("own_background", [False, True])
def test_colors_equal_the_slow_definition(name, anti_aliasing, own_background):
    vertices, faces, perspective = scene_of(name)
    # in one block of rows, and in several
    size = (10, 14) if perspective else (100, 140)
    batch = len(vertices)
    raster = tuple(n * (1 + anti_aliasing) for n in size)
    index = nmr.ops.rasterize(vertices, faces, None, *raster, True, 0.1, 100.0, perspective)
    image, upstream = noise(batch, *raster, 3), noise(batch, *size, 3, seed=1)
    background = noise(batch, 3, seed=2) if own_background else None
    args = vertices, faces, index, image, upstream, anti_aliasing, perspective, background
    grad = colors_gradient(*args)
    if own_background:
        image = torch.where(index[..., None] >= 0, image, background[:, None, None])
    for b in range(batch):
        from_below = (
            index[b].long().flip(0),
            upstream[b],
            anti_aliasing,
            1e-4,
            image[b].flip(0),
            perspective,
        )
        expected = reference.local_gradient(vertices[b], faces, *from_below)
        torch.testing.assert_close(grad[b], expected, rtol=1e-9, atol=1e-9)
    assert grad[..., :2].any() and not grad[..., 2].any()
    before = torch.get_num_threads()
    for threads in (2, 5):
        torch.set_num_threads(threads)
        assert torch.equal(colors_gradient(*args), grad)
    torch.set_num_threads(before)


def in_front(distance):
    """BLOCK at depth 1 before a wall."""
    block, faces = square(*BLOCK)
    wall = square(-2.0, -2.0, 2.0, 2.0)[0] + torch.tensor([0.0, 0.0, distance])
    return torch.cat([block, wall], dim=1), torch.cat([faces, faces + 4])


@pytest.mark.parametrize("distance, moves", [(1.0, True), (1e-3, True), (1e-6, False)])
def test_only_the_surface_in_front_moves(distance, moves):
    """The pixel behind its right end should be as bright as the block, so it moves right; the wall stays."""
    vertices, faces = in_front(distance)
    colors = torch.tensor([1.0] * 4 + [0.25] * 4, dtype=torch.float64)[:, None]
    leaf = vertices.requires_grad_()
    image = nmr.render_rgb(
        leaf,
        faces,
        colors=nmr.VertexColors(colors),
        image_size=8,
        anti_aliasing=False,
        gradient="local",
    )
    assert image[0, 2, 4] == 1 and image[0, 2, 5] == 0.25
    (image[..., 0] * one_pixel({(2, 5): -1.0})).sum().backward()
    expected = [[-0.75 * 4 if moves else 0.0, 0.0, 0.0], [0.0] * 3]
    got = torch.stack([leaf.grad[0, :4].sum(0), leaf.grad[0, 4:].sum(0)])
    torch.testing.assert_close(got, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-9)


@pytest.mark.parametrize("subdivisions", [0, 2, 5])
@pytest.mark.parametrize("doubled", [False, True])
def test_a_surface_has_no_end_within(subdivisions, doubled):
    """Neither at seams, where every face has corners of its own, nor if its faces are smaller than pixels."""
    vertices, faces = nmr.icosphere(subdivisions)
    if doubled:
        vertices, faces = vertices[faces].flatten(0, 1), torch.arange(3 * len(faces)).view(-1, 3)
    leaf = (0.9 * vertices + torch.tensor([0.0, 0.0, 2.0]))[None].requires_grad_()
    colors = nmr.VertexColors(noise(len(vertices), 3, dtype=torch.float32))
    images = nmr.render(
        leaf, faces, outputs=("rgb", "alpha"), colors=colors, image_size=48, gradient="local"
    )
    inside = torch.nn.functional.avg_pool2d(images.alpha[None].detach(), 3, 1, 1)[0] == 1
    assert inside.any()
    (images.rgb * inside[..., None] * noise(48, 48, 3, dtype=torch.float32)).sum().backward()
    assert not leaf.grad.any()


@pytest.mark.parametrize("anti_aliasing", [False, True])
def test_gradients_of_all_outputs(anti_aliasing):
    """ "none" is the true derivative alone, "local" adds its own to that of each output; the images are the same."""
    ball, faces = nmr.icosphere(2)
    vertices = (0.5 * ball.double() + torch.tensor([0.1, 0.0, 2.0]))[None]
    colors = nmr.VertexColors(noise(len(ball), 3))

    def grads(gradient):
        leaf, result = vertices.clone().requires_grad_(), {}
        settings = {
            "colors": colors,
            "image_size": 16,
            "anti_aliasing": anti_aliasing,
            "gradient": gradient,
        }
        images = nmr.render(leaf, faces, outputs=("rgb", "depth", "normals"), far=3.0, **settings)
        for name in ("rgb", "depth", "normals"):
            image = getattr(images, name)
            if image.requires_grad:
                upstream = noise(*image.shape)
                (result[name],) = torch.autograd.grad(image, leaf, upstream, retain_graph=True)
        return images, result

    (images, local), (same, none), (_, published) = map(grads, ("local", "none", "nmr"))
    fragments = nmr.render(
        vertices, faces, outputs=("fragments",), image_size=16, anti_aliasing=anti_aliasing
    ).fragments
    rasters = {"depth": torch.where(fragments.depth == 100, 3.0, fragments.depth)[..., None]}
    rasters["normals"] = fragments.normals()
    for name in ("rgb", "depth", "normals"):
        torch.testing.assert_close(getattr(images, name), getattr(same, name))
    assert "rgb" not in none and local["rgb"].any()
    index = fragments.sided_face_index
    for name, raster in rasters.items():
        assert torch.equal(none[name], published[name])
        upstream = noise(*getattr(images, name).shape).view(1, 16, 16, -1)
        edges = colors_gradient(vertices, faces, index, raster, upstream, anti_aliasing)
        torch.testing.assert_close(local[name] - none[name], edges)
        assert edges.any()


def test_packed_meshes_are_drawn_as_if_alone():
    meshes = [nmr.icosphere(1), nmr.icosphere(2)]
    places = [torch.tensor([-0.1, 0.0, 2.0]), torch.tensor([0.2, 0.1, 3.0])]
    leaves = [
        (0.6 * v + place).double().requires_grad_()
        for (v, _), place in zip(meshes, places, strict=True)
    ]
    faces, colors = [f for _, f in meshes], [noise(len(v), 3) for v, _ in meshes]
    upstream = noise(2, 16, 16, 3)
    together = nmr.render_rgb(
        leaves, faces, colors=nmr.VertexColors(colors), image_size=16, gradient="local"
    )
    got = torch.autograd.grad(together, leaves, upstream)
    for b, leaf in enumerate(leaves):
        alone = nmr.render_rgb(
            leaf, faces[b], colors=nmr.VertexColors(colors[b]), image_size=16, gradient="local"
        )
        assert (
            torch.equal(got[b], torch.autograd.grad(alone, leaf, upstream[b : b + 1])[0])
            and got[b].any()
        )
