"""The folder of a run and its log."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from children import environment

from learn3d.runs import checkpoint
from learn3d.runs import folder as run_folder
from learn3d.runs.log import RunLog
from learn3d.training import train

HOLDER = """
import sys, time
from pathlib import Path
from learn3d.runs.folder import lock_folder
with lock_folder(Path(sys.argv[1])):
    print("mine", flush=True)
    time.sleep(60)
"""


def test_a_folder_in_use_is_refused_and_a_killed_process_does_not_hold_it(tmp_path) -> None:
    folder = tmp_path / "run"
    command = [sys.executable, "-c", HOLDER, str(folder)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, env=environment(), cwd=tmp_path
    ) as holder:
        assert holder.stdout.readline() == b"mine\n"
        with pytest.raises(
            OSError, match=r"another process works in .*run; wait for it, or stop it"
        ):
            with run_folder.lock_folder(folder):
                pass
        holder.send_signal(signal.SIGKILL)
        holder.wait(timeout=30)
    assert (folder / ".lock").exists()
    with run_folder.lock_folder(folder):
        run_folder.remove_old_run(folder, overwrite=False)
    assert not (folder / ".lock").exists()


@pytest.mark.parametrize("name", ["pictures", "tensorboard", "metrics.jsonl"])
def test_a_run_folder_with_links_is_refused(tmp_path, name: str) -> None:
    """A run writes there, and --overwrite removes files."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match=rf"{name} is a link; a run writes to its own folder only"):
        with run_folder.lock_folder(tmp_path / "run"):
            pass
    assert [path.name for path in (tmp_path / "run").iterdir()] == [name]


@pytest.mark.parametrize("links", [True, False])
def test_the_last_two_checkpoints_are_kept(tiny_run, tmp_path, monkeypatch, links: bool) -> None:
    def no_links(*_: object) -> None:
        raise OSError(1, "Operation not permitted")

    if not links:  # a file system without hard links
        monkeypatch.setattr(os, "link", no_links)
    train(tiny_run(tmp_path))
    found = run_folder.checkpoints(tmp_path)
    assert [path.name for path in found] == ["last.safetensors", "previous.safetensors"]
    assert [checkpoint.load(path)[1].progress.step for path in found] == [6, 4]


