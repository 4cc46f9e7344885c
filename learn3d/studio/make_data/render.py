"""Makes a data set from meshes: scales, colours and renders them.

`writers` has cameras and files of each layout.
"""

import itertools
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from learn3d.data.conventions import SPLITS, has_shards, mesh_to_object, synset_of, view_poses
from learn3d.data.shards import finish_set, remove, shard_path, write_shard
from learn3d.files.formats import RawMesh
from learn3d.files.identity import describe
from learn3d.files.reading import MissingFile, read_json
from learn3d.files.writing import publishing, write_json
from learn3d.pictures import KEY_LIGHT, photograph, studio_lights
from learn3d.studio.make_data.contact_sheet import LEGEND, ROWS, draw_sheet, make_row
from learn3d.studio.make_data.looks import natural_look
from learn3d.studio.make_data.meshes import DatasetConfig, Item, check, fit_to_box, split_items
from learn3d.studio.make_data.writers import WRITERS
from learn3d.studio.make_data.writers.writer import RenderedObject, write_png
from learn3d.tasks import Task, make_missing
from learn3d.terminal import note, progress, say, stop_on_signal

SCALE_RANGE = (0.75, 1.25)  # per-axis scales of the augmented copies
MAX_LISTED = 100  # skipped meshes in the text of a report; the card has all of them
OBJECTS_PER_SHARD = 512  # 201 MB of images
LIST = ".report.json"  # suffix of the list of a shard's meshes


class DatasetReport:
    """The outcome of `make_dataset`. Raises ValueError if no mesh is left for training."""

    def __init__(
        self, config: DatasetConfig, meshes: Sequence[dict], left_out: Mapping[str, str]
    ) -> None:
        """meshes: each with name, split, and either objects (names, also of copies) or reason.
        left_out: files that were not split, with the reason.
        """
        self.config, self.left_out = config, left_out
        self.skipped = [mesh for mesh in meshes if "reason" in mesh]
        self.used = [mesh for mesh in meshes if "objects" in mesh]
        names = {
            split: [n for m in self.used if m["split"] == split for n in m["objects"]]
            for split in SPLITS
        }
        self.objects = {split: found for split, found in names.items() if found}
        self.counts = {split: len(found) for split, found in self.objects.items()}
        if "train" not in self.counts:
            reasons = "; ".join(f"{mesh['name']}: {mesh['reason']}" for mesh in self.skipped[:3])
            raise ValueError(
                f"no mesh is left for training; give more meshes. Skipped: {reasons or 'none'}"
            )

    def text(self) -> str:
        """The report for people."""
        lines = [
            f"{self.config.category}: {len(self.used)} meshes used, {len(self.skipped)} skipped"
        ]
        lines.append(
            "objects: " + ", ".join(f"{split} {count}" for split, count in self.counts.items())
        )
        lines += describe(self.left_out)
        lines += [
            f"skipped {mesh['name']} ({mesh['split']}): {mesh['reason']}"
            for mesh in self.skipped[:MAX_LISTED]
        ]
        lines.append(
            f"contact sheet {self.config.output / report_files(self.config.category)[1]}: {LEGEND}"
        )
        return "\n".join(lines)

    def write(self, folder: Path, rows: Mapping[str, Sequence[list[np.ndarray]]]) -> None:
        """Write the card, which suffices to make the data set again, and the contact sheet."""
        splits = {
            split: [mesh["name"] for mesh in self.used if mesh["split"] == split]
            for split in self.counts
        }
        card, sheet = (folder / name for name in report_files(self.config.category))
        about = {"settings": self.config.to_dict(), "splits": splits, "skipped": self.skipped}
        write_json(card, about | {"left_out": self.left_out})
        write_png(sheet, draw_sheet(rows, self.config.views))


def report_files(category: str) -> tuple[str, str]:
    """File names of the card and of the contact sheet."""
    return f"{synset_of(category)}_card.json", f"{synset_of(category)}_contact.png"


