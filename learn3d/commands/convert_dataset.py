"""`learn3d convert-dataset`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from learn3d.commands.command import Command
from learn3d.data import shards
from learn3d.data.categories import synset_of
from learn3d.data.conventions import IMAGE_SIZE
from learn3d.data.layouts import LAYOUTS, Layout, load_dataset
from learn3d.data.readers import READERS
from learn3d.files.writing import check_target
from learn3d.settings import Count, split_names
from learn3d.terminal import say


@dataclass(frozen=True)
class ConvertDataset(Command):
    """Convert a data set into shards, which training reads piece by piece: for data that do not fit into memory.

    Examples:
      learn3d convert-dataset --data DATA --output SHARDS --category chair,airplane
      learn3d convert-dataset --data KAR --layout kar --output SHARDS --category chair

    Then give SHARDS instead of DATA, with the same layout, to train, evaluate, experiment and the others
    (docs/scale.md). Splits that are complete already are left as they are.
    """

    data: Path
    """Folder of the data set."""
    output: Path
    """Folder for the shards. Each category and split gets a folder in it."""
    category: str = ""
    """Categories, separated by commas (default: all that are there)."""
    layout: Layout = "kato"
    """Arrangement of the files of the data set, see docs/data-sets.md."""
    image_size: int = IMAGE_SIZE
    """Side of the images in pixels, for layouts that keep larger ones: the size that the method's encoder takes."""
    views_per_object: Count | None = None
    """Number of training images to keep of each object (default: the layout's protocol, one for kar, else all)."""
    overwrite: bool = False
    """Replace shards that are there."""

    def run(self) -> None:
        check_target(self.output, "--output", folder=True)
        if self.overwrite and self.data.resolve() == self.output.resolve():
            raise ValueError("--overwrite would replace the shards that --data is read from; give another --output")
        found = READERS[self.layout].contents(self.data)
        there = {synset_of(category): splits for category, splits in found.items()}
        wanted = split_names(self.category) or tuple(found)
        if not wanted:
            raise ValueError(f"{self.data} holds nothing of the layout {self.layout!r}")
        for category in wanted:
            splits = there.get(synset_of(category), ("train",))
            if self.layout == "pascal3d" and "val" in splits:
                splits = (*splits, "test")  # the same photographs, which evaluation asks for by this name
            for split in splits:
                self._convert(category, split)

    def _convert(self, category: str, split: str) -> None:
        folder = shards.split_folder(self.output, category, split)
        if not self.overwrite and shards.holds(self.output, category, split):
            say(f"{folder}: is there (--overwrite replaces it)")
            return
        options = {"image_size": self.image_size} if "image_size" in LAYOUTS[self.layout].options else {}
        if split == "train":
            options["views_per_object"] = self.views_per_object
        dataset = load_dataset(self.layout, self.data, category, split, **options)
        shards.remove(folder)  # an older or unfinished conversion
        count = shards.write_set(folder, self.layout, dataset)
        say(f"{folder}: {len(dataset)} images of {dataset.num_objects} objects in {count} shards")
