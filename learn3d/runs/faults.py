"""What goes wrong in a run, said in one sentence: what happened, what is left, what to do."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from learn3d.runs.folder import last_good, resume_command


@contextlib.contextmanager
def explained(folder: Path) -> Iterator[None]:
    """Complete the errors that end a run in `folder`: where it can go on from, and how.

    FloatingPointError and OSError stay what they are; torch's own errors about memory become MemoryError.
    """
    try:
        yield
    except FloatingPointError as error:
        advice = "try a lower learning_rate or precision fp32"
        raise FloatingPointError(f"{error}; {last_good(folder)}; {advice}") from None
    except OSError as error:
        advice = f"repair that and continue with: {resume_command(folder)}"
        raise OSError(f"{error} ({_room(folder)}); {last_good(folder)}; {advice}") from error
    except (MemoryError, RuntimeError) as error:
        if not _is_out_of_memory(error):
            raise
        advice = f"lower batch_size (a new run) or free some memory and continue with: {resume_command(folder)}"
        raise MemoryError(f"out of memory ({error}); {last_good(folder)}; {advice}") from error


def _room(folder: Path) -> str:
    try:
        return f"{shutil.disk_usage(folder).free / 1e6:.0f} MB free in {folder}"
    except OSError:
        return f"{folder} is not there any more"


def _is_out_of_memory(error: BaseException) -> bool:
    """torch has a class of its own for CUDA alone; on the CPU the text tells."""
    said = str(error)
    return isinstance(error, MemoryError) or "out of memory" in said or "can't allocate memory" in said
