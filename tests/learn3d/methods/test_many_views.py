"""Many views: groups of views, the loss written out, depth as bytes, and shapes that learn from other views."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

import nmr
from learn3d.data.augment import augment
from learn3d.data.dataset import DEPTH_REACH, ViewDataset, depth_levels, depth_of_levels
from learn3d.data.layouts import load_dataset
from learn3d.data.poses import LookAtPoses
from learn3d.data.sampling import GROUP_SIZE, sample_indices
from learn3d.evaluation import evaluate
from learn3d.losses import depth_loss
from learn3d.make_data.config import DatasetConfig
from learn3d.make_data.sharded import make_shards
from learn3d.methods import create_method
from learn3d.methods.many_views import ManyViews
from learn3d.presets import PRESETS

SMALL = {"encoder": "conv-small", "generator": "sphere-small"}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> ViewDataset:
    """Six tables from seven sides each, read from shards."""
    folder = tmp_path_factory.mktemp("around")
    options = {"category": "table", "layout": "around", "procedural": 8, "views": 7, "test": 1, "val": 1}
    assert make_shards(DatasetConfig(output=folder, shards=True, **options)) == 0
    return load_dataset("around", folder, "table", "train")


def create(dataset: ViewDataset, **changes) -> ManyViews:
    settings = dataclasses.replace(PRESETS["many-views-around"].settings, **SMALL, **changes)
    return create_method(settings, dataset.info(None), device="cpu", precision="fp32", seed=0)


def test_groups_are_different_views_of_one_object(dataset: ViewDataset) -> None:
    indices = sample_indices(dataset, "groups", 20, seed=0, step=1).reshape(GROUP_SIZE, 4)
    objects = torch.from_numpy(dataset.object_ids[indices].astype(np.int64))
    assert (objects == objects[0]).all()
    assert all(len(set(column.tolist())) == GROUP_SIZE for column in indices.T)
    assert not torch.equal(indices.flatten(), sample_indices(dataset, "groups", 20, seed=0, step=2))
    three = dataset.with_few_views(3)
    of_three = sample_indices(three, "groups", 20, seed=0, step=1).reshape(GROUP_SIZE, 4)
    assert all(len(set(column.tolist())) == 3 for column in of_three.T)


def test_other_batches_are_refused(dataset: ViewDataset) -> None:
    with pytest.raises(ValueError, match=r"5 views of each object.*choose sampling 'groups'"):
        create(dataset).check_batch(dataset.batch(torch.arange(10)))


def test_cameras_stand_all_around_and_see_the_whole_object(dataset: ViewDataset) -> None:
    poses = dataset.poses
    assert poses.elevation_deg.min() < 5 and poses.elevation_deg.max() > 45
    assert poses.elevation_deg.min() >= -10 and poses.elevation_deg.max() <= 60
    assert poses.azimuth_deg.max() - poses.azimuth_deg.min() > 270
    masks = dataset.images[np.arange(len(dataset))][:, 3]
    assert masks.any((1, 2)).all()
    assert not masks[:, [0, -1]].any() and not masks[:, :, [0, -1]].any()


def test_depth_is_that_of_the_renderer(dataset: ViewDataset) -> None:
    batch = dataset.batch(torch.arange(len(dataset)))
    inside, outside = batch.masks == 1, batch.masks == 0
    assert ((batch.depth > 0) & outside).float().mean() < 1e-3 and (batch.depth[inside] > 0).float().mean() > 0.98
    depth = torch.tensor([[[1.2, 2.0, 2.85, 100.0]]])
    poses = LookAtPoses(*torch.tensor([[0.0], [0.0], [2.0], [15.0]]))
    back = depth_of_levels(depth_levels(depth, poses), poses)
    assert torch.allclose(back[..., :3], depth[..., :3], atol=DEPTH_REACH / 254 + 1e-6) and back[..., 3] == 0


def test_flipped_batches_have_flipped_depth(dataset: ViewDataset) -> None:
    batch = dataset.batch(torch.arange(10))
    changed = augment(batch, ["flip"], 0, 1)
    turned = (changed.masks != batch.masks).flatten(1).any(1)
    assert 0 < turned.sum() < 10
    assert torch.equal(changed.depth[turned], batch.depth[turned].flip(2))
    assert torch.equal(changed.depth[~turned], batch.depth[~turned])


def test_depth_loss_counts_pixels_where_both_show_a_surface() -> None:
    depth = torch.tensor([[[2.0, 100.0], [2.5, 2.0]]], requires_grad=True)
    target = torch.tensor([[[2.3, 2.0], [0.0, 1.9]]])
    loss = depth_loss(depth, target)
    assert loss.item() == pytest.approx((0.3 + 0.1) / 2)
    loss.backward()
    assert depth.grad.tolist() == [[[-0.5, 0.0], [0.0, 0.5]]]


def test_losses_are_those_written_out(dataset: ViewDataset) -> None:
    method = create(dataset, symmetry=None)
    batch = dataset.batch(sample_indices(dataset, "groups", 10, seed=0, step=1))
    with torch.no_grad():
        method.generator.layers[-1].weight *= 30  # shapes that differ
        codes, vertices = method.predict(batch.images[:2])
    overlap, distances = [], []
    for view in range(10):
        shape = vertices[view % 2]
        camera = batch.poses[torch.tensor([view])].cameras()
        seen = nmr.render_silhouette(shape, method.faces, camera, image_size=64)
        depth = nmr.render_depth(shape, method.faces, camera, image_size=64)[0]
        overlap.append(nmr.losses.soft_iou_loss(seen, batch.masks[view : view + 1]))
        both = (batch.depth[view] > 0) & (depth < 10)
        distances.append((depth - batch.depth[view])[both].abs())
    losses = method.take_step(batch, 1)
    assert losses["projection"] == pytest.approx(float(torch.stack(overlap).mean()), rel=1e-4)
    assert losses["depth"] == pytest.approx(float(torch.cat(distances).mean()), rel=0.02)
    assert losses["prior"] == pytest.approx(float(codes.square().sum(1).mean()), rel=1e-4)


def test_without_depth_in_the_data_there_is_no_depth_loss(dataset: ViewDataset) -> None:
    bare = dataclasses.replace(dataset, depth=None)
    indices = sample_indices(bare, "groups", 10, seed=0, step=1)
    assert "depth" not in create(bare).take_step(bare.batch(indices), 1)
    assert "depth" in create(dataset).take_step(dataset.batch(indices), 1)


def test_it_learns_the_shapes(dataset: ViewDataset) -> None:
    method = create(dataset, learning_rate=1e-3)
    before = evaluate(method, dataset).voxel_iou
    for step in range(1, 61):
        method.take_step(dataset.batch(sample_indices(dataset, "groups", 30, 0, step)), step)
    assert evaluate(method, dataset).voxel_iou > before + 0.05


def test_the_layout_is_made_as_shards_alone(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="layout around is made as shards: add --shards"):
        DatasetConfig(output=tmp_path, category="table", procedural=4, layout="around")
    with pytest.raises(FileNotFoundError, match="has no shards of table, train"):
        load_dataset("around", tmp_path, "table", "train")
