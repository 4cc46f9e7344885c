"""The losses: published values and gradients, closed forms, true derivatives, errors."""

import itertools

import numpy as np
import pytest
import torch
from scenes import assert_near, double, leaf_of, same_bits, uniform, value_and_gradients
from torch.autograd import gradcheck
from torch.testing import assert_close
from vectors import load_vector, tensors_of, vector_names

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

ON_EDGES = [laplacian_loss, edge_length_loss, normal_consistency_loss]
ON_FACES = [inflation_loss, volume_loss, area_loss]


@pytest.mark.parametrize("name", vector_names("loss_smooth_*"))
def test_smoothness_vectors(name, dtype):
    v = tensors_of(load_vector(name), "")
    edges = nmr.edge_table(v["faces"])
    # Collapsed edges: what remains is rounding (from float64: the vector 2.1e-3, ours 1.5e-3).
    tolerance = 5e-3 if name.endswith("degenerate") else 1e-4
    check_published(lambda x: smoothness_loss(x, edges), v["vertices"], v, dtype, tolerance)


def check_published(function, vertices, v, dtype, tolerance, loss="loss", grad="grad_vertices"):
    value, gradient = value_and_gradients(function, vertices.to(dtype))
    np.testing.assert_allclose(value, v[loss], rtol=1e-5)
    assert (gradient - v[grad]).norm() < tolerance * v[grad].norm()


def test_soft_iou_vector():
    v = tensors_of(load_vector("loss_iou"), "")
    loss, grad = value_and_gradients(lambda x: soft_iou_loss(x, v["target"]), v["prediction"])
    np.testing.assert_allclose(loss, v["loss"], rtol=1e-6)
    assert_close(grad, v["grad_prediction"], rtol=1e-4, atol=1e-9)


def test_soft_iou_of_empty_images():
    """The published loss is NaN as soon as one pair is empty; such a pair agrees."""
    v = tensors_of(load_vector("loss_iou"), "empty_")
    assert v["loss"].isnan()
    loss, grad = value_and_gradients(lambda x: soft_iou_loss(x, v["target"]), v["prediction"])
    assert 0 <= loss <= 1 and grad.isfinite().all()
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
def test_soft_iou_is_the_formula_and_its_derivative(count, dtype):
    images = [uniform(3, count, seed=seed).to(dtype) for seed in (count, 0)]
    share = 1e-6 if dtype == torch.float32 else 1e-13
    ours = value_and_gradients(soft_iou_loss, *images)
    plain = value_and_gradients(plain_iou, *(x.double() for x in images))
    assert_near([x.double() for x in ours], plain, share)
    _, alone = value_and_gradients(lambda x: soft_iou_loss(x, images[1]), images[0])
    assert torch.equal(alone, ours[1])


def test_soft_iou_derivatives_of_any_kind():
    """First and second ones, in forward mode, in torch.func, compiled."""
    prediction, target, tangent = (uniform(3, 20, seed=seed) for seed in range(3))
    images = leaf_of(prediction), leaf_of(target)
    gradcheck(soft_iou_loss, images, check_forward_ad=True)
    torch.autograd.gradgradcheck(soft_iou_loss, images)
    first, plain = (torch.func.grad(loss) for loss in (soft_iou_loss, plain_iou))
    gradient = plain(prediction, target)
    assert_close(first(prediction, target), gradient)
    _, slope = torch.func.jvp(lambda p: soft_iou_loss(p, target), (prediction,), (tangent,))
    assert_close(slope, (gradient * tangent).sum())
    assert_close(*(torch.func.jacrev(grad)(prediction, target) for grad in (first, plain)))
    compiled = torch.compile(soft_iou_loss, fullgraph=True, backend="aot_eager")
    compiled(images[0], target).backward()
    assert_close(images[0].grad, gradient)


def octahedron():
    """Vertices at distance 1 on the axes; every vertex is the middle of its neighbours but for its own axis."""
    ring = [0, 1, 3, 4, 0]
    above = [[a, b, 2] for a, b in itertools.pairwise(ring)]
    below = [[b, a, 5] for a, b in itertools.pairwise(ring)]
    return torch.cat([torch.eye(3), -torch.eye(3)]).double(), torch.tensor(above + below)


PUBLISHED = {
    "laplacian": lambda x, faces: laplacian_loss(x, nmr.unique_edges(faces)),
    # published: once for each face of an edge
    "edge": lambda x, faces: 2 * edge_length_loss(x, nmr.unique_edges(faces)),
    "inflation": inflation_loss,  # published: sqrt(|n|^2 + 1e-5), which is 5e-6 more
}


