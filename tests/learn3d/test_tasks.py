"""Tasks, each in a process of its own, on this machine and on the workers of a Dask cluster."""

from __future__ import annotations

import os
import runpy
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import stub_steps
from children import wait_until
from dask_cluster import dask_cluster

from learn3d import tasks
from learn3d.tasks import Task, Workers, _check_versions, run_tasks

pytestmark = pytest.mark.skipif(os.name != "posix", reason="POSIX signals")


@pytest.fixture(params=["here", "cluster"])
def workers(request) -> Workers:
    return request.getfixturevalue("cluster") if request.param == "cluster" else Workers(jobs=2)


def steps(folder: Path, *names: str, seconds: float = 0.0) -> list[Task]:
    return [
        Task(name, stub_steps.steps, (folder, name, seconds), folder / f"{name}.log")
        for name in names
    ]


def finished(folder: Path, *names: str) -> bool:
    """Every step of the tasks was taken, and none twice."""
    wanted = [str(step) for step in range(stub_steps.STEPS)]
    return all((folder / f"{name}.txt").read_text().split() == wanted for name in names)


def begun(folder: Path, *names: str) -> bool:
    return all((folder / f"{name}.txt").exists() for name in names)


def test_tasks_of_all_kinds(workers, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(tasks, "RESTARTS", 1)
    no_log = Task("no log", stub_steps.steps, (), tmp_path)
    failed = run_tasks([no_log, *steps(tmp_path, "a", "fails", "dies", "b", "c")], workers)
    assert sorted(failed) == ["dies", "fails", "no log"]
    assert finished(tmp_path, "a", "b", "c")
    said = capsys.readouterr().err
    assert all(text in said for text in ("FAILED no log;", "[Errno 21]", "error: no such thing"))
    assert said.count("dies is started again: (ended by SIGKILL)") == 1
    assert said.count("/6] ") == 6 and "\n[6/6] " in said


def test_an_interruption_lets_tasks_save_and_the_next_call_goes_on(
    workers, tmp_path, capsys
) -> None:
    def interrupt() -> None:
        wait_until(lambda: begun(tmp_path, "a"))
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    assert run_tasks(steps(tmp_path, "a", "b", "c", seconds=1), workers) == []
    assert "saved" in (tmp_path / "a.log").read_text()
    assert not (tmp_path / "c.txt").exists(), "nothing new is started"
    assert capsys.readouterr().err.startswith("stopping:")
    assert run_tasks(steps(tmp_path, "a", "b", "c"), workers) == []
    assert finished(tmp_path, "a", "b", "c")


def test_a_task_goes_on_when_its_worker_is_killed(cluster, tmp_path, capsys) -> None:
    def kill() -> None:
        wait_until(lambda: begun(tmp_path, "a"))
        worker = (tmp_path / "a.log").read_text().split(" of ")[1].split()[0]
        os.kill(int(worker), signal.SIGKILL)

    threading.Thread(target=kill).start()
    assert run_tasks(steps(tmp_path, "a", "b", seconds=1), cluster) == []
    assert finished(tmp_path, "a", "b")
    assert "a is started again: its worker died (KilledWorker" in capsys.readouterr().err


def test_a_scheduler_that_is_missing_or_ends(tmp_path, capsys) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(OSError, match="no Dask scheduler answers at nonsense"):
        run_tasks([], Workers(cluster="nonsense"))
    with pytest.raises(ValueError, match="--jobs 2 does not go with --cluster"):
        Workers(2, "tcp://localhost:8786")
    with dask_cluster() as (address, process):

        def kill() -> None:
            wait_until(lambda: begun(tmp_path, "a"))
            process.kill()

        threading.Thread(target=kill).start()
        assert run_tasks(steps(tmp_path, "a", seconds=1), Workers(cluster=address)) == ["a"]
    assert (
        "the Dask scheduler ended; start it, and the same command goes on"
        in capsys.readouterr().err
    )
    wait_until(lambda: "saved" in (tmp_path / "a.log").read_text())


def test_another_version_of_dask_is_refused() -> None:
    def about(version: str) -> dict[str, dict[str, str]]:
        return {"packages": {"distributed": version}}

    found = {"client": about("2"), "scheduler": about("2"), "workers": {"tcp://a:1": about("2")}}
    client = SimpleNamespace(get_versions=lambda: found)
    _check_versions(client)
    found["workers"]["tcp://b:1"] = about("1")
    with pytest.raises(OSError, match=r"distributed differ: .*2 in tcp://a:1, 1 in tcp://b:1"):
        _check_versions(client)


def test_tasks_stop_when_their_parent_is_killed(tmp_path) -> None:
    code = f"""
import sys
sys.path[:0] = {sys.path!r}
from pathlib import Path
from types import SimpleNamespace
import stub_steps
from learn3d.tasks import ONE_WORKER, Task, run_tasks
folder = Path({str(tmp_path)!r})
run_tasks([Task("a", stub_steps.steps, (folder, "a", 0.3), folder / "a.log")], ONE_WORKER)
"""
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL) as parent:
        wait_until(lambda: begun(tmp_path, "a"))
        parent.kill()
    wait_until(lambda: "saved" in (tmp_path / "a.log").read_text())


@pytest.mark.parametrize(
    ("libc", "kernel", "before", "after"),
    [
        ("glibc", "always [madvise] never\n", None, "glibc.malloc.hugetlb=1"),
        ("glibc", "always [madvise] never\n", "a.b=1", "a.b=1:glibc.malloc.hugetlb=1"),
        ("glibc", "always [madvise] never\n", "glibc.malloc.hugetlb=0", "glibc.malloc.hugetlb=0"),
        ("glibc", "[always] madvise never\n", None, None),
        ("glibc", None, None, None),
        ("", "always [madvise] never\n", None, None),
    ],
)
def test_huge_pages_are_asked_for_where_that_helps(
    libc, kernel, before, after, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(tasks.platform, "libc_ver", lambda: (libc, "2.36"))
    monkeypatch.setattr(tasks, "HUGE_PAGES", tmp_path / "enabled")
    if kernel is not None:
        (tmp_path / "enabled").write_text(kernel)
    monkeypatch.setenv("MALLOC_TRIM_THRESHOLD_", "65536")
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    if before is not None:
        monkeypatch.setenv("GLIBC_TUNABLES", before)
    environment = tasks.process_environment()
    assert environment.get("GLIBC_TUNABLES") == after
    assert "MALLOC_TRIM_THRESHOLD_" not in environment
    monkeypatch.setattr(tasks.os, "environ", environment)
    assert tasks.process_environment() == environment, "a second time changes nothing"


def test_the_source_script_starts_again_with_that_environment(monkeypatch) -> None:
    """Once: the second process has the environment, and trains."""
    script = Path(__file__).parents[2] / "tools" / "train.py"
    wanted = dict(os.environ) | {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}
    monkeypatch.setattr(tasks, "process_environment", lambda: wanted)
    monkeypatch.setattr(sys, "orig_argv", ["python", "-u", str(script), "--help"])
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])

    class Started(Exception):
        pass

    def execve(*given: object) -> None:
        raise Started(given)

    monkeypatch.setattr(os, "execve", execve)
    with pytest.raises(Started) as started:
        runpy.run_path(str(script), run_name="__main__")
    command = [sys.executable, "-u", str(script), "--help"]
    assert started.value.args[0] == (sys.executable, command, wanted)
    monkeypatch.setattr(tasks, "process_environment", lambda: dict(os.environ))
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    assert ended.value.code == 0
