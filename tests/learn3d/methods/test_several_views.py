"""The two methods that learn from several views of an object."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
import stub_work
import torch
from steps import TINY, make_method

import nmr
from learn3d import tasks
from learn3d.data.dataset import DEPTH_REACH, ViewDataset, depth_levels, depth_of_levels
from learn3d.data.layouts import load_dataset
from learn3d.data.poses import LookAtPoses
from learn3d.data.sampling import GROUP_SIZE, augment, sample_indices
from learn3d.evaluation import evaluate
from learn3d.losses import depth_losses
from learn3d.methods.multi_view import ManyViews, MultiViewSettings
from learn3d.studio.make_data import render
from learn3d.training import take_step


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> ViewDataset:
    """Six tables from seven sides each, read from shards."""
    folder = tmp_path_factory.mktemp("around")
    options = {
        "category": "table",
        "layout": "around",
        "procedural": 8,
        "views": 7,
        "test": 1,
        "val": 1,
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tasks, "run_tasks", stub_work.run_tasks_here)
        assert render.make_shards(render.DatasetConfig(output=folder, shards=True, **options)) == 0
    return load_dataset("around", folder, "table", "train")


def test_loss_is_the_mean_over_both_shapes_in_both_views(dataset: ViewDataset) -> None:
    method = make_method(MultiViewSettings(encoder="conv-small"))
    batch = dataset.batch(sample_indices(dataset, "pairs", 4, seed=0, step=1))
    with torch.no_grad():
        batch.images[:2] //= 8  # shapes that differ
        method.generator.layers[-1].weight *= 10
        vertices = method.decode(method.encode(batch.images)).vertices
        faces = method.generator.faces
        losses = []
        for shapes, views in itertools.product(([0, 1], [2, 3]), repeat=2):
            cameras = batch.poses[torch.tensor(views)].cameras()
            silhouettes = nmr.render_silhouette(vertices[shapes], faces, cameras, image_size=64)
            losses.append(float(nmr.losses.soft_iou_loss(silhouettes, batch.masks[views])))
        smoothness = float(nmr.losses.smoothness_loss(vertices, method.generator.edges))
    assert len({round(loss, 4) for loss in losses}) == 4
    values = method.losses(batch, 1)
    assert [weight for weight, _ in values.values()] == [1.0, 0.001]
    assert values["projection"][1].item() == pytest.approx(sum(losses) / 4, abs=1e-6)
    assert values["smoothness"][1].item() == pytest.approx(smoothness, rel=1e-5)


def create(dataset: ViewDataset, **changes) -> ManyViews:
    return make_method("many-views-around", dataset.info(None), **TINY, **changes)


def test_groups_are_different_views_of_one_object(dataset: ViewDataset) -> None:
    indices = sample_indices(dataset, "groups", 20, seed=0, step=1).reshape(GROUP_SIZE, 4)
    objects = torch.from_numpy(dataset.object_ids[indices].astype(np.int64))
    assert (objects == objects[0]).all()
    assert all(len(set(column.tolist())) == GROUP_SIZE for column in indices.T)
    assert not torch.equal(indices.flatten(), sample_indices(dataset, "groups", 20, seed=0, step=2))
    three = dataset.with_few_views(3)
    of_three = sample_indices(three, "groups", 20, seed=0, step=1).reshape(GROUP_SIZE, 4)
    assert all(len(set(column.tolist())) == 3 for column in of_three.T)


def test_cameras_stand_all_around_and_see_the_whole_object(dataset: ViewDataset) -> None:
    poses = dataset.poses
    assert -10 <= poses.elevation_deg.min() < 5
    assert 45 < poses.elevation_deg.max() <= 60
    assert poses.azimuth_deg.max() - poses.azimuth_deg.min() > 270
    masks = dataset.images[np.arange(len(dataset))][:, 3]
    assert masks.any((1, 2)).all()
    assert not masks[:, [0, -1]].any() and not masks[:, :, [0, -1]].any()


def test_depth_is_that_of_the_renderer(dataset: ViewDataset) -> None:
    batch = dataset.batch(torch.arange(len(dataset)))
    inside, outside = batch.masks == 1, batch.masks == 0
    assert ((batch.depth > 0) & outside).float().mean() < 1e-3
    assert (batch.depth[inside] > 0).float().mean() > 0.98
    depth = torch.tensor([[[1.2, 2.0, 2.85, 100.0]]])
    poses = LookAtPoses(*torch.tensor([[0.0], [0.0], [2.0], [15.0]]))
    back = depth_of_levels(depth_levels(depth, poses), poses)
    assert torch.allclose(back[..., :3], depth[..., :3], atol=DEPTH_REACH / 254 + 1e-6)
    assert back[..., 3] == 0


def test_flipped_batches_have_flipped_depth(dataset: ViewDataset) -> None:
    batch = dataset.batch(torch.arange(10))
    changed = augment(batch, ["flip"], 0, 1, inverted=True)
    turned = (changed.masks != batch.masks).flatten(1).any(1)
    assert 0 < turned.sum() < 10
    assert torch.equal(changed.depth[turned], batch.depth[turned].flip(2))
    assert torch.equal(changed.depth[~turned], batch.depth[~turned])


def test_depth_losses_count_pixels_where_both_show_a_surface() -> None:
    depth = torch.tensor([[[2.0, 100.0, 2.2], [2.5, 2.0, 2.0]]], requires_grad=True)
    target = torch.tensor([[[2.3, 2.0, 2.1], [0.0, 1.9, 1.9]]])
    loss, slope = depth_losses(depth, target)
    assert loss.item() == pytest.approx((0.3 + 0.1 + 0.1 + 0.1) / 4)
    assert slope.item() == pytest.approx(0.4), "only the first row has a surface at both ends"
    (loss + slope).backward()
    assert depth.grad.tolist() == [[[-1.25, 0.0, 1.25], [0.0, 0.25, 0.25]]]
    slope = depth_losses(torch.tensor([[[2.0, 2.0, 3.0, 2.0]]]), torch.full((1, 1, 4), 2.0))[1]
    assert slope.item() == pytest.approx(0.5), "the mean over two pairs in the row"


def test_losses_are_those_written_out(dataset: ViewDataset) -> None:
    method = create(dataset, symmetry=None)
    batch = dataset.batch(sample_indices(dataset, "groups", 10, seed=0, step=1))
    with torch.no_grad():
        method.generator.layers[-1].weight *= 30  # shapes that differ
        codes, vertices = method.predict(batch.images[:2])
    overlap, distances, slopes = [], [], []
    for view in range(10):
        shape = vertices[view % 2]
        camera = batch.poses[torch.tensor([view])].cameras()
        seen = nmr.render_silhouette(shape, method.faces, camera, image_size=64)
        depth = nmr.render_depth(shape, method.faces, camera, image_size=64)[0]
        overlap.append(nmr.losses.soft_iou_loss(seen, batch.masks[view : view + 1]))
        both = (batch.depth[view] > 0) & (depth < 10)
        error = torch.where(both, depth - batch.depth[view], torch.nan)
        distances.append(error[both].abs())
        slopes.append(
            [(error - error.roll(2, axis)).narrow(axis, 2, 62).abs().flatten() for axis in (0, 1)]
        )
    losses = take_step(method, batch, 1)
    assert losses["projection"] == pytest.approx(float(torch.stack(overlap).mean()), rel=1e-4)
    assert losses["depth"] == pytest.approx(float(torch.cat(distances).mean()), rel=0.02)
    slope = sum(float(torch.cat(part).nanmean()) for part in zip(*slopes, strict=True))
    assert losses["slope"] == pytest.approx(slope, rel=0.02)
    assert losses["prior"] == pytest.approx(float(codes.square().sum(1).mean()), rel=1e-4)
    assert (
        not {"depth", "slope"} & take_step(method, dataclasses.replace(batch, depth=None), 1).keys()
    )


def test_the_azimuth_is_learnt_from_the_pose(dataset: ViewDataset) -> None:
    """So a flipped image, whose pose is mirrored, teaches the right one."""
    batch = dataset.batch(sample_indices(dataset, "groups", 10, seed=0, step=1))
    unknown = dataclasses.replace(batch, view_ids=torch.zeros_like(batch.view_ids))
    mirrored = dataclasses.replace(
        batch, poses=batch.poses.mirrored(torch.ones(10, dtype=torch.bool))
    )
    first, same, other = (
        take_step(create(dataset), b, 1)["view"] for b in (batch, unknown, mirrored)
    )
    assert first == same != other
    symmetric = make_method("many-views-around", dataset.info(90.0), **TINY)
    loss = symmetric.losses(batch, 1)["view"][1]
    assert loss == symmetric.view_loss(batch.images[:2], batch.poses[torch.arange(2)])


def test_it_learns_the_shapes(dataset: ViewDataset) -> None:
    method = create(dataset, learning_rate=1e-3)
    before = evaluate(method, dataset).voxel_iou
    for step in range(1, 61):
        take_step(method, dataset.batch(sample_indices(dataset, "groups", 30, 0, step)), step)
    assert evaluate(method, dataset).voxel_iou > before + 0.05


def test_the_layout_is_made_as_shards_alone(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="the layout around are for shards: add --shards"):
        render.DatasetConfig(output=tmp_path, category="table", procedural=4, layout="around")
    with pytest.raises(FileNotFoundError, match="has no shards of table, train"):
        load_dataset("around", tmp_path, "table", "train")
