"""resolve: NMR's gradient for images of any channels, against the slow definition; its invariances, bad input."""

import numpy as np
import pytest
import torch
from scenes import different_soups, for_threads, pack, random_soup
from vectors import gradient_tolerance, load_vector, vector_names

import nmr
from nmr import _C, reference

EPS = 1e-3


def face_index_of(vertices, faces, raster_size, fill_back=True, starts=None):
    return nmr.ops.rasterize(vertices, faces, starts, raster_size, raster_size, fill_back, 0.1, 50.0)


def random_image(face_index, channels, dtype=torch.float64, seed=0):
    """Random colours, the same for an image wherever it lies in the batch; the background is of one colour."""
    g = torch.Generator().manual_seed(seed)
    image = torch.rand(*face_index.shape[1:], channels, generator=g, dtype=dtype).expand(*face_index.shape, -1)
    return torch.where(face_index[..., None] >= 0, image, torch.full_like(image, 0.3)).contiguous()


def resolve_with_gradient(image, vertices, faces, starts, face_index, anti_aliasing=False, zeros=0.3):
    """The resolved image and both gradients of a random upstream, of which a part is zero."""
    vertices, image = vertices.clone().requires_grad_(), image.clone().requires_grad_()
    resolved = nmr.ops.resolve(image, None, vertices, faces, starts, face_index, anti_aliasing, EPS)
    g = torch.Generator().manual_seed(1)
    upstream = torch.randn(resolved.shape[1:], generator=g, dtype=resolved.dtype)
    upstream[torch.rand(upstream.shape[:2], generator=g) < zeros] = 0
    resolved.backward(upstream.expand_as(resolved))
    return resolved.detach(), image.grad, vertices.grad, upstream


@pytest.mark.parametrize("seed, channels", [(0, 1), (1, 2), (2, 3), (3, 4), (4, 7)])
@pytest.mark.parametrize("anti_aliasing", [False, True])
@pytest.mark.parametrize("fill_back", [False, True])
def test_equals_the_slow_definition(seed, channels, anti_aliasing, fill_back):
    vertices, faces = random_soup(seed)
    face_index = face_index_of(vertices, faces, 20 if anti_aliasing else 19, fill_back)
    image = random_image(face_index, channels)
    resolved, _, grad, upstream = resolve_with_gradient(image, vertices, faces, None, face_index, anti_aliasing)
    for b in range(2):
        index, from_below = face_index[b].flip(0).long(), image[b].flip(0)
        torch.testing.assert_close(resolved[b], reference.resolve(from_below, anti_aliasing))
        slow = reference.edge_gradient(vertices[b], faces, index, from_below, upstream, anti_aliasing, fill_back, EPS)
        torch.testing.assert_close(grad[b], slow, rtol=1e-9, atol=1e-9 * float(slow.abs().max()))
    assert grad[..., :2].any() and not grad[..., 2].any()


@pytest.mark.parametrize("name", vector_names("sil_*"))
def test_coverage_as_a_channel_has_the_gradient_of_the_silhouette(name):
    v = load_vector(name)
    vertices, faces = torch.from_numpy(v["vertices"]).requires_grad_(), torch.from_numpy(v["faces"]).long()
    anti_aliasing, far = bool(v["anti_aliasing"]), float(v["far"])
    size = int(v["image_size"]) * (2 if anti_aliasing else 1)
    settings = size, size, bool(v["fill_back"]), float(v["near"]), far
    face_index = nmr.ops.rasterize(vertices.detach(), faces, None, *settings)
    image = (face_index >= 0).float()[..., None]
    alpha = nmr.ops.resolve(image, None, vertices, faces, None, face_index, anti_aliasing, float(v["eps"]))[..., 0]
    alpha.backward(torch.from_numpy(v["grad_alpha"]))
    assert np.array_equal(alpha.detach().numpy(), v["alpha"])
    difference = np.linalg.norm(vertices.grad.numpy() - v["grad_vertices"])
    # nothing is fragile: the crossings are computed by the published expressions, only the sums are in another order
    assert difference <= min(gradient_tolerance(name), 1e-5) * max(np.linalg.norm(v["grad_vertices"]), 1e-30)


