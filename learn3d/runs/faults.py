"""What ends a run, said in one sentence: what happened, what is left, what to do."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from learn3d.runs.folder import last_good, resume_command


@contextlib.contextmanager
def advice_on_errors(folder: Path) -> Iterator[None]:
    """Complete the errors that end a run in `folder`: where it can go on from, and how.

    FloatingPointError and OSError stay what they are; torch's own errors about memory become MemoryError.
    """
    try:
        yield
    except FloatingPointError as error:
        raise FloatingPointError(f"{error}; {last_good(folder)}; try a lower learning_rate or precision fp32") from None
    except OSError as error:
        room = "it is not there any more"
        with contextlib.suppress(OSError):
            room = f"{shutil.disk_usage(folder).free / 1e6:.0f} MB free there"
        raise OSError(
            f"{error} ({folder}: {room}); {last_good(folder)}; repair that and continue with: {resume_command(folder)}"
        ) from error
    except (MemoryError, RuntimeError) as error:
        said = str(error)  # torch has a class of its own for CUDA alone
        if not isinstance(error, MemoryError) and "out of memory" not in said and "can't allocate memory" not in said:
            raise
        raise MemoryError(
            f"out of memory ({error}); {last_good(folder)}; lower batch_size (a new run) or free some memory and "
            f"continue with: {resume_command(folder)}"
        ) from error
