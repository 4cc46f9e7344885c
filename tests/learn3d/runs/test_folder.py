"""Who may work in a run's folder, and which checkpoints stay in it."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from runs import metadata

import learn3d
from learn3d.files import writing
from learn3d.runs import checkpoint
from learn3d.runs import folder as run_folder

HOLDER = """
import sys, time
from pathlib import Path
from learn3d.runs.folder import lock_folder
with lock_folder(Path(sys.argv[1])):
    print("mine", flush=True)
    time.sleep(60)
"""


def save(folder: Path, step: int, keep: int) -> None:
    before = (folder / "last.safetensors").exists()
    run_folder.keep_previous(folder)
    assert (folder / "last.safetensors").exists() == before, "it is there at every moment"
    checkpoint.save(folder / "last.safetensors", {"x": torch.full((3,), float(step))}, metadata(step))
    run_folder.remove_old(folder, step, keep)


def steps(folder: Path) -> list[int]:
    return [checkpoint.load_metadata(path).progress.step for path in run_folder.checkpoints(folder)]


def test_a_folder_in_use_is_refused_and_a_killed_process_does_not_hold_it(tmp_path) -> None:
    folder = tmp_path / "run"
    path = [str(Path(learn3d.__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path)}
    command = [sys.executable, "-c", HOLDER, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, cwd=tmp_path) as holder:
        assert holder.stdout.readline() == b"mine\n"
        with pytest.raises(OSError, match=r"another process works in .*run; wait for it, or stop it"):
            with run_folder.lock_folder(folder):
                pass
        holder.send_signal(signal.SIGKILL)
        holder.wait(timeout=30)
    assert (folder / ".lock").exists()
    with run_folder.lock_folder(folder):
        run_folder.remove_old_run(folder, overwrite=False)
    assert not (folder / ".lock").exists()


def test_a_folder_that_was_made_for_nothing_is_removed(tmp_path) -> None:
    with pytest.raises(ValueError, match="no data"), run_folder.lock_folder(tmp_path / "run"):
        raise ValueError("no data")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("keep", "kept"), [(1, [50]), (2, [50, 40]), (3, [50, 40, 30])])
def test_the_last_ones_are_kept(tmp_path, keep: int, kept: list[int]) -> None:
    for step in (10, 20, 30, 40, 50):
        save(tmp_path, step, keep)
    assert steps(tmp_path) == kept
    names = [path.name for path in run_folder.checkpoints(tmp_path)]
    assert names == ["last.safetensors", *(f"step-{step:06}.safetensors" for step in kept[1:])]


def test_a_file_system_without_hard_links(tmp_path, monkeypatch) -> None:
    def no_links(*arguments) -> None:
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", no_links)
    for step in (10, 20):
        save(tmp_path, step, keep=2)
    assert steps(tmp_path) == [20, 10]


def test_saving_again_where_a_kill_left_both_names(tmp_path) -> None:
    save(tmp_path, 10, keep=2)
    run_folder.keep_previous(tmp_path)  # killed here: two names for one file
    assert steps(tmp_path) == [10, 10]
    save(tmp_path, 20, keep=2)
    assert steps(tmp_path) == [20, 10]
    assert not list(tmp_path.rglob("*.partial"))


def test_a_damaged_last_checkpoint_is_not_kept(tmp_path) -> None:
    save(tmp_path, 10, keep=2)
    save(tmp_path, 20, keep=2)
    (tmp_path / "last.safetensors").write_bytes(b"rubbish")
    save(tmp_path, 30, keep=2)
    assert steps(tmp_path) == [30, 10]


def test_overwriting_leaves_what_is_not_of_a_run(tmp_path) -> None:
    for step in (10, 20):
        save(tmp_path, step, keep=2)
    mine = [tmp_path / "notes.txt", tmp_path / "checkpoints" / "copy-of-step-10.safetensors"]
    for path in mine:
        path.write_text("mine")
    run_folder.remove_old_run(tmp_path, overwrite=True)
    assert sorted(path for path in tmp_path.rglob("*") if path.is_file()) == sorted(mine)


def test_a_kill_while_a_run_is_replaced_leaves_nothing_to_continue(tmp_path, monkeypatch) -> None:
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "config.json").write_text("{}")
    for step in (1, 2):
        save(tmp_path, step, keep=2)
    remove, removed = Path.unlink, []

    def killed(path, **options):
        if removed:
            raise KeyboardInterrupt
        removed.append(path.name)
        remove(path, **options)

    monkeypatch.setattr(Path, "unlink", killed)
    with pytest.raises(KeyboardInterrupt):
        run_folder.remove_old_run(tmp_path, overwrite=True)
    assert removed == ["config.json"], "without it --resume finds no run"
    monkeypatch.undo()
    run_folder.remove_old_run(tmp_path, overwrite=True)
    assert not list(tmp_path.iterdir()), "what is left is still known as a run's, and can be replaced"


def test_what_is_not_a_run_is_not_replaced(tmp_path) -> None:
    mine = ("pictures/holiday.jpg", "checkpoints/step-000001.safetensors", "config.json", "journal.txt")
    for name in mine:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(ValueError, match=r"has config.json, but no run that it could belong to; choose another"):
            run_folder.remove_old_run(tmp_path, overwrite)
    assert all((tmp_path / name).read_text() == "mine" for name in mine)


def test_a_run_beside_other_files(tmp_path) -> None:
    (tmp_path / "pictures").mkdir()
    for name in ("log.txt", "pictures/holiday.jpg"):
        (tmp_path / name).write_text("mine")
    with pytest.raises(ValueError, match="is not empty; choose another folder, or put the run beside"):
        run_folder.remove_old_run(tmp_path, overwrite=False)
    run_folder.remove_old_run(tmp_path, overwrite=True)
    assert all((tmp_path / name).read_text() == "mine" for name in ("log.txt", "pictures/holiday.jpg"))


@pytest.mark.parametrize(
    ("started", "program"),
    [("tools/train.py", ["python", "tools/train.py"]), ("/usr/bin/learn3d", ["learn3d", "train"])],
)
def test_the_command_to_continue_is_the_one_that_ran(tmp_path, monkeypatch, started: str, program: list[str]) -> None:
    monkeypatch.setattr(sys, "argv", [started])
    words = shlex.split(run_folder.resume_command(tmp_path / "my runs" / "it's"))
    assert words == [*program, "--output", str(tmp_path / "my runs" / "it's"), "--resume"]


def test_half_written_files_do_not_make_a_folder_used_and_are_removed(tmp_path) -> None:
    (tmp_path / ".config.json.partial").write_text("{")
    run_folder.remove_old_run(tmp_path, overwrite=False)
    assert not list(tmp_path.iterdir())
    writing.write_bytes(tmp_path / "x", b"")
    with pytest.raises(ValueError, match="is not empty"):
        run_folder.remove_old_run(tmp_path, overwrite=False)
