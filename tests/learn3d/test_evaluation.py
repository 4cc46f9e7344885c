"""Voxel IoU, MMD over pairs of views, and the report over runs."""

from __future__ import annotations

import dataclasses
import itertools
import json
import types

import numpy as np
import pytest
import torch

import nmr
from learn3d.evaluation import (
    _class_means,
    evaluate,
    evaluate_runs,
    format_table,
    mean_mmd,
    spread_samples,
    versions,
)
from learn3d.losses import mmd
from learn3d.networks import create_networks


@pytest.fixture(scope="module")
def networks():
    return create_networks(24, discriminator=False, device="cpu", seed=0)


def with_truth(dataset, vertices: torch.Tensor, faces: torch.Tensor):
    """The data set with the voxels of one mesh as the truth of every object."""
    voxels = dataset.voxelize(vertices, faces).numpy()
    return dataclasses.replace(dataset, voxels=np.repeat(voxels, dataset.num_objects, axis=0))


def test_perfect_prediction_has_iou_one(networks, tiny_set) -> None:
    sphere, faces = nmr.icosphere(3)
    perfect = types.SimpleNamespace(
        encoder=networks.encoder,
        generator=lambda codes: (0.4 * sphere).expand(len(codes), -1, -1),
        device=torch.device("cpu"),
    )
    perfect.generator = _with_faces(perfect.generator, faces)
    truth = with_truth(tiny_set, 0.4 * sphere[None], faces)
    result = evaluate(perfect, truth)
    assert result.voxel_iou == 1
    assert (result.images, result.undefined) == (72, 0)
    smaller = evaluate(perfect, with_truth(tiny_set, 0.3 * sphere[None], faces), max_images=5)
    assert 0.3 < smaller.voxel_iou < 0.6  # near (0.3 / 0.4)^3
    assert smaller.images == 5


class _with_faces:
    def __init__(self, function, faces: torch.Tensor) -> None:
        self.function, self.faces = function, faces

    def __call__(self, codes: torch.Tensor) -> torch.Tensor:
        return self.function(codes)


def test_images_without_iou_are_counted_and_left_out(networks, tiny_set) -> None:
    _, faces = nmr.icosphere(3)
    nothing = types.SimpleNamespace(encoder=networks.encoder, device=torch.device("cpu"))
    nothing.generator = _with_faces(lambda codes: torch.full((len(codes), 642, 3), float("nan")), faces)
    voxels = tiny_set.voxels.copy()
    voxels[0] = False
    result = evaluate(nothing, dataclasses.replace(tiny_set, voxels=voxels))
    assert (result.voxel_iou, result.undefined) == (0, 24)
    result = evaluate(nothing, dataclasses.replace(tiny_set, voxels=np.zeros_like(voxels)))
    assert (result.voxel_iou, result.undefined) == (None, 72)


@pytest.mark.parametrize(
    ("objects", "count"), [(25, 26), (25, 24), (25, 5), (24, 25), (24, 100), (18, 73), (18, 200), (1, 7), (2, 48)]
)
def test_spread_samples_meet_views_and_objects_evenly(objects: int, count: int) -> None:
    samples = spread_samples(objects, 24, count)
    assert samples.dtype == torch.int64
    assert len(samples.unique()) == count
    assert torch.equal(samples, samples.sort().values)
    assert torch.equal(samples, spread_samples(objects, 24, count))
    for numbers, size in ((samples % 24, 24), (samples // 24, objects)):
        counts = torch.bincount(numbers, minlength=size)
        assert len(counts) == size
        assert counts.max() - counts.min() <= 1
    assert torch.equal(spread_samples(objects, 24, objects * 24), torch.arange(objects * 24))


def test_part_of_the_images_gives_codes_of_every_view(networks, tiny_set, monkeypatch) -> None:
    seen = []
    batch = type(tiny_set).batch
    monkeypatch.setattr(type(tiny_set), "batch", lambda self, chosen: (seen.append(chosen), batch(self, chosen))[1])
    evaluate(networks, tiny_set, max_images=25)  # of 72, three objects
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


def test_mean_mmd_of_one_view_is_nothing() -> None:
    assert mean_mmd(torch.zeros(3, 2), torch.zeros(3, dtype=torch.int64)) == {}


def test_evaluate_runs_reports_and_tabulates(finished_run) -> None:
    said: list[str] = []
    report = evaluate_runs([finished_run], split="test", report_progress=said.append)
    (result,) = report["results"]
    assert (result["category"], result["method"], result["iterations"], result["images"]) == (
        "airplane",
        "proposed",
        4,
        24,
    )
    assert report["means"][0]["voxel_iou"] == result["voxel_iou"]
    assert "last.safetensors" in said[0]
    assert json.loads(json.dumps(report)) == report
    lines = format_table(report).splitlines()
    assert len(lines) == 3
    assert f"{result['voxel_iou']:.4f}" in lines[1]
    with pytest.raises(ValueError, match="at least one run"):
        evaluate_runs([])


def test_mean_is_over_classes_not_over_runs() -> None:
    rows = [
        {"category": c, "method": "proposed", "preset": "released", "voxel_iou": v, "mmd": v, "mmd_paper": None}
        for c, v in (("airplane", 0.6), ("airplane", 0.4), ("chair", 0.1))
    ]
    (mean,) = _class_means(rows)
    assert mean["classes"] == 2
    assert mean["voxel_iou"] == pytest.approx(0.3)
    assert mean["mmd_paper"] is None


def test_versions_name_torch() -> None:
    assert versions()["torch"] == torch.__version__
