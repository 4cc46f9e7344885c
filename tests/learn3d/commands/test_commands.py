"""The command lines, from parsing to files."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from children import environment
from PIL import Image, ImageDraw

from learn3d import commands
from learn3d.commands import train as train_command
from learn3d.commands.train import Train
from learn3d.presets import PRESETS, load_config
from learn3d.runs.checkpoint import Progress
from learn3d.runs.measurement import MEASURES
from learn3d.runs.run import Summary
from learn3d.studio.shapes import numbered_shape
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
    ("options", "steps"), [("", 100), ("--iterations 60", 6), ("--warmup-steps 9", 9)]
)
def test_the_warm_up_is_at_most_a_tenth_of_a_run(options: str, steps: int) -> None:
    command = read(f"--data d --category chair --output o --preset plus {options}")
    assert command.config.schedule.warmup_steps == steps


@pytest.mark.parametrize("form", ["--output {}", "--output={}"])
def test_resume_starts_from_the_saved_options(finished_run, form: str) -> None:
    command = read(f"{form.format(finished_run)} --resume --iterations 9")
    saved = load_config(finished_run / "config.json")
    assert (command.resume, command.config.iterations) == (True, 9)
    assert (command.config.data, command.config.batch_size) == (saved.data, saved.batch_size)
    assert command.config.settings == saved.settings


def test_the_program_lists_its_commands(command) -> None:
    status, out, _ = command()
    assert status == 0 and all(name in out for name in commands.COMMANDS)
    assert command("--version")[1].strip()


def test_tab_completes_commands_options_and_values_in_bash(command, tmp_path) -> None:
    status, script, _ = command("--completion", "bash")
    assert status == 0 and command("--completion", "fish")[0] == 1
    (tmp_path / "learn3d").write_text(script)
    ask = 'source ./learn3d; COMP_WORDS=($0 "$@"); COMP_CWORD=$#; '
    ask += "$(complete -p learn3d | sed 's/.*-F //; s/ .*//')"
    for words, wanted in {
        ("rec",): "reconstruct",
        ("train", "--log", ""): "tensorboard wandb",
        ("evaluate", "--cat"): "--category",
    }.items():
        bash = ["bash", "-c", f"{ask}; echo ${{COMPREPLY[*]}}", "learn3d", *words]
        done = subprocess.run(bash, cwd=tmp_path, capture_output=True, text=True)
        assert done.stdout.strip() == wanted


@pytest.mark.parametrize(
    ("words", "near"),
    [
        ("trian", "'train'"),
        ("train --preset plsu", "'plus'"),
        ("train --data x --category y --output z --iteration 3", "--iterations"),
        ("train --data x --category y --output z --no-clamp-to-cub", "--no-clamp-to-cube"),
        ("check-dataset x --jsno y", "--json"),
        ("figures --output x --runs y tsn", "tsne"),
        ("experiment kaot --data x --output y", "'kato'"),
    ],
)
def test_a_mistyped_name_leads_to_the_right_one(words: str, near: str, command) -> None:
    status, _, said = command(*words.split())
    assert status in (1, 2) and near in said
    assert status == 2 or f"did you mean {near}" in said


PLUS = "train --data x --category chair --output y --preset plus --bank-size 2"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (f"{PLUS} --batch-size 0", "batch_size must be greater than or equal to 1, got 0"),
        (f"{PLUS} --learning-rate -1", "learning_rate must be greater than 0, got -1.0"),
        (f"{PLUS} --batch-size 3", "batch_size must lie in 2 .. 2, got 3"),
        ("convert-dataset --data x --output y --image-size 0", "image_size must be greater"),
        ("convert-dataset --data x --output y --views-per-object 0", "views_per_object must be"),
        ("reconstruct x --output y --guesses 0", "guesses must be greater than or equal to 1"),
        ("figures grid --runs x --output y --images 0", "images must be greater than or equal"),
        ("report x --output y --objects -1", "objects must be greater than or equal to 1, got -1"),
        ("experiment kato --data x --output y --threads 0", "threads must be greater than"),
    ],
)
def test_a_refused_value_is_named(words: str, said: str, command) -> None:
    status, _, text = command(*words.split())
    assert status == 2 and said in " ".join(text.replace("│", " ").split())


@pytest.mark.parametrize("words", PAGES, ids=" ".join)
def test_help_is_complete_and_fits(words: tuple[str, ...], command, monkeypatch) -> None:
    """Every option has a text, and the page fits into the width."""
    monkeypatch.setenv("COLUMNS", "80")
    status, page, _ = command(*words, "--help")
    assert status == 0
    assert f"usage: learn3d {words[0]}" in page
    assert max(map(len, page[page.index(" options ") :].splitlines())) <= 80
    assert "MISSING" not in page
    options = re.split(r"\n[│ ] (?=--\w)", re.sub("[│╰─╯]", " ", page))[1:]
    assert len(options) >= 2
    for option in options:
        name, _, text = " ".join(option.split()).partition(" ")
        assert len(text) > 20 and re.search(r"[.)]( [\w.]+ options.*)?$", text), name


def test_help_names_presets_their_settings_and_columns(command, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "250")  # wider than the source, whose line breaks are gone
    page = command("train", "--help", "--preset", "vpl")[1]
    assert [name for name in PRESETS if f"\n  {name} " not in page] == []
    assert (
        "Weight of the adversarial loss on the shapes (lambda_D); the discriminator's own" in page
    )
    assert "(default: peng2020-kato-vpl)" in page
    page = command("evaluate", "--help")[1]
    assert [
        c for c, _ in MEASURES.values() if not re.search(rf"\n  {re.escape(c)} .{{30}}", page)
    ] == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("train --data {tmp} --category airplane --output {tmp}/run", "02691156_train_images.npz"),
        ("train --output {tmp} --resume", "to start a new run, leave out --resume"),
        ("train --out {tmp} --resume", "--resume needs --output: the folder of the run"),
        (
            "train --data {tmp}/no --category chair --output {tmp}/run",
            "no: there is no such folder",
        ),
        (
            "train --output {run} --resume --preset vanilla",
            "with the preset peng2020-kato, got peng2020-kato-vanilla",
        ),
        ("train --output {run} --resume --overwrite", "give one of them"),
        (
            "train --data {data} --category lamp --output {tmp}/run",
            "03636649_train_images.npz: is missing",
        ),
        ("check-dataset {tmp}/no", "there is no such folder"),
        (
            "convert-dataset --data {data} --output {tmp}/x --image-size 128",
            "images of the layout 'kato' have 64x64 pixels, but 128 are wanted",
        ),
        (
            "estimate-poses {data} --category airplane --output {tmp}/poses.png",
            "--output must end in .npz, got {tmp}/poses.png",
        ),
        ("make-dataset --output {tmp}/file --category chair --procedural 3", "cannot write"),
        ("experiment kato --data {data} --output {tmp}/file", "cannot write {tmp}/file"),
        (
            "experiment kato --data {data} --output {tmp}/x --category airplane,car",
            "has no car; in the layout 'kato' it has airplane; give --category",
        ),
        ("evaluate", "give at least one run"),
        ("evaluate {run} {tmp}/nope", "there is no checkpoint {tmp}/nope"),
        (
            "evaluate {run} --json {tmp}/none/t.json",
            "cannot write {tmp}/none/t.json: No such file or directory; give another",
        ),
        ("evaluate {run} --data {tmp}/nope", "nope: there is no such folder"),
        ("reconstruct --run {run} --output {tmp}/out", "either image files, or --data"),
        (
            "reconstruct a.png --output {tmp}/out --split val --indices 3",
            "--split, --indices does not go with image",
        ),
        ("reconstruct --data {tmp} --output {tmp}/out --no-crop", "--crop does not go with --data"),
        (
            "reconstruct a.png --output {tmp}/out --smooth --category car --guesses 3",
            "--category, --guesses does not go with --smooth",
        ),
        (
            "reconstruct a.png --output {tmp}/out --checkpoint best",
            "--checkpoint chooses one of a run's checkpoints; give --run, too",
        ),
        (
            "reconstruct --run {run} --data {data} --output {tmp}/file/x",
            "cannot write {tmp}/file/x: Not a directory; give another",
        ),
        (
            "reconstruct --run {run} --data {tmp}/nope --output {tmp}/x",
            "nope: there is no such folder",
        ),
    ],
)
def test_mistakes_are_one_clear_line_before_a_model_is_loaded(
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
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["file"]


@pytest.mark.parametrize(
    ("error", "said", "status"),
    [
        (
            ModuleNotFoundError("no", name="plotly"),
            "report needs the package plotly,.*pip install '.\\[report\\]'",
            1,
        ),
        (
            MemoryError("out of memory"),
            r"error: there is too little memory; .*\(out of memory\)",
            1,
        ),
        (KeyboardInterrupt(), "interrupted", INTERRUPTED),
    ],
)
def test_errors_while_libraries_are_imported_are_one_line(
    error, said: str, status: int, command, monkeypatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(commands.importlib, "import_module", fail)
    found, out, text = command("report")
    assert (found, out, text.count("\n")) == (status, "", 1) and re.search(said, text)


def test_without_any_extra_help_is_there_and_a_command_names_the_extra() -> None:
    """Only what `pip install .` brings: the standard library, torch, numpy and earcut."""
    script = """
