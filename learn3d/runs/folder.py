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
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from learn3d.config import load_config
from learn3d.files import writing
from learn3d.runs import checkpoint

CONFIG, LAST, BEST = "config.json", "last.safetensors", "best.safetensors"
METRICS, JOURNAL, DAMAGED = "metrics.jsonl", "journal.txt", "damaged.safetensors"
EARLIER, PICTURES, TENSORBOARD = "checkpoints", "pictures", "tensorboard"
LOCK = ".lock"
_PARTS = {PICTURES: "[0-9]" * 6 + "*.png", TENSORBOARD: "events.out.tfevents.*"}


@contextlib.contextmanager
def sole_use(folder: Path, lock: str = LOCK) -> Iterator[None]:
    """Make the folder and keep other processes from working in it while the block runs.

    The lock is the operating system's: it ends with its process, however that ends. Raises ValueError where `folder` is
    a file, OSError where another process holds the lock or the folder cannot be written to. Where the system or the
    file system has no file locks (Windows, some network drives), nothing is kept. A folder that was made and is still
    empty at the end is removed.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"output {folder} is a file; give a folder for the run")
    made = not folder.is_dir()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = _locked(folder / lock)
    except BlockingIOError:
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
        os.close(file)
        if made:
            with contextlib.suppress(OSError):
                folder.rmdir()


def _locked(path: Path) -> int:
    """An open file that this process alone has locked. Raises BlockingIOError where another one has."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            raise
        except (ImportError, OSError):  # no locks here
            return file
        with contextlib.suppress(FileNotFoundError):
            if os.fstat(file).st_ino == os.stat(path).st_ino:
                return file
        os.close(file)  # its holder has removed it between the two calls: that is no lock any more


def check_free(folder: Path, overwrite: bool) -> None:
    """Raise a ValueError where a new run may not begin in a folder: it is not empty, or not a run that can be replaced.

    What a run that was killed before it had anything leaves behind (a lock, a half-written file) does not count. With
    `overwrite` a run may be replaced, and be put beside other files, but not where these have the names of a run's.
    """
    present = [path for path in _files(folder) if path.exists()]
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


def claim(folder: Path, overwrite: bool) -> None:
    """Take a folder for a new run, where `check_free` allows it: what an earlier run has written is removed."""
    check_free(folder, overwrite)
    for path in _files(folder):
        path.unlink(missing_ok=True)
    for name in (*_PARTS, EARLIER):
        with contextlib.suppress(OSError):  # there is none, or something of the user's is in it
            (folder / name).rmdir()
    remove_partials(folder)


def is_run(folder: Path) -> bool:
    """Whether the options or a checkpoint of a run lie in the folder."""
    try:
        load_config(folder / CONFIG)
        return True
    except (ValueError, OSError):
        pass
    for path in (*checkpoints(folder), folder / BEST):
        try:
            if path.is_file():
                checkpoint.load_metadata(path)
                return True
        except checkpoint.DamagedError:
            pass
        except ValueError:  # of a later version
            return True
    return False


def _files(folder: Path) -> list[Path]:
    """What a run writes, there or not, in the order in which it can be removed.

    The options first, without which a kill in between leaves nothing that could be continued by mistake; the
    checkpoints last, so that the rest is still known as a run's.
    """
    parts = [path for name, pattern in _PARTS.items() for path in (folder / name).glob(pattern)]
    logs = [folder / name for name in (METRICS, JOURNAL, DAMAGED)]
    return [folder / CONFIG, *logs, *parts, *checkpoints(folder), folder / BEST]


def remove_partials(folder: Path) -> None:
    """Remove the half-written files of a run that was killed."""
    writing.remove_partials(folder, folder / EARLIER, folder / PICTURES)


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
        step = checkpoint.load_metadata(last)["step"]
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
    """The command line that continues the run in `folder`, by the program that runs now, quoted for a POSIX shell."""
    program = ["learn3d", "train"]
    if os.path.basename(sys.argv[0]) == "train.py":
        found = shutil.which("python")
        same = found is not None and os.path.samefile(found, sys.executable)
        program = ["python" if same else sys.executable, sys.argv[0]]
    return shlex.join([*program, "--output", str(folder), "--resume"])


def last_good(folder: Path) -> str:
    """Where the run can go on from, as part of a sentence."""
    found = checkpoints(folder)
    return f"the last good checkpoint is {found[0]}" if found else "there is no checkpoint yet"