def make_dataset(config: DatasetConfig) -> DatasetReport:
    """Make the data set that `config` describes, and return a report. Unusable meshes are skipped.

    Writes the layout's files (see `writers`) for every split that is not empty,
    `{synset}_card.json` (settings, splits, skipped meshes) and `{synset}_contact.png` (see
    `contact_sheet.LEGEND`). All files get their final names together, after the last one is complete.

    Raises ValueError (no usable mesh), FileExistsError (the folder has files of the category and
    `overwrite` is False).
    """
    splits, left_out = split_items(config)
    items = [item for of_split in splits.values() for item in of_split]
    writer = WRITERS[config.layout]
    paths = [*writer.paths(config.category), *report_files(config.category)]
    if any(has_shards(config.output, config.category, split) for split in SPLITS):
        raise FileExistsError(
            f"{config.output} has shards of {config.category}, which are read before other files; give another folder, "
            "or remove the shards"
        )
    there = [path for path in paths if (config.output / path).exists()]
    if there and not config.overwrite:
        raise FileExistsError(
            f"{config.output} already holds {there[0]}; give another folder, or --overwrite to replace all files of "
            f"{config.category}"
        )
    config.output.mkdir(parents=True, exist_ok=True)
    made, rows = [], {split: [] for split in SPLITS}
    bar = progress(items, config.category, unit="mesh")
    with publishing(config.output, [*paths, *writer.shared]) as folder:
        writer.write(render_meshes(config, bar, made, rows), config.category, folder, config.output)
        report = DatasetReport(config, made, left_out)
        report.write(folder, rows)
    return report


def render_meshes(
    config: DatasetConfig,
    items: Iterable[Item],
    made: list[dict],
    rows: dict[str, list[list[np.ndarray]]],
) -> Iterator[RenderedObject]:
    """Render the objects of each mesh, and add its entry of `DatasetReport.meshes` to `made`.

    rows: rows of the contact sheet by split; the first objects of these splits are added, up to
    `ROWS` of each.
    """
    for item in items:
        mesh, objects = {"name": item.file, "split": item.split}, []
        try:
            raw = check(item.read())
            objects = [_render(config, raw, item, copy) for copy in range(item.copies)]
            mesh["objects"] = [rendered.name for rendered in objects]
        except (
            ValueError,
            MissingFile,
        ) as error:  # a damaged or invisible mesh must not end the whole data set
            mesh["reason"] = getattr(error, "message", str(error))
        made.append(mesh)
        if objects and item.split in rows and len(rows[item.split]) < ROWS:
            grid = (
                WRITERS[config.layout]
                .convention.to_object(torch.from_numpy(objects[0].voxels)[None])[0]
                .numpy()
            )
            rows[item.split].append(make_row(objects[0].rgb, objects[0].alpha, grid))
        yield from objects


def _render(config: DatasetConfig, mesh: RawMesh, item: Item, copy: int) -> RenderedObject:
    """Scale, place, colour and render copy `copy` of a mesh; copy 0 keeps its proportions.

    Random values depend on `config.seed`, `item.number` and `copy` alone. Raises ValueError if
    all views are empty.
    """
    writer, rng = WRITERS[config.layout], np.random.default_rng([config.seed, 1, item.number, copy])
    scale = rng.uniform(*SCALE_RANGE, size=3)
    # light grey
    color = np.clip(rng.uniform(0.55, 0.9) + rng.uniform(-0.2, 0.2, size=3), 0.35, 1.0).astype(
        np.float32
    )
    turned = mesh.vertices @ mesh_to_object(config.up, config.front_axis).T
    placed = fit_to_box(fit_to_box(turned) * (scale if copy else 1.0)) @ writer.turn.T
    if writer.diagonal is not None:
        placed = placed / (np.linalg.norm(np.ptp(placed, axis=0)) / writer.diagonal)
    rng = np.random.default_rng([config.seed, 2, item.number, copy])
    poses = (
        writer.views(placed, config.views, rng)
        if writer.views
        else view_poses(torch.arange(config.views))
    )
    lights = studio_lights((writer.turn @ KEY_LIGHT).tolist())
    if writer.natural:
        color, lights = natural_look(placed, mesh.faces, rng)
    vertices = torch.as_tensor(placed, dtype=torch.float32).contiguous()
    faces = torch.from_numpy(mesh.faces)
    rgb, alpha = photograph(
        vertices, faces, color, poses.cameras(), image_size=writer.image_size, lights=lights
    )
    if not alpha.any():
        raise ValueError("no view shows it: its faces have no area, or are smaller than a pixel")
    voxels = writer.convention.voxelize(vertices, faces)[0].numpy()
    name = f"{item.name}-{copy}" if copy else item.name
    return RenderedObject(name, item.split, vertices, faces, poses, rgb, alpha, voxels, rng)