def make_run(folder: Path, config: bool = True) -> Path:
    """The files of a run, and one of the user's."""
    names = ("last.safetensors", "metrics.jsonl", "pictures/000010.png", "pictures/holiday.jpg")
    for name in (*names, ".x.partial"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(name)
    if config:
        (folder / "config.json").write_text("{}")
    return folder


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_a_run_is_replaced_only_when_asked_and_other_files_stay(tmp_path) -> None:
    make_run(tmp_path)
    with pytest.raises(ValueError, match=r"has a run; continue it \(--resume\), replace it"):
        run_folder.remove_old_run(tmp_path, overwrite=False)
    (tmp_path / "last.safetensors").unlink()
    with pytest.raises(ValueError, match=r"has a run; replace it"):
        run_folder.remove_old_run(tmp_path, overwrite=False)
    run_folder.remove_old_run(tmp_path, overwrite=True)
    assert files(tmp_path) == ["pictures/holiday.jpg"]
    with pytest.raises(
        ValueError, match="is not empty; choose another folder, or add the run to the files there"
    ):
        run_folder.remove_old_run(tmp_path, overwrite=False)
    run_folder.remove_old_run(tmp_path, overwrite=True)
    shutil.rmtree(tmp_path / "pictures")
    (tmp_path / ".config.json.partial").write_text("{")
    run_folder.remove_old_run(tmp_path, overwrite=False)
    assert not files(tmp_path), "half-written files do not make a folder used, and are removed"


@pytest.mark.parametrize("overwrite", [True, False])
def test_what_is_not_a_run_is_not_replaced(tmp_path, overwrite: bool) -> None:
    before = files(make_run(tmp_path, config=False))
    with pytest.raises(
        ValueError,
        match=r"has last.safetensors, but no run that it could belong to; choose another",
    ):
        run_folder.remove_old_run(tmp_path, overwrite)
    assert files(tmp_path) == before


@pytest.mark.parametrize("removals", range(4))
def test_a_kill_while_a_run_is_replaced_leaves_a_run_that_begins_anew(
    tmp_path, monkeypatch, removals: int
) -> None:
    make_run(tmp_path)
    unlink, removed = Path.unlink, []

    def killed(path, **options):
        if len(removed) == removals:
            raise KeyboardInterrupt
        removed.append(path.name)
        unlink(path, **options)

    monkeypatch.setattr(Path, "unlink", killed)
    with pytest.raises(KeyboardInterrupt):
        run_folder.remove_old_run(tmp_path, overwrite=True)
    assert run_folder.is_run(tmp_path) == (removals < 4)
    assert not removals or not run_folder.checkpoints(tmp_path), "checkpoints go first"
    monkeypatch.undo()
    run_folder.remove_old_run(tmp_path, overwrite=True)
    assert files(tmp_path) == ["pictures/holiday.jpg"]


@pytest.mark.parametrize(
    ("started", "program"),
    [("tools/train.py", ["python", "tools/train.py"]), ("/usr/bin/learn3d", ["learn3d", "train"])],
)
def test_the_command_to_continue_is_the_one_that_ran(
    tmp_path, monkeypatch, started: str, program: list[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [started])
    words = shlex.split(run_folder.resume_command(tmp_path / "my runs" / "it's"))
    assert words == [*program, "--output", str(tmp_path / "my runs" / "it's"), "--resume"]


def test_a_link_is_replaced_and_a_pipe_refused(tmp_path, tiny_config) -> None:
    """A run folder may be a stranger's: a pipe would be waited for, and a link leads to a file of the user's."""
    path, other = tmp_path / "run" / "metrics.jsonl", tmp_path / "other"
    path.parent.mkdir()
    other.write_text("mine")
    path.symlink_to(other)
    with RunLog(tiny_config(path.parent, iterations=10), start=0) as log:
        log.metrics(1, "train", {"total": 0.5})
    assert other.read_text() == "mine" and not path.is_symlink() and path.stat().st_size
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(OSError, match=r"metrics.jsonl is not a regular file"):
        RunLog(tiny_config(path.parent, iterations=10), start=0)


def test_elsewhere_it_prints_few_lines_with_means_of_losses_that_take_turns(
    tmp_path, tiny_config, capsys
) -> None:
    with RunLog(tiny_config(tmp_path, iterations=100), start=4) as log:
        odd, even = {"total": 3.0, "classification": 2.0}, {"total": 1.0, "confusion": 1.0}
        for step in range(5, 101):
            log.step(step, odd if step % 2 else even)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert lines[0] == "step 5/100  total 3  classification 2"
    assert lines[1].startswith("step 100/100  total 2  classification 2  confusion 1 ")
    assert lines[1].endswith("0:00:00 left")


@pytest.mark.parametrize("damaged", ["", '{"step": 1, "spl', "{}\n", "[" * 100_000, "\xff\n"])
def test_metrics_can_be_read_back_and_later_or_damaged_ones_are_dropped(
    tmp_path, tiny_config, read_metrics, damaged: str
) -> None:
    for start in (0, 1):
        with RunLog(tiny_config(tmp_path, iterations=9), start=start) as log:
            log.metrics(start + 1, "train", {"total": 0.5 + start})
            log.metrics(start + 2, "val", {"voxel_iou": 0.25})
            log.picture(start + 2, "val", np.zeros((4, 4, 3), np.uint8))
        with open(tmp_path / "metrics.jsonl", "a", encoding="latin-1") as file:
            file.write(damaged)
    with RunLog(tiny_config(tmp_path, iterations=9), start=3):
        pass
    one, two, three = read_metrics(tmp_path)
    assert [m["split"] for m in (one, two, three)] == ["train", "train", "val"]
    assert (one["step"], two["step"], three["step"], two["total"]) == (1, 2, 3, 1.5)


@pytest.mark.usefixtures("tiny_names")
def test_wandb_is_one_run_with_the_options_numbers_and_pictures(
    tiny_run, run_folder, monkeypatch
) -> None:
    started, shown, finished = [], [], []
    run = types.SimpleNamespace(
        log=lambda values, step: shown.append((step, values)), finish=lambda: finished.append(1)
    )
    fake = types.ModuleType("wandb")
    fake.init = lambda **options: started.append(options) or run
    fake.Image, fake.Error = lambda rgb: rgb.shape, RuntimeError
    fake.__spec__ = types.SimpleNamespace()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    for steps in (2, 4):
        assert train(tiny_run(run_folder, log="wandb", iterations=steps), resume=steps > 2).finished
    assert len(finished) == 2 and started[0]["id"] == started[1]["id"]
    assert started[1]["resume"] == "allow"
    assert started[0]["config"]["batch_size"] == 2 and started[0]["name"] == "run"
    assert [step for step, values in shown if "train/total" in values] == [1, 2, 3, 4]
    assert [(step, values["val"][2]) for step, values in shown if "val" in values] == [
        (2, 3),
        (4, 3),
    ]
    fake.init = lambda **options: (_ for _ in ()).throw(RuntimeError("no API key"))
    with pytest.raises(
        ValueError, match=r"log 'wandb' cannot begin a run \(no API key\); call `wandb login`, or"
    ):
        train(tiny_run(run_folder, log="wandb", iterations=6), resume=True)


def test_wandb_that_is_not_installed_is_an_error_before_anything_is_written(
    tiny_run, run_folder, monkeypatch
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(
        ValueError, match="log 'wandb' needs the package wandb: pip install wandb, or choose"
    ):
        train(tiny_run(run_folder, log="wandb"))
    assert not run_folder.exists()
