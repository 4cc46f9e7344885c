"""What happens to a run when something around it breaks: the table of docs/guarantees.md, a test per line.

Kills are in test_kills.py, locks in test_run_folder.py, damaged files in test_damage.py.
"""

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
import torch
from runs import check_same

from learn3d import training, validation
from learn3d.methods.pose_invariant import PoseInvariant
from learn3d.runs import checkpoint, log
from learn3d.runs import folder as run_folder
from learn3d.training import train

TRAIN_STEP = PoseInvariant.take_step


def before_step(monkeypatch: pytest.MonkeyPatch, step: int, action: Callable[[], object]) -> None:
    """Let something happen before a training step, once."""
    left = [action]

    def take_step(self, batch, now: int):
        if now == step and left:
            left.pop()()
        return TRAIN_STEP(self, batch, now)

    monkeypatch.setattr(PoseInvariant, "take_step", take_step)


def full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


# --- the disk


@pytest.mark.parametrize("saves", [0, 1, 3])
def test_full_disk_while_a_checkpoint_is_written(tiny_run, undisturbed, run_folder, monkeypatch, saves: int) -> None:
    save_file, done = checkpoint.save_file, []

    def fill(tensors, path, metadata) -> None:
        if len(done) == saves:
            path.write_bytes(b"half")
            full()
        done.append(path)
        save_file(tensors, path, metadata)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "save_file", fill)
        with pytest.raises(OSError, match="cannot write the checkpoint") as stop:
            train(tiny_run(run_folder))
    said = str(stop.value)
    for part in ("No space left on device", " MB free", f"learn3d train --output {run_folder} --resume"):
        assert part in said
    assert not list(run_folder.rglob(".*"))
    last = run_folder / "last.safetensors"
    if last.exists():
        checkpoint.load(last)
    assert (f"the last good checkpoint is {last}" if last.exists() else "there is no checkpoint yet") in said
    assert train(tiny_run(run_folder), resume=True).finished
    check_same(run_folder, undisturbed)


def test_a_disk_that_fails_while_it_syncs(tiny_run, undisturbed, run_folder, monkeypatch) -> None:
    fsync = os.fsync

    def broken() -> None:
        monkeypatch.setattr(os, "fsync", lambda number: (_ for _ in ()).throw(OSError(errno.EIO, "Input/output error")))

    before_step(monkeypatch, 4, broken)
    with pytest.raises(OSError, match=r"Input/output error .*last good checkpoint"):
        train(tiny_run(run_folder))
    monkeypatch.setattr(os, "fsync", fsync)
    assert checkpoint.load(run_folder / "last.safetensors")[1].progress.step == 2
    assert train(tiny_run(run_folder), resume=True).finished
    check_same(run_folder, undisturbed)


@contextlib.contextmanager
def small_disk(folder: Path, size: str, *, options: str = "") -> Iterator[Path]:
    """A file system of its own in memory; the test is skipped where that needs rights that it has not."""
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
        with pytest.raises(OSError, match=r"cannot write the checkpoint .* MB free"):
            train(tiny_run(disk / "run"))
        assert not list((disk / "run").rglob("*.partial"))
        kept = checkpoint.load(disk / "run" / "last.safetensors")[1].progress.step
        assert kept in (2, 4)
        subprocess.run(["mount", "-o", f"remount,size={8 * size}", str(disk)], check=True)
        assert train(tiny_run(disk / "run"), resume=True).finished
        check_same(disk / "run", undisturbed)


class Disk:
    """A disk that can be full."""

    def __init__(self) -> None:
        self.full = False

    def open(self, path: Path, mode: str, buffering: int = -1):
        disk, inner = self, io.FileIO(path, mode)

        class File:
            def write(self, content: bytes) -> int:
                if disk.full and len(content) > 5:
                    return inner.write(content[:5])
                return full() if disk.full else inner.write(content)

            def __getattr__(self, name: str):
                return getattr(inner, name)

        return File()


