"""soft_iou_loss and smoothness_loss: published values and gradients, true derivatives, errors."""

import numpy as np
import pytest
import torch
from vectors import load_vector, vector_names

import nmr
from nmr.losses import smoothness_loss, soft_iou_loss


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
    vertices = (vertices + 0.1 * torch.randn(3, len(vertices), 3, generator=g)).double().requires_grad_()
    edges = nmr.edge_table(faces)
    ours, plain = smoothness_loss(vertices, edges), plain_smoothness(vertices, edges)
    torch.testing.assert_close(ours, plain, rtol=1e-12, atol=0)
    torch.testing.assert_close(
        torch.autograd.grad(ours, vertices)[0], torch.autograd.grad(plain, vertices)[0], rtol=1e-9, atol=1e-9
    )


def test_smoothness_gradcheck_and_opcheck():
    vertices, faces = nmr.icosphere(0)
    vertices = (vertices[None] * torch.tensor([1.0, 0.7, 0.5])).double().requires_grad_()
    edges = nmr.edge_table(faces)
    torch.autograd.gradcheck(lambda x: smoothness_loss(x, edges), vertices)
    torch.library.opcheck(nmr.ops.smoothness, (vertices, edges))


def test_smoothness_is_least_when_flat():
    flat = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -1, 0]])
    folded = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0.5], [0.5, -1, 0.5]])
    edge = torch.tensor([[0, 1, 2, 3]])
    assert smoothness_loss(flat, edge) < 1e-4 < 0.1 < smoothness_loss(folded, edge)


def test_smoothness_same_bits_for_any_number_of_threads():
    vertices, faces = nmr.icosphere(2)
    vertices = vertices + 0.1 * torch.randn(37, len(vertices), 3, generator=torch.Generator().manual_seed(0))
    edges, before, results = nmr.edge_table(faces), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            leaf = vertices.clone().requires_grad_()
            smoothness_loss(leaf, edges).backward()
            results.append(leaf.grad)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_smoothness_same_bits_alone_and_in_a_batch(dtype):
    """Meshes are taken 16 at a time while there are as many, and one by one, in groups of edges, after that."""
    vertices, faces = nmr.icosphere(1)
    g = torch.Generator().manual_seed(0)
    vertices = (vertices + 0.1 * torch.randn(19, len(vertices), 3, generator=g)).to(dtype)
    edges = nmr.edge_table(faces)[:-1]  # 119: not a multiple of the group
    weights = torch.rand(19, generator=g).to(dtype)
    loss = nmr.ops.smoothness(vertices, edges)
    grad = nmr.ops.smoothness_backward(vertices, edges, weights)
    for b in range(19):
        assert torch.equal(loss[b : b + 1], nmr.ops.smoothness(vertices[b : b + 1], edges))
        alone = nmr.ops.smoothness_backward(vertices[b : b + 1], edges, weights[b : b + 1])
        assert torch.equal(grad[b : b + 1], alone)


def test_smoothness_errors():
    vertices = torch.zeros(1, 4, 3)
    with pytest.raises(ValueError, match=r"as made by nmr.edge_table.*\[2, 3\]"):
        smoothness_loss(vertices, torch.zeros(2, 3, dtype=torch.long))
    with pytest.raises(ValueError, match="vertex 9, but a mesh has 4 vertices"):
        smoothness_loss(vertices, torch.full((1, 4), 9))
    with pytest.raises(ValueError, match="at least one mesh"):
        smoothness_loss(vertices[:0], torch.zeros(1, 4, dtype=torch.long))


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


def test_soft_iou_error():
    for a, b in (((1, 4, 4), (1, 5, 4)), ((0, 4, 4), (0, 4, 4)), ((4,), (4,))):
        with pytest.raises(ValueError, match=r"one shape \[B, \.\.\.\] with B >= 1, got float32"):
            soft_iou_loss(torch.zeros(a), torch.zeros(b))
    with pytest.raises(TypeError, match="must be tensors"):
        soft_iou_loss([0.0], torch.zeros(1, 1))
