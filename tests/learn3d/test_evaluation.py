"""Evaluation: voxels, surfaces, silhouettes, MMD."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import stub_work
import torch
from tiny_networks import FixedMethod
from vectors import load_vector

import nmr
from learn3d import evaluation
from learn3d.data.conventions import KAR, KATO, PASCAL3D
from learn3d.data.dataset import ViewDataset
from learn3d.evaluation import (
    ANGLES_DEG,
    NO_MMD,
    Evaluation,
    evaluate,
    images_by_angle,
    mean_mmd,
    shuffle_views,
    spread_samples,
)
from learn3d.methods.method import Grids, Meshes
from learn3d.runs.measurement import (
    _means_by_object,
    class_means,
    evaluate_runs,
    format_table,
)
from nmr.metrics import voxel_iou


class Constant(FixedMethod):
    """Codes from the brightness of the image; the same shape for all."""

    def __init__(self, shape: Meshes | Grids) -> None:
        super().__init__()
        self.shape = shape

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        return images.float().mean(dim=(2, 3))

    def decode(self, codes: torch.Tensor) -> Meshes | Grids:
        if isinstance(self.shape, Grids):
            return Grids(self.shape.occupancy.expand(len(codes), -1, -1, -1))
        return Meshes(self.shape.vertices.expand(len(codes), -1, -1), self.shape.faces)


def with_truth(dataset: ViewDataset, shape: Meshes) -> ViewDataset:
    """The data set with the voxels of one mesh as the truth of every object."""
    voxels = dataset.convention.voxelize(shape.vertices, shape.faces).numpy()
    return dataclasses.replace(dataset, voxels=np.repeat(voxels, dataset.num_objects, axis=0))


def with_masks(dataset: ViewDataset, shape: Meshes) -> ViewDataset:
    """The data set with the silhouettes of one mesh as masks."""
    cameras = dataset.poses.cameras()
    masks = nmr.render_silhouette(shape.vertices, shape.faces, cameras, image_size=64)
    images = dataset.images.copy()
    images[:, 3] = (255 * masks).round()
    return dataclasses.replace(dataset, images=images)


def egg(
    scale: float = 1.0, shift: tuple[float, float, float] = (0.0, 0.0, 0.0), flat: float = 1.0
) -> Meshes:
    sphere, faces = nmr.icosphere(3)
    radii = scale * torch.tensor([0.45, 0.3, 0.2 * flat])
    return Meshes(sphere[None] * radii + torch.tensor(shift), faces)


def test_perfect_prediction_has_iou_one(tiny_set) -> None:
    result = evaluate(Constant(egg()), with_truth(tiny_set, egg()), detailed=True)
    assert (result.voxel_iou, len(result.view_ids)) == (1, 72)
    assert result.means["chamfer_l1"] < 0.015  # between random points of the same surface
    assert result.means["f_score"] > 0.999
    assert result.means["hollow"] == 0
    worse = evaluate(Constant(egg()), with_truth(tiny_set, egg(0.75)), max_images=5, detailed=True)
    assert 0.3 < worse.voxel_iou < 0.6  # near 0.75^3
    assert worse.means["voxel_iou_kato19"] != worse.voxel_iou
    # all of the truth is in the larger prediction
    assert worse.values["recall"].tolist() == [1] * 5
    assert torch.equal(worse.values["precision"], worse.values["voxel_iou"])
    assert worse.means["chamfer_l1"] > 0.04


@pytest.mark.parametrize("thicker", [-1 / 64, 1 / 64])
def test_no_thicker_or_thinner_shape_is_nearer_to_the_truth_than_the_true_one(
    tiny_set, thicker
) -> None:
    """Voxels reach beyond the surface that they were made from."""
    vertices, faces = nmr.icosphere(3)
    moved = egg().vertices + thicker * vertices
    right, wrong = (
        evaluate(Constant(shape), with_truth(tiny_set, egg()), max_images=2, detailed=True).means
        for shape in (egg(), Meshes(moved, faces))
    )
    assert right["chamfer_l1"] < wrong["chamfer_l1"] - 0.002


def test_surface_of_the_truth_is_in_the_object_frame(tiny_set) -> None:
    moved, mirrored = (egg(0.5, (0.2, 0.1, z)) for z in (-0.15, 0.15))
    truth = with_truth(tiny_set, moved)
    near, far = (
        evaluate(Constant(shape), truth, max_images=3, detailed=True).means["chamfer_l1"]
        for shape in (moved, mirrored)
    )
    assert near < 0.02 and far > 0.1


def test_points_of_the_data_set_are_the_truth_if_it_has_them(tiny_set) -> None:
    points = np.zeros((tiny_set.num_objects, 10, 3), np.float32)
    result = evaluate(
        Constant(egg()), dataclasses.replace(tiny_set, points=points), max_images=2, detailed=True
    )
    assert 0.2 <= result.means["chamfer_l1"] < 0.45  # from the centre to the egg


def test_an_empty_prediction_has_an_f_score_and_no_distance(tiny_set) -> None:
    half = torch.zeros(2, 64, 64, 64)
    half[0, 16:48, 16:48, 16:48] = 1
    result = evaluate(
        Constant(Grids(half)), with_truth(tiny_set, egg()), max_images=2, detailed=True
    )
    distance, f_score = result.values["chamfer_l1"], result.values["f_score"]
    assert distance.isnan().tolist() == [False, True]
    assert f_score[0] > 0 and f_score[1] == 0
    assert result.means["f_score"] == pytest.approx(float(f_score[0]) / 2), "counted, not left out"
    assert result.means["chamfer_l1"] == pytest.approx(float(distance[0])), "left out"


def test_grids_are_pooled_and_brought_into_the_axes(tiny_set) -> None:
    centred = egg(shift=(0.5, 0.6, 0.45))
    grid = nmr.voxelize(centred.vertices, centred.faces, size=64).float()
    moved = with_truth(tiny_set, egg(shift=(0.0, 0.1, -0.05)))
    assert evaluate(Constant(Grids(grid)), moved, max_images=2).voxel_iou > 0.8
    pascal = dataclasses.replace(tiny_set, convention=PASCAL3D)
    with pytest.raises(ValueError, match=r"the box \[-0.5, 0.5\] cannot be compared with pascal3d"):
        evaluate(Constant(Grids(grid)), pascal, max_images=2)


def test_without_voxels_silhouettes_at_other_cameras_are_compared(tiny_set) -> None:
    photographs = dataclasses.replace(with_masks(tiny_set, egg()), voxels=None)
    result = evaluate(Constant(egg()), photographs, detailed=True)
    assert result.means.keys() == {"silhouette_iou", "mmd", "mmd_paper", "mmd_floor"}
    assert result.selection_metric == "silhouette_iou"
    assert result.means["silhouette_iou"] == pytest.approx(1, abs=0.01)
    flat = Constant(egg(flat=0.1))  # the same from views 0 and 12
    facing = photographs.select(np.flatnonzero(np.isin(photographs.view_ids, (0, 6))))
    own, other = (evaluate(flat, facing).values["silhouette_iou"][k::2].mean() for k in (1, 0))
    assert own > 0.9 > 0.6 > other, "each image is judged by the other view"
    around = photographs.select(np.flatnonzero(photographs.view_ids % 6 == 0))
    own, other = (evaluate(flat, around).values["silhouette_iou"][k::2] for k in (1, 0))
    assert own.min() > 0.9 > 0.6 > other.max(), "of four views by that a quarter turn further on"
    single = photographs.select(np.flatnonzero(photographs.view_ids == 0))
    assert evaluate(flat, single).means["silhouette_iou"] > 0.9, "or by itself if there is no other"
    nothing = evaluate(Constant(Grids(torch.zeros(1, 64, 64, 64))), photographs)
    assert (nothing.selection_metric, nothing.voxel_iou) == ("voxel_iou", None)


def test_images_by_angle_follow_the_definition() -> None:
    rng = np.random.default_rng(0)
    object_ids = rng.integers(0, 6, 70)
    azimuths = torch.from_numpy(rng.uniform(-400, 400, 70)).float()
    found = images_by_angle(object_ids, azimuths)
    assert found.shape == (13, 70) and (found < 0).any()
    for row, angle in enumerate(ANGLES_DEG):
        for sample in range(70):
            own = np.flatnonzero(object_ids == object_ids[sample]).tolist()
            place = own.index(sample)
            for other in own[place:] + own[:place]:
                apart = abs(float(azimuths[other] - azimuths[sample])) % 360
                if abs(min(apart, 360 - apart) - angle) < 7.5:
                    break
            else:
                other = -1
            assert found[row, sample] == other
    assert found[0].tolist() == list(range(70)), "at 0 degrees the image itself"


def test_silhouettes_by_angle_are_those_of_a_loop_over_images(tiny_set) -> None:
    """Each image has an egg of its own size; the truth is one egg, flat along the optical axis of view 0."""

    class Sizes(Constant):
        def decode(self, codes: torch.Tensor) -> Meshes:
            scale = 0.6 + 3 * codes[:, 0] / 255
            return Meshes(self.shape.vertices * scale[:, None, None], self.shape.faces)

    flat = egg(flat=0.3)
    dataset, method = with_masks(tiny_set, flat), Sizes(flat)
    found = evaluate(method, dataset, detailed=True, batch_size=7).angle_ious
    shapes = method.decode(method.encode(torch.from_numpy(dataset.images)))
    wanted = {angle: [] for angle in ANGLES_DEG}
    for sample in range(len(dataset)):
        for angle in ANGLES_DEG:
            other = sample // 24 * 24 + (sample + angle // 15) % 24
            camera = dataset.poses[torch.tensor([other])].cameras()
            drawn = nmr.render_silhouette(
                shapes.vertices[sample][None], shapes.faces, camera, image_size=64
            )[0]
            mask = torch.from_numpy(dataset.images[other, 3]) / 255
            wanted[angle].append(
                float(torch.minimum(drawn, mask).sum() / torch.maximum(drawn, mask).sum())
            )
    assert found == pytest.approx(
        {angle: np.mean(ious) for angle, ious in wanted.items()}, abs=1e-6
    )
    alone = dataset.select(np.flatnonzero(dataset.view_ids == 0))
    assert evaluate(method, alone, detailed=True).angle_ious == {}, "no object has a second image"


def test_the_clamp_counts_in_one_of_two_ious(tiny_set) -> None:
    beyond = egg(shift=(0.1, 0.0, 0.0))
    clamped = Meshes(beyond.vertices.clamp(-0.499, 0.499), beyond.faces, beyond.vertices)

    class Clamped(Constant):
        def decode(self, codes: torch.Tensor) -> Meshes:
            many = (len(codes), -1, -1)
            return Meshes(clamped.vertices.expand(many), beyond.faces, beyond.vertices.expand(many))

    dataset = with_truth(tiny_set, egg())
    both = evaluate(Clamped(clamped), dataset, detailed=True).means
    without = evaluate(Constant(beyond), dataset, detailed=True).means
    assert both["voxel_iou_unclamped"] == without["voxel_iou"] == without["voxel_iou_unclamped"]
    assert both["voxel_iou"] > both["voxel_iou_unclamped"] + 0.1, "an open shape has no inside"
    assert (both["hollow"], without["hollow"]) == (0, 1)


def test_views_are_shuffled_within_objects() -> None:
    generator = torch.Generator().manual_seed(1)
    object_ids, view_ids = torch.arange(240) // 12, torch.arange(240) % 12
    order = torch.randperm(240, generator=generator)
    object_ids, view_ids = object_ids[order], view_ids[order]
    shuffled = shuffle_views(object_ids, view_ids)
    assert not torch.equal(shuffled, view_ids)
    assert torch.equal(shuffled, shuffle_views(object_ids, view_ids)), "the same in every run"
    for number in range(20):
        own = object_ids == number
        assert shuffled[own].sort().values.tolist() == list(range(12))
    shapes = torch.randn(20, 8, generator=generator)[object_ids]
    noise = 0.3 * torch.randn(240, 8, generator=generator)
    posed = shapes + torch.randn(12, 8, generator=generator)[view_ids]
    floor, high = (mean_mmd(codes + noise, shuffled)["mmd"] for codes in (shapes, posed))
    assert mean_mmd(shapes + noise, view_ids)["mmd"] == pytest.approx(floor, rel=0.1)
    assert mean_mmd(posed + noise, view_ids)["mmd"] > 2 * high


def test_novel_views_select_networks_even_if_voxels_are_known(tiny_set) -> None:
    flat, facing = egg(flat=0.1), with_truth(tiny_set, egg())
    assert evaluate(Constant(flat), facing).selection_metric == "silhouette_iou"
    single = evaluate(Constant(flat), facing.select(np.flatnonzero(facing.view_ids == 0)))
    assert single.selection_metric == "voxel_iou", "no novel views"
    assert "silhouette_iou" not in single.means


def test_without_poses_voxels_are_compared_and_silhouettes_are_not(tiny_set) -> None:
    known = with_truth(tiny_set, egg())
    unknown = dataclasses.replace(known, poses=None)
    means = evaluate(Constant(egg()), known).means
    del means["silhouette_iou"]
    assert evaluate(Constant(egg()), unknown).means == means
    nothing = evaluate(Constant(egg()), dataclasses.replace(unknown, voxels=None))
    assert nothing.means.keys() == {"mmd"}


def test_images_without_iou_are_left_out(tiny_set) -> None:
    nothing = Constant(Meshes(torch.full((1, 642, 3), float("nan")), egg().faces))
    voxels = tiny_set.voxels.copy()
    voxels[0] = False
    result = evaluate(nothing, dataclasses.replace(tiny_set, voxels=voxels))
    assert (result.voxel_iou, int(result.values["voxel_iou"].isnan().sum())) == (0, 24)
    voxels[:] = False
    assert evaluate(nothing, dataclasses.replace(tiny_set, voxels=voxels)).voxel_iou is None


@pytest.mark.parametrize(
    ("objects", "count"), [(25, 24), (25, 5), (24, 25), (18, 73), (18, 200), (1, 7), (2, 48)]
)
def test_spread_samples_meet_views_and_objects_evenly(objects: int, count: int) -> None:
    object_ids, view_ids = np.repeat(np.arange(objects), 24), np.tile(np.arange(24), objects)
    samples = spread_samples(object_ids, view_ids, count)
    assert samples.dtype == torch.int64
    assert len(samples.unique()) == count
    assert torch.equal(samples, samples.sort().values)
    assert torch.equal(samples, spread_samples(object_ids, view_ids, count))
    for numbers, size in ((samples % 24, 24), (samples // 24, objects)):
        counts = torch.bincount(numbers, minlength=size)
        assert len(counts) == size
        assert counts.max() - counts.min() <= 1
    everything = spread_samples(object_ids, view_ids, objects * 24)
    assert torch.equal(everything, torch.arange(objects * 24))


def test_mean_mmd_is_the_mean_over_pairs() -> None:
    codes = torch.randn(40, 16, generator=torch.Generator().manual_seed(0))
    views = torch.arange(40) % 4
    codes[views == 2] += 0.7
    pairs = list(itertools.combinations([codes[views == k] for k in range(4)], 2))
    names = ("mmd", "mmd_paper")
    found = mean_mmd(codes, views, names)
    of_pairs = [mean_mmd(torch.cat(pair), torch.arange(20) // 10, names) for pair in pairs]
    for name in names:
        assert found[name] == pytest.approx(np.mean([one[name] for one in of_pairs]), rel=1e-5)


def test_mean_mmd_uses_equally_many_codes_of_each_view(monkeypatch) -> None:
    codes = torch.randn(9, 4, generator=torch.Generator().manual_seed(0))
    views = torch.tensor([0, 0, 0, 0, 0, 5, 5, 5, 5])
    four, three = [0, 1, 2, 3, 5, 6, 7, 8], [0, 1, 2, 5, 6, 7]
    assert mean_mmd(codes, views) == mean_mmd(codes[four], views[four])
    # a single code of a view does not count
    single = torch.tensor([0, 0, 0, 0, 5, 5, 5, 5, 7])
    assert mean_mmd(codes, single) == mean_mmd(codes[:8], single[:8])
    for views_without_pairs in (torch.arange(9), torch.zeros(9, dtype=torch.int64)):
        assert mean_mmd(codes, views_without_pairs) == {}
    monkeypatch.setattr(evaluation, "CODES_PER_VIEW", 3)
    assert mean_mmd(codes, views) == mean_mmd(codes[three], views[three])


def test_evaluate_runs_reports_and_tabulates(finished_run, capsys) -> None:
    (result,) = evaluate_runs([finished_run], split="test")
    said = capsys.readouterr().err.splitlines()
    assert (result.category, result.method) == ("airplane", "Proposed")
    assert (result.step, result.images) == (4, 24)
    ((_, images, iou, _),) = result.objects
    assert (images, iou) == (24, pytest.approx(result.voxel_iou, abs=1e-5))
    assert "last.safetensors" in said[0]
    assert f"warning: {NO_MMD}" in said, "a single object has one image of each view"
    lines = format_table([result]).splitlines()
    assert len(lines) == 3 and f"{result.voxel_iou:.4f}" in lines[1]


def test_means_of_objects_are_those_of_images_with_an_iou(tiny_set) -> None:
    ids, iou = torch.tensor([0, 0, 1]), torch.tensor([torch.nan, 0.5, torch.nan])
    result = Evaluation(ids, ids, {"voxel_iou": iou, "voxel_iou_kato19": iou}, {})
    found = _means_by_object(result, tiny_set)
    assert found == [("0000", 1, 0.5, 0.5), ("0001", 0, None, None)]


def test_a_run_on_several_categories_is_measured_on_each(
    finished_run, monkeypatch, tiny_set
) -> None:
    few = tiny_set.select(np.arange(4))
    monkeypatch.setattr(
        "learn3d.runs.checkpoint.load_dataset",
        lambda *where, **options: dataclasses.replace(few, category=where[2]),
    )
    results = list(evaluate_runs([finished_run], category="airplane, chair"))
    assert [result.category for result in results] == ["airplane", "chair"]
    assert class_means(results)[0]["classes"] == 2


def test_another_layout_must_store_colours_alike(finished_run, tiny_folder) -> None:
    (alike,) = evaluate_runs([finished_run], layout="kato", data=tiny_folder)
    (same,) = evaluate_runs([finished_run], data=tiny_folder)
    assert alike.voxel_iou == same.voxel_iou
    with pytest.raises(ValueError, match="colours as the layout kato has them, not kar"):
        next(evaluate_runs([finished_run], layout="kar", data=tiny_folder))
    with pytest.raises(ValueError, match="layout must be one of"):
        next(evaluate_runs([finished_run], layout="karo", data=tiny_folder))


def test_mean_is_over_classes_not_over_runs() -> None:
    figures = (("airplane", 0, 0.6), ("airplane", 1, 0.4), ("chair", 0, 0.1))
    results = [
        stub_work.result(category=c, seed=s, voxel_iou=v, mmd_paper=None) for c, s, v in figures
    ]
    (mean,) = class_means(results)
    assert mean["classes"] == 2
    assert mean["voxel_iou"] == pytest.approx(0.3)
    assert mean["mmd_paper"] is None
    other = [stub_work.result(category="chair", seed=0, iterations=99)]
    assert class_means(results + other) == [], "runs of other settings are no seeds"


PUBLISHED_IOUS = {KATO: "iou_CVPR18", KAR: "iou_NIPS17", PASCAL3D: "iou_Pascal3D"}


@pytest.mark.parametrize("convention", PUBLISHED_IOUS, ids=lambda convention: convention.name)
def test_iou_after_the_axis_rule_is_the_published_one(convention):
    v = load_vector("voxel_iou")
    predicted, target = (torch.from_numpy(v[name].astype(bool)) for name in ("predicted", "target"))
    published = torch.from_numpy(v[PUBLISHED_IOUS[convention]])
    for other in PUBLISHED_IOUS:
        assert torch.equal(other.to_object(other.to_axes(predicted)), predicted)
        found = voxel_iou(other.to_axes(predicted), target)
        if other is convention:
            torch.testing.assert_close(found, published.to(found), rtol=1e-6, atol=0)
        else:  # the rule matters here
            assert abs(found[0] - published[0]) > 1e-4
