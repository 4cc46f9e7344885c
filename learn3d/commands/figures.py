"""`learn3d figures`."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from learn3d.commands.command import Command, OnDataset
from learn3d.commands.packages import missing_package
from learn3d.figures import paper
from learn3d.figures.runs import Run, open_runs
from learn3d.files.writing import check_target
from learn3d.terminal import note, say


@dataclass(frozen=True, kw_only=True)
class Figure:
    """Options of every figure."""

    packages: ClassVar[tuple[str, ...]] = ()  # needed beside those that drawing images needs

    output: Path
    """File to write; its ending is replaced by those of the files that the figure consists of."""
    runs: tuple[Path, ...]
    """Folders of training runs (or checkpoint files), in the order in which they are shown."""
    labels: tuple[str, ...] = ()
    """Names of the runs (default: those of their presets)."""

    @classmethod
    def lacks(cls) -> str:
        """What must be installed for the figure, "" if nothing is missing."""
        absent = [package for package in cls.packages if find_spec(package) is None]
        return missing_package(absent[0]) if absent else ""

    def draw(self) -> list[Path]:
        """Draw, and return the files."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class FigureOnDataset(OnDataset, Figure):
    """Options of figures that show networks at work on a data set."""

    def open(self) -> list[Run]:
        """The runs with their data."""
        return open_runs(self.runs, labels=self.labels, report_progress=note, **self.where)


@dataclass(frozen=True, kw_only=True)
class Grid(FigureOnDataset):
    """Test images and each run's shape from the input's view and five more (PNG)."""

    images: int | None = None
    """Number of images, spread over objects and views (default: 6, or 2 of each of several categories)."""
    indices: tuple[int, ...] = ()
    """Samples of the data set to show (default: as --images says)."""
    truth: bool = False
    """Show the true voxels, too."""

    def draw(self) -> list[Path]:
        options = {"images": self.images, "indices": self.indices, "truth": self.truth}
        return [paper.save_grid(self.open(), self.output, **options)]


@dataclass(frozen=True, kw_only=True)
class Tsne(FigureOnDataset):
    """Shape codes of test images in the plane, coloured by the view (PNG, SVG)."""

    packages = ("matplotlib", "sklearn")

    def draw(self) -> list[Path]:
        return paper.save_tsne(self.open(), self.output)


@dataclass(frozen=True, kw_only=True)
class Interpolation(FigureOnDataset):
    """Shapes between those of some test images: a strip (PNG) and a morph (GIF)."""

    images: int = 3
    """Number of images, of typical but different objects."""
    indices: tuple[int, ...] = ()
    """Samples of the data set to use (default: as --images says)."""
    steps: int = 4
    """Steps from one image to the next in the strip."""

    def draw(self) -> list[Path]:
        options = {"images": self.images, "indices": self.indices, "steps": self.steps}
        return paper.save_interpolation(self.open(), self.output, **options)


@dataclass(frozen=True, kw_only=True)
class Curves(Figure):
    """Losses, validation IoU and MMD over the steps, a band over seeds (PNG, SVG)."""

    packages = ("matplotlib",)

    def draw(self) -> list[Path]:
        return paper.save_curves(self.runs, self.output, labels=self.labels)


@dataclass(frozen=True, kw_only=True)
class Polar(FigureOnDataset):
    """IoU by the azimuth of the input view, and agreement of the shapes from different views (PNG, SVG, JSON)."""

    packages = ("matplotlib",)

    voxels: Literal["kato18", "kato19"] = "kato18"
    """Voxelizer of the shapes."""

    def draw(self) -> list[Path]:
        return paper.save_polar(self.open(), self.output, definition=self.voxels)


@dataclass(frozen=True, kw_only=True)
class All(FigureOnDataset):
    """Every figure with its defaults, as far as data and runs allow; --output is a folder."""

    def draw(self) -> list[Path]:
        without = {name: kind.lacks() for name, kind in FIGURES.items() if kind.lacks()}
        options = {"labels": self.labels, "without": without, "say": note}
        return paper.save_all(self.open(), self.runs, self.output, **options)


FIGURES = {"all": All, "grid": Grid, "tsne": Tsne, "interpolation": Interpolation, "curves": Curves, "polar": Polar}


@dataclass(frozen=True)
class Figures(Command):
    """Draw the paper's figures from trained runs.

    Examples:
      learn3d figures all --runs runs/vanilla runs/proposed --output pictures
      learn3d figures grid --runs runs/vanilla runs/proposed --output pictures/comparison.png
      learn3d figures tsne --runs runs/vanilla runs/proposed --output pictures/tsne.png
      learn3d figures interpolation --runs runs/proposed --output pictures/interpolation.png
      learn3d figures curves --runs runs/vanilla runs/proposed --output pictures/curves.png
      learn3d figures polar --runs runs/vanilla runs/proposed --output pictures/polar.png
    """

    figure: (
        Annotated[All, tyro.conf.subcommand("all")]
        | Annotated[Grid, tyro.conf.subcommand("grid")]
        | Annotated[Tsne, tyro.conf.subcommand("tsne")]
        | Annotated[Interpolation, tyro.conf.subcommand("interpolation")]
        | Annotated[Curves, tyro.conf.subcommand("curves")]
        | Annotated[Polar, tyro.conf.subcommand("polar")]
    )

    def run(self) -> None:
        figure = self.figure
        if reason := figure.lacks():
            raise ValueError(f"the figure {type(figure).__name__.lower()} {reason}")
        check_target(figure.output if isinstance(figure, All) else figure.output.parent, "--output", folder=True)
        for path in figure.draw():
            say(str(path))
