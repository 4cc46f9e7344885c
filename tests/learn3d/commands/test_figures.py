"""`learn3d figures` from the command line to files, with the checkpoint of a real short run."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from learn3d.figures import grids
from learn3d.figures.runs import name_runs

pytest.importorskip("matplotlib")


@pytest.fixture
def call(command):
    return lambda *words: command("figures", *words)


def test_all_figures_of_a_run(call, finished_run, tmp_path, monkeypatch) -> None:
    pytest.importorskip("sklearn")
    monkeypatch.setattr(grids, "FRAMES", 4)
    monkeypatch.setattr(grids, "FRAME_SIZE", 32)
    monkeypatch.setattr(grids, "TILE_SIZE", 32)
    code, out, err = call("all", "--runs", finished_run, "--output", tmp_path / "out", "--split", "train")
    assert code == 0, err
    written = [Path(line) for line in out.splitlines()]
    plots = [f"{name}.{kind}" for name in ("curves", "polar", "tsne") for kind in ("png", "svg")]
    names = sorted([*plots, "grid.png", "interpolation.gif", "interpolation.png"])
    assert sorted(path.name for path in written) == names
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names
    for path in written:
        if path.suffix == ".png":
            picture = np.asarray(Image.open(path).convert("L"))
            assert min(picture.shape) > 100
            assert 0.005 < (picture < 200).mean() < 0.7, path  # something is drawn, and the page is not dark
    with Image.open(tmp_path / "out" / "interpolation.gif") as image:
        assert image.n_frames == 12


def test_the_images_of_an_interpolation_can_be_chosen(call, finished_run, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(grids, "FRAMES", 4)
    monkeypatch.setattr(grids, "FRAME_SIZE", 32)
    options = ("--split", "train", "--indices", 1, 30)
    code, out, err = call("interpolation", "--runs", finished_run, "--output", tmp_path / "i.gif", *options)
    assert code == 0, err
    assert out.split() == [str(tmp_path / "i.png"), str(tmp_path / "i.gif")]
    with Image.open(tmp_path / "i.gif") as image:
        assert image.n_frames == 8


def test_seeds_are_one_curve(call, finished_run, tmp_path) -> None:
    folders = []
    for seed in (1, 2):
        folder = tmp_path / f"seed{seed}"
        folder.mkdir()
        shutil.copy(finished_run / "metrics.jsonl", folder)
        config = json.loads((finished_run / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps(config | {"seed": seed}))
        folders.append(folder)
    assert call("curves", "--runs", *folders, "--output", tmp_path / "c.svg")[0] == 0
    assert "Proposed (2 seeds: mean and range)" in (tmp_path / "c.svg").read_text()


def test_wrong_inputs_are_errors_in_one_line(call, finished_run, tmp_path) -> None:
    output = ("--output", tmp_path / "x")
    for arguments, message in (
        (("grid", "--runs"), "at least one run folder or checkpoint"),
        (("curves", "--runs"), "at least one run folder"),
        (("tsne", "--truth", "--runs", finished_run), "the figure tsne has no --truth"),
        (("grid", "--runs", tmp_path / "nowhere"), "nowhere"),
        (("grid", "--runs", finished_run, "--labels", "a", "b"), "there are 1 runs but 2 labels"),
        (("grid", "--runs", finished_run, "--images", 0), "has 24 images, 0 were asked for"),
        (("tsne", "--runs", finished_run, "--category", "lamp"), "lamp"),
        (("curves", "--runs", tmp_path), "metrics.jsonl"),
        (
            ("grid", "--runs", finished_run, "--output", f"{__file__}/grid.png"),
            "give another --output",
        ),
        (("all", "--runs", finished_run, "--output", __file__), "give another --output"),
    ):
        code, out, err = call(arguments[0], *output, *arguments[1:])
        assert (code, out) == (1, ""), arguments
        assert err.splitlines()[-1].startswith("error: ") and message in err, (arguments, err)
    assert list(tmp_path.iterdir()) == []


def test_runs_are_called_by_what_tells_them_apart(tiny_config, tmp_path) -> None:
    proposed, vanilla = tiny_config(tmp_path), tiny_config(tmp_path, preset="peng2020-kato-vanilla")
    second, free = dataclasses.replace(proposed, seed=1), tiny_config(tmp_path, lambda_prior=0.0)
    paths = [tmp_path / "a", tmp_path / "b"]
    assert name_runs([vanilla, proposed], paths) == ["Vanilla-AE", "Proposed"]
    assert name_runs([proposed, second], paths) == ["a", "b"]
    chair = dataclasses.replace(proposed, category="chair")
    assert name_runs([proposed, chair], paths) == ["airplane: Proposed", "chair: Proposed"]
    assert name_runs([proposed, chair], paths, ["x", "y"]) == ["x", "y"]
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "best.safetensors").touch()
    assert name_runs([proposed, free], [tmp_path / "a" / "best.safetensors", tmp_path / "b"]) == ["a/best", "b"]
