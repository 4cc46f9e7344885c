"""Points on surfaces, Chamfer distance, F-score, IoU of grids: brute force and closed forms."""

import math
import sys

import pytest
import torch
from scenes import double, leaf_of, uniform, value_and_gradients
from torch.autograd import gradcheck
from torch.testing import assert_close

import nmr
from nmr import metrics
from nmr.metrics import chamfer_distance, f_score, sample_surface, voxel_iou, voxel_precision_recall


@pytest.fixture(params=["tree", "all pairs"])
def search(request, monkeypatch):
    """Both ways to find the nearest points; the second in several chunks."""
    if request.param == "tree":
        pytest.importorskip("scipy")
    else:
        monkeypatch.setitem(sys.modules, "scipy.spatial", None)  # importing it fails
        monkeypatch.setattr(metrics, "_CHUNK", 1000)


def random_points(*shape, seed=0):
    return uniform(*shape, 3, seed=seed)


def test_points_lie_on_their_faces_and_carry_their_normals():
    vertices, faces = nmr.icosphere(1)
    batch = torch.stack([vertices, vertices * torch.tensor([1.0, 2, 3])])
    points, normals, index = sample_surface(batch, faces, 500, torch.Generator().manual_seed(0))
    assert points.shape == normals.shape == (2, 500, 3) and index.shape == (2, 500)
    for b, mesh in enumerate(batch):
        weights = torch.linalg.solve(mesh[faces[index[b]]].mT, points[b])
        assert (weights > -1e-5).all()
        assert_close(weights.sum(1), torch.ones(500))
        assert_close(normals[b], nmr.face_normals(mesh, faces)[index[b]])


def test_points_are_uniform_over_the_area():
    """Two triangles of areas 1 and 3: their shares; within each, the centroid and the mean square distance to it."""
    vertices = double([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 5], [3, 0, 5], [0, 2, 5]])
    faces = torch.tensor([[0, 1, 2], [3, 4, 5], [0, 0, 4]])  # the last one has no area
    count = 100_000
    points, _, index = sample_surface(vertices, faces, count, torch.Generator().manual_seed(0))
    share = index.bincount(minlength=3) / count
    assert share[2] == 0 and abs(share[1] - 3 / 4) < 4 * math.sqrt(3 / 16 / count)
    for f in (0, 1):
        corners, mine = vertices[faces[f]], points[index == f]
        assert (mine.mean(0) - corners.mean(0)).norm() < 0.02
        sides = (corners - corners.roll(1, 0)).square().sum()
        spread = (mine - corners.mean(0)).square().sum(1).mean()
        assert spread.item() == pytest.approx(sides.item() / 36, rel=0.02)


def test_points_repeat_with_the_generator_and_are_differentiable():
    vertices, faces = nmr.icosphere(0)
    vertices = vertices.double().requires_grad_()

    def draw(x, seed=1):
        return sample_surface(x, faces, 20, torch.Generator().manual_seed(seed))

    assert torch.equal(draw(vertices).points, draw(vertices).points)
    assert not torch.equal(draw(vertices).points, draw(vertices, seed=2).points)
    gradcheck(lambda x: draw(x)[:2], vertices)


def test_distances_equal_brute_force(search):
    a, b = random_points(2, 300), random_points(2, 211, seed=1)
    all_pairs = (a[:, :, None] - b[:, None]).norm(dim=-1)
    ab, ba = all_pairs.amin(2), all_pairs.amin(1)
    squared = chamfer_distance(a, b)
    assert_close(squared, ab.square().mean(1) + ba.square().mean(1))
    assert_close(chamfer_distance(a, b, "l1"), (ab.mean(1) + ba.mean(1)) / 2)
    p, r = ((x < 0.08).double().mean(1) for x in (ab, ba))
    assert_close(f_score(a, b, 0.08), 2 * p * r / (p + r))
    assert_close(chamfer_distance(a.float(), b.float()), squared.float())
    assert_close(chamfer_distance(a[1], b[1]), squared[1])
    assert f_score(a[1], b[1], 0.08).shape == ()


def test_near_points_far_from_the_origin_are_told_apart(search):
    b = torch.tensor([[100.0, 0, 0], [100.001, 0, 0]])
    a = torch.tensor([[100.0006, 0, 0]])
    assert metrics._nearest(a[None], b[None]).tolist() == [[1]]


def test_f_score_of_uneven_sets(search):
    """Three of four points a are near, both points b: P = 3/4, R = 1."""
    a = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [5, 0, 0], [9, 9, 9]])
    b = torch.tensor([[0.05, 0, 0], [5, 0.05, 0]])
    for sets in ((a, b), (b, a)):
        assert f_score(*sets, 0.06).item() == pytest.approx(6 / 7)


@pytest.mark.parametrize("form", ["squared", "l1"])
def test_chamfer_gradcheck(form, search):
    points = leaf_of(random_points(2, 12)), leaf_of(random_points(2, 9, seed=1))
    gradcheck(lambda x, y: chamfer_distance(x, y, form), points)


@pytest.mark.parametrize("form", ["squared", "l1"])
def test_chamfer_of_equal_points_has_a_gradient_of_zero(form, search):
    a = random_points(10)
    assert not value_and_gradients(lambda x: chamfer_distance(x, a, form), a)[1].any()


def test_voxel_iou_of_boxes():
    a, b = torch.zeros(2, 3, 8, 8, 8, dtype=torch.bool)
    a[0, :4] = b[0, 2:6] = True  # 2 of 6 slices are shared
    a[1, :4] = b[1, :4] = True
    iou = voxel_iou(a, b)
    assert iou[:2].tolist() == [1 / 3, 1] and iou[2].isnan()


def test_precision_and_recall_of_boxes():
    a, b = torch.zeros(2, 3, 8, 8, 8, dtype=torch.bool)
    a[0, :4] = b[0, 2:8] = True  # 2 of 4 predicted slices are right, which are 2 of 6
    a[1, 1] = True
    precision, recall = voxel_precision_recall(a, b)
    assert precision[:2].tolist() == [1 / 2, 0] and precision[2].isnan()
    assert recall[0] == 1 / 3 and recall[1:].isnan().all()


def test_metrics_of_points_under_vmap():
    """Sets of points are a batch, whoever adds its axis."""
    a, b = uniform(3, 1, 20, 3, seed=1), uniform(3, 1, 30, 3, seed=2)
    for measure in (
        lambda x, y: metrics.chamfer_distance(x, y, "l1"),
        lambda x, y: metrics.f_score(x, y, 0.2),
    ):
        assert_close(torch.func.vmap(measure)(a, b), measure(a[:, 0], b[:, 0]).unsqueeze(1))
