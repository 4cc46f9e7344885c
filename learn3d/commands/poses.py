"""`learn3d estimate-poses`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tqdm import tqdm

from learn3d.commands.command import Command
from learn3d.data.layouts import Layout
from learn3d.files.writing import check_target
from learn3d.pictures.sheets import save_png
from learn3d.poses.estimate import PoseOptions
from learn3d.poses.sheet import LEGEND, draw_sheet
from learn3d.poses.views import SURE, CameraOptions, compare, estimate_views, load_views
from learn3d.settings import Count
from learn3d.terminal import is_watched, note, say


@dataclass(frozen=True, kw_only=True)
class EstimatePoses(Command):
    """Estimate the pose of each image of a data set from the masks alone, for `learn3d train --poses`.

    Examples:
      learn3d estimate-poses photos --layout photos --category mug --elevation 20 --output mug-poses.npz
      learn3d estimate-poses DATA --category airplane --output poses.npz --compare

    It also writes a sheet (poses.png). Look at it: all images below an azimuth must show the object from there.
    Azimuth 0 is a side that the estimate chooses.
    """

    data: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="DATA")]]
    """Folder of the data set."""
    category: str
    """Categories, separated by commas, which share the prototypes."""
    output: Path
    """File of the table (.npz)."""
    layout: Layout = "kato"
    """Arrangement of the files of the data set, see docs/data-sets.md."""
    options: PoseOptions
    cameras: CameraOptions
    candidates: Annotated[int, tyro.conf.arg(metavar="INT")] = 4
    """Number of poses of each image in the table, with probabilities; each training step draws one."""
    compare: bool = False
    """Compare with the known azimuths, and turn the table into their frame, so that voxel IoU can be measured."""
    views_per_object: Count | None = None
    """Number of training images of each object (default: the layout's protocol, one for kar, else all)."""

    def run(self) -> None:
        if not 1 <= self.candidates <= 64:
            raise ValueError(f"candidates must lie in 1 .. 64, got {self.candidates}")
        check_target(self.output, "--output")
        datasets = load_views(self.layout, self.data, self.category, self.views_per_object)
        with tqdm(total=self.options.all_steps, desc="poses", unit="step", disable=not is_watched()) as bar:
            views = estimate_views(datasets, self.cameras, self.options, self.candidates, bar.update)
        table = views.table
        doubtful = float((table.confidence < SURE).mean())
        say(f"{len(table.confidence)} images: mean confidence {table.confidence.mean():.2f}, below .5: {doubtful:.0%}")
        if self.compare:
            comparison = compare(views)
            say(comparison.text())
            table = table.turned(comparison.offset_deg)
        for warning in views.warnings:
            note(f"warning: {warning}")
        table.write(self.output)
        sheet = self.output.with_suffix(".png")
        save_png(sheet, draw_sheet(views))
        say(f"written to {self.output}; sheet {sheet}: {LEGEND}")