def make_shards(config: DatasetConfig) -> int:
    """Make the data set that `config` describes as shards in `output/SYNSET/SPLIT`, by workers.

    A shard depends on the settings and its meshes alone, so those of a killed call are kept. The
    report has the same files as that of `make_dataset`. Returns the exit status: 0, 1 if a shard
    failed (the next call tries it again), 130 after a signal. Raises ValueError (no usable mesh,
    shards of other settings in the folder) and OSError.
    """
    folder = config.output / synset_of(config.category)
    splits, left_out = split_items(config)
    _check_settings(config, folder, splits)
    threads, tasks = config.workers.threads, {}
    for split, items in splits.items():
        for number, part in enumerate(_parts(items)):
            path, log = shard_path(folder / split, number), folder / f"{split}-{number:05d}.log"
            tasks[path] = Task(
                f"{split} {number}", make_shard, (config, path, number, part, threads), log
            )
    note(f"{config.category}: logs are in {folder / '*.log'}")
    if status := make_missing(tasks, config.workers, "shards"):
        if config.overwrite:
            note("to keep the shards that are made, run the command again without --overwrite")
        return status
    lists = [
        read_json(path.with_suffix(LIST), 2**28, "the list of a shard's meshes") for path in tasks
    ]
    report = DatasetReport(config, [mesh for found in lists for mesh in found], left_out)
    rows = {split: [] for split in report.counts}
    for split in rows:
        count = sum(path.parent.name == split for path in tasks)
        finish_set(
            folder / split,
            config.layout,
            count,
            WRITERS[config.layout].join([], config.category, split),
        )
        list(render_meshes(config, splits[split][:ROWS], [], rows))
    with publishing(config.output, report_files(config.category)) as temporary:
        report.write(temporary, rows)
    say(report.text())
    return 0


def make_shard(
    config: DatasetConfig, path: Path, number: int, items: Sequence[Item], threads: int
) -> bool:
    """Make one shard and the list of its meshes. Returns False if a signal stopped it."""
    torch.set_num_threads(threads)
    made, objects = [], []
    with stop_on_signal() as stop:
        for item in render_meshes(config, items, made, rows={}):
            if stop.name:
                return False
            objects.append(item)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path.with_suffix(LIST), made, sync=True)
        write_shard(
            path.parent,
            number,
            WRITERS[config.layout].join(objects, config.category, items[0].split),
        )
    print(f"{path.parent.name} {number}: {len(objects)} objects", flush=True)
    return True


def _parts(items: Sequence[Item]) -> list[list[Item]]:
    """The meshes of each shard: at most `OBJECTS_PER_SHARD` objects, and at least one mesh."""
    parts, room = [], 0
    for item in items:
        if item.copies > room:
            parts.append([])
            room = OBJECTS_PER_SHARD
        parts[-1].append(item)
        room -= item.copies
    return parts


def _name_and_size(source: Path | None, item: Item) -> str:
    """The name of a mesh, and the size of its file if it is from a folder."""
    path = source / item.file if source else None
    return f"{item.name} {path.stat().st_size}" if path and path.is_file() else item.name


def _check_settings(config: DatasetConfig, folder: Path, splits: dict[str, list[Item]]) -> None:
    """Make the category's folder, and write its settings.

    Raises ValueError if it has shards of other settings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "settings.json"
    if config.overwrite:
        for split in SPLITS:
            remove(folder / split)
        path.unlink(missing_ok=True)
    items = sorted(itertools.chain(*splits.values()), key=lambda item: item.number)
    crc = zlib.crc32("\n".join(_name_and_size(config.source, item) for item in items).encode())
    settings = config.to_dict() | {"list of meshes": f"{len(items)}, CRC-32 {crc:08x}"}
    before = read_json(path, 2**20, "the settings of shards") if path.is_file() else settings
    if different := sorted(k for k in {*settings, *before} if settings.get(k) != before.get(k)):
        raise ValueError(
            f"{folder} has shards that were made with another {', '.join(different)}; repeat those settings, give "
            "another folder, or --overwrite to replace them"
        )
    write_json(path, settings)
