"""Commands on data sets: fetch meshes, make, convert and check a data set, estimate its poses."""

import dataclasses
from pathlib import Path

from learn3d.commands.command import Command, DataFolder, Split
from learn3d.data import shards
from learn3d.data.categories import synset_of
from learn3d.data.conventions import IMAGE_SIZE
from learn3d.data.layouts import Layout, check_folder, load_dataset
from learn3d.data.readers import READERS
from learn3d.files.writing import check_target, write_json
from learn3d.make_data.debian.models import fetch_debian_models
from learn3d.make_data.render import DatasetConfig, make_dataset, make_shards
from learn3d.pictures.sheets import save_png
from learn3d.poses.estimate import PoseOptions
from learn3d.poses.views import MIN_CONFIDENCE, CameraOptions, compare, draw_sheet, estimate_views, load_views
from learn3d.settings import Count, split_names
from learn3d.terminal import align, note, say


class MakeDataset(Command):
    """Render a data set from a folder of meshes, a mesh pack or procedural shapes, in the layout of a published one.

    Examples:
      learn3d make-dataset --output data --category chair --source my_chairs --augment 5
      learn3d make-dataset --output data --category airplane --procedural 300
      learn3d make-dataset --output big --category chair --source my_chairs --shards --jobs 8
    """

    config: DatasetConfig

    def run(self) -> int:
        if self.config.shards:
            return make_shards(self.config)
        say(make_dataset(self.config).text())
        return 0


class FetchDebianModels(Command):
    """Extract airplanes, chairs, tables, cabinets, sofas and lamps from Debian packages into a folder of PLY meshes.

    Example:
      learn3d fetch-debian-models --output models
    """

    output: Path
    """Folder to write; it must not exist."""
    packages_dir: Path | None = None
    """Folder for the .deb files; missing ones are downloaded into it (default: a temporary folder)."""

    def run(self) -> None:
        say(fetch_debian_models(self.output, self.packages_dir).summary())
        say(f"written to {self.output}")


class CheckDataset(Command):
    """Read every file of a data set and list all faults: missing, truncated, empty or inconsistent files.

    Example:
      learn3d check-dataset DATA --layout kar --category airplane,chair --split train

    The exit status is 1 if there are errors, with which training or evaluation would fail, and 0 otherwise.
    """

    folder: DataFolder
    """Folder of the data set."""
    layout: Layout = "kato"
    """Arrangement of its files, see docs/data-sets.md."""
    category: str = ""
    """Categories to read, by name or synset id, separated by commas (default: all)."""
    split: tuple[Split, ...] = ()
    """Splits to read (default: all)."""
    json: Path | None = None
    """JSON file for the report (default: none)."""

    def run(self) -> int:
        if self.json is not None:
            check_target(self.json, "--json")
        splits = check_folder(self.layout, self.folder, split_names(self.category), self.split)
        for problem in (problem for split in splits for problem in split.problems):
            say(f"{problem.severity}: {problem.path}: {problem.message}")
        rows = [(s.category, s.split, s.objects, s.count("error"), s.count("warning")) for s in splits]
        errors, warnings = (sum(row[column] for row in rows) for column in (3, 4))
        table = align([("category", "split", "objects", "errors", "warnings"), *(tuple(map(str, row)) for row in rows)])
        say(f"\n{table}\n\n{errors} errors, {warnings} warnings")
        if self.json is not None:
            report = {"errors": errors, "warnings": warnings, "layout": self.layout, "folder": str(self.folder)}
            write_json(self.json, report | {"splits": [dataclasses.asdict(split) for split in splits]})
        return 1 if errors else 0


class ConvertDataset(Command):
    """Convert a data set that is larger than memory into shards, which training reads piece by piece.

    Example:
      learn3d convert-dataset --data KAR --layout kar --output SHARDS --category chair,airplane

    Then give the other commands SHARDS in place of DATA, with the same layout (docs/scale.md). Splits that are complete
    are skipped.
    """

    data: Path
    """Folder of the data set."""
    output: Path
    """Folder for the shards. Each category and split gets a folder in it."""
    category: str = ""
    """Categories, separated by commas (default: all)."""
    layout: Layout = "kato"
    """Arrangement of the files of the data set, see docs/data-sets.md."""
    image_size: int = IMAGE_SIZE
    """Side of the images in pixels, for the method's encoder; larger images are scaled down."""
    views_per_object: Count | None = None
    """Number of training images to keep of each object (default: the layout's protocol, one for kar, else all)."""

    def run(self) -> None:
        check_target(self.output, "--output", folder=True)
        found = READERS[self.layout].contents(self.data)
        splits_of = {synset_of(category): splits for category, splits in found.items()}
        if not (wanted := split_names(self.category) or found):
            raise ValueError(f"{self.data} holds nothing of the layout {self.layout!r}")
        for category in wanted:
            splits = splits_of.get(synset_of(category), ("train",))
            if self.layout == "pascal3d" and "val" in splits:
                splits = (*splits, "test")  # evaluation reads the val photographs by this name
            for split in splits:
                folder = shards.split_folder(self.output, category, split)
                if shards.holds(self.output, category, split):
                    say(f"{folder}: exists; remove it to convert it again")
                    continue
                few = {"views_per_object": self.views_per_object} if split == "train" else {}
                dataset = load_dataset(self.layout, self.data, category, split, image_size=self.image_size, **few)
                shards.remove(folder)  # an unfinished conversion
                count = shards.write_set(folder, self.layout, dataset)
                say(f"{folder}: {len(dataset)} images of {dataset.num_objects} objects in {count} shards")


class EstimatePoses(Command):
    """Estimate the pose of each image of a data set from the masks alone, for `learn3d train --poses`.

    Examples:
      learn3d estimate-poses photos --layout photos --category mug --elevation 20 --output mug-poses.npz
      learn3d estimate-poses DATA --category airplane --output poses.npz --compare

    It also writes a sheet (poses.png). Look at it: all images below an azimuth must show the object from there.
    Azimuth 0 is a side that the estimate chooses.
    """

    data: DataFolder
    """Folder of the data set."""
    category: str
    """Categories, separated by commas, which share the prototypes."""
    output: Path
    """File of the table (.npz)."""
    layout: Layout = "kato"
    """Arrangement of the files of the data set, see docs/data-sets.md."""
    options: PoseOptions
    cameras: CameraOptions
    compare: bool = False
    """Compare with the known azimuths, and turn the table into their frame, so that voxel IoU can be measured."""
    views_per_object: Count | None = None
    """Number of training images of each object (default: the layout's protocol, one for kar, else all)."""

    def run(self) -> None:
        check_target(self.output, "--output")
        datasets = load_views(self.layout, self.data, self.category, self.views_per_object)
        views = estimate_views(datasets, self.cameras, self.options)
        table, offset_deg = views.table, 0.0
        doubtful = float((table.confidence < MIN_CONFIDENCE).mean())
        say(f"{len(table.confidence)} images: mean confidence {table.confidence.mean():.2f}, below 0.5: {doubtful:.0%}")
        if self.compare:
            comparison = compare(views)
            say(comparison.text())
            offset_deg = comparison.offset_deg
            table = table.turned(offset_deg)
        for warning in views.warnings:
            note(f"warning: {warning}")
        table.write(self.output)
        sheet = self.output.with_suffix(".png")
        save_png(sheet, draw_sheet(views, offset_deg))
        rows = "first rows: renderings of the prototypes; other rows: images with that estimated azimuth"
        say(f"written to {self.output}; sheet {sheet}: columns: azimuths; {rows}")
