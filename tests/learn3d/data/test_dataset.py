"""The data set in memory: batches, several categories, parts that do not fit; sampling; view classes."""

from __future__ import annotations

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from steps import make_method

import nmr
from learn3d.data.conventions import KATO
from learn3d.data.dataset import DatasetInfo, ViewDataset, concatenate
from learn3d.data.poses import LookAtPoses, PoseCandidates, RotationPoses
from learn3d.data.sampling import augment, batches, sample_indices
from learn3d.data.view_bins import AngleBins


def continuous(
    objects: int = 3, views: int = 4, category: str = "cup", seed: int = 0
) -> ViewDataset:
    """Random images seen from random sides, in two view classes."""
    rng = np.random.default_rng(seed)
    count = objects * views
    poses = LookAtPoses(
        *(rng.uniform(*limits, count) for limits in ((-180, 180), (-20, 40), (2, 3))), 15.0
    )
    return ViewDataset(
        category=category,
        split="train",
        images=rng.integers(0, 256, (count, 4, 64, 64), np.uint8),
        poses=poses,
        view_ids=rng.integers(0, 2, count),
        view_names=("left", "right"),
        object_ids=np.repeat(np.arange(objects), views),
        object_names=tuple(f"{category}{i}" for i in range(objects)),
        voxels=rng.random((objects, 32, 32, 32)) < 0.5,
        convention=KATO,
        inverted=True,
    )


def test_a_batch_has_the_fields_of_its_samples() -> None:
    data = continuous()
    batch = data.batch(torch.tensor([7, 0, 7]))
    assert len(batch) == 3
    assert torch.equal(batch.images, torch.from_numpy(data.images[[7, 0, 7]]))
    assert torch.equal(batch.masks, batch.images[:, 3] / 255)
    assert batch.object_ids.tolist() == [1, 0, 1]
    assert batch.class_ids.tolist() == [0, 0, 0]
    assert torch.equal(batch.voxels, torch.from_numpy(data.voxels[[1, 0, 1]]))
    seven = [getattr(data.poses, key)[7] for key in ("distance", "elevation_deg", "azimuth_deg")]
    wanted = nmr.LookAt.from_angles(*seven, half_fov_deg=15.0)
    assert torch.allclose(batch.cameras.eye[0], wanted.eye, atol=1e-6)
    assert data.batch([0], voxels=False).voxels is None
    with pytest.raises(ValueError, match=r"indices must lie in 0 .. 11, got 12 .. 12"):
        data.batch(torch.tensor([12]))


