"""The folder of a run: what lies in it, who may work in it, and which checkpoints are kept.

config.json           the options
last.safetensors      all that a resumption needs; a complete file at every moment after the first save
checkpoints/          step-<step>.safetensors: the ones before last.safetensors, `keep_checkpoints` with it
best.safetensors      the networks with the best validation IoU
metrics.jsonl         losses and measurements
journal.txt           what the run said, with the time
tensorboard/, pictures/
damaged.safetensors   what was found under the name last.safetensors and could not be used
.lock                 held by the process that works here; .<name>.partial: a file being written
"""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import filelock

from learn3d.config import load_config
from learn3d.files import writing
from learn3d.runs import checkpoint

CONFIG, LAST, BEST = "config.json", "last.safetensors", "best.safetensors"
METRICS, JOURNAL, DAMAGED = "metrics.jsonl", "journal.txt", "damaged.safetensors"
EARLIER, PICTURES, TENSORBOARD = "checkpoints", "pictures", "tensorboard"
LOCK = ".lock"
#: What a run writes, in the order in which it is removed: the options first, without which nothing is continued by
#: mistake; the checkpoints last, by which the rest is still known as a run's.
WRITTEN = (
    *(CONFIG, METRICS, JOURNAL, DAMAGED, f"{PICTURES}/{'[0-9]' * 6}*.png", f"{TENSORBOARD}/events.out.tfevents.*"),
    *(f"{EARLIER}/step-[0-9]*.safetensors", LAST, BEST),
)


@contextlib.contextmanager
def lock_folder(folder: Path, lock: str = LOCK) -> Iterator[None]:
    """Make the folder and keep other processes from working in it while the block runs.

    The lock is the operating system's: it ends with its process, however that ends. Raises ValueError where `folder` is
    a file, OSError where another process holds the lock or the folder cannot be written to. A folder that was made and
    is still empty at the end is removed.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"output {folder} is a file; give a folder for the run")
    made, held = not folder.is_dir(), filelock.FileLock(folder / lock, timeout=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held.acquire()
    except filelock.Timeout:
        raise OSError(f"another process works in {folder}; wait for it, or stop it") from None
    except OSError as error:
        raise OSError(
            f"the output folder {folder} cannot be written to ({error.strerror}); choose another --output"
        ) from None
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # a full or read-only disk; the folder is gone
            (folder / lock).unlink()
        held.release()
        if made:
            with contextlib.suppress(OSError):
                folder.rmdir()


def check_can_start(folder: Path, overwrite: bool) -> None:
    """Raise a ValueError where a new run may not begin in a folder: it is not empty, or not a run that can be replaced.

    What a run that was killed before it had anything leaves behind (a lock, a half-written file) does not count. With
    `overwrite` a run may be replaced, and be put beside other files, but not where these have the names of a run's.
    """
    present = [path for pattern in WRITTEN for path in folder.glob(pattern)]
    if present and not is_run(folder):
        raise ValueError(
            f"{folder} has {present[0].relative_to(folder)}, but no run that it could belong to; choose another folder"
        )
    if present and not overwrite:
        raise ValueError(
            f"{folder} has a run; continue it (--resume), replace it (--overwrite) or choose another folder"
        )
    if not overwrite and any(path.name != LOCK and not path.match(".*.partial") for path in folder.iterdir()):
        raise ValueError(
            f"{folder} is not empty; choose another folder, or put the run beside what is in it (--overwrite)"
        )


def remove_old_run(folder: Path, overwrite: bool) -> None:
    """Take a folder for a new run, where `check_can_start` allows it: what an earlier run has written is removed."""
    check_can_start(folder, overwrite)
    for pattern in WRITTEN:
        for path in folder.glob(pattern):
            path.unlink()
    for name in (EARLIER, PICTURES, TENSORBOARD):
        with contextlib.suppress(OSError):  # there is none, or something of the user's is in it
            (folder / name).rmdir()
    remove_partials(folder)


def is_run(folder: Path) -> bool:
    """Whether the options or a checkpoint of a run lie in the folder."""
    readable = [(load_config, folder / CONFIG)]
    readable += [(checkpoint.load_metadata, path) for path in (*checkpoints(folder), folder / BEST)]
    for read, path in readable:
        with contextlib.suppress(ValueError, OSError):
            read(path)
            return True
    return False


def remove_partials(folder: Path) -> None:
    """Remove the half-written files of a run that was killed; safetensors has names of its own for them."""
    writing.remove_partials(folder, folder / EARLIER, folder / PICTURES)
    for path in folder.glob(".tmp??????"):
        path.unlink()


def checkpoints(folder: Path) -> list[Path]:
    """The checkpoints that a run can go on from, newest first: last.safetensors, then those in checkpoints/."""
    earlier = {
        path: step for path in (folder / EARLIER).glob("step-*.safetensors") if (step := _step(path)) is not None
    }
    last = [folder / LAST] if (folder / LAST).is_file() else []
    return last + sorted(earlier, key=earlier.__getitem__, reverse=True)


def _step(path: Path) -> int | None:
    digits = path.name.removeprefix("step-").removesuffix(".safetensors")
    return int(digits) if digits.isdecimal() else None


def keep_previous(folder: Path) -> None:
    """Before last.safetensors is replaced: let it also be found as checkpoints/step-<step>.safetensors.

    One that cannot be read is not kept.
    """
    last = folder / LAST
    if not last.is_file():
        return
    try:
        step = checkpoint.load_metadata(last).progress.step
    except checkpoint.DamagedError:
        return
    (folder / EARLIER).mkdir(exist_ok=True)
    writing.give_second_name(last, folder / EARLIER / f"step-{step:06}.safetensors")


def remove_old(folder: Path, step: int, keep: int) -> None:
    """After last.safetensors of `step` was written: of the checkpoints before it keep the newest `keep` - 1."""
    earlier = [path for path in checkpoints(folder)[1:] if _step(path) < step]
    for path in earlier[keep - 1 :]:
        path.unlink(missing_ok=True)


def put_in_place(path: Path) -> None:
    """Make an earlier checkpoint the last one; what has that name now is kept as damaged.safetensors."""
    folder = path.parent.parent
    if (folder / LAST).exists():
        os.replace(folder / LAST, folder / DAMAGED)
    writing.give_second_name(path, folder / LAST)


def resume_command(folder: Path) -> str:
    """The command line that continues the run in `folder`, quoted for a POSIX shell: tools/train.py, where that was
    started, and else `learn3d train`."""
    started = sys.argv[0]
    program = ["python", started] if os.path.basename(started) == "train.py" else ["learn3d", "train"]
    return shlex.join([*program, "--output", str(folder), "--resume"])


def last_good(folder: Path) -> str:
    """Where the run can go on from, as part of a sentence."""
    found = checkpoints(folder)
    return f"the last good checkpoint is {found[0]}" if found else "there is no checkpoint yet"
