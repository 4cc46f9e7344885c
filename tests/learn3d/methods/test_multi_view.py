"""Vanilla-AE on pairs of views: the bounded generator, the four silhouettes, the optimizer."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

import nmr
from learn3d.data.batch import Batch
from learn3d.data.poses import LookAtPoses
from learn3d.methods.method import DatasetInfo, check_groups
from learn3d.methods.multi_view import MultiView, MultiViewSettings
from learn3d.methods.optimization import SparseGradientAdam, TrainingSchedule
from learn3d.networks.generators import deform_bounded_sphere


def make_batch(objects: list[int]) -> Batch:
    count = len(objects)
    images = torch.randint(0, 256, (count, 4, 64, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    masks = torch.zeros(count, 64, 64)
    for i in range(count):
        masks[i, 16 + 2 * i : 46, 20 : 40 + 2 * i] = 1
    views = torch.arange(count) * 5 % 24
    poses = LookAtPoses(-15.0 * views, 30.0, 2.732, 15.0)
    return Batch(images, masks, poses, views, torch.tensor(objects), torch.zeros(count, dtype=torch.int64), None)


@pytest.fixture(scope="module")
def method() -> MultiView:
    torch.manual_seed(0)
    return MultiView(
        MultiViewSettings(encoder="conv-small"), DatasetInfo(24), "cpu", "fp32", TrainingSchedule(200, "step")
    )


def test_bounded_rule() -> None:
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(50, 3))
    sphere[0], sphere[1, 0] = (0, 0, 1), 0  # on coordinate planes
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    bias, centroid = rng.normal(size=(2, 50, 3)), rng.normal(size=(2, 3))
    wanted = np.empty((2, 50, 3))
    for b, i, axis in np.ndindex(2, 50, 3):
        base, c = 0.5 * sphere[i, axis], np.tanh(centroid[b, axis])
        size = 0.0 if base == 0 else 1 / (1 + (1 - abs(base)) / abs(base) * np.exp(-bias[b, i, axis]))
        wanted[b, i, axis] = 0.5 * (c + (1 - c) * size if base > 0 else c - (1 + c) * size)
    arrays = (torch.tensor(a) for a in (sphere, bias, centroid))
    assert np.allclose(deform_bounded_sphere(*arrays), wanted, atol=1e-12)


def test_vertices_keep_the_box_and_their_octant() -> None:
    sphere = nmr.icosphere(3)[0].float()
    bias = 20 * torch.randn(4, 642, 3, generator=torch.Generator().manual_seed(1))
    centroid = torch.tensor([[0.0, 0.0, 0.0], [1.0, -2.0, 0.3], [50.0, -50.0, 0.0], [0.1, 0.1, 0.1]])
    bias.requires_grad_()
    vertices = deform_bounded_sphere(sphere, bias, centroid)
    assert vertices.abs().max() <= 0.5
    offset = vertices - 0.5 * torch.tanh(centroid)[:, None]
    assert ((offset * sphere) >= -1e-6).all()
    assert offset[:, sphere == 0].abs().max() < 1e-6
    vertices.sum().backward()
    assert bias.grad.isfinite().all()
    assert (bias.grad[:, sphere == 0] == 0).all()


def test_loss_is_the_mean_over_both_shapes_in_both_views(method: MultiView) -> None:
    batch = make_batch([4, 7, 4, 7])
    with torch.no_grad():
        method.generator.bias.weight *= 100  # shapes that differ
        vertices, faces = method.decode(method.encode(batch.images)).vertices, method.generator.faces
        losses = []
        for shapes, views in (([0, 1], [0, 1]), ([2, 3], [0, 1]), ([0, 1], [2, 3]), ([2, 3], [2, 3])):
            cameras = nmr.LookAt.from_angles(2.732, 30.0, batch.poses.azimuth_deg[views], half_fov_deg=15.0)
            silhouettes = nmr.render_silhouette(vertices[shapes], faces, cameras, image_size=64)
            losses.append(float(nmr.losses.soft_iou_loss(silhouettes, batch.masks[views])))
        smoothness = float(nmr.losses.smoothness_loss(vertices, method.generator.edges))
    assert len({round(loss, 4) for loss in losses}) == 4
    before = {name: [p.detach().clone() for p in n.parameters()] for name, n in method.networks.items()}
    values = method.take_step(batch, 1)
    rates = {name: optimizer.param_groups[0]["lr"] for name, optimizer in method.optimizers.items()}
    assert rates == pytest.approx({"encoder": 1e-4, "generator": 1e-4, "centroid": 1e-5})
    assert values["projection"] == pytest.approx(sum(losses) / 4, abs=1e-6)
    assert values["smoothness"] == pytest.approx(smoothness, rel=1e-5)
    assert values["total"] == pytest.approx(values["projection"] + 0.001 * values["smoothness"])
    for name, network in method.networks.items():
        assert all((p != q).any() for p, q in zip(network.parameters(), before[name], strict=True)), name


@pytest.mark.parametrize("objects", [[0, 1, 1, 0], [0, 1, 0]])
def test_batches_must_be_pairs(objects: list[int]) -> None:
    with pytest.raises(ValueError, match="is not made so; choose sampling 'pairs'"):
        check_groups(make_batch(objects), 2, "pairs")


def slow_adam(weight: float, grads: list[float], rate: float, skip: bool) -> float:
    first = second = 0.0
    for t, grad in enumerate(grads, start=1):
        if skip and grad == 0:
            continue
        first, second = 0.9 * first + 0.1 * grad, 0.999 * second + 0.001 * grad**2
        corrected = rate * np.sqrt(1 - 0.999**t) / (1 - 0.9**t)
        weight -= corrected * first / (np.sqrt(second) + 1e-8)
    return weight


def test_zero_gradients_leave_weights_and_moments_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("learn3d.methods.optimization.CHUNK", 4)  # several pieces
    rng = np.random.default_rng(0)
    grads = rng.normal(size=(6, 5, 3)) * (rng.random((6, 5, 3)) < 0.6)
    grads[:, 0] = 0
    ours, theirs = (nn.Parameter(torch.ones(5, 3, dtype=torch.float64)) for _ in range(2))
    sparse, plain = SparseGradientAdam([ours], lr=0.01), torch.optim.Adam([theirs], lr=0.01)
    for grad in grads:
        ours.grad, theirs.grad = torch.tensor(grad), torch.tensor(grad)
        sparse.step()
        plain.step()
    for i, j in np.ndindex(5, 3):
        assert ours[i, j].item() == pytest.approx(slow_adam(1.0, list(grads[:, i, j]), 0.01, skip=True), abs=1e-9)
        assert theirs[i, j].item() == pytest.approx(slow_adam(1.0, list(grads[:, i, j]), 0.01, skip=False), abs=1e-7)
    assert (ours[0] == 1).all()
    assert (ours - theirs).abs().max() > 1e-3  # it matters
    assert (sparse.state[ours]["exp_avg_sq"][0] == 0).all()
