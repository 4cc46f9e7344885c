"""Draw the paper's figures from the checkpoints of trained runs.

Examples:
  python tools/figures.py grid --runs runs/vanilla runs/proposed --output pictures/comparison.png
  python tools/figures.py tsne --runs runs/vanilla runs/proposed --output pictures/tsne.png
  python tools/figures.py interpolation --runs runs/proposed --output pictures/interpolation.png
  python tools/figures.py curves --runs runs/vanilla runs/proposed --output pictures/curves.png
  python tools/figures.py polar --runs runs/vanilla runs/proposed --output pictures/polar.png
  python tools/figures.py all --runs runs/vanilla runs/proposed --output pictures
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from learn3d.figures import paper
from learn3d.figures.interpolation import AZIMUTHS_DEG
from learn3d.figures.runs import Run, open_runs
from learn3d.files.writing import check_target_folder
from learn3d.terminal import in_a_sentence, note, say


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """What every figure takes."""

    output: Path
    """File to write; its ending is replaced by those of the files that the figure consists of."""
    runs: tuple[Path, ...] = ()
    """Folders of training runs (or checkpoint files), in the order in which they are shown."""
    labels: tuple[str, ...] = ()
    """What to call each run. None given: the names of their presets."""

    @property
    def folder(self) -> Path:
        """Where the files go."""
        return self.output.parent


@dataclass(frozen=True, kw_only=True)
class Measured(Drawn):
    """What figures of networks and data take."""

    data: Path | None = None
    """Folder of the data set. None: the one each run was trained on."""
    category: str | None = None
    """Class to show. None: the one each run was trained on."""
    split: Literal["train", "val", "test"] = "test"
    """Part of the data set."""
    checkpoint: Literal["last", "best"] = "last"
    """Which networks of a run folder: the last ones, or those with the best validation IoU."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the networks run."""

    def open(self) -> list[Run]:
        return open_runs(
            self.runs,
            labels=self.labels,
            data=self.data,
            category=self.category,
            split=self.split,
            which=self.checkpoint,
            device=self.device,
            report_progress=note,
        )


@dataclass(frozen=True, kw_only=True)
class Grid(Measured):
    """Test images and each run's shape from the input's view and five more (PNG)."""

    images: int | None = None
    """How many images, spread over objects and views. None: 6, or 2 of each of several classes."""
    indices: tuple[int, ...] = ()
    """Samples of the data set to show instead."""
    truth: bool = False
    """Show the true voxels, too."""

    def draw(self) -> list[Path]:
        return [paper.save_grid(self.open(), self.output, images=self.images, indices=self.indices, truth=self.truth)]


@dataclass(frozen=True, kw_only=True)
class Tsne(Measured):
    """Shape codes of test images in the plane, coloured by the view (PNG, SVG)."""

    max_images: int = 2000
    """Images that are laid out, at most."""
    seed: int = 0
    """Seed of the layout."""

    def draw(self) -> list[Path]:
        return paper.save_tsne(self.open(), self.output, max_images=self.max_images, seed=self.seed)


@dataclass(frozen=True, kw_only=True)
class Interpolation(Measured):
    """Shapes between those of some test images: a strip (PNG) and a morph (GIF)."""

    images: int = 3
    """How many images, of typical but different objects."""
    indices: tuple[int, ...] = ()
    """Samples of the data set to use instead."""
    steps: int = 4
    """Steps from one image to the next in the strip."""
    frames: int = paper.FRAMES
    """The same in the morph."""
    azimuths: tuple[float, ...] = AZIMUTHS_DEG
    """Viewpoints: azimuths in degrees."""

    def draw(self) -> list[Path]:
        options = {"images": self.images, "indices": self.indices, "steps": self.steps, "frames": self.frames}
        return paper.save_interpolation(self.open(), self.output, azimuths=self.azimuths, **options)


@dataclass(frozen=True, kw_only=True)
class Curves(Drawn):
    """Losses, validation IoU and MMD over the steps, a band over seeds (PNG, SVG)."""

    def draw(self) -> list[Path]:
        return paper.save_curves(self.runs, self.output, labels=self.labels)


@dataclass(frozen=True, kw_only=True)
class Polar(Measured):
    """IoU by the azimuth of the input view, and agreement of the shapes from different views (PNG, SVG, JSON)."""

    values: Path | None = None
    """Draw these values, a JSON that this command wrote, instead of measuring --runs."""
    voxels: Literal["kato18", "kato19"] = "kato18"
    """Voxeliser of the shapes."""

    def draw(self) -> list[Path]:
        if (self.values is None) == (not self.runs):
            raise ValueError("give either --runs to measure, or --values to draw")
        if self.values is not None:
            return paper.redraw_polar(self.values, self.output)
        return paper.save_polar(self.open(), self.output, definition=self.voxels)


@dataclass(frozen=True, kw_only=True)
class All(Measured):
    """Every figure with its defaults, as far as data and runs allow; --output is a folder."""

    @property
    def folder(self) -> Path:
        return self.output

    def draw(self) -> list[Path]:
        written, failed = paper.save_all(self.open(), self.runs, self.output, labels=self.labels, report_progress=note)
        for text in failed:
            note(f"not drawn: {text}")
        return written


Command = (
    Annotated[Grid, tyro.conf.subcommand("grid")]
    | Annotated[Tsne, tyro.conf.subcommand("tsne")]
    | Annotated[Interpolation, tyro.conf.subcommand("interpolation")]
    | Annotated[Curves, tyro.conf.subcommand("curves")]
    | Annotated[Polar, tyro.conf.subcommand("polar")]
    | Annotated[All, tyro.conf.subcommand("all")]
)


@in_a_sentence()
def main() -> int:
    command = tyro.cli(Command, description=__doc__)
    check_target_folder(command.folder, "--output")
    for path in command.draw():
        say(str(path))
    return 0


if __name__ == "__main__":
    sys.exit(main())
