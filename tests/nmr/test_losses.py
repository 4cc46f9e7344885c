"""The losses: published values and gradients, closed forms, true derivatives, errors."""

import math

import numpy as np
import pytest
import torch
from scenes import for_threads
from vectors import load_vector, vector_names

import nmr
from nmr.losses import (
    area_loss,
    edge_length_loss,
    inflation_loss,
    laplacian_loss,
    normal_consistency_loss,
    smoothness_loss,
    soft_iou_loss,
    volume_loss,
)


def relative_l2(a, b):
    return np.linalg.norm(np.asarray(a, np.float64) - b) / np.linalg.norm(b)


@pytest.mark.parametrize("name", vector_names("loss_smooth_*"))
def test_smoothness_vectors(name):
    v = load_vector(name)
    edges = nmr.edge_table(torch.from_numpy(v["faces"]))
    for dtype in (torch.float32, torch.float64):
        vertices = torch.from_numpy(v["vertices"]).to(dtype).requires_grad_()
        loss = smoothness_loss(vertices, edges)
        loss.backward()
        np.testing.assert_allclose(loss.item(), v["loss"], rtol=1e-5)
        # Collapsed edges: what remains is rounding (the vector is 2.1e-3 from the float64 value, ours 1.5e-3).
        tolerance = 5e-3 if name.endswith("degenerate") else 1e-4
        assert relative_l2(vertices.grad.numpy(), v["grad_vertices"]) < tolerance


def plain_smoothness(vertices, edges, e=1e-6):
    """The documented formula, as a chain of torch operations."""
    v0, v1, v2, v3 = vertices[:, edges].unbind(2)
    a = v1 - v0
    heights, lengths = [], []
    for b in (v2 - v0, v3 - v0):
        a2, b2, ab = (a * a).sum(-1), (b * b).sum(-1), (a * b).sum(-1)
        cos = ab / ((a2 + e).sqrt() * (b2 + e).sqrt() + e)
        heights.append(b - a * (ab / (a2 + e))[..., None])
        lengths.append((b2 + e).sqrt() * (1 - cos**2 + e).sqrt())
    cos = (heights[0] * heights[1]).sum(-1) / (lengths[0] * lengths[1] + e)
    return ((1 + cos) ** 2).sum(1).mean()


def test_smoothness_equals_the_formula_and_its_derivative():
    vertices, faces = nmr.icosphere(2)
    g = torch.Generator().manual_seed(0)
    vertices = (
        (vertices + 0.1 * torch.randn(3, len(vertices), 3, generator=g)).double().requires_grad_()
    )
    edges = nmr.edge_table(faces)
    ours, plain = smoothness_loss(vertices, edges), plain_smoothness(vertices, edges)
    torch.testing.assert_close(ours, plain, rtol=1e-12, atol=0)
    torch.testing.assert_close(
        torch.autograd.grad(ours, vertices)[0],
        torch.autograd.grad(plain, vertices)[0],
        rtol=1e-9,
        atol=1e-9,
    )


