"""Plots with axes: t-SNE maps, learning curves, polar plots; what they show, and what they say when they cannot."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import skimage.color
from PIL import Image

from learn3d.figures import codes, curves, paper, plots, polar
from learn3d.files import limits

matplotlib = pytest.importorskip("matplotlib")
VIEWS, OBJECTS = np.tile(np.arange(12), 20), np.repeat(np.arange(20), 12)
AZIMUTHS = -30.0 * VIEWS


def entangled(share: float) -> np.ndarray:
    """Codes [240, 16] of 20 objects from 12 sides: `share` of the view, the rest of the object."""
    rng = np.random.default_rng(0)
    of_view, of_object = rng.normal(size=(12, 16))[VIEWS], rng.normal(size=(20, 16))[OBJECTS]
    return share * of_view + (1 - share) * of_object + 0.1 * rng.normal(size=(240, 16))


def test_an_embedding_is_the_same_for_the_same_seed() -> None:
    pytest.importorskip("sklearn")
    noise = np.random.default_rng(0).normal(size=(150, 512))  # flat: its principal axes are found by chance
    points = codes.embed(noise, seed=1)
    assert points.shape == (150, 2)
    assert points.dtype == np.float32
    assert np.array_equal(points, codes.embed(noise, seed=1))
    assert not np.array_equal(points, codes.embed(noise, seed=2))
    points = codes.embed(entangled(0.9)[:60])
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    assert (VIEWS[:60][distances.argmin(axis=1)] == VIEWS[:60]).mean() > 0.9  # neighbours stay neighbours
    with pytest.raises(ValueError, match=r"at least 10 images, got \[9, 16\]"):
        codes.embed(entangled(0.9)[:9])


def test_the_view_is_told_from_entangled_codes_alone() -> None:
    pytest.importorskip("sklearn")
    accuracy, chance = codes.view_accuracy(entangled(0.95), VIEWS, OBJECTS)
    assert accuracy > 0.95
    assert chance == pytest.approx(1 / 12, abs=0.03)
    accuracy, _ = codes.view_accuracy(entangled(0.0), VIEWS, OBJECTS)
    assert 0.02 < accuracy < 0.17  # as often as by chance, not never: views of the same object do not count
    assert codes.view_accuracy(entangled(0.5)[:12], VIEWS[:12], OBJECTS[:12]) is None
    assert codes.view_accuracy(entangled(0.5), 0 * VIEWS, OBJECTS) is None


def test_maps_are_coloured_by_the_azimuth(tmp_path) -> None:
    points = np.random.default_rng(0).normal(size=(240, 2)).astype(np.float32)
    maps = [
        codes.CodeMap("Vanilla-AE", points, AZIMUTHS, 0.374, 0.0832),
        codes.CodeMap("Proposed", points, AZIMUTHS, None, None),
    ]
    figure = codes.plot_maps(maps)
    scatter = figure.axes[0].collections[0]
    wheel = plots.cyclic_map()
    for position, color in zip(scatter.get_offsets(), scatter.get_facecolors(), strict=True):
        (index,) = np.flatnonzero((points == position).all(axis=1))
        assert np.allclose(color, wheel((AZIMUTHS[index] % 360) / 360), atol=1e-6)
    written = plots.save_figure(figure, tmp_path / "maps.png")
    assert written == [tmp_path / "maps.png", tmp_path / "maps.svg"]
    assert Image.open(written[0]).size > (800, 400)
    text = written[1].read_text()
    for words in ("Vanilla-AE", "Proposed", "view told from the code: 37 % (chance 8 %)", "90°"):
        assert words in text
    first = written[1].read_bytes()
    plots.save_figure(codes.plot_maps(maps), tmp_path / "maps.svg")
    assert written[1].read_bytes() == first
    with pytest.raises(ValueError, match="at least one map"):
        codes.plot_maps([])


def test_the_colours_of_the_wheel_can_be_told_apart_by_everyone() -> None:
    lab = skimage.color.rgb2lab(plots.cyclic_colors(72)[None])[0]
    steps = np.linalg.norm(np.diff(lab, axis=0, append=lab[:1]), axis=1)
    assert steps.max() < 8  # no jump, at the end neither
    lightness_and_blue = lab[:, [0, 2]]  # what remains without red-green vision
    opposite = np.linalg.norm(lightness_and_blue - np.roll(lightness_and_blue, 36, axis=0), axis=1)
    assert opposite.min() > 45
    assert lab[:, 0].max() < 85  # none vanishes on white


def write_metrics(folder: Path, records: list[dict], tail: str = "") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metrics.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records) + tail)
    return folder


def records(offset: float, steps: int = 4) -> list[dict]:
    training = [{"step": 50 * k, "split": "train", "projection": 1 / k + offset, "total": 2.0} for k in range(1, steps)]
    return [*training, {"step": 100, "split": "val", "voxel_iou": 0.5 + offset, "images": 24}]


def test_metrics_become_curves(tmp_path, monkeypatch) -> None:
    read = curves.read_metrics(write_metrics(tmp_path / "run", records(0.25), tail='{"step": 200, "spl'))
    assert set(read) == {("train", "projection"), ("train", "total"), ("val", "voxel_iou")}
    assert read["train", "projection"].steps.tolist() == [50, 100, 150]
    assert read["train", "projection"].values.tolist() == pytest.approx([1.25, 0.75, 1 / 3 + 0.25])
    with pytest.raises(FileNotFoundError, match=r"no .*nowhere; give the folder"):
        curves.read_metrics(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"line 1 is no record with a step and a split: '\[\]'"):
        curves.read_metrics(write_metrics(tmp_path / "foreign", [[], *records(0)]))
    with pytest.raises(ValueError, match="no numbers yet"):
        curves.read_metrics(write_metrics(tmp_path / "new", []))
    for line in ("[" * 100_000, '{"step": true, "split": "val"}', '{"step": 1e300, "split": "val"}', "5", "\udcff"):
        folder = write_metrics(tmp_path / "hostile", records(0.25))
        content = (folder / "metrics.jsonl").read_bytes()
        (folder / "metrics.jsonl").write_bytes(line.encode("utf-8", "surrogateescape") + b"\n" + content)
        with pytest.raises(ValueError, match="line 1 is no record with a step and a split"):
            curves.read_metrics(folder)
    for name in ("\ud800", "\x1b[2J", "a" * 61):
        with pytest.raises(ValueError, match="line 1 has a number whose name is none: 'train "):
            curves.read_metrics(write_metrics(tmp_path / "odd", [{"step": 1, "split": "train", name: 1.0}]))
    many = {"step": 1, "split": "train"} | {f"loss{k}": 1.0 for k in range(101)}
    with pytest.raises(ValueError, match="holds 101 different numbers; at most 100 are drawn"):
        curves.read_metrics(write_metrics(tmp_path / "many", [many]))
    monkeypatch.setattr(limits, "METRICS_BYTES", 10)
    with pytest.raises(ValueError, match=r"metrics\.jsonl: has \d+ bytes, and at most 10 are read"):
        curves.read_metrics(folder)


def test_dollars_in_names_are_no_formulas(tmp_path) -> None:
    folder = write_metrics(tmp_path / "run", [{"step": 1, "split": "train", "$\\frac{$": 1.0}])
    assert all(path.stat().st_size for path in paper.save_curves([folder], tmp_path / "c.png", labels=["$\\bad$"]))


def test_what_a_run_counts_is_no_curve(finished_run) -> None:
    names = {name for _, name in curves.read_metrics(finished_run)}
    assert {"voxel_iou", "projection"} <= names <= curves.TITLES.keys()


def test_seeds_become_a_band(tmp_path) -> None:
    folders = [write_metrics(tmp_path / "a", records(0.0, 4)), write_metrics(tmp_path / "b", records(0.5, 3))]
    runs = [curves.read_metrics(folder) for folder in folders]
    steps, mean, low, high = curves.band([run["train", "projection"] for run in runs])
    assert steps.tolist() == [50, 100]  # the second run has not got further
    assert (low.tolist(), mean.tolist(), high.tolist()) == ([1.0, 0.5], [1.25, 0.75], [1.5, 1.0])
    figure = curves.plot_curves({"Proposed": runs, "Vanilla-AE": runs[:1]})
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["voxel IoU, val", "projection loss (1 - IoU), train", "total loss (weighted), train"]
    panel = figure.axes[1]
    assert panel.lines[0].get_ydata().tolist() == [1.25, 0.75]
    assert panel.lines[1].get_ydata().tolist() == pytest.approx([1.0, 0.5, 1 / 3])
    assert len(panel.collections) == 1  # one band: the second label has one run
    edge = panel.collections[0].get_paths()[0].vertices
    assert {(50.0, 1.0), (50.0, 1.5), (100.0, 0.5), (100.0, 1.0)} <= {tuple(map(float, v)) for v in edge}
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "Proposed (2 seeds: mean and range)",
        "Vanilla-AE",
    ]
    assert panel.get_xlabel() == "training step"
    with pytest.raises(ValueError, match="at least one run"):
        curves.plot_curves({})


def test_directions_are_views_or_sectors() -> None:
    ids, azimuths = polar.directions(-15.0 * np.arange(48))
    assert azimuths.tolist() == [15.0 * k for k in range(24)]
    assert ids[:3].tolist() == [0, 23, 22]
    ids, azimuths = polar.directions(np.append(np.linspace(0, 357, 100), [359.999, -7.0, 22.0]))
    assert azimuths.tolist() == [15.0 * k for k in range(24)]
    assert ids[-3:].tolist() == [0, 0, 1]


def test_agreements_are_iou_of_all_pairs() -> None:
    voxels = np.zeros((4, 4, 4, 4), bool)
    voxels[0, :2], voxels[1, 1:3] = True, True
    table = polar.agreements(voxels)
    assert table[0, 1] == table[1, 0] == pytest.approx(1 / 3)
    assert table[0, 2] == 0.0
    assert np.isnan(table[2, 3])  # both are empty
    assert np.isnan(np.diag(table)).all()


def profiles() -> list[polar.ViewProfile]:
    rng = np.random.default_rng(0)
    ious, agreement = rng.uniform(0.3, 0.6, 240), rng.uniform(0.5, 0.9, 240)
    ious[VIEWS == 3] = np.nan
    first = polar.profile("a", AZIMUTHS, ious, agreement, OBJECTS)
    return [first, polar.profile("b", AZIMUTHS, ious + 0.1, agreement, OBJECTS)]


def test_the_polar_plot_shows_the_means_of_the_views(tmp_path) -> None:
    drawn = profiles()
    figure = polar.plot_profiles(drawn)
    left, right = figure.axes
    for axes, name in ((left, "iou"), (right, "agreement")):
        for line, p in zip(axes.lines, drawn, strict=True):
            values = getattr(p, name)
            assert np.array_equal(line.get_ydata(), np.append(values, values[0]), equal_nan=True)  # closed
            assert np.allclose(line.get_xdata()[:-1], np.deg2rad(p.azimuths_deg))
            assert np.nanmax(values) < axes.get_ylim()[1] <= 1
    assert np.isnan(drawn[0].iou).sum() == 1
    assert [text.get_text() for text in left.get_legend().get_texts()] == [
        f"{p.label}: {p.mean_iou:.3f}" for p in drawn
    ]
    assert left.get_theta_offset() == pytest.approx(1.5 * np.pi)  # azimuth 0 below
    assert left.get_theta_direction() == 1  # and 90 to the right
    alone = [polar.profile("a", AZIMUTHS, np.full(240, 0.5), np.full(240, np.nan), OBJECTS)]
    assert len(polar.plot_profiles(alone).axes) == 1
    with pytest.raises(ValueError, match="at least one run"):
        polar.plot_profiles([])


def test_profiles_are_plain_values() -> None:
    first = json.loads(json.dumps(profiles()[0].to_json(), allow_nan=False))
    assert first["label"] == "a" and None in first["iou"] and len(first["iou"]) == len(first["azimuths_deg"]) == 12


def test_plots_change_no_settings_of_others() -> None:
    before = dict(matplotlib.rcParams)
    polar.plot_profiles(profiles())
    assert dict(matplotlib.rcParams) == before


def test_training_does_without_the_packages_of_plots(tmp_path) -> None:
    code = "import sys, learn3d.figures.paper; print({'matplotlib', 'sklearn'} & set(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert result.stdout.strip() == "set()"
