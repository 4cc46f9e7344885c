"""Data sets of any size: meshes -> shards (`learn3d.data.shards`), each made by a process of its own.

A shard depends on the settings and its meshes alone. So it does not matter which process or machine makes it, and what
a killed call has made is kept by the next one.
"""

from __future__ import annotations

import dataclasses
import json
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from learn3d.data.categories import synset_of
from learn3d.data.dataset import SPLITS
from learn3d.data.layouts import load_dataset
from learn3d.data.readers import kato
from learn3d.data.shards import finish_set, made, remove, split_folder, write_shard
from learn3d.distributed.tasks import Task, run_tasks
from learn3d.files.reading import parse_json, read_bytes
from learn3d.files.writing import write_json
from learn3d.make_data import meshes
from learn3d.make_data.config import DatasetConfig
from learn3d.make_data.contact_sheet import ROWS, draw_sheet, make_row
from learn3d.make_data.folders import check_room
from learn3d.make_data.render import list_sources, render, settings_of, split_objects
from learn3d.make_data.writers import writer_of
from learn3d.make_data.writers.pictures import write_png
from learn3d.terminal import INTERRUPTED, note, say, stop_on_signal

OBJECTS_PER_SHARD = 512  # 201 MB of images
SETTINGS = "card.json"
_MOST_SAID = 20  # meshes that are named in the terminal as skipped


@dataclasses.dataclass(frozen=True)
class Item:
    """A mesh of a shard."""

    number: int  # in the whole data set
    name: str  # of its object
    source: meshes.MeshSource


