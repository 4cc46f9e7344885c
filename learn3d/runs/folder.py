"""The folder of a run: the files in it, and the one process that may work there.

config.json           the options; the first file of a run
last.safetensors      all that a resumption needs; a complete file at every moment after the first save
previous.safetensors  the checkpoint before it
best.safetensors      the networks with the best IoU on validation images, see `validation.validate`
metrics.jsonl         losses and measurements
tensorboard/ or metrics.csv or wandb.txt (the run's id there), as --log says; pictures/
.lock                 held by the process that works here; .<name>.partial: a file being written
"""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import filelock

from learn3d.files import writing

CONFIG, METRICS, METRICS_CSV, WANDB_ID = "config.json", "metrics.jsonl", "metrics.csv", "wandb.txt"
LAST, PREVIOUS, BEST = "last.safetensors", "previous.safetensors", "best.safetensors"
PICTURES, TENSORBOARD, LOCK = "pictures", "tensorboard", ".lock"
#: The files of a run in the order of their removal. The options are last: without them it is no run any more.
WRITTEN = (LAST, PREVIOUS, BEST, METRICS, f"{PICTURES}/{'[0-9]' * 6}*.png", f"{TENSORBOARD}/events.out.tfevents.*")
WRITTEN += (METRICS_CSV, WANDB_ID, CONFIG)


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Make the folder and keep other processes from working in it while the block runs.

    The lock is the operating system's: it ends with its process, however that ends. Raises ValueError if `folder` is a
    file, OSError if another process holds the lock or the folder cannot be written to. A folder that is empty at the
    end is removed.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"output {folder} is a file; give a folder for the run")
    lock = filelock.FileLock(folder / LOCK, timeout=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except filelock.Timeout:
        raise OSError(f"another process works in {folder}; wait for it, or stop it") from None
    except OSError as error:
        reason = f"cannot be written to ({error.strerror})"
        raise OSError(f"the output folder {folder} {reason}; choose another --output") from None
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # a full or read-only disk; the folder is gone
            (folder / LOCK).unlink()
        lock.release()
        with contextlib.suppress(OSError):  # it holds something
            folder.rmdir()


def is_run(folder: Path) -> bool:
    """Whether the options of a run lie in the folder."""
    return (folder / CONFIG).is_file()


def check_can_start(folder: Path, overwrite: bool) -> None:
    """Raise a ValueError if a new run may not begin in a folder: it holds other files, or a run (unless `overwrite`).

    With `overwrite` a run may also be put beside other files, but not if these have the names of a run's.
    """
    if is_run(folder):
        if not overwrite:
            advice = "continue it (--resume), replace it (--overwrite) or choose another folder"
            raise ValueError(f"{folder} has a run; {advice}")
        return
    if clashing := [path for pattern in WRITTEN for path in folder.glob(pattern)]:
        name = clashing[0].relative_to(folder)
        raise ValueError(f"{folder} has {name}, but no run that it could belong to; choose another folder")
    if not overwrite and any(not path.name.startswith(".") for path in folder.iterdir()):
        raise ValueError(
            f"{folder} is not empty; choose another folder, or put the run beside what is in it (--overwrite)"
        )


def remove_old_run(folder: Path, overwrite: bool) -> None:
    """Take a folder for a new run, if `check_can_start` allows it: the files of an earlier run are removed."""
    check_can_start(folder, overwrite)
    for pattern in WRITTEN:
        for path in folder.glob(pattern):
            path.unlink()
    for name in (PICTURES, TENSORBOARD):
        with contextlib.suppress(OSError):  # there is none, or something of the user's is in it
            (folder / name).rmdir()
    remove_partials(folder)


def remove_partials(folder: Path) -> None:
    """Remove the half-written files of a run that was killed; safetensors has names of its own for them."""
    writing.remove_partials(folder, folder / PICTURES)
    for path in folder.glob(".tmp??????"):
        path.unlink()


def checkpoints(folder: Path) -> list[Path]:
    """The checkpoints that a run can go on from, newest first."""
    return [path for name in (LAST, PREVIOUS) if (path := folder / name).is_file()]


def resume_command(folder: Path) -> str:
    """The command line that continues the run in `folder`, quoted for a POSIX shell."""
    started = sys.argv[0]
    program = ["python", started] if os.path.basename(started) == "train.py" else ["learn3d", "train"]
    return shlex.join([*program, "--output", str(folder), "--resume"])


@contextlib.contextmanager
def advice_on_errors(folder: Path) -> Iterator[None]:
    """Complete the errors that end a run in `folder`: its last checkpoint, and the command to go on from it."""
    try:
        yield
    except (FloatingPointError, OSError) as error:
        found = checkpoints(folder)
        last = f"the last good checkpoint is {found[0]}" if found else "there is no checkpoint yet"
        if isinstance(error, FloatingPointError):
            raise FloatingPointError(f"{error}; {last}; try a lower learning_rate or precision fp32") from None
        room = f"{shutil.disk_usage(folder).free / 1e6:.0f} MB free there" if folder.is_dir() else "it is gone"
        advice = f"repair that and continue with: {resume_command(folder)}"
        raise OSError(f"{error} ({folder}: {room}); {last}; {advice}") from error