@pytest.mark.parametrize("key", PUBLISHED)
def test_published_losses(key, dtype):
    v = tensors_of(load_vector("loss_extra"), "")
    check_published(
        lambda x: PUBLISHED[key](x, v["faces"]), v["vertices"], v, dtype, 1e-5, key, f"grad_{key}"
    )


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_closed_forms_on_an_octahedron(scale):
    vertices, faces = octahedron()
    edges, x = nmr.edge_table(faces), scale * vertices
    for loss, expected in (
        # The four neighbours of a vertex have mean 0.
        (laplacian_loss(x, edges), 6 * scale**2),
        # All edges are sqrt(2) long.
        (edge_length_loss(x, edges), 0),
        (edge_length_loss(x, edges, target=scale), 12 * (2**0.5 - 1) ** 2 * scale**2),
        (edge_length_loss(x, edges, target=0), 24 * scale**2),
        # Normals (+-1, +-1, +-1) / sqrt(3): those of neighbours differ in one sign.
        (normal_consistency_loss(x, edges), 2 / 3),
        # With half axes a: the volume 4 a^3 / 3, the area 4 sqrt(3) a^2, whichever the place.
        (volume_loss(x + 5, faces), 4 / 3 * scale**3),
        (volume_loss(x + 5, faces.flip(1)), -4 / 3 * scale**3),
        (area_loss(x + 5, faces), 4 * 3**0.5 * scale**2),
        (area_loss(x + 5, faces.flip(1)), 4 * 3**0.5 * scale**2),
    ):
        assert loss.item() == pytest.approx(expected, abs=1e-12)


def test_an_edge_alone_and_a_face_without_area():
    points = double([[0.0, 0.0, 0.0], [1.0, 2.0, 2.0], [5.0, 0.0, 0.0], [2.0, 4.0, 4.0]])
    assert laplacian_loss(points, torch.tensor([[0, 1]])) == 2 * 9, "two ends, others count 0"
    assert normal_consistency_loss(points, torch.tensor([[0, 1, 2, 3]])) == 1


@pytest.mark.parametrize("loss", ON_EDGES + ON_FACES)
def test_batches_are_means_over_their_meshes(loss):
    vertices, faces = octahedron()
    table = nmr.edge_table(faces) if loss in ON_EDGES else faces
    batch = torch.stack([vertices, 3 * vertices, vertices * double([1, 2, 3])])
    assert_close(loss(batch, table), sum(loss(x, table) for x in batch) / 3)
    assert loss(vertices, table).shape == ()


def test_normal_consistency_does_not_depend_on_the_winding():
    vertices, faces = octahedron()
    mixed = torch.cat([faces[:3].flip(1), faces[3:]])
    uneven = vertices * double([1.0, 0.7, 0.5])
    assert_close(*(normal_consistency_loss(uneven, nmr.edge_table(f)) for f in (faces, mixed)))


@pytest.mark.parametrize(
    "loss",
    [*ON_EDGES, smoothness_loss, lambda x, e: edge_length_loss(x, e, 0.5), volume_loss, area_loss],
)
def test_losses_have_true_derivatives(loss):
    vertices, faces = nmr.icosphere(0)
    uneven = vertices * double([[[1.0, 0.7, 0.5]], [[0.4, 1.0, 0.9]]])
    table = faces if loss in ON_FACES else nmr.edge_table(faces)
    forward = loss is not smoothness_loss
    gradcheck(lambda x: loss(x, table), leaf_of(uneven), check_forward_ad=forward)
    if not forward:
        with pytest.raises(RuntimeError, match="no forward-mode derivative"):
            torch.func.jvp(lambda x: loss(x, table), (uneven,), (uneven,))
    grad = torch.func.grad(lambda x: loss(x, table))
    assert same_bits(torch.func.vmap(grad)(uneven), map(grad, uneven))


@pytest.mark.parametrize("sizes", [[0.0, 0, 0], [1.0, 0, 0]], ids=["point", "line"])
@pytest.mark.parametrize("loss", [*ON_EDGES, *ON_FACES, smoothness_loss])
def test_collapsed_meshes_have_finite_gradients(loss, sizes, dtype):
    vertices, faces = nmr.icosphere(0)
    table = faces if loss in ON_FACES else nmr.edge_table(faces)
    results = value_and_gradients(
        lambda x: loss(x, table), (vertices * torch.tensor(sizes)).to(dtype)
    )
    assert all(x.isfinite().all() for x in results)


@pytest.mark.parametrize("size", [1e-12, 1e-10, 1e8])
def test_the_size_of_a_mesh_does_not_change_how_smooth_it_is(size):
    vertices, faces = nmr.icosphere(2)
    edges = nmr.edge_table(faces)
    usual = value_and_gradients(lambda v: nmr.losses.normal_consistency_loss(v, edges), vertices)
    found = value_and_gradients(
        lambda v: nmr.losses.normal_consistency_loss(v, edges), size * vertices
    )
    assert_close(found[0], usual[0])
    assert_close(size * found[1], usual[1], rtol=1e-3, atol=1e-6)
