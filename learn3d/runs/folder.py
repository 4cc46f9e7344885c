"""The folder of a run, its files, and the lock of the process that works there.

config.json           options; the first file of a run
last.safetensors      last checkpoint, with all that --resume needs; never incomplete
previous.safetensors  the checkpoint before it
best.safetensors      networks with the best validation IoU, see `training.validate`
metrics.jsonl         losses and metrics
tensorboard/ or wandb.txt (id of the run at Weights & Biases), by --log
pictures/             picture grids of validation images
.lock                 lock of the process that works here; .<name>.partial: a file being written
"""

import contextlib
import os
import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import filelock

from learn3d.distributed import rank

CONFIG, METRICS, WANDB_ID = "config.json", "metrics.jsonl", "wandb.txt"
LAST, PREVIOUS, BEST = "last.safetensors", "previous.safetensors", "best.safetensors"
PICTURES, TENSORBOARD, LOCK = "pictures", "tensorboard", ".lock"
#: The files of a run in the order of their removal; config.json is last, as it marks a run.
WRITTEN = (
    LAST,
    PREVIOUS,
    BEST,
    METRICS,
    f"{PICTURES}/{'[0-9]' * 6}*.png",
    f"{TENSORBOARD}/events.out.tfevents.*",
)
WRITTEN += (WANDB_ID, CONFIG)


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Context that makes the folder and locks it; a folder that is empty at the end is removed.

    The operating system releases the lock when the process ends, even if it is killed. Raises
    OSError if another process holds the lock, or if the folder cannot be written to.
    """
    if rank() > 0:  # rank 0 has locked it
        yield
        return
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
        for name in (PICTURES, TENSORBOARD, METRICS):
            if (folder / name).is_symlink():  # else a run would write and remove files elsewhere
                raise OSError(
                    f"{folder / name} is a link; a run writes to its own folder only: remove it"
                )
        yield
    finally:
        with contextlib.suppress(OSError):  # a read-only disk, or the folder was removed
            (folder / LOCK).unlink()
        lock.release()
        with contextlib.suppress(OSError):  # not empty
            folder.rmdir()


def is_run(folder: Path) -> bool:
    """Whether the folder holds a run."""
    return (folder / CONFIG).is_file()


def check_can_start(folder: Path, overwrite: bool) -> None:
    """Raise a ValueError unless a new run may begin in a folder.

    An empty folder may, or with `overwrite` any. Even then no file may have the name of a run's
    file, unless it belongs to a run. Only rank 0 checks.
    """
    if rank() > 0:
        return
    if is_run(folder):
        if not overwrite:
            resume = "continue it (--resume), " if checkpoints(folder) else ""
            raise ValueError(
                f"{folder} has a run; {resume}replace it (--overwrite) or choose another folder"
            )
        return
    if clashing := [path for pattern in WRITTEN for path in folder.glob(pattern)]:
        name = clashing[0].relative_to(folder)
        raise ValueError(
            f"{folder} has {name}, but no run that it could belong to; choose another folder"
        )
    if not overwrite and any(not path.name.startswith(".") for path in folder.iterdir()):
        raise ValueError(
            f"{folder} is not empty; choose another folder, or add the run to the files there (--overwrite)"
        )


def remove_old_run(folder: Path, overwrite: bool) -> None:
    """Remove the files of an older run, if `check_can_start` allows it."""
    check_can_start(folder, overwrite)
    _remove(folder, WRITTEN)
    for name in (PICTURES, TENSORBOARD):
        with contextlib.suppress(OSError):  # missing, or with files of the user
            (folder / name).rmdir()
    remove_partials(folder)


def remove_partials(folder: Path) -> None:
    """Remove the half-written files of a killed run; those of safetensors are named .tmp??????."""
    _remove(folder, (".*.partial", f"{PICTURES}/.*.partial", ".tmp??????"))


def _remove(folder: Path, patterns: Sequence[str]) -> None:
    for pattern in patterns:
        for path in folder.glob(pattern):
            path.unlink()


def checkpoints(folder: Path) -> list[Path]:
    """The checkpoints from which a run can be resumed, newest first."""
    return [path for name in (LAST, PREVIOUS) if (path := folder / name).is_file()]


def resume_command(folder: Path) -> str:
    """The command that resumes the run in `folder`, quoted for a POSIX shell."""
    started = sys.argv[0]
    program = (
        ["python", started] if os.path.basename(started) == "train.py" else ["learn3d", "train"]
    )
    return shlex.join([*program, "--output", str(folder), "--resume"])


@contextlib.contextmanager
def advice_on_errors(folder: Path) -> Iterator[None]:
    """Context that adds the last checkpoint and the command to resume to errors."""
    try:
        yield
    except (FloatingPointError, OSError) as error:
        found = checkpoints(folder)
        last = f"the last good checkpoint is {found[0]}" if found else "there is no checkpoint yet"
        if isinstance(error, FloatingPointError):
            raise FloatingPointError(
                f"{error}; {last}; try a lower learning_rate or precision fp32"
            ) from None
        room = (
            f"{shutil.disk_usage(folder).free / 1e6:.0f} MB free there"
            if folder.is_dir()
            else "it is gone"
        )
        advice = f"repair that and continue with: {resume_command(folder)}"
        raise OSError(f"{error} ({folder}: {room}); {last}; {advice}") from error
