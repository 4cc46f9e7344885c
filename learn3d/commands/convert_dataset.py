"""Convert a data set into shards, which training reads piece by piece: for data that does not fit into memory.

Examples:
  learn3d convert-dataset --data DATA --output SHARDS --category chair,airplane
  learn3d convert-dataset --data KAR --layout kar --output SHARDS --category chair

Then give SHARDS instead of DATA, with the same layout, to train, evaluate, experiment and the others (docs/scale.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from learn3d.commands.parsing import names, parse
from learn3d.data import shards
from learn3d.data.categories import synset_of
from learn3d.data.conventions import IMAGE_SIZE
from learn3d.data.layouts import LAYOUTS, Layout, load_dataset
from learn3d.data.readers import READERS
from learn3d.files.writing import check_target
from learn3d.settings import Count
from learn3d.terminal import say


@dataclass(frozen=True)
class Command:
    """What is asked for."""

    data: Path
    """Folder of the data set."""
    output: Path
    """Folder for the shards, one folder for each category and split."""
    category: str = ""
    """Categories, separated by commas. None given: all that are there."""
    layout: Layout = "kato"
    """How the files of the data set are arranged, see docs/data-sets.md."""
    image_size: int = IMAGE_SIZE
    """Side of the images in pixels, for layouts that keep larger ones: what the method's encoder takes."""
    views_per_object: Count | None = None
    """Training images of every object to keep. None: what the layout's protocol uses, one for Kar's, else all."""
    overwrite: bool = False
    """Replace shards that are there."""


def run(arguments: Sequence[str]) -> int:
    """Convert each category and split; one that is complete already is left as it is."""
    command = parse(Command, arguments, name="convert-dataset", about=__doc__)
    check_target(command.output, "--output", folder=True)
    if command.overwrite and command.data.resolve() == command.output.resolve():
        raise ValueError("--overwrite would replace the shards that --data is read from; give another --output")
    found = READERS[command.layout].contents(command.data)
    there = {synset_of(category): splits for category, splits in found.items()}
    wanted = names(command.category) or tuple(found)
    if not wanted:
        raise ValueError(f"{command.data} holds nothing of the layout {command.layout!r}")
    for category in wanted:
        splits = there.get(synset_of(category), ("train",))
        if command.layout == "pascal3d" and "val" in splits:
            splits = (*splits, "test")  # the same photographs, which evaluation asks for by this name
        for split in splits:
            _convert(command, category, split)
    return 0


def _convert(command: Command, category: str, split: str) -> None:
    folder = shards.split_folder(command.output, category, split)
    if not command.overwrite and shards.holds(command.output, category, split):
        say(f"{folder}: is there (--overwrite replaces it)")
        return
    options = {"image_size": command.image_size} if "image_size" in LAYOUTS[command.layout].options else {}
    if split == "train":
        options["views_per_object"] = command.views_per_object
    dataset = load_dataset(command.layout, command.data, category, split, **options)
    shards.remove(folder)  # what is there is replaced, or was never finished
    count = shards.write_set(folder, command.layout, dataset)
    say(f"{folder}: {len(dataset)} images of {dataset.num_objects} objects in {count} shards")
