"""The command lines of training, evaluation and reconstruction, from parsing to files."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest

from learn3d.config import load_config
from learn3d.experiments.evaluation_report import COLUMNS
from learn3d.training import Summary

TOOLS = Path(__file__).parents[2] / "tools"


def tool(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"tool_{name}", TOOLS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def call(module: ModuleType, monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["tool", *map(str, arguments)])
    return module.main()


def test_options_reach_the_configuration(tmp_path) -> None:
    arguments = (
        f"--data d --category chair --output {tmp_path} --preset peng2020-kato-printed --lambda-prior 0.5 "
        "--batch-size 7 --augment flip-image channels --overwrite"
    )
    command = tool("train").parse(arguments.split())
    config = command.config
    assert (config.category, config.preset, config.batch_size) == ("chair", "peng2020-kato-printed", 7)
    assert (config.settings.lambda_prior, config.settings.prior_form) == (0.5, "norm")
    assert config.augment == ("flip-image", "channels")
    assert (command.overwrite, command.resume) == (True, False)
    assert config.iterations == 20_000


@pytest.mark.parametrize("form", ["--output {}", "--output={}"])
def test_resume_starts_from_the_saved_options(finished_run, form: str) -> None:
    arguments = [*form.format(finished_run).split(), "--resume", "--iterations", "9"]
    command = tool("train").parse(arguments)
    assert command.resume
    assert command.config.iterations == 9
    saved = load_config(finished_run / "config.json")
    assert (command.config.data, command.config.batch_size) == (saved.data, saved.batch_size)


@pytest.mark.parametrize("name", ["train", "evaluate", "reconstruct", "make_dataset", "figures", "bench_processes"])
def test_help_keeps_the_examples_apart(name: str, monkeypatch, capsys) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.syspath_prepend(str(TOOLS))
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        tool(name).main()
    lines = capsys.readouterr().out.splitlines()
    examples = [line for line in tool(name).__doc__.splitlines() if " tools/" in line]
    assert examples and [line for line in lines if line in examples] == examples


@pytest.mark.parametrize("name", ["train", "evaluate", "reconstruct"])
def test_help_explains_every_option(name: str, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as stop:
        tool(name).main()
    assert stop.value.code == 0
    out = capsys.readouterr().out
    examples = [line for line in out.splitlines() if "python tools/" in line]
    assert examples == [line for line in tool(name).__doc__.splitlines() if "python tools/" in line]
    text = " ".join(out.split())
    assert f"python tools/{name}.py" in text
    assert {"train": "Images per step", "evaluate": "Run folders", "reconstruct": "turntable GIF"}[name] in text


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("train", ["--data", "{}", "--category", "airplane", "--output", "{}/run"], "02691156_train_images.npz"),
        ("train", ["--output", "{}", "--resume"], "folder of a training run"),
        ("train", ["--resume"], "--resume needs --output: the folder of the run"),
        ("train", ["--out", "{}", "--resume"], "--resume needs --output"),
        ("train", ["--data", "{}/no", "--category", "chair", "--output", "{}/run"], "data set is with --data"),
        ("train", ["--output", "{}", "--preset", "kato"], "there is no preset 'kato'; choose one of peng2020-kato,"),
        ("train", ["--data", "x", "--category", "chair", "--output", "{}", "--resume", "--overwrite"], "folder of a"),
        ("evaluate", ["{}"], "there is no checkpoint"),
        ("reconstruct", ["--run", "{}", "--output", "{}/out"], "give either image files or --dataset"),
    ],
)
def test_mistakes_are_one_clear_line(
    name: str, arguments: list[str], message: str, tmp_path, monkeypatch, capsys
) -> None:
    assert call(tool(name), monkeypatch, *(a.format(tmp_path) for a in arguments)) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert message in error


def test_help_says_what_the_paper_preset_keeps(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["train", "--help"])
    with pytest.raises(SystemExit):
        tool("train").main()
    assert "factor 0.5" in " ".join(capsys.readouterr().out.replace("│", " ").split())


@pytest.mark.parametrize(
    "error",
    [PermissionError(13, "no permission"), OSError(28, "No space left on device"), MemoryError("out of memory")],
)
def test_what_the_disk_refuses_is_one_clear_line(error: OSError, tmp_path, monkeypatch, capsys) -> None:
    def fail(*_, **__):
        raise error

    module = tool("train")
    monkeypatch.setattr(module, "train", fail)
    assert call(module, monkeypatch, "--data", tmp_path, "--category", "chair", "--output", tmp_path) == 1
    assert capsys.readouterr().err == f"error: {error}\n"


def test_the_help_of_evaluate_explains_every_column(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["evaluate", "--help"])
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        tool("evaluate").main()
    lines = capsys.readouterr().out.splitlines()
    for column in COLUMNS.values():
        assert any(line.startswith(f"  {column}: ") and len(line) > len(column) + 30 for line in lines), column


@pytest.mark.parametrize(("best_step", "shown"), [(0, False), (500, True)])
def test_best_iou_is_said_where_there_is_one(best_step: int, shown: bool, tmp_path, monkeypatch, capsys) -> None:
    module = tool("train")
    summary = Summary(tmp_path, 700, False, 0.25 if best_step else -1.0, best_step, 60.0, 600.0)
    monkeypatch.setattr(module, "train", lambda *_, **__: summary)
    assert call(module, monkeypatch, "--data", tmp_path, "--category", "chair", "--output", tmp_path) == 0
    out = capsys.readouterr().out
    assert out.startswith("stopped at step 700 after 1.0 min (10.0 min of training in all); ")
    assert ("best validation IoU 0.2500 at step 500" in out, "IoU" in out) == (shown, shown)
    assert out.endswith(f"everything is in {tmp_path}\n")


def test_resume_with_another_preset_is_refused(finished_run, monkeypatch, capsys) -> None:
    preset = ["--preset", "peng2020-kato-vanilla"]
    assert call(tool("train"), monkeypatch, "--output", finished_run, "--resume", *preset) == 1
    assert "was started with the preset peng2020-kato, got peng2020-kato-vanilla" in capsys.readouterr().err


def test_resume_and_overwrite_exclude_each_other(finished_run, monkeypatch, capsys) -> None:
    assert call(tool("train"), monkeypatch, "--output", finished_run, "--resume", "--overwrite") == 1
    assert "give one of them" in capsys.readouterr().err


def test_evaluate_prints_a_table_and_writes_json(finished_run, tmp_path, monkeypatch, capsys) -> None:
    assert call(tool("evaluate"), monkeypatch, finished_run, "--split", "val", "--json", tmp_path / "t.json") == 0
    report = json.loads((tmp_path / "t.json").read_text())
    assert report["protocol"]["split"] == "val"
    assert f"{report['results'][0]['voxel_iou']:.4f}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        (
            "evaluate",
            ["{run}", "--json", "{tmp}/none/t.json"],
            "there is no folder {tmp}/none; make it, or give another",
        ),
        ("evaluate", ["{run}", "{tmp}/nope"], "there is no checkpoint {tmp}/nope"),
        ("evaluate", ["{run}", "--data", "{tmp}/nope"], "nope: there is no such folder"),
        ("reconstruct", ["--run", "{run}", "--dataset", "{data}", "--output", "{tmp}/file/x"], "file is no folder"),
        ("reconstruct", ["--run", "{run}", "--dataset", "{tmp}/nope", "--output", "{tmp}/x"], "is with --dataset"),
        (
            "reconstruct",
            ["--run", "{run}", "--dataset", "{data}", "--output", "{tmp}/x", "--frames", "0"],
            "frames must",
        ),
        (
            "reconstruct",
            ["--run", "{run}", "--output", "{tmp}/x", "{tmp}/a.png", "--image-size", "0"],
            "image_size must",
        ),
    ],
)
def test_what_cannot_work_is_said_before_a_model_is_loaded(
    name: str, arguments: list[str], message: str, finished_run, tiny_folder, tmp_path, monkeypatch, capsys
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a model is loaded")

    (tmp_path / "file").touch()
    places = {"run": finished_run, "tmp": tmp_path, "data": tiny_folder}
    module = tool(name)
    monkeypatch.setattr("learn3d.runs.checkpoint.load_method", refuse)
    assert call(module, monkeypatch, *(a.format(**places) for a in arguments)) == 1
    out, error = capsys.readouterr()
    assert (out, error.count("\n")) == ("", 1)
    assert error.startswith("error: ") and message.format(**places) in error
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_table_that_cannot_be_written_is_printed(finished_run, tmp_path, monkeypatch, capsys) -> None:
    def refuse(*_: object) -> None:
        raise OSError("the disk is full")

    module = tool("evaluate")
    monkeypatch.setattr(module, "write_json", refuse)
    assert call(module, monkeypatch, finished_run, "--json", tmp_path / "t.json") == 1
    out, error = capsys.readouterr()
    assert out.startswith("class") and error.endswith("error: the disk is full\n")


def test_reconstruct_lists_its_files(finished_run, tiny_folder, tmp_path, monkeypatch, capsys) -> None:
    options = ["--dataset", tiny_folder, "--indices", 0, 7, "--format", "glb", "--frames", 2, "--image-size", 32]
    assert call(tool("reconstruct"), monkeypatch, "--run", finished_run, "--output", tmp_path, *options) == 0
    listed = capsys.readouterr().out.split()
    assert len(listed) == 6
    assert all(Path(path).stat().st_size > 100 for path in listed)


def test_an_interrupt_outside_of_the_loop_is_one_line(tmp_path, monkeypatch, capsys) -> None:
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    module = tool("train")
    monkeypatch.setattr(module, "train", interrupt)
    assert call(module, monkeypatch, "--data", tmp_path, "--category", "chair", "--output", tmp_path) == 130
    assert capsys.readouterr().err == "interrupted; what was saved before is as it was\n"


def test_a_closed_terminal_does_not_change_how_a_run_ended(tmp_path, monkeypatch) -> None:
    module = tool("train")
    monkeypatch.setattr(module, "train", lambda *_, **__: Summary(tmp_path, 3, False, -1.0, 0, 1.0, 1.0))
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w") as terminal:
        monkeypatch.setattr(sys, "stdout", terminal)
        assert call(module, monkeypatch, "--data", tmp_path, "--category", "chair", "--output", tmp_path) == 0


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT to another process")
def test_interrupting_the_command_saves_and_ends_well(tiny_folder, run_folder) -> None:
    command = [sys.executable, str(TOOLS / "train.py"), "--data", str(tiny_folder), "--category", "airplane"]
    command += [
        "--output",
        str(run_folder),
        "--batch-size",
        "2",
        "--preset",
        "peng2020-kato-vanilla",
        "--log-every",
        "1",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120
        metrics = run_folder / "metrics.jsonl"
        while not (metrics.exists() and metrics.stat().st_size) and time.monotonic() < deadline:
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert "stopped by SIGINT" in err
    assert "--resume" in err
    assert out.startswith("stopped at step ")
    assert (run_folder / "last.safetensors").exists()
