"""Commands that show trained models: figures, a page about runs, and a page that reconstructs pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from learn3d.commands.command import Command, OnDataset, Runs
from learn3d.files.writing import check_target
from learn3d.terminal import note, say


@dataclass(frozen=True, kw_only=True)
class Figures(OnDataset):
    """Draw the paper's figures from trained runs.

    Figures:
      grid           test images and each run's shape from the input's view and five more (PNG)
      tsne           shape codes of test images in the plane, coloured by the view (PNG, SVG)
      interpolation  shapes between those of some test images (PNG)

    Examples:
      learn3d figures grid --runs runs/vanilla runs/proposed --output pictures/comparison.png
      learn3d figures tsne --runs runs/vanilla runs/proposed --output pictures/tsne.png
    """

    figure: tyro.conf.Positional[Annotated[Literal["grid", "tsne", "interpolation"], tyro.conf.arg(metavar="FIGURE")]]
    """One of the figures above."""
    runs: tuple[Path, ...]
    """Run folders (or checkpoint files), in the order of the figure."""
    output: Path
    """File to write; its ending is replaced by those of the figure's formats."""
    labels: tuple[str, ...] = ()
    """Names of the runs (default: those of their presets)."""
    images: int | None = None
    """Number of images in a grid (default: 6) or an interpolation (default: 3)."""
    indices: tuple[int, ...] = ()
    """Samples of the data set in a grid or an interpolation (default: --images of different objects and views)."""
    truth: bool = False
    """Show the ground-truth voxels in a grid as well."""

    def run(self) -> None:
        from learn3d.figures import paper
        from learn3d.figures.runs import open_runs

        check_target(self.output.parent, "--output", folder=True)
        allowed = {"grid": ("images", "indices", "truth"), "interpolation": ("images", "indices")}
        own = {name: getattr(self, name) for name in allowed["grid"] if getattr(self, name) != getattr(Figures, name)}
        if wrong := [f"--{name}" for name in own if name not in allowed.get(self.figure, ())]:
            raise ValueError(f"the figure {self.figure} has no {', '.join(wrong)}; leave it out")
        runs = open_runs(self.runs, labels=self.labels, report_progress=note, **self.source)
        paths = getattr(paper, f"save_{self.figure}")(runs, self.output, **own)
        say("\n".join(map(str, paths)))


@dataclass(frozen=True, kw_only=True)
class Report(OnDataset):
    """Write one HTML file about trained runs: options, curves, test IoU, and shapes that one can turn.

    Examples:
      learn3d report runs/plus runs/vanilla --output report.html
      learn3d report runs/plus --data DATA --indices 0 31 62 --output report.html
    """

    runs: Runs
    """Run folders, or checkpoint files, of one category."""
    output: Path
    """File to write, .html."""
    labels: tuple[str, ...] = ()
    """Names of the runs (default: those of their presets)."""
    objects: int = 12
    """Number of objects to show, spread from the best IoU to the worst."""
    indices: tuple[int, ...] = ()
    """Numbers of the images to show (default: from --objects). With V views of each object, image n * V + k is view k
    of object n."""

    def run(self) -> None:
        from learn3d.pages.report import write_report

        check_target(self.output, "--output")
        shown = {"labels": self.labels, "objects": self.objects, "indices": self.indices}
        size = write_report(self.runs, self.output, report_progress=note, **shown, **self.source)
        say(f"{self.output} ({size / 1e6:.1f} MB)")


@dataclass(frozen=True)
class Demo(Command):
    """Open a page in the browser that turns pictures into meshes.

    Examples:
      learn3d demo
      learn3d demo --run runs/vanilla runs/proposed    (meshes of both, side by side)
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.arg(name="run")] = ()
    """Run folders (or checkpoint files) of trained models (default: the small model of the package)."""
    port: int = 7860
    """Port of the page's address, http://HOST:PORT."""
    host: str = "127.0.0.1"
    """Address to listen on. With 0.0.0.0 everybody in the network can use the page."""
    browser: bool = True
    """Open a browser, or only print the address of the page."""

    def run(self) -> None:
        from learn3d.demo.server import serve

        serve(self.runs, host=self.host, port=self.port, browser=self.browser)
