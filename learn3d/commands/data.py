"""Commands on data sets: check and convert."""

import dataclasses
from pathlib import Path

from learn3d.commands.command import Command, DataFolder, Split
from learn3d.data import shards
from learn3d.data.conventions import IMAGE_SIZE, SET_FILE, has_shards, shards_folder, synset_of
from learn3d.data.layouts import Layout, check_folder, check_options, load_dataset, reader
from learn3d.files.writing import check_target, write_json
from learn3d.settings import Count, Pixels, split_names
from learn3d.tasks import Task, Workers, make_missing
from learn3d.terminal import align, say


class CheckDataset(Command):
    """Read every file of a data set and list all faults: missing, truncated, empty or
    inconsistent files.

    Example:
      learn3d check-dataset DATA --layout kar --category airplane,chair --split train

    The exit status is 1 if there are errors, with which training or evaluation would fail, and 0
    otherwise.
    """

    folder: DataFolder
    """Folder of the data set."""
    layout: Layout = "kato"
    """Arrangement of its files, see docs/data-sets.md."""
    category: str = ""
    """Categories to read, by name or synset id, separated by commas. If not given: all."""
    split: tuple[Split, ...] = ()
    """Splits to read. If not given: all."""
    json: Path | None = None
    """JSON file for the report."""

    def run(self) -> int:
        if self.json is not None:
            check_target(self.json, "--json")
        splits = check_folder(self.layout, self.folder, split_names(self.category), self.split)
        for problem in (problem for split in splits for problem in split.problems):
            say(f"{problem.severity}: {problem.path}: {problem.message}")
        rows = [
            (s.category, s.split, s.objects, s.count("error"), s.count("warning")) for s in splits
        ]
        errors, warnings = (sum(row[column] for row in rows) for column in (3, 4))
        table = align(
            [
                ("category", "split", "objects", "errors", "warnings"),
                *(tuple(map(str, row)) for row in rows),
            ]
        )
        say(f"\n{table}\n\n{errors} errors, {warnings} warnings")
        if self.json is not None:
            report = {
                "errors": errors,
                "warnings": warnings,
                "layout": self.layout,
                "folder": str(self.folder),
            }
            write_json(
                self.json, report | {"splits": [dataclasses.asdict(split) for split in splits]}
            )
        return 1 if errors else 0


class ConvertDataset(Command):
    """Convert a data set that is larger than memory into shards, which training reads piece by
    piece.

    Example:
      learn3d convert-dataset --data KAR --layout kar --output SHARDS --category chair,airplane

    Then give the other commands SHARDS in place of DATA, with the same layout (docs/scale.md).
    Splits that are complete are skipped.
    """

    data: Path
    """Folder of the data set."""
    output: Path
    """Folder for the shards. Each category and split gets a folder in it."""
    category: str = ""
    """Categories, separated by commas. If not given: all."""
    layout: Layout = "kato"
    """Arrangement of the files of the data set, see docs/data-sets.md."""
    image_size: Pixels = IMAGE_SIZE
    """Side of the images in pixels, for the method's encoder; larger images are scaled down."""
    views_per_object: Count | None = None
    """Number of training images to keep of each object. If not given: the layout's protocol, one
    for kar, else all."""
    workers: Workers

    def run(self) -> int:
        check_target(self.output, "--output", folder=True)
        check_options(self.layout, image_size=self.image_size)
        found = reader(self.layout).contents(self.data)
        splits_of = {synset_of(category): splits for category, splits in found.items()}
        if not (wanted := split_names(self.category) or found):
            raise ValueError(f"{self.data} holds nothing of the layout {self.layout!r}")
        tasks = {}
        for category in wanted:
            splits = splits_of.get(synset_of(category), ("train",))
            if self.layout == "pascal3d" and "val" in splits:
                splits = (*splits, "test")  # evaluation reads the val photographs by this name
            for split in splits:
                folder = shards_folder(self.output, category, split)
                if has_shards(self.output, category, split):
                    say(f"{folder}: exists; remove it to convert it again")
                    continue
                few = self.views_per_object if split == "train" else None
                arguments = (self.layout, self.data, category, split, folder, self.image_size, few)
                tasks[folder / SET_FILE] = Task(
                    f"{category} {split}", convert_split, arguments, folder.with_suffix(".log")
                )
        return make_missing(tasks, self.workers, "splits")


def convert_split(
    layout: Layout,
    data: Path,
    category: str,
    split: str,
    folder: Path,
    image_size: int,
    views_per_object: int | None,
) -> bool:
    """Write a split of a data set as shards into `folder`, and print a line about them."""
    options = {"image_size": image_size, "views_per_object": views_per_object}
    dataset = load_dataset(layout, data, category, split, **options)
    shards.remove(folder)  # an unfinished conversion
    count = shards.write_set(folder, layout, dataset)
    say(f"{folder}: {len(dataset)} images of {dataset.num_objects} objects in {count} shards")
    return True
