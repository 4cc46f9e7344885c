"""The command lines of training, evaluation and reconstruction, from parsing to files."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from learn3d import commands
from learn3d.commands import packages
from learn3d.commands import train as train_command
from learn3d.commands.train import Train
from learn3d.config import load_config
from learn3d.experiments.measurement import MEASURES
from learn3d.runs.summary import Summary
from learn3d.terminal import INTERRUPTED

TOOLS = Path(__file__).parents[3] / "tools"


PAGES = [(name,) for name in commands.COMMANDS]
PAGES += [("train", "--preset", name) for name in ("proposed", "multi-view", "vpl", "prgan")]


def read(words: str) -> Train:
    return Train.parse("train", words.split())


def test_options_reach_the_configuration(tmp_path) -> None:
    words = f"--data d --category chair --output {tmp_path} --preset proposed --prior-form norm --lambda-prior 0.5 "
    command = read(f"{words} --batch-size 7 --augment flip-image channels --overwrite")
    config = command.config
    assert (config.category, config.preset, config.batch_size) == ("chair", "peng2020-kato", 7)
    assert (config.settings.lambda_prior, config.settings.prior_form) == (0.5, "norm")
    assert config.augment == ("flip-image", "channels")
    assert (command.overwrite, command.resume) == (True, False)
    assert config.iterations == 20_000
    assert read(f"{words} --symmetry auto --clamp-to-cube").config.settings.symmetry == "auto"


@pytest.mark.parametrize(
    ("name", "preset"), [("proposed", "peng2020-kato"), ("vpl", "peng2020-kato-vpl"), ("prgan", "gadelha2017-kato")]
)
def test_methods_have_short_names(name: str, preset: str) -> None:
    assert read(f"--data d --category chair --output o --preset {name}").config.preset == preset


@pytest.mark.parametrize("form", ["--output {}", "--output={}"])
def test_resume_starts_from_the_saved_options(finished_run, form: str) -> None:
    command = read(f"{form.format(finished_run)} --resume --iterations 9")
    assert command.resume
    assert command.config.iterations == 9
    saved = load_config(finished_run / "config.json")
    assert (command.config.data, command.config.batch_size) == (saved.data, saved.batch_size)


def test_the_program_lists_its_commands(command) -> None:
    status, out, _ = command()
    assert status == 0 and all(name in out for name in commands.COMMANDS)
    assert command("--version")[1].strip()


@pytest.mark.parametrize(
    ("words", "near"),
    [
        ("trian", "'train'"),
        ("train --preset plsu", "'plus'"),
        ("train --data x --category y --output z --iteration 3", "--iterations"),
        ("train --data x --category y --output z --no-clamp-to-cub", "--no-clamp-to-cube"),
        ("check-dataset x --moost 3", "--most"),
        ("figures --output x --runs y polr", "polar"),
        ("experiment kaot --data x --output y", "'kato'"),
    ],
)
def test_a_mistyped_name_leads_to_the_right_one(words: str, near: str, command) -> None:
    status, _, said = command(*words.split())
    assert status in (1, 2) and near in said
    assert status == 2 or f"did you mean {near}" in said


@pytest.mark.parametrize("columns", [80, 120])
@pytest.mark.parametrize("words", PAGES, ids=" ".join)
def test_help_is_complete_and_fits(words: tuple[str, ...], columns: int, command, monkeypatch) -> None:
    """Every option has a text, filled to the width; its default is a value that one can type, or explained."""
    monkeypatch.setenv("COLUMNS", str(columns))
    (status, brief, _), (other_status, whole, _) = (command(*words, option) for option in ("--help", "--help-all"))
    assert (status, other_status) == (0, 0)
    assert f"usage: learn3d {words[0]}" in brief
    assert len(brief.splitlines()) <= 60
    for page in (brief, whole):
        lines = [line for line in page.splitlines() if not line.lstrip().startswith(("learn3d", "torchrun", "usage"))]
        assert max(map(len, lines)) <= columns
        text = " ".join(line.strip("│ ") for line in lines)
        assert not [
            word for word in ("None:", "MISSING", "{None}|INT", "(default: )", "(default: False)") if word in text
        ]
    for option in re.findall(r"│ (--[^│]*?)(?=│ -|│\n╰|$)", whole, re.DOTALL):
        name, _, text = " ".join(option.replace("│", " ").split()).partition(" ")
        assert len(text) > 20 and ("(" in text or "--" in text or text[-1] == "."), name


def test_help_all_has_every_option_and_preset(command) -> None:
    brief, whole = (command("train", option, "--preset", "vpl")[1] for option in ("--help", "--help-all"))
    for option in ("--lambda-discriminator", "--augment", "--encoder", "--pictures-every"):
        assert option in whole and option not in brief
    assert "  kato2019-pascal " in whole and "  prgan " in brief and "--help-all" in brief
    assert "Images per training step" in brief and "Images per training step" in whole
    assert "--anti-aliasing, --no-anti-aliasing" in whole


def test_the_help_of_evaluate_explains_every_column(command, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    lines = command("evaluate", "--help")[1].splitlines()
    for column, _ in MEASURES.values():
        assert [line for line in lines if line.startswith(f"  {column} ") and len(line) > len(column) + 30], column


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("train --data {tmp} --category airplane --output {tmp}/run", "02691156_train_images.npz"),
        ("train --output {tmp} --resume", "folder of a training run"),
        ("train --resume", "--resume needs --output: the folder of the run"),
        ("train --out {tmp} --resume", "--resume needs --output"),
        ("train --data {tmp}/no --category chair --output {tmp}/run", "data set is with --data"),
        ("train --output {tmp} --preset kato", "there is no preset 'kato'; "),
        ("train --data x --category chair --output {tmp} --resume --overwrite", "folder of a"),
        ("train --data x --category chair --output {tmp}/run --batch-size 0", "batch_size must be at least 1, got 0"),
        ("make-dataset --output {tmp}/x --category chair", "give either --source"),
        ("train --data {data} --category lamp --output {tmp}/run", "the folder holds: airplane train"),
        ("evaluate {tmp}", "there is no checkpoint"),
        ("evaluate", "give at least one run"),
        ("reconstruct --run {tmp} --output {tmp}/out", "either image files, or --data"),
        (
            "reconstruct a.png --output {tmp}/out --split val --indices 3",
            "leave out what belongs to --data: --split, --indices",
        ),
        ("reconstruct --data {tmp} --output {tmp}/out --no-crop", "leave out what belongs to image files: --crop"),
        ("check-dataset {tmp}/no", "there is no folder"),
        ("experiment kat --data {tmp} --output {tmp}/out", "no table 'kat'; did you mean 'kato'"),
    ],
)
def test_mistakes_are_one_clear_line(words: str, message: str, tiny_folder, tmp_path, command) -> None:
    status, _, said = command(*words.format(tmp=tmp_path, data=tiny_folder).split())
    assert status == 1
    assert said.startswith("error: ") and said.count("\n") == 1
    assert message in said


def test_a_folder_of_another_layout_is_told(tmp_path, command) -> None:
    (tmp_path / "photos" / "chair").mkdir(parents=True)
    (tmp_path / "photos" / "chair" / "poses.csv").write_text("image\n")
    status, _, said = command(
        "train", "--data", tmp_path / "photos", "--category", "chair", "--output", tmp_path / "run"
    )
    assert status == 1 and "--layout photos" in said


def test_a_photograph_without_a_mask_leads_to_the_option(finished_run, tmp_path, command) -> None:
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "a.png")
    words = ("--run", finished_run, "--output", tmp_path / "out", tmp_path / "a.png")
    status, _, said = command("reconstruct", *words)
    assert status == 1 and "--masks" in said


@pytest.mark.parametrize(
    ("package", "name"), [("tyro", "tyro"), ("sklearn", "scikit-learn"), ("plotly", "plotly"), ("gradio", "gradio")]
)
def test_missing_packages_are_named_with_the_command_that_installs_them(package, name, command, monkeypatch) -> None:
    def refuse(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {package!r}", name=package)

    monkeypatch.setattr(commands.importlib, "import_module", refuse)
    status, _, said = command("evaluate")
    assert status == 1 and f"pip install {name}" in said


def test_the_extra_of_a_missing_package_is_named(monkeypatch) -> None:
    requirements = [
        "torch>=2.2",
        'trimesh>=4.4; extra == "data"',
        "plotly-tools; extra == 'x'",
        'plotly>=6; extra == "report"',
    ]
    monkeypatch.setattr(packages.metadata, "requires", lambda _: requirements)
    assert packages.missing_package("plotly").endswith(
        "pip install '.[report]' in a clone, 'FILE.whl[report]' of a wheel"
    )
    for name, extra in (("demo", "demo"), ("evaluate", "train"), ("make-dataset", "data")):
        assert f"pip install '.[{extra}]' in a clone" in packages.missing_package("trimesh", name)
    assert packages.missing_package("gradio").endswith("pip install gradio")


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_an_interrupt_is_one_line_in_every_command(name: str, command, monkeypatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(commands.importlib, "import_module", interrupt)  # where the libraries are imported
    status, out, said = command(name)
    assert (status, out) == (INTERRUPTED, "") and said.startswith("interrupted") and said.count("\n") == 1


@pytest.mark.parametrize(
    "error",
    [PermissionError(13, "no permission"), OSError(28, "No space left on device"), MemoryError("out of memory")],
)
def test_what_the_disk_refuses_is_one_clear_line(error: OSError, tmp_path, monkeypatch, command) -> None:
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(train_command, "train", fail)
    status, _, said = command("train", "--data", tmp_path, "--category", "chair", "--output", tmp_path)
    assert (status, said) == (1, f"error: {error}\n")


@pytest.mark.parametrize(("best_step", "shown"), [(0, False), (500, True)])
def test_best_iou_is_said_where_there_is_one(best_step: int, shown: bool, tmp_path, monkeypatch, command) -> None:
    summary = Summary(tmp_path, 700, False, 0.25 if best_step else -1.0, best_step, 60.0, 600.0)
    monkeypatch.setattr(train_command, "train", lambda *_, **__: summary)
    status, out, _ = command("train", "--data", tmp_path, "--category", "chair", "--output", tmp_path)
    assert status == INTERRUPTED
    assert out.startswith("stopped at step 700 after 1.0 min (10.0 min of training in all); ")
    assert ("best validation IoU 0.2500 at step 500" in out, "IoU" in out) == (shown, shown)
    assert out.endswith(f"everything is in {tmp_path}\n")


def test_resume_with_another_preset_is_refused(finished_run, command) -> None:
    said = command("train", "--output", finished_run, "--resume", "--preset", "vanilla")[2]
    assert "was started with the preset peng2020-kato, got peng2020-kato-vanilla" in said


def test_resume_and_overwrite_exclude_each_other(finished_run, command) -> None:
    status, _, said = command("train", "--output", finished_run, "--resume", "--overwrite")
    assert status == 1 and "give one of them" in said


def test_evaluate_prints_a_table_and_writes_json(finished_run, tmp_path, command) -> None:
    status, out, _ = command("evaluate", finished_run, "--split", "val", "--json", tmp_path / "t.json")
    report = json.loads((tmp_path / "t.json").read_text())
    assert (status, report["protocol"]["split"]) == (0, "val")
    assert f"{report['results'][0]['voxel_iou_kato18']:.4f}" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("evaluate {run} --json {tmp}/none/t.json", "there is no folder {tmp}/none; give another"),
        ("evaluate {run} {tmp}/nope", "there is no checkpoint {tmp}/nope"),
        ("evaluate {run} --data {tmp}/nope", "nope: there is no such folder"),
        (
            "reconstruct --run {run} --data {data} --output {tmp}/file/x",
            "write {tmp}/file/x: {tmp}/file is a file; give another",
        ),
        ("reconstruct --run {run} --data {tmp}/nope --output {tmp}/x", "is with --data"),
        ("reconstruct --run {run} --data {data} --output {tmp}/x --frames 0", "frames must"),
        ("reconstruct --run {run} --output {tmp}/x {tmp}/a.png --image-size 0", "image_size must"),
    ],
)
def test_what_cannot_work_is_said_before_a_model_is_loaded(
    words: str, message: str, finished_run, tiny_folder, tmp_path, monkeypatch, command
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a model is loaded")

    (tmp_path / "file").touch()
    places = {"run": finished_run, "tmp": tmp_path, "data": tiny_folder}
    monkeypatch.setattr("learn3d.runs.checkpoint.load_method", refuse)
    status, out, said = command(*words.format(**places).split())
    assert (status, out, said.count("\n")) == (1, "", 1)
    assert said.startswith("error: ") and message.format(**places) in said
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_table_that_cannot_be_written_is_printed(finished_run, tmp_path, monkeypatch, command) -> None:
    def refuse(*_: object) -> None:
        raise OSError("the disk is full")

    monkeypatch.setattr("learn3d.files.writing.write_json", refuse)
    status, out, said = command("evaluate", finished_run, "--json", tmp_path / "t.json")
    assert status == 1
    assert out.startswith("class") and said.endswith("error: the disk is full\n")


def test_reconstruct_lists_its_files(finished_run, tiny_folder, tmp_path, command) -> None:
    words = ["--run", finished_run, "--output", tmp_path, "--data", tiny_folder, "--indices", 0, 7]
    status, out, _ = command("reconstruct", *words, "--frames", 2, "--image-size", 32)
    listed = [Path(path) for path in out.split()]
    assert (status, len(listed)) == (0, 6) and {path.suffix for path in listed} == {".glb", ".gif", ".png"}
    assert all(path.stat().st_size > 100 for path in listed)


def test_a_closed_terminal_does_not_change_how_a_run_ended(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(train_command, "train", lambda *_, **__: Summary(tmp_path, 3, False, -1.0, 0, 1.0, 1.0))
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w") as terminal:
        monkeypatch.setattr(sys, "stdout", terminal)
        assert read(f"--data {tmp_path} --category chair --output {tmp_path}").run() == INTERRUPTED


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT to another process")
def test_interrupting_the_command_saves_and_says_so(tiny_folder, run_folder) -> None:
    command = [sys.executable, str(TOOLS / "train.py"), "--data", str(tiny_folder), "--category", "airplane"]
    command += ["--output", str(run_folder), "--batch-size", "2", "--log-every", "1", "--preset", "vanilla"]
    command += ["--encoder", "conv-small", "--generator", "sphere-small"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120
        metrics = run_folder / "metrics.jsonl"
        while not (metrics.exists() and metrics.stat().st_size) and time.monotonic() < deadline:
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert process.returncode == INTERRUPTED, err
    assert "stopped by SIGINT" in err
    assert "--resume" in err
    assert out.startswith("stopped at step ")
    assert (run_folder / "last.safetensors").exists()


@pytest.mark.parametrize(("options", "steps"), [("", 100), ("--iterations 60", 6), ("--warmup-steps 9", 9)])
def test_the_warm_up_of_a_preset_is_a_tenth_of_a_short_run(options: str, steps: int) -> None:
    assert read(f"--data d --category chair --output o --preset plus {options}").config.warmup_steps == steps
