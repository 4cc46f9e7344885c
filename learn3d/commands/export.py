"""Write the networks of a run into one small file to give away: half precision, nothing that only training needs.

Example:
  learn3d export --run runs/chair --output chair.safetensors
  learn3d reconstruct photo.png --run chair.safetensors --output meshes
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from learn3d.commands.parsing import parse
from learn3d.terminal import say


@dataclass(frozen=True)
class Command:
    """What is asked for."""

    run: Path
    """Run folder (or checkpoint file) of the trained model."""
    output: Path
    """File to write, .safetensors."""
    checkpoint: Literal["last", "best"] = "last"
    """Which networks of a run: the last ones, or those with the best validation IoU."""


def run(arguments: Sequence[str]) -> int:
    """Write the file, and say how large it is."""
    command = parse(Command, arguments, name="export", about=__doc__)
    from learn3d.files.writing import check_target
    from learn3d.runs.export import export

    check_target(command.output, "--output")
    size = export(command.run, command.output, which=command.checkpoint)
    say(f"{command.output} ({size / 1e6:.1f} MB)")
    return 0