import sys
for name in "tqdm tyro trimesh skimage imageio PIL scipy pydantic safetensors tensorboard filelock jinja2".split():
    sys.modules[name] = None
from learn3d.commands import main
assert main("--help") == 0
sys.exit(main("train"))
"""
    ended = subprocess.run(
        [sys.executable, "-c", script], env=environment(), capture_output=True, text=True
    )
    assert ended.returncode == 1 and ended.stdout.startswith("usage: learn3d COMMAND")
    wanted = r"error: learn3d train needs the package \w+, .*pip install '.\[train\]'.*\n"
    assert re.fullmatch(wanted, ended.stderr), ended.stderr


@pytest.mark.parametrize(("best_step", "shown"), [(0, False), (500, True)])
def test_best_iou_is_said_if_there_is_one(
    best_step: int, shown: bool, tmp_path, monkeypatch, command
) -> None:
    progress = Progress(700, 0.25 if best_step else -1.0, best_step, 600.0)
    summary = Summary(tmp_path, progress, False, 60.0)
    monkeypatch.setattr(train_command, "train", lambda *_, **__: summary)
    status, out, _ = command(
        "train", "--data", tmp_path, "--category", "chair", "--output", tmp_path
    )
    assert status == INTERRUPTED
    assert out.startswith("stopped at step 700 after 1.0 min (10.0 min of training in all); ")
    assert ("best validation IoU 0.2500 at step 500" in out, "IoU" in out) == (shown, shown)
    assert out.endswith(f"everything is in {tmp_path}\n")


def test_evaluate_prints_a_table_and_writes_json(
    finished_run, tmp_path, command, monkeypatch
) -> None:
    words = ("evaluate", finished_run, "--split", "val", "--json", tmp_path / "t.json")
    status, out, _ = command(*words)
    report = json.loads((tmp_path / "t.json").read_text())
    assert (status, report["protocol"]["split"]) == (0, "val")
    assert f"{report['results'][0]['voxel_iou']:.4f}" in out

    def refuse(*_: object) -> None:
        raise OSError("the disk is full")

    monkeypatch.setattr("learn3d.commands.train.write_json", refuse)
    assert command(*words)[:2] == (1, out), "the table is not lost"


def test_what_is_measured_is_not_lost_if_a_later_category_fails(
    finished_run, tmp_path, command
) -> None:
    words = ("evaluate", finished_run, "--json", tmp_path / "t.json", "--category")
    status, out, err = command(*words, "airplane,rocket")
    assert (status, "airplane" in out, "rocket" in err) == (1, True, True)
    assert len(json.loads((tmp_path / "t.json").read_text())["results"]) == 1
    status, out, err = command(*words, ",")
    assert (status, out) == (1, "") and "a category must be a name" in err


def test_the_fit_of_pictures_is_measured(tmp_path, capsys) -> None:
    (tmp_path / "airplane").mkdir()
    numbered_shape("airplane", 1, 0).export(tmp_path / "airplane" / "plane.ply")
    runpy.run_path(str(TOOLS / "measure_fit.py"))["main"](tmp_path, "airplane", images=2)
    assert len(capsys.readouterr().out.splitlines()[1].split()) == 10


def test_likenesses_are_measured(tmp_path, capsys) -> None:
    circle = Image.new("RGBA", (80, 80))
    ImageDraw.Draw(circle).ellipse((10, 10, 70, 70), (200, 40, 40, 255))
    circle.save(tmp_path / "disc.png")
    main = runpy.run_path(str(TOOLS / "measure_likeness.py"))["main"]
    main(tmp_path, sheet=tmp_path / "sheet.png")
    one, mean, *_ = capsys.readouterr().out.splitlines()
    assert float(one.split()[1]) > 0.8 and mean.startswith("1 pictures: outline 0.")
    assert (tmp_path / "sheet.png").is_file()