def test_metrics_and_pictures_wait_for_room_and_never_stop_a_run(
    tiny_run, undisturbed, run_folder, monkeypatch, capsys
) -> None:
    from tensorboard.summary.writer.record_writer import RecordWriter

    disk, save_png, write = Disk(), validation.save_png, RecordWriter.write
    monkeypatch.setattr(log, "open", disk.open, raising=False)
    monkeypatch.setattr(validation, "save_png", lambda *a: full() if disk.full else save_png(*a))
    monkeypatch.setattr(RecordWriter, "write", lambda *a: full() if disk.full else write(*a))
    monkeypatch.setattr("threading.excepthook", lambda arguments: None)  # TensorBoard's thread tells as well

    def take_step(self, batch, now: int):
        disk.full = now in (3, 4)
        return TRAIN_STEP(self, batch, now)

    monkeypatch.setattr(PoseInvariant, "take_step", take_step)
    assert train(tiny_run(run_folder)).finished
    said = capsys.readouterr().err
    for what in ("metrics.jsonl cannot be written", "pictures cannot be written", "tensorboard does not work"):
        assert said.count(f"warning: {what}") == 1
    assert "No space left on device" in said
    assert sorted(path.name for path in (run_folder / "pictures").iterdir()) == ["000002.png", "000006.png"]
    shutil.copy(undisturbed / "pictures" / "000004.png", run_folder / "pictures")
    check_same(run_folder, undisturbed)
    assert "warning: pictures cannot be written" in (run_folder / "journal.txt").read_text()


def test_output_in_a_place_that_is_no_folder(tiny_run, tmp_path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"output folder .* cannot be written to \(Not a directory\); choose another"):
        train(tiny_run(tmp_path / "file" / "run"))


def test_read_only_disk(tiny_run, tmp_path) -> None:
    with small_disk(tmp_path / "disk", "1m", options=",ro") as disk:
        with pytest.raises(OSError, match=r"cannot be written to \(Read-only file system\); choose another --output"):
            train(tiny_run(disk / "run"))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_missing_permission(tmp_path) -> None:
    folder = tmp_path / "run"
    folder.mkdir(mode=0o555)
    reading, writing = os.pipe()
    if (child := os.fork()) == 0:
        try:
            os.chdir(tmp_path)  # whose parents may be closed to others
            tmp_path.chmod(0o755)
            if os.geteuid() == 0:
                os.seteuid(65534)
            with run_folder_of(folder.name):
                os.write(writing, b"it was open")
        except BaseException as error:
            os.write(writing, str(error).encode())
        finally:
            os._exit(0)
    os.close(writing)
    os.waitpid(child, 0)
    with os.fdopen(reading) as file:
        assert file.read() == "the output folder run cannot be written to (Permission denied); choose another --output"


def run_folder_of(name: str) -> contextlib.AbstractContextManager[None]:
    return run_folder.lock_folder(Path(name))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # TensorBoard's
def test_the_output_folder_vanishes(tiny_run, run_folder, monkeypatch) -> None:
    before_step(monkeypatch, 3, lambda: shutil.rmtree(run_folder))
    with pytest.raises(OSError, match=r"is not there any more.*there is no checkpoint yet"):
        train(tiny_run(run_folder))
    assert not run_folder.exists()


# --- time, memory, terminal


def test_a_clock_that_jumps(tiny_run, undisturbed, run_folder, monkeypatch) -> None:
    now, jumps = time.time, iter([0.0, 1e9, -1e9, 3e8] * 10_000)
    monkeypatch.setattr(time, "time", lambda: now() + next(jumps))
    started = time.monotonic()
    before_step(monkeypatch, 4, lambda: signal.raise_signal(signal.SIGTERM))
    seconds = []
    for resume in (False, True):
        assert train(tiny_run(run_folder), resume=resume).finished == resume
        seconds.append(checkpoint.load_metadata(run_folder / "last.safetensors").progress.seconds)
    assert 0 < seconds[0] < seconds[1] < time.monotonic() - started, "both parts count, and nothing else"
    check_same(run_folder, undisturbed)


