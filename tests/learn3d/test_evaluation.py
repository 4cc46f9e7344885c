"""Voxel IoU, MMD over pairs of views, and the report over runs."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math

import numpy as np
import pytest
import stub_work
import torch

import nmr
from learn3d.data.batch import Batch
from learn3d.data.dataset import ViewDataset
from learn3d.data.readers.pascal3d import PASCAL3D
from learn3d.evaluation import codes_per_view, evaluate, mean_mmd, spread_samples
from learn3d.experiments.measurement import _warnings, class_means, evaluate_runs, format_table, to_json
from learn3d.losses import mmd
from learn3d.methods import Grids, Meshes, Method
from learn3d.runs.versions import versions


class Constant(Method):
    """Codes from the brightness of the image; the same shape for all."""

    image_size = 64

    def __init__(self, shape: Meshes | Grids) -> None:
        self.networks, self.optimizers, self.device, self.precision = {}, {}, torch.device("cpu"), "fp32"
        self.shape = shape

    def create_networks(self):
        raise NotImplementedError

    def create_optimizers(self):
        raise NotImplementedError

    def training_step(self, batch, step):
        raise NotImplementedError

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        return images.float().mean(dim=(2, 3))

    def decode(self, codes: torch.Tensor) -> Meshes | Grids:
        if isinstance(self.shape, Grids):
            return Grids(self.shape.occupancy.expand(len(codes), -1, -1, -1))
        return Meshes(self.shape.vertices.expand(len(codes), -1, -1), self.shape.faces)


def with_truth(dataset, vertices: torch.Tensor, faces: torch.Tensor):
    """The data set with the voxels of one mesh as the truth of every object."""
    voxels = dataset.voxelize(vertices, faces).numpy()
    return dataclasses.replace(dataset, voxels=np.repeat(voxels, dataset.num_objects, axis=0))


def egg() -> Meshes:
    sphere, faces = nmr.icosphere(3)
    return Meshes(sphere[None] * torch.tensor([0.45, 0.3, 0.2]), faces)


def test_perfect_prediction_has_iou_one(tiny_set) -> None:
    shape = egg()
    perfect = Constant(shape)
    result = evaluate(perfect, with_truth(tiny_set, shape.vertices, shape.faces), surfaces=True)
    assert result.voxel_iou == 1
    assert (result.images, result.undefined) == (72, 0)
    assert result.summary()["chamfer_l1"] < 0.02  # the truth is the surface of a 32^3 grid
    assert result.summary()["f_score"] > 0.95
    smaller = with_truth(tiny_set, 0.75 * shape.vertices, shape.faces)
    worse = evaluate(perfect, smaller, max_images=5, surfaces=True)
    assert 0.3 < worse.voxel_iou < 0.6  # near 0.75^3
    assert worse.images == 5
    assert worse.recall.tolist() == [1] * 5, "all of the truth is in the larger prediction"
    assert torch.equal(worse.precision, worse.ious["kato18"])
    assert worse.summary()["chamfer_l1"] > 0.04


def test_surface_of_the_truth_is_in_the_object_frame(tiny_set) -> None:
    shape = egg()
    moved = Meshes(shape.vertices * 0.5 + torch.tensor([0.2, 0.1, -0.15]), shape.faces)
    truth = with_truth(tiny_set, moved.vertices, moved.faces)
    assert evaluate(Constant(moved), truth, max_images=3, surfaces=True).summary()["chamfer_l1"] < 0.02
    mirrored = Constant(Meshes(moved.vertices * torch.tensor([1.0, 1.0, -1.0]), moved.faces))
    assert evaluate(mirrored, truth, max_images=3, surfaces=True).summary()["chamfer_l1"] > 0.1


def test_points_of_the_data_set_are_the_truth_where_it_has_them(tiny_set) -> None:
    points = np.zeros((tiny_set.num_objects, 10, 3), np.float32)
    result = evaluate(Constant(egg()), dataclasses.replace(tiny_set, points=points), max_images=2, surfaces=True)
    assert 0.2 <= result.summary()["chamfer_l1"] < 0.45  # from the centre to the egg


def test_an_empty_prediction_has_an_f_score_and_no_distance(tiny_set) -> None:
    shape = egg()
    half = torch.zeros(2, 64, 64, 64)
    half[0, 16:48, 16:48, 16:48] = 1
    empty_second = Grids(half)
    result = evaluate(
        Constant(empty_second), with_truth(tiny_set, shape.vertices, shape.faces), max_images=2, surfaces=True
    )
    assert result.chamfer_l1.isnan().tolist() == [False, True]
    assert result.f_score[0] > 0 and result.f_score[1] == 0
    summary = result.summary()
    assert summary["without_distance"] == 1
    assert summary["f_score"] == pytest.approx(float(result.f_score[0]) / 2), "counted, not left out"
    assert summary["chamfer_l1"] == pytest.approx(float(result.chamfer_l1[0])), "left out"


def test_why_there_is_no_mmd_is_said(tiny_set, finished_run) -> None:
    assert evaluate(Constant(egg()), tiny_set).without_mmd == ""
    result = evaluate(Constant(egg()), tiny_set, max_images=8)
    assert result.mmd is None
    assert result.without_mmd.endswith("two images of each of two views, and these are 8 images of 8 views")
    said = [line for line in (finished_run / "journal.txt").read_text().splitlines() if "val voxel IoU" in line]
    assert said and all(line.endswith("these are 4 images of 4 views (max_val_images 4)") for line in said)
    report = []
    evaluate_runs([finished_run], report_progress=report.append)
    (warning,) = (line for line in report if line.startswith("warning: no MMD: "))
    assert warning.endswith("24 images of 24 views")


def test_both_voxelisers(tiny_set) -> None:
    shape = egg()
    data = with_truth(tiny_set, shape.vertices, shape.faces)
    result = evaluate(Constant(shape), data, definitions=("kato19", "kato18"), max_images=2).summary()
    assert result["voxel_iou_kato18"] == 1
    assert result["voxel_iou"] == result["voxel_iou_kato19"] < 1


def test_grids_are_pooled_and_brought_into_the_axes(tiny_set) -> None:
    shape = egg()
    grid = nmr.voxelize(shape.vertices + torch.tensor([0.5, 0.6, 0.45]), shape.faces, size=64).float()
    moved = shape.vertices + torch.tensor([0.0, 0.1, -0.05])
    result = evaluate(Constant(Grids(grid)), with_truth(tiny_set, moved, shape.faces), max_images=2)
    assert result.voxel_iou > 0.8
    with pytest.raises(ValueError, match="cannot be pooled to 24"):
        Grids(grid).occupied(24)
    pascal = dataclasses.replace(tiny_set, convention=PASCAL3D)
    with pytest.raises(ValueError, match=r"the box \[-0.5, 0.5\] cannot be compared with pascal3d"):
        evaluate(Constant(Grids(grid)), pascal, max_images=2)


def test_without_voxels_silhouettes_at_other_cameras_are_compared(tiny_set) -> None:
    def silhouettes_of(shape: Meshes):
        """The data set as photographs of the shape."""
        masks = nmr.render_silhouette(shape.vertices, shape.faces, tiny_set.poses.cameras(), image_size=64)
        images = tiny_set.images.copy()
        images[:, 3] = (255 * masks).round()
        return dataclasses.replace(tiny_set, images=images, voxels=None)

    photographs = silhouettes_of(egg())
    result = evaluate(Constant(egg()), photographs, surfaces=True)
    assert (result.voxel_iou, result.undefined, result.chamfer_l1) == (None, 0, None)
    assert result.mmd is not None
    assert result.chosen_by == ("silhouette IoU", pytest.approx(1, abs=0.01))
    assert result.silhouette_iou.shape == (72,)
    flat = Meshes(egg().vertices * torch.tensor([1.0, 1.0, 0.1]), egg().faces)  # the same from views 0 and 12
    facing = photographs.select(np.flatnonzero(np.isin(photographs.view_ids, (0, 6))))
    own, other = (evaluate(Constant(flat), facing).silhouette_iou[k::2].mean() for k in (1, 0))
    assert own > 0.9 > 0.6 > other, "each image is judged by the other view"
    single = photographs.select(np.flatnonzero(photographs.view_ids == 0))
    assert evaluate(Constant(flat), single).silhouette_iou.mean() > 0.9, "or by itself where there is no other"
    assert evaluate(Constant(egg()), tiny_set).silhouette_iou is None, "true shapes say more"
    grids = Grids(torch.zeros(1, 64, 64, 64))
    assert evaluate(Constant(grids), photographs).chosen_by == ("voxel IoU", None)


def test_images_without_iou_are_counted_and_left_out(tiny_set) -> None:
    _, faces = nmr.icosphere(3)
    nothing = Constant(Meshes(torch.full((1, 642, 3), float("nan")), faces))
    voxels = tiny_set.voxels.copy()
    voxels[0] = False
    result = evaluate(nothing, dataclasses.replace(tiny_set, voxels=voxels))
    assert (result.voxel_iou, result.undefined) == (0, 24)
    result = evaluate(nothing, dataclasses.replace(tiny_set, voxels=np.zeros_like(voxels)))
    assert (result.voxel_iou, result.undefined) == (None, 72)


def test_meshes_beyond_the_grid_are_counted(tiny_set) -> None:
    shape = egg()
    assert evaluate(Constant(shape), tiny_set).hollow == 0
    beyond = Meshes(shape.vertices + torch.tensor([0.1, 0, 0]), shape.faces)
    whole, opened = (tiny_set.voxelize(mesh.vertices, mesh.faces) for mesh in (shape, beyond))
    assert opened.sum() < 0.7 * whole.sum(), "an open shape has no inside"
    assert evaluate(Constant(beyond), tiny_set).hollow == len(tiny_set)
    warnings = _warnings(evaluate(Constant(beyond), tiny_set))
    assert warnings == [f"{len(tiny_set)} predicted meshes reach beyond the grid of voxels, and count as hollow there"]


@pytest.mark.parametrize(
    ("objects", "count"), [(25, 26), (25, 24), (25, 5), (24, 25), (24, 100), (18, 73), (18, 200), (1, 7), (2, 48)]
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
    assert torch.equal(spread_samples(object_ids, view_ids, objects * 24), torch.arange(objects * 24))


def test_part_of_the_images_gives_codes_of_every_view(tiny_set, monkeypatch) -> None:
    seen = []
    batch = type(tiny_set).batch
    monkeypatch.setattr(type(tiny_set), "batch", lambda self, chosen: (seen.append(chosen), batch(self, chosen))[1])
    evaluate(Constant(egg()), tiny_set, max_images=25)  # of 72, three objects
    assert len((torch.cat(seen) % 24).unique()) == 24


@pytest.mark.parametrize("form", ["released", "paper"])
def test_mean_mmd_is_the_mean_over_pairs(form: str) -> None:
    generator = torch.Generator().manual_seed(0)
    codes = torch.randn(40, 16, generator=generator)
    views = torch.arange(40) % 4
    codes[views == 2] += 0.7
    pairs = itertools.combinations([codes[views == k] for k in range(4)], 2)
    expected = torch.stack([mmd(x, y, form) for x, y in pairs]).mean()
    assert mean_mmd(codes, views, forms=(form,))[form] == pytest.approx(float(expected), rel=1e-5)


def test_mean_mmd_uses_equally_many_codes_of_each_view() -> None:
    codes = torch.randn(9, 4, generator=torch.Generator().manual_seed(0))
    views = torch.tensor([0, 0, 0, 0, 0, 5, 5, 5, 5])
    expected = float(mmd(codes[:3], codes[5:8]))
    assert mean_mmd(codes, views, per_view=3)["released"] == pytest.approx(expected, rel=1e-5)
    assert mean_mmd(codes, views)["released"] == pytest.approx(float(mmd(codes[:4], codes[5:])), rel=1e-5)


def test_number_of_codes_behind_an_mmd(tiny_set) -> None:
    assert evaluate(Constant(egg()), tiny_set).summary()["mmd_codes"] == 3
    assert codes_per_view(torch.tensor([0, 0, 1, 1, 1, 2])) == 2  # the single code is left out
    assert codes_per_view(torch.tensor([0, 0, 1, 2])) == 0
    assert codes_per_view(torch.zeros(1000, dtype=torch.int64).index_fill(0, torch.arange(500), 1), per_view=9) == 9


def test_mean_mmd_of_one_view_is_nothing() -> None:
    assert mean_mmd(torch.zeros(3, 2), torch.zeros(3, dtype=torch.int64)) == {}


def test_views_with_a_single_code_do_not_count() -> None:
    codes = torch.randn(9, 4, generator=torch.Generator().manual_seed(0))
    views = torch.tensor([0, 0, 0, 0, 5, 5, 5, 5, 7])
    assert mean_mmd(codes, views) == mean_mmd(codes[:8], views[:8])
    assert mean_mmd(codes, torch.arange(9)) == {}


def test_evaluate_runs_reports_and_tabulates(finished_run) -> None:
    said: list[str] = []
    results = evaluate_runs([finished_run], split="test", report_progress=said.append)
    (result,) = results
    assert (result.category, result.method, result.step, result.images) == ("airplane", "Proposed", 4, 24)
    assert result.objects.images == [24] and len(result.views.names) == 24
    assert "last.safetensors" in said[0]
    report = to_json(results, split="test")
    assert json.loads(json.dumps(report)) == report
    assert report["means"][0]["voxel_iou_kato18"] == result.voxel_iou_kato18
    lines = format_table(results).splitlines()
    assert len(lines) == 3 and f"{result.voxel_iou_kato18:.4f}" in lines[1]
    with pytest.raises(ValueError, match="at least one run"):
        evaluate_runs([])


def test_a_run_on_several_categories_is_measured_on_each(finished_run, monkeypatch, tiny_set) -> None:
    monkeypatch.setattr(
        "learn3d.runs.checkpoint.load_dataset",
        lambda *where, **options: dataclasses.replace(tiny_set, category=where[2]),
    )
    results = evaluate_runs([finished_run], category="airplane, chair")
    assert [result.category for result in results] == ["airplane", "chair"]
    assert class_means(results)[0]["classes"] == 2


def test_mean_is_over_classes_not_over_runs() -> None:
    figures = (("airplane", 0.6), ("airplane", 0.4), ("chair", 0.1))
    results = [stub_work.result(category=c, voxel_iou_kato18=v, mmd=v, mmd_paper=None) for c, v in figures]
    (mean,) = class_means(results)
    assert mean["classes"] == 2
    assert mean["voxel_iou_kato18"] == pytest.approx(0.3)
    assert mean["mmd_paper"] is None


def test_versions_name_torch() -> None:
    assert versions()["torch"] == torch.__version__


def turned(vertices: torch.Tensor, degrees: float) -> torch.Tensor:
    angle = math.radians(degrees)
    turn = torch.tensor([[math.cos(angle), 0, -math.sin(angle)], [0, 1, 0], [math.sin(angle), 0, math.cos(angle)]])
    return vertices @ turn


def test_shapes_may_be_aligned_before_they_are_compared(tiny_set) -> None:
    sphere, faces = nmr.icosphere(2)
    vertices = sphere * torch.tensor([0.45, 0.3, 0.15])
    dataset = with_truth(tiny_set, vertices, faces)
    method = Constant(Meshes(turned(vertices, 60.0), faces))
    aside = evaluate(method, dataset, max_images=4)
    assert aside.voxel_iou < 0.7

    def own(shapes: Meshes, batch: Batch, of: ViewDataset) -> Meshes:
        assert of is dataset and len(batch) == len(shapes.vertices)
        return dataclasses.replace(shapes, vertices=turned(shapes.vertices, -60.0))

    back = evaluate(method, dataset, max_images=4, align=own, surfaces=True)
    assert back.voxel_iou > 0.99
    assert back.chamfer_l1.max() < 0.05


def test_without_poses_voxels_are_compared_and_silhouettes_are_not(tiny_set) -> None:
    sphere, faces = nmr.icosphere(2)
    known = with_truth(tiny_set, 0.3 * sphere, faces)
    unknown = dataclasses.replace(known, poses=None)
    method = Constant(Meshes(0.3 * sphere, faces))
    assert evaluate(method, unknown).summary() == evaluate(method, known).summary()
    nothing = evaluate(method, dataclasses.replace(unknown, voxels=None))
    assert (nothing.voxel_iou, nothing.silhouette_iou) == (None, None)