def make_shards(config: DatasetConfig) -> int:
    """Make the data set that `config` describes as shards in `output/CATEGORY/SPLIT`; the exit status.

    Shards that are there already are kept. A mesh that cannot be used is left out, and listed in `report.json`; a shard
    whose process dies is reported, and the next call tries it again. Returns 1 then, 130 where a signal stopped it.

    Raises ValueError (no usable mesh, settings that do not fit, shards of other settings in the folder), OSError (the
    folder cannot be written, no such cluster).
    """
    config = config.complete()
    folder = config.output / synset_of(config.category)
    sources, _ = list_sources(config)
    names = meshes.object_names(sources)
    _prepare(config, folder, settings_of(config) | {"list of meshes": f"{len(names)}, CRC-32 {_crc(names):08x}"})
    threads = max(1, torch.get_num_threads() // config.jobs)
    tasks, shards = [], {}
    for split, numbers in split_objects(len(sources), config.test, config.val, config.seed).items():
        step = max(1, OBJECTS_PER_SHARD // _copies(config, split))  # meshes of a shard
        parts = np.split(numbers, range(step, len(numbers), step)) if len(numbers) else []
        shards[split] = len(parts)
        for number, part in enumerate(parts):
            if made(folder / split, number) is None:
                items = [Item(i, names[i], sources[i]) for i in part.tolist()]
                given = (config, folder / split, split, number, items, threads)
                tasks.append(Task(f"{split} {number}", make_shard, given, folder / f"{split}-{number:05d}.log"))
    note(f"{config.category}: {sum(shards.values())} shards, {len(tasks)} to be made; logs: {folder / '*.log'}")
    failed = run_tasks(tasks, folder, jobs=config.jobs, cluster=config.cluster)
    for name, tail in failed.items():
        note(f"\nFAILED {name}; the end of the log:\n{tail}")
    missing = [f"{s} {k}" for s, count in shards.items() for k in range(count) if made(folder / s, k) is None]
    if missing:
        note(f"{len(missing)} shards are missing ({', '.join(missing[:5])} ...); the same command makes them")
        return 1 if failed else INTERRUPTED
    _finish(config, folder, shards)
    return 0


def make_shard(
    config: DatasetConfig, folder: Path, split: str, number: int, items: Sequence[Item], threads: int
) -> bool:
    """Make one shard; False where a signal asked for the end."""
    torch.set_num_threads(threads)
    writer = writer_of(config.layout)(folder, config.category)
    objects, used, skipped = [], [], []
    with stop_on_signal() as stop:
        for item in items:
            if stop.name:
                return False
            try:
                mesh = meshes.checked(item.source.read(), config.max_faces)
                own = [item.name, *(f"{item.name}-{copy}" for copy in range(1, _copies(config, split)))]
                objects += [render(config, writer, mesh, item.number, k, name, split) for k, name in enumerate(own)]
            except ValueError as error:
                skipped.append({"name": item.source.name, "split": split, "reason": str(error)})
            else:
                used.append(item.source.name)
        size = writer.image_size
        images = np.empty((len(objects), config.views, 4, size, size), np.uint8)
        for k, item in enumerate(objects):
            images[k, :, :3], images[k, :, 3] = 255 - item.rgb.transpose(0, 3, 1, 2), item.alpha
        voxels = np.array([item.voxels for item in objects], bool).reshape(len(objects), *(32,) * 3)
        part = dataclasses.replace(
            kato.from_arrays(images, voxels, config.category, split), object_names=tuple(item.name for item in objects)
        )
        folder.mkdir(parents=True, exist_ok=True)
        write_json(_report(folder, number), {"objects": len(objects), "used": used, "skipped": skipped}, sync=True)
        write_shard(folder, number, part)
    print(f"{split} {number}: {len(objects)} objects, {len(skipped)} meshes skipped", flush=True)
    return True


def _report(folder: Path, number: int) -> Path:
    """What a shard was made of."""
    return folder / f"{number:05d}.report.json"


def _copies(config: DatasetConfig, split: str) -> int:
    """Objects that are made of each mesh."""
    return 1 + config.augment if split == "train" else 1


def _crc(names: Sequence[str]) -> int:
    return zlib.crc32("\n".join(names).encode())


def _prepare(config: DatasetConfig, folder: Path, settings: dict) -> None:
    """The category's folder, with the settings of its shards."""
    check_room(folder, 2**24, "a data set")
    if config.overwrite:
        for split in SPLITS:
            remove(folder / split)
        (folder / SETTINGS).unlink(missing_ok=True)
    path = folder / SETTINGS
    if path.is_file():
        before = parse_json(read_bytes(path, 2**20, "the settings of shards"))
        if different := sorted(k for k in {*settings, *before} if settings.get(k) != before.get(k)):
            raise ValueError(
                f"{folder} has shards that were made with another {', '.join(different)}; ask for the same, give "
                "another folder, or --overwrite to replace them"
            )
    write_json(path, settings)


def _finish(config: DatasetConfig, folder: Path, shards: dict[str, int]) -> None:
    """Declare the splits complete; a report, and a picture to look at."""
    counts, used, skipped, rows = {}, 0, [], {}
    for split, count in shards.items():
        of_split = [json.loads(_report(folder / split, number).read_text()) for number in range(count)]
        counts[split] = sum(report["objects"] for report in of_split)
        used += sum(len(report["used"]) for report in of_split)
        skipped += [mesh for report in of_split for mesh in report["skipped"]]
        if count and not counts[split]:
            reasons = "; ".join(f"{mesh['name']}: {mesh['reason']}" for mesh in skipped[:3])
            raise ValueError(f"none of the meshes for {split} can be used; the first reasons: {reasons}")
        if count:
            part = kato.from_arrays(
                np.empty((0, config.views, 4, 64, 64), np.uint8), np.empty((0, 32, 32, 32), bool), "", split
            )
            finish_set(split_folder(config.output, config.category, split), config.layout, count, part)
            rows[split] = _rows(config, split)
    write_png(folder / "contact.png", draw_sheet(rows, config.views))
    write_json(folder / "report.json", {"objects": counts, "used": used, "skipped": skipped})
    say(f"{config.category}: {used} meshes used, {len(skipped)} skipped")
    say("objects: " + ", ".join(f"{split} {count}" for split, count in counts.items() if count))
    for mesh in skipped[:_MOST_SAID]:
        say(f"skipped {mesh['name']} ({mesh['split']}): {mesh['reason']}")
    say(f"shards, report.json and contact.png are in {folder}")


def _rows(config: DatasetConfig, split: str) -> list[list[np.ndarray]]:
    """Rows of the contact sheet: some objects of a split."""
    dataset = load_dataset(config.layout, config.output, config.category, split)
    rows = []
    for number in np.unique(np.linspace(0, dataset.num_objects - 1, ROWS).astype(int)):
        batch = dataset.batch(torch.from_numpy(np.flatnonzero(dataset.object_ids == number)))
        grid = dataset.convention.to_object(batch.voxels[:1])[0].numpy()
        images = batch.images.numpy()
        rows.append(make_row(255 - images[:, :3].transpose(0, 2, 3, 1), images[:, 3], grid))
    return rows