@pytest.mark.parametrize("error", [MemoryError(), None, torch.cuda.OutOfMemoryError("CUDA out of memory. Tried")])
def test_too_little_memory(tiny_run, undisturbed, run_folder, monkeypatch, error: Exception | None) -> None:
    def allocate() -> None:
        if error is not None:
            raise error
        torch.empty(1 << 60)

    before_step(monkeypatch, 5, allocate)
    with pytest.raises(MemoryError, match=r"^out of memory .*last good checkpoint is .*; lower batch_size .*--resume$"):
        train(tiny_run(run_folder))
    assert train(tiny_run(run_folder), resume=True).finished
    check_same(run_folder, undisturbed)


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no terminals")
def test_a_closed_terminal_stops_the_run_in_good_order(tiny_run, undisturbed, run_folder, monkeypatch) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup it is ignored, also by us
    with open(writing, "w", closefd=True) as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        before_step(monkeypatch, 3, lambda: signal.raise_signal(signal.SIGHUP))
        summary = train(tiny_run(run_folder))
        monkeypatch.undo()
        with contextlib.suppress(BrokenPipeError):
            terminal.close()
    signal.signal(signal.SIGHUP, before)
    assert (summary.step, summary.finished) == (3, False)
    assert "stopped by SIGHUP after step 3" in (run_folder / "journal.txt").read_text()
    assert train(tiny_run(run_folder), resume=True).finished
    check_same(run_folder, undisturbed)


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no terminals")
def test_nohup_is_respected(tiny_run, run_folder, monkeypatch) -> None:
    monkeypatch.setattr(training, "draw", lambda *arguments: None)
    before_step(monkeypatch, 2, lambda: signal.raise_signal(signal.SIGHUP))
    handler = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert train(tiny_run(run_folder)).finished
    finally:
        signal.signal(signal.SIGHUP, handler)


@pytest.mark.parametrize("stream", [None, io.StringIO()])
def test_without_a_terminal_at_all(tiny_run, run_folder, monkeypatch, stream: io.StringIO | None) -> None:
    if stream is not None:
        stream.close()
    monkeypatch.setattr(training, "draw", lambda *arguments: None)
    monkeypatch.setattr(sys, "stderr", stream)
    assert train(tiny_run(run_folder, iterations=2)).finished


# --- TensorBoard


def test_tensorboard_that_cannot_be_loaded(tiny_run, undisturbed, run_folder, monkeypatch, capsys) -> None:
    import torch.utils.tensorboard

    def fail(*_: object, **__: object) -> None:
        raise TypeError("Descriptors cannot be created directly")

    monkeypatch.setattr(torch.utils.tensorboard, "SummaryWriter", fail)
    assert train(tiny_run(run_folder)).finished
    assert "warning: tensorboard does not work (Descriptors cannot be created directly)" in capsys.readouterr().err
    check_same(run_folder, undisturbed)


def test_tensorboard_shows_every_step_once_after_a_kill(tiny_run, undisturbed, run_folder, monkeypatch) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    class Killed(BaseException):
        pass

    def kill() -> None:
        raise Killed

    monkeypatch.setattr(log.RunLog, "__exit__", lambda *arguments: None)  # a killed process closes nothing
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


# --- the beginning


def test_resuming_before_the_first_checkpoint_starts_anew(tiny_run, undisturbed, run_folder, monkeypatch) -> None:
    before_step(monkeypatch, 2, full)
    with pytest.raises(OSError, match="there is no checkpoint yet"):
        train(tiny_run(run_folder))
    assert json.loads((run_folder / "metrics.jsonl").read_text().splitlines()[0])["step"] == 1
    with pytest.raises(ValueError, match=r"cannot resume with different options .*batch_size: 2 in the run, 4 asked"):
        train(tiny_run(run_folder, batch_size=4), resume=True)
    assert train(tiny_run(run_folder), resume=True).finished
    check_same(run_folder, undisturbed)


def test_what_a_kill_left_half_written_is_removed(tiny_run, undisturbed, run_folder) -> None:
    train(tiny_run(run_folder, iterations=4))
    for name in (".best.safetensors.partial", "checkpoints/.step-000004.safetensors.partial", "pictures/.x.partial"):
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
