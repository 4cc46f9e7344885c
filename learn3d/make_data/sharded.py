"""Data sets of any size: meshes -> shards (`learn3d.data.shards`), each made by a process of its own.

A shard depends on the settings and its meshes alone. So it does not matter which process or machine makes it, and what
a killed call has made is kept by the next one.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Sequence
from pathlib import Path

import torch

from learn3d.data.categories import synset_of
from learn3d.data.dataset import SPLITS, ViewDataset
from learn3d.data.readers import kato
from learn3d.data.shards import finish_set, remove, shard_path, write_shard
from learn3d.distributed.tasks import Task, run_tasks
from learn3d.files.reading import parse_json, read_bytes
from learn3d.files.writing import write_json
from learn3d.make_data.config import DatasetConfig
from learn3d.make_data.folders import check_room, publishing
from learn3d.make_data.render import Item, Part, check_train, copies_of, render_meshes, split_items
from learn3d.make_data.report import DatasetReport, report_files, settings_of, write_report
from learn3d.make_data.writers import KatoWriter
from learn3d.pictures.contact_sheet import ROWS
from learn3d.terminal import INTERRUPTED, note, say, stop_on_signal

OBJECTS_PER_SHARD = 512  # 201 MB of images
SETTINGS = "settings.json"
PART_BYTES = 2**28  # of the list of a shard's meshes


def make_shards(config: DatasetConfig) -> int:
    """Make the data set that `config` describes as shards in `output/CATEGORY/SPLIT`; returns the exit status.

    Shards that are there already are kept. A mesh that cannot be used is left out, and listed in the report (the same
    files as those of `make_dataset`); a shard whose process dies is reported, and the next call tries it again. Returns
    1 then, 130 if a signal stopped it.

    Raises ValueError (no usable mesh, settings that do not fit, shards of other settings in the folder), OSError (the
    folder cannot be written, no such cluster).
    """
    config = config.complete()
    folder = config.output / synset_of(config.category)
    splits, ignored = split_items(config)
    _prepare(config, folder, splits)
    threads = max(1, torch.get_num_threads() // config.jobs)
    tasks, counts = [], {}
    for split, items in splits.items():
        step = max(1, OBJECTS_PER_SHARD // copies_of(config, split))  # meshes of a shard
        starts = range(0, len(items), step)
        counts[split] = len(starts)
        for number, start in enumerate(starts):
            if not shard_path(folder / split, number).is_file():
                given = (config, folder / split, split, number, items[start : start + step], threads)
                tasks.append(Task(f"{split} {number}", make_shard, given, folder / f"{split}-{number:05d}.log"))
    note(f"{config.category}: {sum(counts.values())} shards, {len(tasks)} to be made; logs: {folder / '*.log'}")
    failed = run_tasks(tasks, jobs=config.jobs, cluster=config.cluster)
    for name, tail in failed.items():
        note(f"\nFAILED {name}; the end of the log:\n{tail}")
    missing = [
        f"{s} {k}" for s, count in counts.items() for k in range(count) if not shard_path(folder / s, k).is_file()
    ]
    if missing:
        note(f"{len(missing)} shards are missing ({', '.join(missing[:5])} ...); the same command makes them")
        return 1 if failed else INTERRUPTED
    say(_finish(config, folder, splits, counts, ignored).text())
    return 0


def make_shard(
    config: DatasetConfig, folder: Path, split: str, number: int, items: Sequence[Item], threads: int
) -> bool:
    """Make one shard; returns False if a signal stopped it."""

    def check_stop() -> None:
        if stop.name:
            raise KeyboardInterrupt

    torch.set_num_threads(threads)
    folder.mkdir(parents=True, exist_ok=True)
    writer = KatoWriter(folder, config.category)
    with stop_on_signal() as stop:
        try:
            part = render_meshes(config, writer, split, items, check_stop)
        except KeyboardInterrupt:
            return False
        dataset = kato.from_arrays(*writer.arrays(), config.category, split)
        plain = {"objects": part.objects, "used": part.used, "skipped": part.skipped}
        write_json(_part_file(folder, number), plain, sync=True)
        write_shard(folder, number, dataclasses.replace(dataset, object_names=tuple(part.objects)))
    print(f"{split} {number}: {len(part.objects)} objects, {len(part.skipped)} meshes skipped", flush=True)
    return True


def _part_file(folder: Path, number: int) -> Path:
    """The list of a shard's meshes."""
    return folder / f"{number:05d}.report.json"


def _prepare(config: DatasetConfig, folder: Path, splits: dict[str, list[Item]]) -> None:
    """Make the category's folder, and write the settings of its shards or compare them with those there."""
    check_room(folder, 2**24, "a data set")
    path = folder / SETTINGS
    if config.overwrite:
        for split in SPLITS:
            remove(folder / split)
        path.unlink(missing_ok=True)
    names = sorted((item.number, item.name) for items in splits.values() for item in items)
    crc = zlib.crc32("\n".join(name for _, name in names).encode())
    settings = settings_of(config) | {"list of meshes": f"{len(names)}, CRC-32 {crc:08x}"}
    if path.is_file():
        before = parse_json(read_bytes(path, 2**20, "the settings of shards"))
        if different := sorted(k for k in {*settings, *before} if settings.get(k) != before.get(k)):
            raise ValueError(
                f"{folder} has shards that were made with another {', '.join(different)}; ask for the same, give "
                "another folder, or --overwrite to replace them"
            )
    write_json(path, settings)


def _finish(
    config: DatasetConfig, folder: Path, splits: dict[str, list[Item]], counts: dict[str, int], ignored: dict[str, int]
) -> DatasetReport:
    """Declare the splits complete, and write the report."""
    parts = {split: _joined(folder / split, count) for split, count in counts.items()}
    check_train(parts["train"].objects, parts["train"].skipped)
    with publishing(config.output, report_files(config.category)) as temporary:
        sheet = {}
        for split, part in parts.items():
            if part.objects:
                finish_set(folder / split, config.layout, counts[split], _empty(config, split))
                shown = render_meshes(config, KatoWriter(temporary, config.category), split, splits[split][:ROWS])
                sheet[split] = list(shown.rows.values())
        used = [mesh for part in parts.values() for mesh in part.used]
        skipped = [mesh for part in parts.values() for mesh in part.skipped]
        objects = {split: len(part.objects) for split, part in parts.items() if part.objects}
        return write_report(config, temporary, [folder.name], objects, used, skipped, ignored, sheet)


def _joined(folder: Path, count: int) -> Part:
    """The lists of meshes of all shards of a split."""
    part = Part()
    for number in range(count):
        found = parse_json(read_bytes(_part_file(folder, number), PART_BYTES, "the list of a shard's meshes"))
        part.objects += found["objects"]
        part.used += found["used"]
        part.skipped += found["skipped"]
    return part


def _empty(config: DatasetConfig, split: str) -> ViewDataset:
    """A data set without objects, which has all that the shards have in common."""
    writer = KatoWriter(Path(), config.category)
    writer.start(split, 0)
    return kato.from_arrays(*writer.arrays(), config.category, split)
