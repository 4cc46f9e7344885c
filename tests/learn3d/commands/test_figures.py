"""`learn3d figures` from the command line to files, with the checkpoint of a real short run."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from PIL import Image

from learn3d.figures.runs import name_runs

pytest.importorskip("matplotlib")


@pytest.fixture
def call(command):
    return lambda *words: command("figures", *words)


def test_a_figure_from_a_run_to_a_file(call, finished_run, tmp_path) -> None:
    pytest.importorskip("sklearn")
    code, out, err = call("tsne", "--runs", finished_run, "--output", tmp_path / "out" / "a", "--split", "train")
    assert code == 0, err
    assert out.split() == [str(tmp_path / "out" / f"a.{kind}") for kind in ("png", "svg")]
    with Image.open(tmp_path / "out" / "a.png") as image:
        assert 0.005 < (np.asarray(image.convert("L")) < 200).mean() < 0.7  # something is drawn on white


def test_the_images_of_an_interpolation_can_be_chosen(call, finished_run, tmp_path) -> None:
    options = ("--split", "train", "--indices", 1, 30)
    code, out, err = call("interpolation", "--runs", finished_run, "--output", tmp_path / "i.gif", *options)
    assert (code, out.split()) == (0, [str(tmp_path / "i.png")]), err


def test_wrong_inputs_are_errors_in_one_line(call, finished_run, tmp_path) -> None:
    output = ("--output", tmp_path / "x")
    for arguments, message in (
        (("grid", "--runs"), "at least one run folder or checkpoint"),
        (("tsne", "--truth", "--runs", finished_run), "the figure tsne has no --truth"),
        (("grid", "--runs", tmp_path / "nowhere"), "nowhere"),
        (("grid", "--runs", finished_run, "--labels", "a", "b"), "there are 1 runs but 2 labels"),
        (("grid", "--runs", finished_run, "--images", 0), "has 24 images, 0 were asked for"),
        (("tsne", "--runs", finished_run, "--category", "lamp"), "lamp"),
        (
            ("grid", "--runs", finished_run, "--output", f"{__file__}/grid.png"),
            "give another --output",
        ),
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
