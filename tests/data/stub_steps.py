"""Stands in for the work of a task; a module that needs no torch, so that its processes start at once."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from learn3d.terminal import stop_on_signal

STEPS = 12


def steps(folder: Path, name: str, seconds: float = 0.0) -> bool:
    """Twelve steps, a line each in a file; goes on after those that are there. A task called "dies" kills itself."""
    path = folder / f"{name}.txt"
    done = len(path.read_text().split()) if path.exists() else 0
    print("pid", os.getpid(), "of", os.getppid(), "from step", done, flush=True)
    if name == "fails":
        raise ValueError("no such thing")
    with stop_on_signal() as stop:
        for step in range(done, STEPS):
            if name == "dies" and step == 2:
                os.kill(os.getpid(), signal.SIGKILL)
            if stop.name:
                print("saved", flush=True)
                return False
            time.sleep(seconds)
            with open(path, "a") as file:
                file.write(f"{step}\n")
    return True
