"""`learn3d figures`."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import tyro

from learn3d.commands.command import OnDataset
from learn3d.commands.packages import missing_package
from learn3d.figures import paper
from learn3d.figures.runs import open_runs
from learn3d.files.writing import check_target
from learn3d.terminal import note, say

#: Packages that figures need beside those that every picture needs.
PACKAGES = {"tsne": ("matplotlib", "sklearn"), "curves": ("matplotlib",), "polar": ("matplotlib",)}
#: Options that only some figures have.
OPTIONS = {
    "grid": ("images", "indices", "truth"),
    "interpolation": ("images", "indices", "steps"),
    "polar": ("voxels",),
}


@dataclass(frozen=True, kw_only=True)
class Figures(OnDataset):
    """Draw the paper's figures from trained runs.

    Figures:
      all            every figure with its defaults, as far as data and runs allow; --output is a folder
      grid           test images and each run's shape from the input's view and five more (PNG)
      tsne           shape codes of test images in the plane, coloured by the view (PNG, SVG)
      interpolation  shapes between those of some test images: a strip (PNG) and a morph (GIF)
      curves         losses, validation IoU and MMD over the steps, a band over seeds (PNG, SVG)
      polar          IoU and agreement of shapes by the azimuth of the input view (PNG, SVG, JSON)

    Examples:
      learn3d figures all --runs runs/vanilla runs/proposed --output pictures
      learn3d figures grid --runs runs/vanilla runs/proposed --output pictures/comparison.png
      learn3d figures curves --runs runs/vanilla runs/proposed --output pictures/curves.png
    """

    figure: tyro.conf.Positional[
        Annotated[Literal["all", "grid", "tsne", "interpolation", "curves", "polar"], tyro.conf.arg(metavar="FIGURE")]
    ]
    """One of the figures above."""
    runs: tuple[Path, ...]
    """Folders of training runs (or checkpoint files), in the order in which they are shown."""
    output: Path
    """File to write; its ending is replaced by those of the files that the figure consists of."""
    labels: tuple[str, ...] = ()
    """Names of the runs (default: those of their presets)."""
    images: int | None = None
    """Number of images in a grid (default: 6, or 2 of each of several categories) or an interpolation (default: 3)."""
    indices: tuple[int, ...] = ()
    """Samples of the data set in a grid or an interpolation (default: as many as --images says, chosen to differ)."""
    truth: bool = False
    """Show the true voxels in a grid, too."""
    steps: int = 4
    """Steps from one image to the next in the strip of an interpolation."""
    voxels: Literal["kato18", "kato19"] = "kato18"
    """Voxelizer of the shapes in a polar figure."""

    def run(self) -> None:
        lacking = {name: reason for name in PACKAGES if (reason := _lacking(name))}
        if self.figure in lacking:
            raise ValueError(f"the figure {self.figure} {lacking[self.figure]}")
        check_target(self.output if self.figure == "all" else self.output.parent, "--output", folder=True)
        for path in self._draw(lacking):
            say(str(path))

    def _draw(self, lacking: dict[str, str]) -> list[Path]:
        own = {name: getattr(self, name) for names in OPTIONS.values() for name in names}
        given = {name: value for name, value in own.items() if value != getattr(Figures, name)}
        if wrong := [f"--{name}" for name in given if name not in OPTIONS.get(self.figure, ())]:
            raise ValueError(f"the figure {self.figure} has no {', '.join(wrong)}; leave it out")
        if self.figure == "curves":
            return paper.save_curves(self.runs, self.output, labels=self.labels)
        runs = open_runs(self.runs, labels=self.labels, report_progress=note, **self.where)
        if self.figure == "grid":
            return [paper.save_grid(runs, self.output, **given)]
        if self.figure == "tsne":
            return paper.save_tsne(runs, self.output)
        if self.figure == "interpolation":
            return paper.save_interpolation(runs, self.output, **given)
        if self.figure == "polar":
            return paper.save_polar(runs, self.output, definition=self.voxels)
        return paper.save_all(runs, self.runs, self.output, labels=self.labels, without=lacking, say=note)


def _lacking(figure: str) -> str:
    """The message about a package that the figure needs and that is not installed, "" if there is none."""
    absent = [package for package in PACKAGES[figure] if find_spec(package) is None]
    return missing_package(absent[0]) if absent else ""
