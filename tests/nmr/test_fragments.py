"""fragments and depth_image: against the slow definition and finite differences, their invariances, bad input."""

import numpy as np
import pytest
import torch
from scenes import different_soups, for_threads, pack, random_soup

import nmr
from nmr import _C, reference

FAR = 50.0


def face_index_of(vertices, faces, raster_size, fill_back=True, starts=None):
    height, width = (raster_size, raster_size) if isinstance(raster_size, int) else raster_size
    return nmr.ops.rasterize(vertices, faces, starts, height, width, fill_back, 0.1, FAR)


def gradients(vertices, faces, starts, face_index, upstream_seed=0):
    """Outputs of both operators and the gradient of random sums of each."""
    results = []
    for op in (
        lambda v: nmr.ops.fragments(v, faces, starts, face_index, FAR),
        lambda v: (nmr.ops.depth_image(v, faces, starts, face_index, face_index.shape[1] % 2 == 0, FAR),),
    ):
        leaf = vertices.clone().requires_grad_()
        outputs = op(leaf)
        g = torch.Generator().manual_seed(upstream_seed)
        # the same upstream gradient for an image wherever it lies in the batch
        upstream = [torch.randn(o.shape[1:], generator=g, dtype=o.dtype).expand_as(o) for o in outputs]
        torch.autograd.backward(outputs, upstream)
        results += [*(o.detach() for o in outputs), leaf.grad]
    return results


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("fill_back", [False, True])
@pytest.mark.parametrize("raster_size", [18, 23, (9, 40), (40, 9)])
def test_equals_the_slow_definition(seed, fill_back, raster_size):
    vertices, faces = random_soup(seed)
    face_index = face_index_of(vertices, faces, raster_size, fill_back)
    assert not fill_back or (face_index >= len(faces)).any()
    leaf = vertices.clone().requires_grad_()
    weights, depth = nmr.ops.fragments(leaf, faces, None, face_index, FAR)
    slow_leaf = vertices.clone().requires_grad_()
    slow = [reference.fragments(slow_leaf[b], faces, face_index[b].flip(0).long(), FAR) for b in range(2)]
    slow_weights, slow_depth = (torch.stack([s[n].flip(0) for s in slow]) for n in range(2))
    torch.testing.assert_close(weights, slow_weights, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(depth, slow_depth, rtol=1e-9, atol=1e-9)
    g = torch.Generator().manual_seed(seed)
    upstream = [torch.randn(t.shape, generator=g, dtype=t.dtype) for t in (weights, depth)]
    torch.autograd.backward([weights, depth], upstream)
    torch.autograd.backward([slow_weights, slow_depth], upstream)
    torch.testing.assert_close(leaf.grad, slow_leaf.grad, rtol=1e-7, atol=1e-7 * float(slow_leaf.grad.abs().max()))
    assert leaf.grad.any(dim=1).all()


def test_weights_interpolate_the_face_in_space():
    """sum_k b_k (x_k z_k, y_k z_k, z_k) is the point seen at the pixel: perspective-correct."""
    vertices, faces = random_soup(5)
    raster_size = 20
    face_index = face_index_of(vertices, faces, raster_size)
    weights, depth = nmr.ops.fragments(vertices, faces, None, face_index, FAR)
    drawn = face_index >= 0
    torch.testing.assert_close(weights.sum(-1), drawn.double())
    assert (depth[~drawn] == FAR).all() and not weights[~drawn].any()
    centre = (2 * torch.arange(raster_size).double() + 1 - raster_size) / raster_size
    rays = torch.stack(
        [*torch.meshgrid(centre, -centre, indexing="xy"), torch.ones(raster_size, raster_size).double()], -1
    )
    for b in range(2):
        corners = vertices[b][faces[face_index[b].clamp_min(0).long() % len(faces)]]
        space = torch.cat([corners[..., :2] * corners[..., 2:], corners[..., 2:]], dim=-1)
        point = (weights[b][..., None] * space).sum(-2)
        torch.testing.assert_close(point[drawn[b]], (rays * depth[b][..., None])[drawn[b]])


@pytest.mark.parametrize("anti_aliasing", [False, True])
@pytest.mark.parametrize("size", [(22, 22), (8, 50), (50, 8)])
def test_depth_image_is_the_mean_of_the_depth_of_fragments(anti_aliasing, size):
    vertices, faces = random_soup(6, dtype=torch.float32)
    face_index = face_index_of(vertices, faces, size)
    leaves = [vertices.clone().requires_grad_() for _ in range(2)]
    _, depth = nmr.ops.fragments(leaves[0], faces, None, face_index, FAR)
    mean = depth.view(2, size[0] // 2, 2, size[1] // 2, 2).mean((2, 4)) if anti_aliasing else depth
    image = nmr.ops.depth_image(leaves[1], faces, None, face_index, anti_aliasing, FAR)
    torch.testing.assert_close(image, mean)
    upstream = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    mean.backward(upstream)
    image.backward(upstream)
    torch.testing.assert_close(leaves[1].grad, leaves[0].grad)


@pytest.mark.parametrize("seed", range(2))
def test_gradcheck(seed):
    vertices, faces = random_soup(seed, batch=2, num_faces=4)
    face_index = face_index_of(vertices, faces, 8)
    vertices.requires_grad_()
    assert torch.autograd.gradcheck(lambda v: nmr.ops.fragments(v, faces, None, face_index, FAR), vertices)
    assert torch.autograd.gradcheck(lambda v: nmr.ops.depth_image(v, faces, None, face_index, True, FAR), vertices)


def test_one_of_the_two_gradients():
    vertices, faces = random_soup(1)
    face_index = face_index_of(vertices, faces, 12)
    leaf = vertices.clone().requires_grad_()
    grads = []
    for pick in (
        lambda w, d: w.square().sum(),
        lambda w, d: d.square().sum(),
        lambda w, d: w.square().sum() + d.square().sum(),
    ):
        grads.append(*torch.autograd.grad(pick(*nmr.ops.fragments(leaf, faces, None, face_index, FAR)), leaf))
    torch.testing.assert_close(grads[0] + grads[1], grads[2])
    assert grads[0].any() and grads[1].any()


@pytest.mark.parametrize("batch, raster_size", [(5, 40), (2, 300), (2, (100, 500)), (1, (500, 60))])
def test_same_bits_for_any_number_of_threads(batch, raster_size):
    """Also of fewer images than threads, large enough to be cut into blocks."""
    vertices, faces = random_soup(2, batch, 60, torch.float32)
    face_index = face_index_of(vertices, faces, raster_size)
    results = for_threads((1, 2, 5), lambda: gradients(vertices, faces, None, face_index))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_packed_equals_one_by_one():
    meshes = different_soups()
    vertices, faces, starts = pack(meshes)
    face_index = face_index_of(vertices, faces, 150, starts=starts)
    packed = gradients(vertices, faces, starts, face_index)
    for b, (v, f) in enumerate(meshes):
        single = gradients(v[None], f, None, face_index[b : b + 1])
        assert torch.equal(face_index_of(v[None], f, 150), face_index[b : b + 1])
        for n, (whole, one) in enumerate(zip(packed, single, strict=True)):
            part = whole[starts[b, 0] : starts[b + 1, 0]] if n in (2, 4) else whole[b]
            assert torch.equal(part, one[0])


def test_faces_per_image_equal_shared_faces():
    vertices, faces = random_soup(3)
    face_index = face_index_of(vertices, faces, 16)
    shared, own = (gradients(vertices, f, None, face_index) for f in (faces, faces.expand(2, -1, -1).contiguous()))
    assert all(torch.equal(a, b) for a, b in zip(shared, own, strict=True))


def test_a_corner_in_the_plane_of_the_eye_gives_no_gradient_and_spoils_nothing():
    """Depths of 0, inf and 1e-40: weights and gradients of the other faces stay, none is NaN."""
    vertices, faces = random_soup(4, batch=1, num_faces=6, dtype=torch.float32)
    for bad in (0.0, 1e-40, -1e-40, float("inf")):
        spoiled = vertices.clone()
        spoiled[0, 0, 2] = bad
        face_index = face_index_of(spoiled, faces, 32)
        _, _, grad, depth, grad_depth = gradients(spoiled, faces, None, face_index)
        assert not depth.isnan().any() and not grad.isnan().any() and not grad_depth.isnan().any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_mesh_gives_depths_and_gradients(dtype):
    """Coordinates of every kind: what is drawn has a depth in (near, far) and gradients that are numbers."""
    g = torch.Generator().manual_seed(0)
    odd = torch.tensor([0.0, -0.0, 1.0, -1.0, 0.5, 1e-45, 1e-30, 1e30, -1e30, 3e38, float("inf"), float("nan"), 1e-7])
    drawn = 0
    for _ in range(150):
        vertices = 2 * torch.randn(2, 7, 3, generator=g, dtype=dtype)
        choose = torch.rand(vertices.shape, generator=g) < 0.25
        vertices[choose] = odd[torch.randint(0, len(odd), (int(choose.sum()),), generator=g)].to(dtype)
        faces = torch.randint(0, 7, (6, 3), generator=g)
        face_index = face_index_of(vertices, faces, 12)
        weights, depth, grad, image, grad_image = gradients(vertices, faces, None, face_index)
        assert ((depth > 0.1) & (depth <= FAR)).all() and ((image > 0.1) & (image <= FAR)).all()
        assert not (weights.isnan().any() or grad.isnan().any() or grad_image.isnan().any())
        drawn += int((face_index >= 0).any())
    assert drawn > 100


@pytest.mark.parametrize("batch, num_faces", [(0, 5), (2, 0)])
def test_empty_batches_and_meshes(batch, num_faces):
    vertices, faces = torch.zeros(batch, 15, 3), torch.zeros(num_faces, 3, dtype=torch.long)
    weights, depth, grad, image, grad_image = gradients(vertices, faces, None, face_index_of(vertices, faces, 8))
    assert weights.shape == (batch, 8, 8, 3) and not weights.any() and (depth == FAR).all() and (image == FAR).all()
    assert not grad.any() and not grad_image.any()


@pytest.mark.parametrize("dtype, packed", [(torch.float32, False), (torch.float64, True)])
def test_opcheck(dtype, packed):
    vertices, faces = random_soup(0, dtype=dtype)
    starts = None
    if packed:
        vertices, faces, starts = pack([(v, faces) for v in vertices])
    face_index = face_index_of(vertices, faces, 12, starts=starts)
    arguments = vertices.clone().requires_grad_(), faces, starts, face_index
    torch.library.opcheck(nmr.ops.fragments, (*arguments, FAR))
    torch.library.opcheck(nmr.ops.depth_image, (*arguments, True, FAR))
    weights, depth = torch.randn(2, 12, 12, 3, dtype=dtype), torch.randn(2, 12, 12, dtype=dtype)
    for grads in ((weights, depth), (None, depth)):
        torch.library.opcheck(nmr.ops.fragments_backward, (vertices, *arguments[1:], *grads))
    torch.library.opcheck(nmr.ops.depth_backward, (vertices, *arguments[1:], depth[:, :6, :6], True))


def test_second_derivatives_are_refused():
    vertices, faces = random_soup(0)
    face_index = face_index_of(vertices, faces, 12)
    leaf = vertices.requires_grad_()
    for name, output in (
        ("render_fragments", nmr.ops.fragments(leaf, faces, None, face_index, FAR)[0]),
        ("render_depth", nmr.ops.depth_image(leaf, faces, None, face_index, False, FAR)),
    ):
        (grad,) = torch.autograd.grad(output.square().sum(), leaf, create_graph=True)
        with pytest.raises(RuntimeError, match=f"{name} has no second derivative"):
            grad.square().sum().backward()


CALLS = {
    "fragments": lambda a: _C.fragments_forward(*a["mesh"](a), a["weights"], a["depth"], FAR, 1),
    "fragments_backward": lambda a: _C.fragments_backward(*a["mesh"](a), a["weights"], a["depth"], a["grad"], 1),
    "depth": lambda a: _C.depth_forward(*a["mesh"](a), a["depth"], False, FAR, 1),
    "depth_backward": lambda a: _C.depth_backward(*a["mesh"](a), a["depth"], a["grad"], False, 1),
}
ALL = tuple(CALLS)


@pytest.mark.parametrize(
    "calls, change, words",
    [
        (
            ALL,
            dict(face_index=np.zeros((3, 8, 8), np.int32)),
            r"face_index must have shape \[2, H, W\], got \[3, 8, 8\]",
        ),
        (ALL, dict(face_index=np.full((2, 8, 8), 8, np.int32)), "the face index map does not belong to these faces"),
        (ALL, dict(face_index=np.full((2, 8, 8), -2, np.int32)), "the face index map does not belong to these faces"),
        (ALL, dict(faces=np.full((4, 3), 12)), "vertex 12, but a mesh has 12 vertices"),
        (ALL[:1], dict(weights=np.zeros((2, 8, 8))), r"weights must have shape \[2, 8, 8, 3\], got \[2, 8, 8\]"),
        (ALL[1:2], dict(weights=np.zeros((2, 8, 8))), r"grad_weights must have shape \[2, 8, 8, 3\]"),
        (ALL[::2], dict(depth=np.zeros((2, 8, 7))), r"depth must have shape \[2, 8, 8\], got \[2, 8, 7\]"),
        (ALL[1::2], dict(depth=np.zeros((2, 8, 7))), r"grad_depth must have shape \[2, 8, 8\], got \[2, 8, 7\]"),
        (ALL[1::2], dict(grad=np.zeros((2, 12))), r"grad_vertices must have shape \[2, 12, 3\], got \[2, 12\]"),
    ],
)
def test_no_call_reads_or_writes_outside_an_array(calls, change, words):
    arguments = dict(
        mesh=lambda a: (a["vertices"], a["faces"], None, a["face_index"]),
        vertices=random_soup(0, num_faces=4)[0].numpy(),
        faces=np.arange(12).reshape(4, 3),
        face_index=np.zeros((2, 8, 8), np.int32),
        weights=np.zeros((2, 8, 8, 3)),
        depth=np.zeros((2, 8, 8)),
        grad=np.zeros((2, 12, 3)),
    )
    for call in calls:
        CALLS[call](arguments)
        with pytest.raises(ValueError, match=words):
            CALLS[call]({**arguments, **change})


def test_an_anti_aliased_face_index_map_is_even():
    vertices, faces = random_soup(0)
    with pytest.raises(ValueError, match=r"even size, got \[2, 9, 9\]"):
        nmr.ops.depth_image(vertices, faces, None, face_index_of(vertices, faces, 9), True, FAR)
