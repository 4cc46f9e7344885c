"""Who may work in a run's folder, and which files stay in it."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import learn3d
from learn3d.runs import checkpoint
from learn3d.runs import folder as run_folder
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
    for name in ("last.safetensors", "metrics.jsonl", "pictures/000010.png", "pictures/holiday.jpg", ".x.partial"):
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
    run_folder.remove_old_run(tmp_path, overwrite=True)
    assert files(tmp_path) == ["pictures/holiday.jpg"]
    with pytest.raises(ValueError, match="is not empty; choose another folder, or put the run beside"):
        run_folder.remove_old_run(tmp_path, overwrite=False)
    run_folder.remove_old_run(tmp_path, overwrite=True)
    shutil.rmtree(tmp_path / "pictures")
    (tmp_path / ".config.json.partial").write_text("{")
    run_folder.remove_old_run(tmp_path, overwrite=False)
    assert not files(tmp_path), "half-written files do not make a folder used, and are removed"


@pytest.mark.parametrize("overwrite", [True, False])
def test_what_is_not_a_run_is_not_replaced(tmp_path, overwrite: bool) -> None:
    before = files(make_run(tmp_path, config=False))
    with pytest.raises(ValueError, match=r"has last.safetensors, but no run that it could belong to; choose another"):
        run_folder.remove_old_run(tmp_path, overwrite)
    assert files(tmp_path) == before


@pytest.mark.parametrize("removals", range(4))
def test_a_kill_while_a_run_is_replaced_leaves_a_run_that_begins_anew(tmp_path, monkeypatch, removals: int) -> None:
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
def test_the_command_to_continue_is_the_one_that_ran(tmp_path, monkeypatch, started: str, program: list[str]) -> None:
    monkeypatch.setattr(sys, "argv", [started])
    words = shlex.split(run_folder.resume_command(tmp_path / "my runs" / "it's"))
    assert words == [*program, "--output", str(tmp_path / "my runs" / "it's"), "--resume"]
