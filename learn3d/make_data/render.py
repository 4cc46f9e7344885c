"""Makes a data set from meshes: splits, scales, colours and renders them. `writers` has cameras and files by layout."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from learn3d.data import conventions
from learn3d.data.categories import SPLITS, synset_of
from learn3d.files.writing import publishing, write_json
from learn3d.make_data import meshes
from learn3d.make_data.config import DatasetConfig
from learn3d.make_data.writers import WRITERS, RenderedObject, Writer
from learn3d.make_data.writers.writer import write_png
from learn3d.pictures.sheets import LEGEND, ROWS, draw_sheet, make_row
from learn3d.pictures.studio import photograph

SCALE_RANGE = (0.75, 1.25)  # per-axis scales of the augmented copies
MAX_LISTED = 100  # skipped meshes in the text of a report; the card has all of them


@dataclass(frozen=True)
class Item:
    """A mesh to render."""

    number: int  # index among all meshes; it seeds scale, colour and views
    name: str  # name of the object, valid as a file name
    split: str
    file: str  # name of the mesh in its source
    read: meshes.Source
    copies: int  # objects that are made of it


@dataclass(frozen=True)
class DatasetReport:
    """The outcome of `make_dataset`."""

    config: DatasetConfig
    meshes: Sequence[dict]  # each with name, split, and either objects (names, with those of scaled copies) or reason

    def __post_init__(self) -> None:
        if "train" not in self.objects:
            reasons = "; ".join(f"{mesh['name']}: {mesh['reason']}" for mesh in self.skipped[:3])
            raise ValueError(f"no mesh can be used for training; the first reasons: {reasons}")

    @property
    def skipped(self) -> list[dict]:
        """The meshes that could not be used, each with the reason."""
        return [mesh for mesh in self.meshes if "reason" in mesh]

    @property
    def objects(self) -> dict[str, list[str]]:
        """The names of the objects of each split that is not empty."""
        found = {split: [] for split in SPLITS}
        for mesh in self.meshes:
            found[mesh["split"]] += mesh.get("objects", [])
        return {split: names for split, names in found.items() if names}

    @property
    def counts(self) -> dict[str, int]:
        """The number of objects of each split that is not empty."""
        return {split: len(names) for split, names in self.objects.items()}

    def text(self) -> str:
        """The report for people."""
        config, skipped, counts = self.config, self.skipped, self.counts
        lines = [f"{config.category}: {len(self.meshes) - len(skipped)} meshes used, {len(skipped)} skipped"]
        lines.append("objects: " + ", ".join(f"{split} {count}" for split, count in counts.items()))
        lines += [f"skipped {mesh['name']} ({mesh['split']}): {mesh['reason']}" for mesh in skipped[:MAX_LISTED]]
        lines.append(f"contact sheet {config.output / report_files(config.category)[1]}: {LEGEND}")
        return "\n".join(lines)

    def write(self, folder: Path, rows: Mapping[str, Sequence[list[np.ndarray]]]) -> None:
        """Write the card, which suffices to make the data set again, and the contact sheet with the rows of `rows`."""
        used = [mesh for mesh in self.meshes if "objects" in mesh]
        splits = {split: [mesh["name"] for mesh in used if mesh["split"] == split] for split in self.counts}
        card, sheet = (folder / name for name in report_files(self.config.category))
        write_json(card, {"settings": self.config.to_dict(), "splits": splits, "skipped": self.skipped})
        write_png(sheet, draw_sheet(rows, self.config.views))


def report_files(category: str) -> tuple[str, str]:
    """File names of the card and of the contact sheet."""
    return f"{synset_of(category)}_card.json", f"{synset_of(category)}_contact.png"


def make_dataset(config: DatasetConfig, progress: bool = True) -> DatasetReport:
    """Make the data set that `config` describes, and return a report. Unusable meshes are skipped.

    Writes the layout's files (see its class in `learn3d.make_data.writers`) for every split that is not empty,
    `{synset}_card.json` (settings, splits, skipped meshes) and `{synset}_contact.png` (see `sheets.LEGEND`). All files
    get their final names together, after the last one is complete.

    Raises ValueError (no usable mesh), FileNotFoundError (no such source), FileExistsError (the folder has files of the
    category and `overwrite` is False), OSError (folder not writable, disk full).
    """
    items = [item for of_split in split_items(config).values() for item in of_split]
    writer_class = WRITERS[config.layout]
    paths = [*writer_class.paths(config.category), *report_files(config.category)]
    there = [path for path in paths if (config.output / path).exists()]
    if there and not config.overwrite:
        raise FileExistsError(
            f"{config.output} already holds {there[0]}; give another folder, or --overwrite to replace all files of "
            f"{config.category}"
        )
    config.output.mkdir(parents=True, exist_ok=True)
    made, rows = [], {split: [] for split in SPLITS}
    with publishing(config.output, [*paths, *writer_class.shared]) as folder:
        writer = writer_class(folder, config.category)
        bar = tqdm(items, desc=config.category, unit="mesh", disable=not progress, dynamic_ncols=True)
        for mesh, objects in render_meshes(config, writer, bar):
            made.append(mesh)
            for item in objects:
                writer.write(item)
            if objects and len(rows[mesh["split"]]) < ROWS:
                rows[mesh["split"]].append(contact_row(writer, objects[0]))
        report = DatasetReport(config, writer.split(made))
        writer.finish(config.output, report.objects)
        report.write(folder, rows)
    return report


def render_meshes(
    config: DatasetConfig, writer: Writer, items: Iterable[Item]
) -> Iterator[tuple[dict, list[RenderedObject]]]:
    """Render each mesh. Yields its entry in `DatasetReport.meshes` and its objects, none if the mesh is unusable."""
    for item in items:
        mesh, objects = {"name": item.file, "split": item.split}, []
        try:
            raw = meshes.check(item.read())
            objects = [_render(config, writer, raw, item, copy) for copy in range(item.copies)]
            mesh["objects"] = [made.name for made in objects]
        except ValueError as error:  # a damaged or invisible mesh must not end the whole data set
            mesh["reason"] = str(error)
        yield mesh, objects


def contact_row(writer: Writer, item: RenderedObject) -> list[np.ndarray]:
    """The row of an object in the contact sheet."""
    grid = writer.convention.to_object(torch.from_numpy(item.voxels)[None])[0].numpy()
    return make_row(item.rgb, item.alpha, grid)


def _render(config: DatasetConfig, writer: Writer, mesh: meshes.RawMesh, item: Item, copy: int) -> RenderedObject:
    """Scale, place, colour and render copy `copy` of a mesh; copy 0 keeps its proportions.

    Random values depend on `config.seed`, `item.number` and `copy` alone. Raises ValueError if all views are empty.
    """
    rng = np.random.default_rng([config.seed, 1, item.number, copy])
    scale = rng.uniform(*SCALE_RANGE, size=3)
    color = np.clip(rng.uniform(0.55, 0.9) + rng.uniform(-0.2, 0.2, size=3), 0.35, 1.0).astype(np.float32)  # light grey
    vertices = mesh.vertices @ conventions.mesh_to_object(config.up, config.front_axis).T
    placed = writer.place(meshes.fit_to_box(meshes.fit_to_box(vertices) * (scale if copy else 1.0)))
    rng = np.random.default_rng([config.seed, 2, item.number, copy])
    poses = writer.views(placed, config.views, rng)
    vertices, faces = torch.as_tensor(placed, dtype=torch.float32).contiguous(), torch.from_numpy(mesh.faces)
    face_colors, lights = writer.paint(placed, mesh.faces, color, rng)
    rgb, alpha = photograph(vertices, faces, face_colors, poses.cameras(), image_size=writer.image_size, lights=lights)
    if not alpha.any():
        raise ValueError("no view shows it: its faces have no area, or are smaller than a pixel")
    name, voxels = f"{item.name}-{copy}" if copy else item.name, writer.voxelize(vertices, faces)
    return RenderedObject(name, item.split, vertices, faces, poses, rgb, alpha, voxels, rng)


def split_items(config: DatasetConfig) -> dict[str, list[Item]]:
    """The meshes of each of the splits train, val and test."""
    shapes = meshes.procedural_sources(config.category, config.procedural, config.seed) if config.procedural else {}
    sources = meshes.list_sources(config.source) if config.source else shapes
    augmented = len(sources)
    sources = sources | shapes
    numbers = split_objects(len(sources), config.test, config.val, config.seed)
    named = list(zip(meshes.object_names(sources), sources.items(), strict=True))

    def item(number: int, split: str) -> Item:
        name, (file, read) = named[number]
        copies = config.augment if split == "train" and number < augmented else 0
        return Item(number, name, split, file, read, 1 + copies)

    return {split: [item(number, split) for number in numbers[split].tolist()] for split in SPLITS}


def split_objects(count: int, test: float, val: float, seed: int) -> dict[str, np.ndarray]:
    """Object numbers int64 of each split: a random permutation, cut into test, val and train.

    `test` and `val` are counts, or shares below 1. A share gives at least 4 objects, or an equal part of few objects.
    With test = 0.2 and val = 0, test is `default_rng(seed).permutation(count)[:max(4, round(0.2 * count))]`.
    Raises ValueError if no object is left for training.
    """
    least = min(4, count // (1 + (test > 0) + (val > 0)))
    sizes = [int(part) if part >= 1 else max(least * (part > 0), round(part * count)) for part in (test, val)]
    if sum(sizes) >= count:
        raise ValueError(
            f"test ({sizes[0]}) and val ({sizes[1]}) leave none of the {count} meshes to train on; give more meshes, "
            "or a smaller test or val"
        )
    order = np.random.default_rng(seed).permutation(count)
    return dict(zip(("test", "val", "train"), np.split(order, np.cumsum(sizes)), strict=True))
