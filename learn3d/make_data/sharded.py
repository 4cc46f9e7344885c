"""Makes a data set as shards (`learn3d.data.shards`), each in its own process.

A shard depends on the settings and its meshes alone, so a later call keeps the shards of a killed one.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from learn3d.data.categories import SPLITS, synset_of
from learn3d.data.shards import finish_set, remove, shard_path, write_shard
from learn3d.files.reading import read_json
from learn3d.files.writing import publishing, write_json
from learn3d.make_data.config import DatasetConfig
from learn3d.make_data.render import DatasetReport, Item, contact_row, render_meshes, report_files, split_items
from learn3d.make_data.writers import WRITERS
from learn3d.pictures.sheets import ROWS
from learn3d.runs.tasks import Task, run_tasks
from learn3d.terminal import INTERRUPTED, note, say, stop_on_signal

OBJECTS_PER_SHARD = 512  # 201 MB of images
LIST = ".report.json"  # suffix of the list of a shard's meshes


def make_shards(config: DatasetConfig) -> int:
    """Make the data set that `config` describes as shards in `output/SYNSET/SPLIT`.

    Existing shards are kept. Unusable meshes are skipped and listed in the report, which has the same files as that of
    `make_dataset`. Returns the exit status: 0, 1 if a shard failed (the next call tries it again), 130 after a signal.

    Raises ValueError (no usable mesh, shards of other settings in the folder), OSError (folder not writable).
    """
    folder, splits = config.output / synset_of(config.category), split_items(config)
    _prepare(config, folder, splits)
    threads = max(1, torch.get_num_threads() // config.jobs)
    tasks = {}
    for split, items in splits.items():
        for number, part in enumerate(_parts(items)):
            path = shard_path(folder / split, number)
            given = (config, path, number, part, threads)
            tasks[path] = Task(f"{split} {number}", make_shard, given, folder / f"{split}-{number:05d}.log")
    missing = [task for path, task in tasks.items() if not path.is_file()]
    note(f"{config.category}: {len(tasks)} shards, {len(missing)} to be made; logs: {folder / '*.log'}")
    failed = run_tasks(missing, jobs=config.jobs)
    for name, tail in failed.items():
        note(f"\nFAILED {name}; the end of the log:\n{tail}")
    if count := sum(not path.is_file() for path in tasks):
        note(f"{count} shards are missing; the same command makes them")
        return 1 if failed else INTERRUPTED
    say(_finish(config, folder, splits, list(tasks)).text())
    return 0


def make_shard(config: DatasetConfig, path: Path, number: int, items: Sequence[Item], threads: int) -> bool:
    """Make one shard and the list of its meshes. Returns False if a signal stopped it."""
    torch.set_num_threads(threads)
    writer, made, objects = WRITERS[config.layout](path.parent, config.category), [], []
    with stop_on_signal() as stop:
        for mesh, of_mesh in render_meshes(config, writer, items):
            if stop.name:
                return False
            made.append(mesh)
            objects += of_mesh
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path.with_suffix(LIST), made, sync=True)
        write_shard(path.parent, number, writer.dataset(objects, config.category, items[0].split))
    print(f"{path.parent.name} {number}: {len(objects)} objects", flush=True)
    return True


def _parts(items: Sequence[Item]) -> Iterator[list[Item]]:
    """The meshes of each shard: as many as make `OBJECTS_PER_SHARD` objects at most, and at least one."""
    part: list[Item] = []
    for item in items:
        if part and sum(each.copies for each in part) + item.copies > OBJECTS_PER_SHARD:
            yield part
            part = []
        part.append(item)
    if part:
        yield part


def _prepare(config: DatasetConfig, folder: Path, splits: dict[str, list[Item]]) -> None:
    """Make the category's folder, and write its settings. Raises ValueError if it has shards of other settings."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "settings.json"
    if config.overwrite:
        for split in SPLITS:
            remove(folder / split)
        path.unlink(missing_ok=True)
    names = sorted((item.number, item.name) for items in splits.values() for item in items)
    crc = zlib.crc32("\n".join(name for _, name in names).encode())
    settings = config.to_dict() | {"list of meshes": f"{len(names)}, CRC-32 {crc:08x}"}
    before = read_json(path, 2**20, "the settings of shards") if path.is_file() else settings
    if different := sorted(k for k in {*settings, *before} if settings.get(k) != before.get(k)):
        raise ValueError(
            f"{folder} has shards that were made with another {', '.join(different)}; repeat those settings, give "
            "another folder, or --overwrite to replace them"
        )
    write_json(path, settings)


def _finish(
    config: DatasetConfig, folder: Path, splits: dict[str, list[Item]], shards: Sequence[Path]
) -> DatasetReport:
    """Mark the splits as complete, and write the report."""
    lists = [read_json(path.with_suffix(LIST), 2**28, "the list of a shard's meshes") for path in shards]
    report = DatasetReport(config, [mesh for found in lists for mesh in found])
    rows, writer = {}, WRITERS[config.layout](folder, config.category)
    for split in report.counts:
        count = sum(path.parent.name == split for path in shards)
        finish_set(folder / split, config.layout, count, writer.dataset([], config.category, split))
        shown = [objects[0] for _, objects in render_meshes(config, writer, splits[split][:ROWS]) if objects]
        rows[split] = [contact_row(writer, item) for item in shown]
    with publishing(config.output, report_files(config.category)) as temporary:
        report.write(temporary, rows)
    return report
