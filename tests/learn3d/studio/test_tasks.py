"""Tasks, each in a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import stub_work

from learn3d.studio.tasks import Task, run_tasks

pytestmark = pytest.mark.skipif(os.name != "posix", reason="POSIX signals")


def tasks(folder: Path, *names: str, seconds: float = 0.0) -> list[Task]:
    return [Task(name, stub_work.steps, (folder, name, seconds), folder / f"{name}.log") for name in names]


def finished(folder: Path, *names: str) -> bool:
    """Every step of the tasks was taken, and none twice."""
    wanted = [str(step) for step in range(stub_work.STEPS)]
    return all((folder / f"{name}.txt").read_text().split() == wanted for name in names)


def wait_for(condition: Callable[[], bool], what: str, seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"waited for {what}"
        time.sleep(0.05)


def begun(folder: Path, *names: str) -> bool:
    return all((folder / f"{name}.txt").exists() for name in names)


def test_tasks_of_all_kinds(tmp_path, capsys) -> None:
    no_log = Task("no log", stub_work.steps, (), tmp_path)
    failed = run_tasks([no_log, *tasks(tmp_path, "a", "fails", "dies", "b", "c")], jobs=2)
    assert sorted(failed) == ["dies", "fails", "no log"]
    assert finished(tmp_path, "a", "b", "c")
    said = capsys.readouterr().err
    assert all(text in said for text in ("FAILED no log: [Errno 21]", "error: no such thing", "(ended by SIGKILL)"))
    assert sum(line.startswith("[") for line in said.splitlines()) == 5 and "\n[6/6] " in said


def test_an_interruption_lets_tasks_save_and_the_next_call_goes_on(tmp_path, capsys) -> None:
    def interrupt() -> None:
        wait_for(lambda: begun(tmp_path, "a"), "the task")
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    assert run_tasks(tasks(tmp_path, "a", "b", seconds=0.3)) == []
    assert "saved" in (tmp_path / "a.log").read_text()
    assert not (tmp_path / "b.txt").exists(), "nothing new is started"
    assert capsys.readouterr().err.startswith("stopping:")
    assert run_tasks(tasks(tmp_path, "a", "b")) == []
    assert finished(tmp_path, "a", "b")


def test_tasks_stop_when_their_parent_is_killed(tmp_path) -> None:
    code = f"""
import sys
sys.path[:0] = {sys.path!r}
from pathlib import Path
import stub_work
from learn3d.studio.tasks import Task, run_tasks
folder = Path({str(tmp_path)!r})
run_tasks([Task("a", stub_work.steps, (folder, "a", 0.3), folder / "a.log")])
"""
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL) as parent:
        wait_for(lambda: begun(tmp_path, "a"), "the task")
        parent.kill()
    wait_for(lambda: "saved" in (tmp_path / "a.log").read_text(), "the orphan")
