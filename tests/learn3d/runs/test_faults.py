"""A run around which something breaks: disk, clock, terminal, TensorBoard. Kills are in test_kills.py."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from runs import before_step, check_same

from learn3d import training
from learn3d.runs import checkpoint, log
from learn3d.training import train


def full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def full_at(name: str) -> Callable[..., None]:
    """Half of this checkpoint is written when the disk is full."""
    save_file = checkpoint.save_file

    def save_or_fail(tensors: dict, path: Path, metadata: dict) -> None:
        if name in path.name:
            path.write_bytes(b"half")
            full()
        save_file(tensors, path, metadata)

    return save_or_fail


BROKEN = {  # what cannot be written any more
    "last": (checkpoint, "save_file", full_at("last")),
    "best": (checkpoint, "save_file", full_at("best")),
    "metrics": (log.json, "dumps", full),
    "pictures": (training, "save_png", full),
    "sync": (os, "fsync", full),
}


@pytest.mark.parametrize(
    ("what", "step"),
    [("last", 1), ("best", 1), ("last", 4), ("metrics", 4), ("pictures", 4), ("sync", 4)],
)
def test_a_full_disk_stops_the_run_and_it_goes_on(
    tiny_run, undisturbed, run_folder, monkeypatch, what: str, step: int
) -> None:
    with monkeypatch.context() as patch:
        before_step(patch, step, lambda: patch.setattr(*BROKEN[what]))
        with pytest.raises(OSError, match="No space left on device") as stop:
            train(tiny_run(run_folder))
    last = run_folder / "last.safetensors"
    good = f"the last good checkpoint is {last}" if last.exists() else "there is no checkpoint yet"
    for part in (" MB free", f"learn3d train --output {run_folder} --resume", good):
        assert part in str(stop.value)
    assert not list(run_folder.rglob(".*"))
    if last.exists():
        assert checkpoint.load(last)[1].progress.step == 2
    assert last.exists() or step == 1
    assert train(tiny_run(run_folder), resume=True).finished
    check_same(run_folder, undisturbed)


@contextlib.contextmanager
def small_disk(folder: Path, size: str, *, options: str = "") -> Iterator[Path]:
    """A file system of its own in memory; the test is skipped if the rights for that are missing."""
    if shutil.which("mount") is None:
        pytest.skip("no mount")
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}{options}", "tmpfs", str(folder)]
    if subprocess.run(command, capture_output=True).returncode:
        pytest.skip("mounting a file system needs root")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_disk_that_is_really_full(tiny_run, undisturbed, tmp_path) -> None:
    size = (undisturbed / "last.safetensors").stat().st_size
    with small_disk(tmp_path / "disk", str(2 * size + size // 2)) as disk:
        with pytest.raises(OSError, match=r"No space left on device.* MB free"):
            train(tiny_run(disk / "run"))
        assert not list((disk / "run").rglob("*.partial"))
        assert checkpoint.load(disk / "run" / "last.safetensors")[1].progress.step in (2, 4)
        subprocess.run(["mount", "-o", f"remount,size={8 * size}", str(disk)], check=True)
        assert train(tiny_run(disk / "run"), resume=True).finished
        check_same(disk / "run", undisturbed)


def test_places_that_cannot_be_written_to(tiny_run, tmp_path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(
        OSError, match=r"output folder .* cannot be written to \(Not a directory\); choose another"
    ):
        train(tiny_run(tmp_path / "file" / "run"))
    with small_disk(tmp_path / "disk", "1m", options=",ro") as disk:
        with pytest.raises(
            OSError,
            match=r"cannot be written to \(Read-only file system\); choose another --output",
        ):
            train(tiny_run(disk / "run"))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # TensorBoard's
def test_the_output_folder_vanishes(tiny_run, run_folder, monkeypatch) -> None:
    before_step(monkeypatch, 3, lambda: shutil.rmtree(run_folder))
    with pytest.raises(OSError, match=r"it is gone.*there is no checkpoint yet"):
        train(tiny_run(run_folder))
    assert not run_folder.exists()


def test_a_clock_that_jumps(tiny_run, undisturbed, run_folder, monkeypatch) -> None:
    now, jumps = time.time, iter([0.0, 1e9, -1e9, 3e8] * 10_000)
    monkeypatch.setattr(time, "time", lambda: now() + next(jumps))
    started = time.monotonic()
    before_step(monkeypatch, 4, lambda: signal.raise_signal(signal.SIGTERM))
    seconds = []
    for resume in (False, True):
        assert train(tiny_run(run_folder), resume=resume).finished == resume
        seconds.append(checkpoint.load_metadata(run_folder).progress.seconds)
    assert 0 < seconds[0] < seconds[1] < time.monotonic() - started, (
        "both parts count, and nothing else"
    )
    check_same(run_folder, undisturbed)


@pytest.mark.parametrize("nohup", [False, True])
def test_a_closed_terminal_stops_the_run_in_good_order_but_under_nohup(
    tiny_run, undisturbed, run_folder, monkeypatch, nohup: bool
) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if nohup else signal.SIG_DFL)
    with open(writing, "w", closefd=True) as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        before_step(monkeypatch, 3, lambda: signal.raise_signal(signal.SIGHUP))
        summary = train(tiny_run(run_folder))
        monkeypatch.undo()
        with contextlib.suppress(BrokenPipeError):
            terminal.close()
    signal.signal(signal.SIGHUP, before)
    assert (summary.progress.step, summary.finished) == ((6, True) if nohup else (3, False))
    assert train(tiny_run(run_folder), resume=True).finished
    check_same(run_folder, undisturbed)


@pytest.mark.parametrize("stream", [None, io.StringIO()])
def test_without_a_terminal_at_all(
    tiny_run, run_folder, monkeypatch, stream: io.StringIO | None
) -> None:
    if stream is not None:
        stream.close()
    monkeypatch.setattr(training, "draw", lambda *arguments: None)
    monkeypatch.setattr(sys, "stderr", stream)
    assert train(tiny_run(run_folder, iterations=2)).finished


def test_tensorboard_that_cannot_be_loaded(
    tiny_run, undisturbed, run_folder, monkeypatch, capsys
) -> None:
    import torch.utils.tensorboard

    def fail(*_: object, **__: object) -> None:
        raise TypeError("Descriptors cannot be created directly")

    monkeypatch.setattr(torch.utils.tensorboard, "SummaryWriter", fail)
    assert train(tiny_run(run_folder)).finished
    assert (
        "warning: tensorboard does not work (Descriptors cannot be created directly)"
        in capsys.readouterr().err
    )
    check_same(run_folder, undisturbed)


def test_tensorboard_shows_every_step_once_after_a_kill(
    tiny_run, undisturbed, run_folder, monkeypatch
) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    class Killed(BaseException):
        pass

    def kill() -> None:
        raise Killed

    # a killed process closes nothing
    monkeypatch.setattr(log.RunLog, "__exit__", lambda *arguments: None)
    before_step(monkeypatch, 6, kill)
    with pytest.raises(Killed):
        train(tiny_run(run_folder))
    monkeypatch.undo()
    time.sleep(1.1)  # the files are sorted by the second of their making
    assert train(tiny_run(run_folder), resume=True).finished
    for folder in (run_folder, undisturbed):
        events = EventAccumulator(str(folder / "tensorboard"))
        events.Reload()
        assert [event.step for event in events.Scalars("train/total")] == [1, 2, 3, 4, 5, 6]
        assert [event.step for event in events.Scalars("val/voxel_iou")] == [2, 4, 6]


def test_resuming_before_the_first_checkpoint_starts_anew(
    tiny_run, undisturbed, run_folder, monkeypatch
) -> None:
    before_step(monkeypatch, 2, full)
    with pytest.raises(OSError, match="there is no checkpoint yet"):
        train(tiny_run(run_folder))
    assert json.loads((run_folder / "metrics.jsonl").read_text().splitlines()[0])["step"] == 1
    with pytest.raises(
        ValueError,
        match=r"cannot resume with different options .*batch_size: 2 in the run, 4 asked",
    ):
        train(tiny_run(run_folder, batch_size=4), resume=True)
    for name in (
        ".best.safetensors.partial",
        "pictures/.x.partial",
    ):  # half written when a run was killed
        (run_folder / name).parent.mkdir(exist_ok=True)
        (run_folder / name).write_text("half")
    assert train(tiny_run(run_folder), resume=True).finished
    check_same(run_folder, undisturbed)


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="reads /proc of Linux")
def test_a_resumed_run_holds_nothing_of_the_checkpoint(tiny_run, run_folder, monkeypatch) -> None:
    train(tiny_run(run_folder, iterations=4))
    maps: list[str] = []
    before_step(monkeypatch, 6, lambda: maps.append(Path("/proc/self/maps").read_text()))
    train(tiny_run(run_folder), resume=True)
    assert str(run_folder) not in maps[0]
