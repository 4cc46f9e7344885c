"""Reading in worker processes: a failure becomes an error of one sentence, and the next file is read."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import strange_functions as strange
from children import environment

from learn3d.files.reading import DamagedFile, MissingFile
from learn3d.files.sandbox import Call, cores, read, read_all

linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "file").write_bytes(b"12345")
    return tmp_path / "file"


def wait_until_ended(pid: int) -> None:
    for _ in range(1200):  # a minute, as a busy machine may need
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            if Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z":
                time.sleep(0.05)
                continue
        return
    pytest.fail("the worker is still there")


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (strange.crash, "crashed"),
        (strange.eat, "memory"),
        (strange.fail, "a strange word"),
        (strange.spin, "processor time; expected a spoon. Make a smaller file"),
    ],
)
def test_what_goes_wrong_is_one_sentence_and_the_next_file_is_read(
    path: Path, function: object, said: str
) -> None:
    with pytest.raises(DamagedFile, match=said) as caught:
        read(function, path, wanted="a spoon", seconds=1)
    assert str(caught.value).startswith(f"{path}: ")
    assert "expected a spoon" in str(caught.value) and "\n" not in str(caught.value)
    assert read(strange.size, path) == 5
    with pytest.raises(MissingFile, match="expected a spoon"):
        read(strange.size, path.with_name("other"), wanted="a spoon")


def test_worker_that_was_killed_while_idle_is_no_fault_of_the_file(path: Path) -> None:
    for pid in {read(strange.sleep, path, 0.0) for _ in range(8)}:
        os.kill(pid, signal.SIGKILL)
        wait_until_ended(pid)
    assert read(strange.size, path) == 5


@linux
def test_worker_is_kept_until_it_has_grown(path: Path) -> None:
    first = read(strange.keep, path, 10)
    assert read(strange.keep, path, 10) == first
    assert read(strange.keep, path, 300) == first
    assert read(strange.keep, path, 10) != first


def test_workers_are_light(path: Path) -> None:
    assert not {"torch", "scipy", "trimesh", "PIL"} & set(read(strange.modules, path))


def test_arrays_of_all_sizes_and_orders_come_back_and_can_be_changed(path: Path) -> None:
    found, wanted = read(strange.arrays, path), strange.arrays(path)
    for name, value in wanted.items():
        np.testing.assert_array_equal(found[name], value)
    found["large"][0, 0] = 7


def test_many_are_read_in_order_each_fault_in_its_place(path: Path) -> None:
    calls = [
        Call(strange.size, path),
        Call(strange.crash, path),
        Call(strange.size, path.with_name("other")),
    ]
    others = [Call(strange.sleep, path, (0.001,)), Call(strange.size, path)]
    for k, found in enumerate(read_all(calls if k % 5 == 2 else others for k in range(20))):
        if k % 5 == 2:
            assert (
                found[0] == 5
                and isinstance(found[1], DamagedFile)
                and isinstance(found[2], MissingFile)
            )
        else:
            assert found[1] == 5


def test_only_a_few_are_read_ahead(path: Path) -> None:
    asked = []
    reading = read_all(asked.append(k) or [Call(strange.size, path)] for k in range(1000))
    next(reading)
    assert len(asked) < 4 * cores() + 2
    reading.close()
    assert read(strange.size, path) == 5


def test_relative_paths_begin_at_the_folder_of_the_moment(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert read(strange.size, path) == 5  # by a worker that was started elsewhere
    monkeypatch.chdir(path.parent)
    assert read(strange.size, path.name) == 5


def _script(path: Path, code: str, **options: object) -> subprocess.Popen:
    """A program that prints the number of its worker, and then does `code`."""
    start = f"import os, sys, strange_functions as s; from learn3d.files.sandbox import read; p = {str(path)!r}\n"
    start += "print(read(s.sleep, p, 0.0), flush=True)\n"
    pipes = {
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "text": True,
        "start_new_session": True,
    }
    command = [sys.executable, "-c", start + code]
    return subprocess.Popen(command, env=environment(), **pipes, **options)


@linux
@pytest.mark.parametrize("how", ["exit", "interrupt", "kill"])
def test_no_worker_outlives_its_parent(path: Path, how: str) -> None:
    code = {"exit": "pass", "interrupt": "read(s.sleep, p, 60.0)", "kill": "s.time.sleep(60)"}[how]
    process = _script(path, code)
    pid = int(process.stdout.readline())
    if how == "interrupt":
        time.sleep(0.2)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all processes
    if how == "kill":
        process.kill()
    _, errors = process.communicate(timeout=60)
    assert errors.strip().endswith("KeyboardInterrupt" if how == "interrupt" else "")
    assert (process.returncode == 0) == (how == "exit")
    wait_until_ended(pid)


def test_copy_of_the_process_starts_its_own_workers(path: Path) -> None:
    process = _script(
        path, "pid = os.fork(); print(read(s.sleep, p, 0.0), flush=True); pid and os.wait()"
    )
    numbers = [process.stdout.readline() for _ in range(3)]
    process.communicate(timeout=60)
    assert len(set(numbers)) == 2


@linux
def test_files_are_read_when_the_system_gives_no_more_threads(path: Path) -> None:
    limit = 1_200_000 * 1024
    process = _script(
        path,
        "print(read(s.size, p))",
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
    )
    output, errors = process.communicate(timeout=60)
    assert output.split()[1:] == ["5"] and not errors
