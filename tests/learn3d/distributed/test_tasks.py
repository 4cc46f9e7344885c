"""Tasks in processes: on this machine, and on a Dask cluster that loses workers and its head."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import stub_tasks

from learn3d.distributed.tasks import Task, run_tasks

pytestmark = pytest.mark.skipif(os.name != "posix", reason="POSIX signals")


def tasks(folder: Path, *names: str, seconds: float = 0.0) -> list[Task]:
    return [Task(name, stub_tasks.steps, (folder, name, seconds), folder / f"{name}.log") for name in names]


def finished(folder: Path, *names: str) -> bool:
    """Every step of the tasks was taken, and none twice."""
    wanted = [str(step) for step in range(stub_tasks.STEPS)]
    return all((folder / f"{name}.txt").read_text().split() == wanted for name in names)


def wait_for(condition: Callable[[], bool], what: str, seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"waited for {what}"
        time.sleep(0.05)


def begun(folder: Path, *names: str) -> bool:
    return all((folder / f"{name}.txt").exists() for name in names)


def test_tasks_of_all_kinds(tmp_path, capsys) -> None:
    (tmp_path / "c.log").mkdir()
    failed = run_tasks(tasks(tmp_path, "a", "fails", "dies", "b", "c"), jobs=2)
    assert set(failed) == {"fails", "dies", "c"}
    assert "error: no such thing" in failed["fails"]
    assert "(ended by SIGKILL)" in failed["dies"]
    assert "Is a directory" in failed["c"]
    assert finished(tmp_path, "a", "b")
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 5 and said[-1].startswith("[5/5] ")


def test_an_interruption_lets_tasks_save_and_the_next_call_goes_on(tmp_path, capsys) -> None:
    def interrupt() -> None:
        wait_for(lambda: begun(tmp_path, "a"), "the task")
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    assert run_tasks(tasks(tmp_path, "a", "b", seconds=0.3)) == {}
    assert "saved" in (tmp_path / "a.log").read_text()
    assert not (tmp_path / "b.txt").exists(), "nothing new is started"
    assert capsys.readouterr().err.startswith("stopping:")
    assert run_tasks(tasks(tmp_path, "a", "b")) == {}
    assert finished(tmp_path, "a", "b")


def test_tasks_stop_when_their_parent_is_killed(tmp_path) -> None:
    code = f"""
import sys
sys.path[:0] = {sys.path!r}
from pathlib import Path
import stub_tasks
from learn3d.distributed.tasks import Task, run_tasks
folder = Path({str(tmp_path)!r})
run_tasks([Task("a", stub_tasks.steps, (folder, "a", 0.3), folder / "a.log")])
"""
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL) as parent:
        wait_for(lambda: begun(tmp_path, "a"), "the task")
        parent.kill()
    wait_for(lambda: "saved" in (tmp_path / "a.log").read_text(), "the orphan")


class Cluster:
    """A Dask scheduler and workers, as processes of this machine that stand for nodes."""

    def __init__(self, folder: Path) -> None:
        pytest.importorskip("distributed")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address, self.folder = f"tcp://127.0.0.1:{self.port}", folder
        self.processes: list[subprocess.Popen] = []
        self.start_head()

    def _start(self, *words: str) -> subprocess.Popen:
        code = "import sys; from dask.__main__ import main; main()"
        with open(self.folder / "cluster.log", "a") as log:
            process = subprocess.Popen([sys.executable, "-c", code, *words], stdout=log, stderr=log, cwd=self.folder)
        self.processes.append(process)
        return process

    def start_head(self) -> None:
        self.head = self._start("scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")
        wait_for(self._answers, "the scheduler")

    def _answers(self) -> bool:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1):
            return True
        return False

    def start_node(self) -> subprocess.Popen:
        return self._start(
            *("worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "60")
        )

    def end(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    there = Cluster(tmp_path)
    yield there
    there.end()


@pytest.mark.slow
def test_a_cluster_that_loses_a_node_and_wins_one(tmp_path, cluster) -> None:
    """Of two nodes one dies with its task, which the other takes over where it was; a third one joins later."""
    lost, _ = cluster.start_node(), cluster.start_node()
    names = ["a", "b", "c", "d", "e"]

    def change() -> None:
        wait_for(lambda: begun(tmp_path, "a", "b"), "both nodes")
        lost.kill()
        cluster.start_node()

    thread = threading.Thread(target=change)
    thread.start()
    given = [*tasks(tmp_path, *names, seconds=0.3), *tasks(tmp_path, "fails")]
    assert set(run_tasks(given, cluster=cluster.address)) == {"fails"}
    thread.join()
    assert finished(tmp_path, *names)
    logs = [(tmp_path / f"{name}.log").read_text() for name in names]
    assert sum(log.count("pid ") for log in logs) > len(names), "one was begun twice"
    assert any("saved" in log for log in logs), "and the lost node's process saved what it had when it was orphaned"


@pytest.mark.slow
def test_a_cluster_that_loses_its_head(tmp_path, cluster) -> None:
    cluster.start_node()

    def behead() -> None:
        wait_for(lambda: begun(tmp_path, "a"), "the node")
        cluster.head.kill()

    threading.Thread(target=behead).start()
    failed = run_tasks(tasks(tmp_path, "a", "b", seconds=0.3), cluster=cluster.address)
    assert set(failed) == {"a", "b"}
    assert "lost (" in failed["a"] and "tries it again" in failed["a"]
    wait_for(lambda: "saved" in (tmp_path / "a.log").read_text(), "the orphan")
    cluster.start_head()
    cluster.start_node()
    assert run_tasks(tasks(tmp_path, "a", "b"), cluster=cluster.address) == {}
    assert finished(tmp_path, "a", "b")


def test_no_cluster_there(tmp_path) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(OSError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        run_tasks(tasks(tmp_path, "a"), cluster="tcp://127.0.0.1:9")