@pytest.mark.parametrize("anti_aliasing", [False, True])
def test_gradient_in_the_image_is_the_mean_s(anti_aliasing):
    vertices, faces = random_soup(0)
    face_index = face_index_of(vertices, faces, 6)
    image = random_image(face_index, 2).requires_grad_()

    def resolve(image):
        return nmr.ops.resolve(image, None, vertices, faces, None, face_index, anti_aliasing, EPS)

    assert torch.autograd.gradcheck(resolve, image)


def test_an_image_of_one_colour_has_no_edges():
    vertices, faces = random_soup(0)
    face_index = face_index_of(vertices, faces, 24)
    image = torch.rand(3, dtype=torch.float64).expand(*face_index.shape, 3).contiguous()
    _, grad_image, grad, _ = resolve_with_gradient(image, vertices, faces, None, face_index)
    assert grad_image.any() and not grad.any()


def test_channels_act_together():
    """A second channel that gains twice as much, where the first one loses, reverses the pull."""
    vertices = torch.tensor([[[-0.5, -0.5, 1.0], [0.5, -0.5, 1.0], [0.0, 0.6, 1.0]]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2]])
    face_index = face_index_of(vertices, faces, 16)
    covered = (face_index >= 0).double()[..., None]

    def spread(image, weights):
        """How far the loss sum(weights . image) wants the two lower corners apart (> 0: together)."""
        leaf = vertices.clone().requires_grad_()
        (
            nmr.ops.resolve(image, None, leaf, faces, None, face_index, False, EPS) * torch.tensor(weights)
        ).sum().backward()
        return leaf.grad[0, 1, 0] - leaf.grad[0, 0, 0]

    two = covered.expand(-1, -1, -1, 2).contiguous()
    assert spread(covered, [1.0]) > 0 > spread(covered, [-1.0])
    assert spread(two, [1.0, -2.0]) < 0 < spread(two, [-1.0, 2.0])
    torch.testing.assert_close(spread(two, [1.0, -2.0]), spread(covered, [-1.0]))


@pytest.mark.parametrize("batch, raster_size", [(5, 40), (2, 100)])
def test_same_bits_for_any_number_of_threads(batch, raster_size):
    """Also of fewer images than threads: then the threads share the lines and faces of each."""
    vertices, faces = random_soup(2, batch, 100, torch.float32)
    face_index = face_index_of(vertices, faces, raster_size)
    assert len(face_index[0].unique()) > 64  # several chunks of faces
    image = random_image(face_index, 3, torch.float32)
    results = for_threads((1, 2, 5), lambda: resolve_with_gradient(image, vertices, faces, None, face_index, True))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_packed_equals_one_by_one():
    meshes = different_soups()
    vertices, faces, starts = pack(meshes)
    face_index = face_index_of(vertices, faces, 30, starts=starts)
    image = random_image(face_index, 3, torch.float32)
    resolved, grad_image, grad, _ = resolve_with_gradient(image, vertices, faces, starts, face_index)
    for b, (v, f) in enumerate(meshes):
        part = slice(b, b + 1)
        single = resolve_with_gradient(image[part], v[None], f, None, face_index[part])
        expected = resolved[part], grad_image[part], grad[None, starts[b, 0] : starts[b + 1, 0]]
        assert all(torch.equal(a, b) for a, b in zip(single, expected, strict=False))


