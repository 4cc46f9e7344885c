"""`learn3d export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from learn3d.commands.command import Command, Which
from learn3d.terminal import say


@dataclass(frozen=True)
class Export(Command):
    """Write the networks of a run into one small file to give away: half precision, nothing that only training needs.

    Example:
      learn3d export --run runs/chair --output chair.safetensors
      learn3d reconstruct photo.png --run chair.safetensors --output meshes
    """

    source: Annotated[Path, tyro.conf.arg(name="run")]
    """Run folder (or checkpoint file) of the trained model."""
    output: Path
    """File to write, .safetensors."""
    which: Which = "last"
    """Networks of a run to use: the last ones, or those with the best validation IoU."""

    def run(self) -> None:
        from learn3d.files.writing import check_target
        from learn3d.runs.export import export

        check_target(self.output, "--output")
        size = export(self.source, self.output, which=self.which)
        say(f"{self.output} ({size / 1e6:.1f} MB)")