def test_separate_masks_replace_the_fourth_channel() -> None:
    data = continuous(1, 2)
    large = dataclasses.replace(
        data, images=np.zeros((2, 4, 224, 224), np.uint8), masks=np.full((2, 64, 64), 51, np.uint8)
    )
    assert large.image_size == 224
    assert torch.equal(large.batch(torch.tensor([1])).masks, torch.full((1, 64, 64), 0.2))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"images": np.zeros((12, 4, 64, 64))},
            r"images must be uint8 \[M, 4, S, S\], got float64",
        ),
        (
            {"images": np.zeros((12, 4, 32, 32), np.uint8)},
            "images of 32 pixels need masks of 64, got None",
        ),
        (
            {"masks": np.zeros((12, 32, 32), np.uint8)},
            r"masks .* must be \[12, 64, 64\], got \[12, 32, 32\]",
        ),
        (
            {"view_ids": np.zeros(5, np.int64)},
            r"view_ids of 12 images of 3 objects must be \[12\], got \[5\]",
        ),
        (
            {"voxels": np.zeros((2, 32, 32, 32), bool)},
            r"voxels .* must be \[3, 32, 32, 32\], got \[2, 32, 32, 32\]",
        ),
        ({"view_ids": np.full(12, 2)}, r"view_ids must lie in 0 .. 1, got 2 .. 2"),
        ({"object_ids": np.full(12, -1)}, r"object_ids must lie in 0 .. 2, got -1 .. -1"),
    ],
)
def test_parts_that_do_not_fit_are_named(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(continuous(), **change)


def test_several_categories_become_one_set_with_classes() -> None:
    cups, jars = continuous(), continuous(2, 3, "jar", seed=1)
    both = concatenate([cups, jars])
    assert (both.category, both.class_names) == ("cup,jar", ("cup", "jar"))
    assert (both.num_classes, both.num_objects) == (2, 5)
    batch, alone = both.batch(torch.tensor([3, 12 + 4])), jars.batch(torch.tensor([4]))
    assert (batch.class_ids.tolist(), batch.object_ids.tolist()) == ([0, 1], [0, 4])
    assert torch.equal(batch.images[1], alone.images[0])
    assert torch.equal(batch.voxels[1], alone.voxels[0])
    assert torch.equal(batch.cameras.eye[1], alone.cameras.eye[0])
    # one number for all
    near = dataclasses.replace(jars, poses=dataclasses.replace(jars.poses, distance=2.0))
    distances = concatenate([cups, near]).poses.distance
    assert torch.equal(distances, torch.cat([cups.poses.distance, torch.full((6,), 2.0)]))
    far = dataclasses.replace(near, poses=dataclasses.replace(near.poses, distance=3.0))
    assert concatenate([near, near]).poses.distance == 2.0
    assert concatenate([near, far]).poses.distance.tolist() == [2.0] * 6 + [3.0] * 6
    assert concatenate([cups]) is cups
    with pytest.raises(ValueError, match="jar and cup differ in view classes"):
        concatenate([cups, dataclasses.replace(jars, view_names=("a", "b"))])
    clouds = [
        dataclasses.replace(d, points=np.zeros((d.num_objects, count, 3), np.float32))
        for d, count in ((cups, 5), (jars, 7))
    ]
    with pytest.raises(ValueError, match=r"points of different sizes .* \[5, 3\] and \[7, 3\]"):
        concatenate(clouds)
    turned = dataclasses.replace(jars, poses=RotationPoses(torch.eye(3).expand(6, 3, 3)))
    with pytest.raises(ValueError, match="poses of different kinds"):
        concatenate([cups, turned])


def test_pairs_are_two_views_of_one_object() -> None:
    data = continuous(5, 3)
    indices = sample_indices(data, "pairs", 40, seed=0, step=1)
    first, second = data.batch(indices[:20]), data.batch(indices[20:])
    assert torch.equal(first.object_ids, second.object_ids)
    assert (indices[:20] != indices[20:]).all()
    assert len(first.object_ids.unique()) == 5
    assert torch.equal(indices, sample_indices(data, "pairs", 40, seed=0, step=1))
    assert not torch.equal(indices, sample_indices(data, "pairs", 40, seed=0, step=2))
    with pytest.raises(ValueError, match="no object has two views"):
        sample_indices(continuous(4, 1), "pairs", 2, seed=0, step=1)


@pytest.mark.parametrize(
    ("w", "h", "count"),
    [
        (60, 60, 6),
        (30, 30, 24),
        (20, 20, 54),
        (20, 15, 72),
        (15, 20, 72),
        (15, 15, 96),
        (10, 10, 216),
    ],
)
def test_the_papers_seven_settings(w: int, h: int, count: int) -> None:
    bins = AngleBins.parse(f"{w}x{h}")
    names = bins.names()
    assert len(names) == count
    rng = np.random.default_rng(0)
    azimuth, elevation = rng.uniform(-180, 180, 5000), rng.uniform(-20, 40, 5000)
    ids = bins.ids(LookAtPoses(azimuth, elevation, 2.0, 15.0))
    wanted = (azimuth + 180) // w * (60 / h) + (elevation + 20) // h
    assert (ids.numpy() == wanted).mean() > 0.998  # float32 angles on the edge of a cell
    assert len(ids.unique()) == count
    middle = [float(word) for word in re.findall(r"-?[\d.]+", names[ids[0]])]
    assert abs(azimuth[0] - middle[0]) <= w / 2 and abs(elevation[0] - middle[1]) <= h / 2


def test_ends_of_the_range_belong_to_cells() -> None:
    azimuths = np.array([180.0, -180.0, 179.9, 0.0, 0.0])
    elevations = np.array([40.0, -20.0, 40.0, 55.0, -90.0])
    ids = AngleBins(15, 20).ids(LookAtPoses(azimuths, elevations, 2.0, 15.0))
    assert ids.tolist() == [71, 0, 71, 38, 36]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("15", "view bins are written as AZIMUTHxELEVATION"),
        ("ax20", "view bins are written as"),
        ("15x20:1", "view bins are written as"),
        ("15x20x3", "view bins are written as"),
        ("0x20", "azimuth_width_deg"),
        ("15x20:40:-20", "from low to high"),
        ("0.001x0.001", "there would be .* bins"),
    ],
)
def test_bins_make_sense(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AngleBins.parse(text)


def test_rebinning_changes_the_classes_alone() -> None:
    data = continuous()
    bins = AngleBins.parse("60x60")
    mirrored = data.poses.mirrored(torch.ones(12, dtype=bool))
    candidates = PoseCandidates(mirrored, data.view_ids, *2 * [np.ones((12, 1))])
    binned = dataclasses.replace(data, candidates=candidates).with_bins(bins)
    assert binned.num_views == 6
    assert np.array_equal(binned.view_ids, bins.ids(data.poses).numpy())
    assert np.array_equal(binned.candidates.view_ids, bins.ids(mirrored).numpy())
    assert not np.array_equal(binned.candidates.view_ids, binned.view_ids)
    turned = dataclasses.replace(data, poses=RotationPoses(torch.eye(3).expand(12, 3, 3)))
    with pytest.raises(ValueError, match="need look-at cameras"):
        turned.with_bins(bins)


def lopsided() -> tuple[torch.Tensor, torch.Tensor]:
    """A mesh that is symmetric about z = 0 and nothing else."""
    sphere, faces = nmr.icosphere(3)
    x, y, _ = sphere.unbind(1)
    return sphere * 0.3 + torch.stack([0.2 * y**2, 0.1 * (x > 0.2), torch.zeros_like(x)], 1), faces


@pytest.mark.parametrize("kind", ["look-at", "rotation"])
def test_mirrored_pose_sees_the_mirrored_image_of_a_symmetric_object(kind: str) -> None:
    vertices, faces = lopsided()
    if kind == "look-at":  # the mirror plane of a mirrored azimuth is x = 0
        vertices = vertices[:, [2, 1, 0]]
        poses = LookAtPoses(np.array([35.0, -100.0]), np.array([20.0, -10.0]), 2.732, 15.0)
    else:
        torch.manual_seed(0)
        rotation = torch.linalg.qr(torch.randn(2, 3, 3))[0]
        poses = RotationPoses(rotation * torch.linalg.det(rotation)[:, None, None])
    seen, mirrored = (
        nmr.render_silhouette(vertices, faces, p.cameras(), image_size=64)
        for p in (poses, poses.mirrored(torch.tensor([True, False])))
    )
    assert (seen[0] > 0).float().mean() > 0.05
    assert (mirrored[0] - seen[0].flip(1)).abs().mean() < 2e-3
    assert (mirrored[0] - seen[0]).abs().mean() > 0.01
    assert torch.equal(mirrored[1], seen[1])


def test_poses_of_wrong_shape() -> None:
    with pytest.raises(ValueError, match=r"distance must be \[2\] or one number, got \[3\]"):
        LookAtPoses(np.zeros(2), 0.0, np.zeros(3), 15.0)
    with pytest.raises(ValueError, match=r"rotation must be \[M, 3, 3\]"):
        RotationPoses(torch.eye(3))


def test_poses_may_be_unknown(tiny_set: ViewDataset) -> None:
    unknown = dataclasses.replace(tiny_set, poses=None)
    assert (tiny_set.info().pose_features, unknown.info().pose_features) == (3, 0)
    assert unknown.digest() != tiny_set.digest()
    assert concatenate([unknown, unknown]).poses is None
    assert unknown.select(np.array([0, 1])).poses is None
    indices = torch.tensor([1, 30])
    batch, known = (
        augment(dataset.batch(indices), ("flip",), 0, 1, inverted=True)
        for dataset in (unknown, tiny_set)
    )
    assert batch.poses is None
    assert torch.equal(batch.images, known.images)
    with pytest.raises(ValueError, match="no poses"):
        unknown.with_bins(AngleBins.parse("15x20"))
    with pytest.raises(ValueError, match="different kinds"):
        concatenate([unknown, tiny_set])


@pytest.mark.parametrize(
    "preset", ["peng2020-kato", "multi-view-kato", "peng2020-kato-vpl", "gadelha2017-kato"]
)
def test_methods_that_need_poses_say_so(preset: str) -> None:
    with pytest.raises(ValueError, match="has no poses"):
        make_method(preset, DatasetInfo(1, inverted=False, pose_features=0))


def test_few_views_of_every_object(tiny_set) -> None:
    few = tiny_set.with_few_views(2)
    assert few.object_ids.tolist() == [0, 0, 1, 1, 2, 2]
    # not the same views of every object
    assert len({tuple(few.view_ids[i : i + 2]) for i in (0, 2, 4)}) == 3
    np.testing.assert_array_equal(few.view_ids, tiny_set.with_few_views(2).view_ids)
    for sample in range(6):
        of_all = 24 * few.object_ids[sample] + few.view_ids[sample]
        np.testing.assert_array_equal(few.images[sample], tiny_set.images[of_all])
        assert few.poses.azimuth_deg[sample] == tiny_set.poses.azimuth_deg[of_all]
    assert len(tiny_set.with_few_views(24)) == len(tiny_set)
    uneven = tiny_set.select(np.array([0, 1, 2, 24, 50, 51]))
    # those that have fewer keep them
    assert uneven.with_few_views(2).object_ids.tolist() == [0, 0, 1, 2, 2]
    for wrong in (0, 25):
        with pytest.raises(ValueError, match=r"views_per_object must lie in 1 \.\. 24"):
            tiny_set.with_few_views(wrong)


def test_colours_are_permuted_scaled_or_left_out(tiny_set) -> None:
    batch = tiny_set.batch(torch.arange(72))
    changed = augment(batch, ("colors",), 0, 1, inverted=True)
    assert torch.equal(changed.images[:, 3], batch.images[:, 3])
    assert torch.equal(changed.masks, batch.masks)
    assert torch.equal(augment(batch, ("colors",), 0, 1, inverted=True).images, changed.images)
    means, before = (
        b.images[:, :3].double().mean((2, 3)).sort(dim=1).values for b in (changed, batch)
    )
    without = (means == 0).all(1)
    assert 8 < without.sum() < 36  # 30 % of 72
    ratio = means[~without] / before[~without]
    assert ratio.min() > 0.6 and ratio.max() < 1.4 and ratio.std() > 0.05
    # The same images stored as they are, not inverted, get the same change: a white background stays white.
    natural = torch.cat([255 - batch.images[:, :3], batch.images[:, 3:]], dim=1)
    images = augment(
        dataclasses.replace(batch, images=natural), ("colors",), 0, 1, inverted=False
    ).images
    assert torch.equal(255 - images[:, :3], changed.images[:, :3])


def test_all_views_of_an_object_are_flipped_or_none(tiny_set) -> None:
    options = SimpleNamespace(
        sampling="pairs", batch_size=40, augment=("flip",), seed=0, iterations=1
    )
    (batch,) = batches(tiny_set, options)
    before = tiny_set.batch(sample_indices(tiny_set, "pairs", 40, 0, 1))
    flipped = (batch.images != before.images).flatten(1).any(1)
    assert torch.equal(flipped[:20], flipped[20:]) and 0 < flipped.sum() < 40


def test_batches_are_sampled_and_augmented_from_any_step_on(tiny_set) -> None:
    options = SimpleNamespace(
        sampling="views", batch_size=4, augment=("flip", "channels"), seed=5, iterations=6
    )
    found = list(batches(tiny_set, options, 3))
    assert len(found) == 4
    for step, batch in enumerate(found, 3):
        samples = sample_indices(tiny_set, "views", 4, 5, step)
        wanted = augment(
            tiny_set.batch(samples, voxels=False), ("flip", "channels"), 5, step, inverted=True
        )
        assert batch.voxels is None and torch.equal(batch.images, wanted.images)
        assert torch.equal(batch.poses.azimuth_deg, wanted.poses.azimuth_deg)