def test_not_a_number_in_a_pixel_gives_none_in_a_vertex():
    vertices, faces = random_soup(0, dtype=torch.float32)
    face_index = face_index_of(vertices, faces, 24)
    image = random_image(face_index, 3, torch.float32)
    image[:, 4, 3], image[:, 12, 12] = float("nan"), float("inf")
    _, _, grad, _ = resolve_with_gradient(image, vertices, faces, None, face_index)
    assert grad.any() and not grad.isnan().any()


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("per_image", [False, True])
def test_background_is_the_colour_of_pixels_without_a_face(threads, per_image):
    """The same as an image that holds it, in values and gradients; the gradient has the same bits for any threads."""
    vertices, faces = random_soup(0)
    face_index = face_index_of(vertices, faces, 20)
    image, behind = random_image(face_index, 3), torch.rand(2 if per_image else 1, 3, dtype=torch.float64)
    upstream = torch.randn(2, 10, 10, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    filled = torch.where(face_index[..., None] >= 0, image, behind[:, None, None])
    results = []
    for given, background in ((image, behind), (filled, None)):
        leaves = [x.clone().requires_grad_() for x in (given, vertices, behind)]
        pixels = (
            leaves[0]
            if background is not None
            else torch.where(face_index[..., None] >= 0, leaves[0], leaves[2][:, None, None])
        )
        mesh = leaves[1], faces, None, face_index
        resolved = nmr.ops.resolve(pixels, None if background is None else leaves[2], *mesh, True, EPS)
        resolved.backward(upstream)
        results.append([resolved.detach(), *(leaf.grad for leaf in leaves)])
    torch.testing.assert_close(*results)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_an_upstream_gradient_that_is_not_finite_reaches_every_visible_face_of_its_image(value):
    vertices, faces = random_soup(0)
    face_index = face_index_of(vertices, faces, 20)
    leaf = vertices.clone().requires_grad_()
    resolved = nmr.ops.resolve(random_image(face_index, 3), None, leaf, faces, None, face_index, True, EPS)
    upstream = torch.zeros_like(resolved)
    upstream[0, 3, 4, 1] = value
    resolved.backward(upstream)
    seen = torch.unique(face_index[0][face_index[0] >= 0] % len(faces))
    corners = torch.unique(faces[seen.long()])
    assert leaf.grad[0, corners, :2].isnan().all() and not leaf.grad[1].any()


def test_a_step_with_nan_does_not_change_later_steps():
    vertices, faces = nmr.icosphere(2)
    camera = nmr.LookAt([0.0, 0.5, -3.0])

    def step(bad):
        leaf = (0.5 * vertices).requires_grad_()
        outputs = ("rgb", "alpha") if bad else ("rgb",)
        images = nmr.render(
            leaf, faces, camera, outputs=outputs, colors=nmr.VertexColors((vertices + 1) / 2), image_size=64
        )
        loss = sum(image[:, 28:32].square().sum() for image in images)
        (loss * (float("nan") if bad else 1.0)).backward()
        return leaf.grad

    healthy = step(False)
    assert step(True).isnan().any()
    assert torch.equal(step(False), healthy)


@pytest.mark.parametrize("batch, num_faces", [(0, 5), (2, 0)])
def test_empty_batches_and_meshes(batch, num_faces):
    vertices, faces = torch.zeros(batch, 15, 3), torch.zeros(num_faces, 3, dtype=torch.long)
    face_index = face_index_of(vertices, faces, 8)
    resolved, _, grad, _ = resolve_with_gradient(
        random_image(face_index, 3, torch.float32), vertices, faces, None, face_index
    )
    assert resolved.shape == (batch, 8, 8, 3) and grad.shape == vertices.shape and not grad.any()


@pytest.mark.parametrize("dtype, packed", [(torch.float32, False), (torch.float64, True)])
def test_opcheck(dtype, packed):
    vertices, faces = random_soup(0, dtype=dtype)
    starts = None
    if packed:
        vertices, faces, starts = pack([(v, faces) for v in vertices])
    face_index = face_index_of(vertices, faces, 12, starts=starts)
    image = random_image(face_index, 3, dtype)
    leaf = image.clone().requires_grad_()
    mesh, upstream = (vertices.clone().requires_grad_(), faces, starts, face_index), image[:, :6, :6].contiguous()
    for behind in (
        None,
        torch.rand(1, 3, dtype=dtype),
        torch.rand(len(face_index), 3, dtype=dtype, requires_grad=True),
    ):
        torch.library.opcheck(nmr.ops.resolve, (leaf, behind, *mesh, True, EPS))
        behind = None if behind is None else behind.detach()
        torch.library.opcheck(nmr.ops.resolve_backward, (upstream, behind, face_index, True, True, behind is not None))
        torch.library.opcheck(nmr.ops.edges_backward, (vertices, *mesh[1:], image, behind, upstream, True, EPS))


def test_second_derivatives_are_refused():
    vertices, faces = random_soup(0)
    face_index = face_index_of(vertices, faces, 12)
    leaf, image = vertices.requires_grad_(), random_image(face_index, 3).requires_grad_()
    loss = nmr.ops.resolve(image, None, leaf, faces, None, face_index, False, EPS).square().sum()
    for grad in torch.autograd.grad(loss, (image, leaf), create_graph=True):
        with pytest.raises(RuntimeError, match="render has no second derivative"):
            grad.square().sum().backward(retain_graph=True)


CALLS = {
    "resolve": lambda a: _C.resolve_forward(a["image"], a["background"], a["face_index"], a["resolved"], True, 1),
    "resolve_backward": lambda a: _C.resolve_backward(
        a["resolved"], a["background"], a["face_index"], a["image"], a["grad_background"], True, 1
    ),
    "edges": lambda a: _C.edges_backward(
        a["vertices"],
        a["faces"],
        None,
        a["face_index"],
        a["image"],
        a["background"],
        a["resolved"],
        a["grad"],
        True,
        EPS,
        1,
    ),
}
ALL = tuple(CALLS)


@pytest.mark.parametrize(
    "calls, change, words",
    [
        (
            ALL[:2],
            dict(resolved=np.zeros((2, 4, 4))),
            r"resolved image must have shape \[B, h, w, C\], got \[2, 4, 4\]",
        ),
        (ALL[:2], dict(resolved=np.zeros((2, 4, 5, 3))), r"face_index must have shape \[2, 8, 10\]"),
        (ALL[:2], dict(resolved=np.zeros((2, 4, 4, 0))), "must have pixels and channels"),
        (ALL, dict(image=np.zeros((2, 8, 7, 3))), r"image must have shape \[2, 8, 8, 3\], got \[2, 8, 7, 3\]"),
        (ALL[2:], dict(image=np.zeros((2, 8, 8))), r"image must have shape \[B, H, W, C\], got \[2, 8, 8\]"),
        (
            ALL[2:],
            dict(face_index=np.full((2, 8, 8), 8, np.int32)),
            "the face index map does not belong to these faces",
        ),
        (ALL[2:], dict(resolved=np.zeros((2, 4, 4, 2))), r"grad_resolved must have shape \[2, 4, 4, 3\]"),
        (ALL, dict(background=np.zeros((3, 3))), r"background must have shape \[1 or 2, 3\], got \[3, 3\]"),
        (ALL[1:2], dict(grad_background=np.zeros((1, 3))), r"grad_background must have shape \[2, 3\]"),
        (ALL[2:], dict(grad=np.zeros((2, 12, 2))), r"grad_vertices must have shape \[2, 12, 3\]"),
    ],
)
def test_no_call_reads_or_writes_outside_an_array(calls, change, words):
    arguments = dict(
        vertices=random_soup(0, num_faces=4)[0].numpy(),
        faces=np.arange(12).reshape(4, 3),
        face_index=np.zeros((2, 8, 8), np.int32),
        image=np.zeros((2, 8, 8, 3)),
        background=np.zeros((1, 3)),
        grad_background=np.zeros((2, 3)),
        resolved=np.zeros((2, 4, 4, 3)),
        grad=np.zeros((2, 12, 3)),
    )
    for call in calls:
        CALLS[call](arguments)
        with pytest.raises(ValueError, match=words):
            CALLS[call]({**arguments, **change})
