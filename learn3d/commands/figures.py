"""Draw the paper's figures from trained runs.

Examples:
  learn3d figures all --runs runs/vanilla runs/proposed --output pictures
  learn3d figures grid --runs runs/vanilla runs/proposed --output pictures/comparison.png
  learn3d figures tsne --runs runs/vanilla runs/proposed --output pictures/tsne.png
  learn3d figures interpolation --runs runs/proposed --output pictures/interpolation.png
  learn3d figures curves --runs runs/vanilla runs/proposed --output pictures/curves.png
  learn3d figures polar --runs runs/vanilla runs/proposed --output pictures/polar.png
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from learn3d.commands.packages import missing_package
from learn3d.commands.parsing import parse
from learn3d.terminal import note, say

if TYPE_CHECKING:
    from learn3d.figures.runs import Run


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """What every figure takes."""

    output: Path
    """File to write; its ending is replaced by those of the files that the figure consists of."""
    runs: tuple[Path, ...] = ()
    """Folders of training runs (or checkpoint files), in the order in which they are shown."""
    labels: tuple[str, ...] = ()
    """What to call each run, if not by its preset."""


@dataclass(frozen=True, kw_only=True)
class Measured(Drawn):
    """What figures of networks and data take."""

    data: Path | None = None
    """Folder of the data set, if not the one each run was trained on."""
    category: str | None = None
    """Class to show, if not the one each run was trained on."""
    split: Literal["train", "val", "test"] = "test"
    """Part of the data set."""
    checkpoint: Literal["last", "best"] = "last"
    """Which networks of a run: the last ones, or those with the best validation IoU."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the networks run."""

    def open(self) -> list[Run]:
        """The runs with their data."""
        from learn3d.figures.runs import open_runs

        options = {"data": self.data, "category": self.category, "split": self.split, "device": self.device}
        return open_runs(self.runs, labels=self.labels, which=self.checkpoint, report_progress=note, **options)


@dataclass(frozen=True, kw_only=True)
class Grid(Measured):
    """Test images and each run's shape from the input's view and five more (PNG)."""

    images: int | None = None
    """How many images, spread over objects and views. None given: 6, or 2 of each of several classes."""
    indices: tuple[int, ...] = ()
    """Samples of the data set to show instead."""
    truth: bool = False
    """Show the true voxels, too."""


@dataclass(frozen=True, kw_only=True)
class Tsne(Measured):
    """Shape codes of test images in the plane, coloured by the view (PNG, SVG)."""


@dataclass(frozen=True, kw_only=True)
class Interpolation(Measured):
    """Shapes between those of some test images: a strip (PNG) and a morph (GIF)."""

    images: int = 3
    """How many images, of typical but different objects."""
    indices: tuple[int, ...] = ()
    """Samples of the data set to use instead."""
    steps: int = 4
    """Steps from one image to the next in the strip."""


@dataclass(frozen=True, kw_only=True)
class Curves(Drawn):
    """Losses, validation IoU and MMD over the steps, a band over seeds (PNG, SVG)."""


@dataclass(frozen=True, kw_only=True)
class Polar(Measured):
    """IoU by the azimuth of the input view, and agreement of the shapes from different views (PNG, SVG, JSON)."""

    voxels: Literal["kato18", "kato19"] = "kato18"
    """Voxeliser of the shapes."""


@dataclass(frozen=True, kw_only=True)
class All(Measured):
    """Every figure with its defaults, as far as data and runs allow; --output is a folder."""


FIGURES = {"all": All, "grid": Grid, "tsne": Tsne, "interpolation": Interpolation, "curves": Curves, "polar": Polar}
PACKAGES = {"tsne": ("matplotlib", "sklearn"), "curves": ("matplotlib",), "polar": ("matplotlib",)}


def run(arguments: Sequence[str]) -> int:
    """Draw, and print the paths of the files."""
    name, *rest = arguments or ["--help"]
    if name not in FIGURES:
        if not {"-h", "--help", "--help-all"} & {name, *rest}:
            raise ValueError(f"there is no figure {name!r}; choose one of {', '.join(FIGURES)}")
        described = "\n".join(f"  {name:13}  {figure.__doc__}" for name, figure in FIGURES.items())
        say(f"usage: learn3d figures FIGURE --runs RUN [RUN ...] --output PATH [OPTIONS]\n\n{described}\n")
        say("learn3d figures FIGURE --help has the options of a figure.\n")
        say(__doc__.partition("\n")[2].strip())
        return 0
    command = parse(FIGURES[name], rest, name=f"figures {name}", about=FIGURES[name].__doc__)
    lacking = {f: reason for f in PACKAGES if (reason := _lacking(f))}
    if name in lacking:
        raise ValueError(f"the figure {name} {lacking[name]}")
    from learn3d.figures import paper
    from learn3d.files.writing import check_target

    where, runs = command.output, command.runs
    check_target(where if name == "all" else where.parent, "--output", folder=True)
    if name == "curves":
        paths = paper.save_curves(runs, where, labels=command.labels)
    elif name == "polar":
        paths = paper.save_polar(command.open(), where, definition=command.voxels)
    elif name == "tsne":
        paths = paper.save_tsne(command.open(), where)
    elif name == "grid":
        options = {"images": command.images, "indices": command.indices, "truth": command.truth}
        paths = [paper.save_grid(command.open(), where, **options)]
    elif name == "interpolation":
        options = {"images": command.images, "indices": command.indices, "steps": command.steps}
        paths = paper.save_interpolation(command.open(), where, **options)
    else:
        paths = paper.save_all(command.open(), runs, where, labels=command.labels, without=lacking, say=note)
    for path in paths:
        say(str(path))
    return 0


def _lacking(figure: str) -> str:
    """What to say where a package that the figure needs is not installed."""
    absent = [package for package in PACKAGES[figure] if find_spec(package) is None]
    return missing_package(absent[0]) if absent else ""
