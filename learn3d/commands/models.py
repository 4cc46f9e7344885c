"""Commands on trained models: measure them, reconstruct images, export them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from learn3d.commands.command import Command, OnDataset, Runs, Which
from learn3d.files.writing import check_target, write_json
from learn3d.terminal import note, say


@dataclass(frozen=True, kw_only=True)
class Evaluate(OnDataset):
    """Measure trained models on a test set: voxel IoU of each category and its mean, and more.

    Example:
      learn3d evaluate runs/airplane runs/chair --json table.json
    """

    runs: Runs
    """Run folders, or checkpoint files."""
    layout: str | None = None
    """Arrangement of the files of the data set (default: from the run)."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device on which the networks run."""
    json: Path | None = None
    """JSON file for the figures, with protocol and versions (default: none)."""

    @classmethod
    def about(cls, everything: bool) -> str:
        from learn3d.experiments.measurement import describe_measures

        columns = "Columns of the table (means over the images, then over the categories; - if there is no value):"
        return f"{super().about(everything)}\n\n{columns}\n{describe_measures()}"

    def run(self) -> None:
        from learn3d.experiments.measurement import class_means, evaluate_runs, format_table

        if self.json is not None:
            check_target(self.json, "--json")
        options = {"layout": self.layout, "device": self.device, **self.source}
        results = evaluate_runs(self.runs, report_progress=note, **options)
        say(format_table(results))
        if self.json is not None:
            protocol = {"split": self.split, "checkpoint": self.which}
            values = [result.model_dump() for result in results]
            write_json(self.json, {"protocol": protocol, "results": values, "means": class_means(results)})


@dataclass(frozen=True, kw_only=True)
class Reconstruct(OnDataset):
    """Turn images into meshes, each with a turntable animation and a strip of views.

    Examples:
      learn3d reconstruct photo.png --output meshes    (transparent background; the small model of the package)
      learn3d reconstruct photo.jpg --masks mask.png --run runs/airplane --output meshes
      learn3d reconstruct --data DATA --indices 0 31 62 --run runs/airplane --output meshes
    """

    output: Path
    """Folder for the results: a mesh, a turntable GIF and a PNG strip of each image."""
    model: Annotated[Path | None, tyro.conf.arg(name="run")] = None
    """Run folder (or checkpoint file) of the trained model (default: the small model of the package)."""
    images: tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="[IMAGE ...]")]] = ()
    """Images of any size, with a transparent background, --masks or --plain-background (default: images of --data)."""
    masks: tuple[Path, ...] = ()
    """Mask images (white = object), one for each image (default: the transparency of the images)."""
    plain_background: bool = False
    """The background has one colour: pixels that differ from the border belong to the object."""
    box: tuple[int, int, int, int] | None = None
    """Box around the object in a single photograph: X Y WIDTH HEIGHT in pixels, from the upper left. The object is cut
    out of it (needs the extra photos)."""
    crop: bool = True
    """Centre and scale the object in each image as in the data set, or leave the images as they are."""
    data: Path | None = None
    """Data set from which images are taken (default: image files are given)."""
    indices: tuple[int, ...] = (0,)
    """Images of the data set: object * V + view, if each object has V views (Kato's: 24, Kar's: 20)."""
    refine: bool | None = None
    """Fit the predicted shapes to the masks. The cameras are those of the data set; for image files cameras and colours
    are estimated (default: yes for image files, no for --data)."""
    format: Literal["glb", "obj", "ply"] = "glb"
    """Format of the mesh files."""

    def run(self) -> None:
        self._check()
        from learn3d.reconstruction import reconstruct_dataset, reconstruct_files

        check_target(self.output, "--output", folder=True)
        if self.data is not None:
            options = {"indices": self.indices, "refined": bool(self.refine), **self.source}
            paths = reconstruct_dataset(self.model, self.output, mesh_format=self.format, **options)
        else:
            options = {name: getattr(self, name) for name in ("crop", "plain_background", "box", "which")}
            options["refined"] = self.refine is not False
            files = (self.model, self.output, self.images, self.masks)
            paths = reconstruct_files(*files, mesh_format=self.format, **options)
        say("\n".join(map(str, paths)))

    def _check(self) -> None:
        """Raise ValueError if options contradict each other."""
        if bool(self.images) == (self.data is not None):
            raise ValueError("give either image files, or --data with --indices")
        if self.box is not None and (len(self.images) > 1 or self.masks or self.plain_background):
            raise ValueError("--box is for one photograph, without --masks and --plain-background")
        kind, others = "image files", ("category", "split", "indices")
        if self.data is not None:
            kind, others = "--data", ("masks", "plain_background", "box", "crop")
        if wrong := [name for name in others if getattr(self, name) != getattr(Reconstruct, name)]:
            options = ", ".join(f"--{name.replace('_', '-')}" for name in wrong)
            raise ValueError(f"{options} does not go with {kind}; leave it out")


@dataclass(frozen=True)
class Export(Command):
    """Write the networks of a run into one small file: in half precision, without the parts for training alone.

    Example:
      learn3d export --run runs/chair --output chair.safetensors
    """

    source: Annotated[Path, tyro.conf.arg(name="run")]
    """Run folder (or checkpoint file) of the trained model."""
    output: Path
    """File to write, .safetensors."""
    which: Which = "last"
    """Checkpoint of a run: the last one, or the one with the best validation IoU."""
    others: Path | None = None
    """Folder of PNG files with transparency that show other things, so that `reconstruct` warns of such pictures
    (default: it warns of pictures that are far from all training images)."""

    def run(self) -> None:
        from learn3d.reconstruction import cut_out_pictures, load_model
        from learn3d.runs.export import export

        check_target(self.output, "--output")
        others = None if self.others is None else cut_out_pictures(load_model(self.source, self.which), self.others)
        size = export(self.source, self.output, which=self.which, others=others)
        say(f"{self.output} ({size / 1e6:.1f} MB)")
