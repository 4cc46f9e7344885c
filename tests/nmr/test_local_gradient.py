"""render_silhouette(gradient="local"): against the slow definition, by hand, its reach, what descent does with it."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import different_soups, for_threads, pack, random_soup

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


def test_float32_is_close_to_float64():
    vertices, faces = random_soup(1, dtype=torch.float32)
    upstream = noise(2, 12, 12)
    single, double = gradient_of(vertices, faces, upstream.float()), gradient_of(vertices.double(), faces, upstream)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), double, rtol=1e-4, atol=1e-4)


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


def test_descent_moves_a_square_onto_another():
    vertices, faces = square(-0.5, -0.4, 0.3, 0.4)
    target = nmr.render_silhouette(vertices + vertices.new_tensor([0.2, 0.12, 0.0]), faces, image_size=32)
    offset = torch.zeros(1, 1, 3, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.SGD([offset], lr=0.01)
    losses = []
    for _ in range(40):
        optimizer.zero_grad()
        alpha = nmr.render_silhouette(vertices + offset, faces, image_size=32, gradient="local")
        loss = nmr.losses.soft_iou_loss(alpha, target)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[0] > 0.5 and losses[-1] < 0.1
    # It comes to rest less than a pixel of the raster away.
    torch.testing.assert_close(offset.detach().flatten(), vertices.new_tensor([0.2, 0.12, 0.0]), rtol=0, atol=2 / 64)


def test_descent_through_a_camera_deforms_a_sphere():
    vertices, faces = nmr.icosphere(2)
    camera = nmr.LookAt.from_angles(2.732, 20.0, [0.0, 60.0, 120.0], half_fov_deg=20.0)
    target = nmr.render_silhouette(vertices * torch.tensor([0.6, 0.25, 0.4]), faces, camera, image_size=48)
    shape = (0.4 * vertices).requires_grad_()
    optimizer = torch.optim.Adam([shape], lr=0.01)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        alpha = nmr.render_silhouette(shape, faces, camera, image_size=48, gradient="local")
        loss = nmr.losses.soft_iou_loss(alpha, target)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[0] > 0.3 and losses[-1] < 0.6 * losses[0]


def test_reversed_faces_and_their_order_change_nothing():
    vertices, faces = nmr.icosphere(2)
    vertices = (0.5 * vertices + torch.tensor([0.1, 0.0, 2.0])).double()[None]
    upstream = noise(24, 24)
    grad = gradient_of(vertices, faces, upstream)
    order = torch.randperm(len(faces), generator=torch.Generator().manual_seed(0))
    for other in (faces.flip(1), faces[order], faces.roll(1, 1)):
        torch.testing.assert_close(gradient_of(vertices, other, upstream), grad, rtol=1e-9, atol=1e-9)
    assert grad.any()


def test_same_bits_for_any_number_of_threads_and_in_company():
    vertices, faces = random_soup(3, batch=5, dtype=torch.float32)
    upstream = noise(5, 24, 24, dtype=torch.float32)
    results = for_threads((1, 2, 5), lambda: gradient_of(vertices, faces, upstream))
    assert all(torch.equal(grad, results[0]) for grad in results[1:]) and results[0].any()
    for b in range(5):
        assert torch.equal(gradient_of(vertices[b : b + 1], faces, upstream[b : b + 1])[0], results[0][b])


def test_a_list_equals_its_meshes_one_by_one():
    meshes = different_soups()
    upstream = noise(len(meshes), 16, 16, dtype=torch.float32)
    vertices = [v.clone().requires_grad_() for v, _ in meshes]
    nmr.render_silhouette(vertices, [f for _, f in meshes], image_size=16, gradient="local").backward(upstream)
    for (v, f), own, leaf in zip(meshes, upstream, vertices, strict=True):
        assert torch.equal(gradient_of(v[None], f, own[None])[0], leaf.grad)
    assert vertices[0].grad.any() and vertices[3].grad.any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_opcheck(dtype):
    vertices, faces = random_soup(0, dtype=dtype)
    settings = 12, 12, True, True, 0.1, 100.0, 1e-4
    torch.library.opcheck(nmr.ops.silhouette, (vertices.clone().requires_grad_(), faces, None, *settings, True))
    _, face_index = nmr.ops.silhouette(vertices, faces, None, *settings, True)
    upstream = noise(2, 12, 12, dtype=dtype)
    torch.library.opcheck(nmr.ops.local_gradient, (vertices, faces, None, face_index, upstream, True, 1e-4))
    packed = pack(different_soups(dtype))
    _, face_index = nmr.ops.silhouette(*packed, *settings, True)
    torch.library.opcheck(nmr.ops.silhouette, (packed[0].requires_grad_(), *packed[1:], *settings, True))
    upstream = noise(4, 12, 12, dtype=dtype)
    torch.library.opcheck(nmr.ops.local_gradient, (packed[0].detach(), *packed[1:], face_index, upstream, True, 1e-4))


def test_compile_fullgraph():
    vertices, faces = random_soup(0, dtype=torch.float32)

    def loss(v):
        return nmr.render_silhouette(v, faces, image_size=16, gradient="local").square().mean()

    eager, compiled = vertices.clone().requires_grad_(), vertices.clone().requires_grad_()
    loss(eager).backward()
    torch.compile(loss, fullgraph=True, backend="aot_eager")(compiled).backward()
    torch.testing.assert_close(compiled.grad, eager.grad, rtol=1e-5, atol=1e-7)
    assert eager.grad.any()


def test_second_derivative_is_refused():
    vertices, faces = random_soup(0)
    vertices.requires_grad_()
    loss = nmr.render_silhouette(vertices, faces, image_size=12, gradient="local").square().sum()
    (grad,) = torch.autograd.grad(loss, vertices, create_graph=True)
    with pytest.raises(RuntimeError, match="render_silhouette has no second derivative"):
        grad.square().sum().backward()


@settings(max_examples=80, deadline=None)
@given(
    st.lists(
        st.floats(width=32) | st.floats(-2, 2, width=32) | st.sampled_from([0.0, 1e-30, 3e38]), min_size=18, max_size=18
    ),
    st.lists(st.lists(st.integers(0, 5), min_size=3, max_size=3), max_size=5),
    st.integers(1, 9),
    st.booleans(),
)
def test_no_mesh_gives_a_nan(numbers, faces, size, anti_aliasing):
    vertices = torch.from_numpy(np.array(numbers, np.float32)).view(1, 6, 3)
    faces = torch.tensor(faces, dtype=torch.long).view(-1, 3)
    grad = gradient_of(vertices, faces, noise(size, size, dtype=torch.float32), anti_aliasing=anti_aliasing)
    assert grad.isfinite().all()


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


@pytest.mark.parametrize("gradient", ["soft", None, torch.zeros(2)])
def test_an_unknown_gradient(gradient):
    with pytest.raises(ValueError, match="gradient must be 'nmr' or 'local', got "):
        nmr.render_silhouette(*square(*BLOCK), gradient=gradient)