def test_same_bits_for_any_number_of_threads():
    vertices, faces = nmr.icosphere(2)
    g = torch.Generator().manual_seed(0)
    vertices = vertices + 0.1 * torch.randn(37, len(vertices), 3, generator=g)
    edges = nmr.edge_table(faces)
    images = [torch.rand(7, 5001, generator=g) for _ in range(2)]

    def gradients():
        leaves = [x.clone().requires_grad_() for x in (vertices, *images)]
        losses = (
            smoothness_loss(leaves[0], edges),
            soft_iou_loss(*leaves[1:]),
            nmr.ops.soft_iou_loss(*images)[1],
        )
        return losses[2], *torch.autograd.grad(losses[0] + losses[1], leaves)

    results = for_threads((1, 2, 5), gradients)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
    alone = [nmr.ops.soft_iou_loss(*(x[b : b + 1] for x in images))[1] for b in range(7)]
    assert torch.equal(torch.cat(alone), results[0][0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_smoothness_same_bits_alone_and_in_a_batch(dtype):
    """Meshes are taken 16 at a time while there are as many, and one by one, in groups of edges, after that."""
    vertices, faces = nmr.icosphere(1)
    g = torch.Generator().manual_seed(0)
    vertices = (vertices + 0.1 * torch.randn(19, len(vertices), 3, generator=g)).to(dtype)
    edges = nmr.edge_table(faces)[:-1]  # 119: not a multiple of the group
    weights = torch.rand(19, generator=g).to(dtype)
    loss = nmr.ops.smoothness(vertices, edges)
    grad = nmr.ops.smoothness.backward(vertices, edges, weights, [True])
    for b in range(19):
        assert torch.equal(loss[b : b + 1], nmr.ops.smoothness(vertices[b : b + 1], edges))
        alone = nmr.ops.smoothness.backward(vertices[b : b + 1], edges, weights[b : b + 1], [True])
        assert torch.equal(grad[b : b + 1], alone)


def test_soft_iou_vector():
    v = load_vector("loss_iou")
    prediction = torch.from_numpy(v["prediction"]).requires_grad_()
    loss = soft_iou_loss(prediction, torch.from_numpy(v["target"]))
    loss.backward()
    np.testing.assert_allclose(loss.item(), v["loss"], rtol=1e-6)
    np.testing.assert_allclose(prediction.grad.numpy(), v["grad_prediction"], rtol=1e-4, atol=1e-9)


def test_soft_iou_of_empty_images():
    """The published loss is NaN as soon as one pair is empty; such a pair agrees."""
    v = load_vector("loss_iou")
    assert np.isnan(v["empty_loss"])
    prediction = torch.from_numpy(v["empty_prediction"]).requires_grad_()
    loss = soft_iou_loss(prediction, torch.from_numpy(v["empty_target"]))
    loss.backward()
    assert 0 <= loss.item() <= 1 and prediction.grad.isfinite().all()
    assert soft_iou_loss(torch.zeros(2, 4, 4), torch.zeros(2, 4, 4)) == 0


@pytest.mark.parametrize(
    "dtype", [torch.float16, torch.bfloat16, torch.bool, torch.uint8, torch.int64, torch.float64]
)
def test_soft_iou_sums_in_float32(dtype):
    """A float16 cannot hold the sum of 90,000 ones."""
    ones = torch.ones(2, 300, 300)
    loss = soft_iou_loss(ones, ones.to(dtype))
    assert loss == 0 and loss.dtype == torch.float32
    if dtype.is_floating_point:
        prediction = ones.to(dtype).requires_grad_()
        loss = soft_iou_loss(prediction, 0.5 * ones)
        loss.backward()
        assert loss == 0.5 and loss.dtype == torch.promote_types(dtype, torch.float32)
        assert prediction.grad.isfinite().all() and prediction.grad.dtype == dtype


def plain_iou(prediction, target):
    """The published formula."""
    intersection = (prediction * target).flatten(1).sum(1)
    union = (prediction + target - prediction * target).flatten(1).sum(1)
    return 1 - (intersection / union).mean()


@pytest.mark.parametrize("count", [1, 15, 16, 31, 4096, 4097, 10007])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_soft_iou_is_the_formula_and_its_derivative(count, dtype):
    g = torch.Generator().manual_seed(count)
    images = [torch.rand(3, count, generator=g, dtype=torch.float64) for _ in range(2)]
    given = [x.to(dtype).requires_grad_() for x in images]
    exact = [x.detach().double().requires_grad_() for x in given]
    ours, plain = soft_iou_loss(*given), plain_iou(*exact)
    tolerance = {"rtol": 0, "atol": 1e-6 if dtype == torch.float32 else 1e-13}
    torch.testing.assert_close(ours.double(), plain, **tolerance)
    for a, b in zip(
        torch.autograd.grad(ours, given), torch.autograd.grad(plain, exact), strict=True
    ):
        torch.testing.assert_close(a.double() / b.abs().max(), b / b.abs().max(), **tolerance)
    (alone,) = torch.autograd.grad(soft_iou_loss(given[0], images[1].to(dtype)), given[0])
    assert torch.equal(alone, torch.autograd.grad(soft_iou_loss(*given), given)[0])


def test_soft_iou_derivatives_of_any_kind():
    """First and second ones, in forward mode, in torch.func, compiled; and opcheck."""
    g = torch.Generator().manual_seed(0)
    prediction, target, tangent = (
        torch.rand(3, 20, generator=g, dtype=torch.float64) for _ in range(3)
    )
    leaves = prediction.requires_grad_(), target.requires_grad_()
    assert torch.autograd.gradcheck(soft_iou_loss, leaves, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(soft_iou_loss, leaves)
    (gradient,) = torch.autograd.grad(plain_iou(*leaves), leaves[0])
    prediction, target = prediction.detach(), target.detach()
    torch.testing.assert_close(torch.func.grad(soft_iou_loss)(prediction, target), gradient)
    _, slope = torch.func.jvp(lambda p: soft_iou_loss(p, target), (prediction,), (tangent,))
    torch.testing.assert_close(slope, (gradient * tangent).sum())
    hessian = torch.func.jacrev(torch.func.grad(soft_iou_loss))(prediction, target)
    torch.testing.assert_close(
        hessian, torch.func.jacrev(torch.func.grad(plain_iou))(prediction, target)
    )
    compiled = torch.compile(soft_iou_loss, fullgraph=True, backend="aot_eager")
    leaf = prediction.detach().clone().requires_grad_()
    compiled(leaf, target).backward()
    torch.testing.assert_close(leaf.grad, gradient)
    for dtype in (torch.float32, torch.float64):
        images = [x.to(dtype).detach().requires_grad_() for x in (prediction, target)]
        torch.library.opcheck(nmr.ops.soft_iou_loss.op, images)
        areas = nmr.ops.soft_iou_loss(*images)[1]
        upstream = torch.rand((), dtype=dtype, generator=g)
        torch.library.opcheck(
            nmr.ops.soft_iou_loss.backward.op, (*images, areas, upstream, [True, False])
        )


def octahedron():
    """Vertices at distance 1 on the axes; every vertex is the middle of its neighbours but for its own axis."""
    vertices = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    faces = torch.tensor(
        [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    )
    return vertices, faces


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("key", ["laplacian", "edge", "inflation"])
def test_published_losses(key, dtype):
    v = load_vector("loss_extra")
    vertices = torch.from_numpy(v["vertices"]).to(dtype).requires_grad_()
    faces = torch.from_numpy(v["faces"])
    if key == "laplacian":
        loss = laplacian_loss(vertices, nmr.unique_edges(faces))
    elif key == "edge":
        # published: once for each face of an edge
        loss = 2 * edge_length_loss(vertices, nmr.unique_edges(faces))
    else:
        loss = inflation_loss(vertices, faces)  # published: sqrt(|n|^2 + 1e-5), which is 5e-6 more
    loss.backward()
    np.testing.assert_allclose(loss.item(), v[key], rtol=1e-5)
    assert relative_l2(vertices.grad.numpy(), v[f"grad_{key}"]) < 1e-5


def test_closed_forms_on_an_octahedron():
    vertices, faces = octahedron()
    edges = nmr.edge_table(faces)
    for scale in (1.0, 3.0):
        x = scale * vertices
        # The four neighbours of a vertex have mean 0.
        assert laplacian_loss(x, edges).item() == pytest.approx(6 * scale**2)
        # All edges are sqrt(2) long.
        assert edge_length_loss(x, edges).item() == pytest.approx(0, abs=1e-20)
        assert edge_length_loss(x, edges, target=scale).item() == pytest.approx(
            12 * (2**0.5 - 1) ** 2 * scale**2
        )
        assert edge_length_loss(x, edges, target=0).item() == pytest.approx(24 * scale**2)
        # Normals (+-1, +-1, +-1) / sqrt(3): those of neighbours differ in one sign.
        assert normal_consistency_loss(x, edges).item() == pytest.approx(2 / 3)


def test_batches_are_means_over_their_meshes():
    vertices, faces = octahedron()
    edges = nmr.edge_table(faces)
    batch = torch.stack([vertices, 3 * vertices, vertices * torch.tensor([1.0, 2, 3])])
    tables = {
        normal_consistency_loss: edges,
        laplacian_loss: edges,
        edge_length_loss: edges,
        inflation_loss: faces,
        volume_loss: faces,
        area_loss: faces,
    }
    for loss, table in tables.items():
        mean = sum(loss(x, table) for x in batch) / 3
        torch.testing.assert_close(loss(batch, table), mean)
        assert loss(vertices, table).shape == ()


def test_normal_consistency_does_not_depend_on_the_winding():
    vertices, faces = octahedron()
    vertices = vertices * torch.tensor([1.0, 0.7, 0.5])
    mixed = torch.cat([faces[:3].flip(1), faces[3:]])
    values = [normal_consistency_loss(vertices, nmr.edge_table(f)) for f in (faces, mixed)]
    torch.testing.assert_close(*values)


@pytest.mark.parametrize("loss", [laplacian_loss, edge_length_loss, normal_consistency_loss])
def test_losses_gradcheck(loss):
    vertices, faces = nmr.icosphere(0)
    vertices = (
        (vertices[None] * torch.tensor([[[1.0, 0.7, 0.5]], [[0.4, 1.0, 0.9]]]))
        .double()
        .requires_grad_()
    )
    edges = nmr.edge_table(faces)
    torch.autograd.gradcheck(lambda x: loss(x, edges), vertices)
    torch.autograd.gradcheck(lambda x: edge_length_loss(x, edges, 0.5), vertices)


def test_volume_of_boxes():
    """The octahedron with half axes a, b, c has the volume 4 abc / 3, wherever it is."""
    vertices, faces = octahedron()
    boxes = torch.stack([vertices, vertices * torch.tensor([1.0, 2, 3]) + 5]).requires_grad_()
    loss = volume_loss(boxes, faces)
    assert loss.item() == pytest.approx((4 / 3 + 8) / 2)
    assert volume_loss(boxes[0], faces.flip(1)).item() == pytest.approx(-4 / 3)
    loss.backward()
    torch.testing.assert_close(boxes.grad[0], 2 / 3 * vertices.to(boxes.grad) / 2)
    torch.autograd.gradcheck(lambda x: volume_loss(x, faces), boxes)


def test_area_of_octahedra():
    """A regular octahedron of half axis a has the area 4 sqrt(3) a^2."""
    vertices, faces = octahedron()
    pair = torch.stack([vertices, 2 * vertices + 5]).double().requires_grad_()
    loss = area_loss(pair, faces)
    assert loss.item() == pytest.approx(4 * math.sqrt(3) * (1 + 4) / 2)
    assert area_loss(pair[0], faces.flip(1)).item() == pytest.approx(4 * math.sqrt(3))
    torch.autograd.gradcheck(lambda x: area_loss(x, faces), pair)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_collapsed_meshes_have_finite_gradients(dtype):
    vertices, faces = nmr.icosphere(0)
    edges = nmr.edge_table(faces)
    for x in (0 * vertices, vertices * torch.tensor([1.0, 0, 0])):
        x = x.to(dtype).requires_grad_()
        total = inflation_loss(x, faces) + volume_loss(x, faces) + area_loss(x, faces)
        for loss in (laplacian_loss, edge_length_loss, normal_consistency_loss, smoothness_loss):
            total = total + loss(x, edges)
        total.backward()
        assert total.isfinite() and x.grad.isfinite().all()
