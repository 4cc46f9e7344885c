"""Data sets of any size, kept in shards: files of which training reads only the rows of each batch.

`FOLDER/CATEGORY/SPLIT/` holds, for a split of N objects and M views,

    00000.safetensors, 00001 ...    some objects with their views, in the format of the library safetensors
    set.json                        facts about all shards, written last: it declares the split complete

A shard of n objects and m views has the tensors

    images                          uint8 [m, 4, S, S], as `ViewDataset.images`; likewise `masks`, if there are any
    voxels                          bool [n, 32, 32, 32]; likewise `points` float32 [n, P, 3]; each if there are any
    images.checksums ...            uint32: CRC-32 of each row of these arrays
    object_ids, view_ids, sides     int32 [m] in 0 .. n-1, int32 [m], float32 [m]: tables of the views
    azimuth_deg ... or rotation     float32 [m, ...]: the poses; those fields that are the same for all are in set.json

and the names of its objects and a CRC-32 of the names and tables as metadata. Its bytes depend on its content alone.
The layout (`kato`, `kar` ...) says how axes and colours are meant, as it does without shards.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from safetensors.numpy import save_file
from torch import Tensor

from learn3d.data.categories import synset_of
from learn3d.data.conventions import VOXEL_SIZE
from learn3d.data.dataset import MASK_SIZE, SPLITS, ViewDataset
from learn3d.data.disk_array import MOST_BYTES, WANTED, DiskArray
from learn3d.data.poses import LookAtPoses, Poses, RotationPoses
from learn3d.data.readers import READERS
from learn3d.files import limits
from learn3d.files.findings import DamagedFile, MissingFile, Problem
from learn3d.files.reading import open_file, parse_json, read_bytes
from learn3d.files.writing import replacing, write_json
from learn3d.settings import checked

SET_FILE = "set.json"
SHARD_BYTES = 2**28  # of images in a shard, about
_FILES = 5 * "[0-9]" + "*.safetensors"
_REPORTS = 5 * "[0-9]" + "*.report.json"  # lists of meshes, which `make_data.sharded` writes
_ARRAYS = ("images", "masks", "voxels", "points")  # the first two have a row for each view, the others for each object
_DTYPES = {"U8": np.uint8, "BOOL": np.bool_, "I32": np.int32, "U32": np.uint32, "F32": np.float32}
_POSES = {kind.__name__: kind for kind in (LookAtPoses, RotationPoses)}
_MAKE_AGAIN = "make or convert the data set again"
_ROWS_AT_ONCE = 256  # that are read to be checked

Text = Annotated[str, Field(max_length=1000)]


@checked
class SetFile:
    """`set.json`: the facts that hold for all shards."""

    layout: Literal[tuple(READERS)]
    shards: Annotated[int, Field(ge=1)]
    image_size: Annotated[int, Field(ge=1, le=4096)]
    view_names: Annotated[list[Text], Field(max_length=limits.VIEW_CLASSES)]
    poses: Literal[(None, *_POSES)]  # kind of the poses; None if they are unknown
    constants: dict[Text, Annotated[float, Field(allow_inf_nan=False)]]  # fields of the poses that all views share

    @property
    def pose_fields(self) -> list[str]:
        """Names of the fields of the poses."""
        return [] if self.poses is None else [field.name for field in dataclasses.fields(_POSES[self.poses])]


@dataclasses.dataclass(frozen=True)
class Shard:
    """A shard whose names and tables have been read; its arrays are on disk."""

    path: Path
    objects: list[str]
    tables: dict[str, np.ndarray]
    arrays: dict[str, DiskArray]


def split_folder(folder: Path | str, category: str, split: str) -> Path:
    """The folder of the shards of a split."""
    return Path(folder) / synset_of(category) / split


def holds(folder: Path | str, category: str, split: str) -> bool:
    """Whether the folder has this split in shards; False for a name that no category can have."""
    try:
        return (split_folder(folder, category, split) / SET_FILE).is_file()
    except (ValueError, OSError):
        return False


def shard_path(folder: Path, number: int) -> Path:
    """Shard `number` in the folder of its split. The file is there only when it is complete."""
    return folder / f"{number:05d}.safetensors"


# ------------------------------------------------------------------------------------------------------------- writing


def write_shard(folder: Path, number: int, part: ViewDataset) -> None:
    """Write shard `number` of a split's folder: a part of a data set, whose arrays are in memory."""
    tensors = {name: getattr(part, name).astype(np.int32) for name in ("object_ids", "view_ids")}
    tensors["sides"] = part.object_sides().astype(np.float32)
    tensors |= {name: v.numpy() for name, v in _fields(part.poses).items() if isinstance(v, Tensor)}
    arrays = {name: np.ascontiguousarray(a) for name in _ARRAYS if (a := getattr(part, name)) is not None}
    for name, array in arrays.items():
        tensors[f"{name}.checksums"] = np.array([zlib.crc32(row) for row in array], np.uint32)
    metadata = {"objects": list(part.object_names), "crc": _crc(part.object_names, tensors)}
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(shard_path(folder, number), sync=True) as path:
        save_file(tensors | arrays, path, {"shard": json.dumps(metadata)})


def finish_set(folder: Path, layout: str, shards: int, part: ViewDataset) -> None:
    """Declare a split of so many shards complete. `part`: any part of the data set."""
    facts = SetFile(
        layout=layout,
        shards=shards,
        image_size=part.image_size,
        view_names=list(part.view_names),
        poses=None if part.poses is None else type(part.poses).__name__,
        constants={name: v for name, v in _fields(part.poses).items() if not isinstance(v, Tensor)},
    )
    write_json(folder / SET_FILE, dataclasses.asdict(facts), sync=True)


def write_set(folder: Path, layout: str, dataset: ViewDataset) -> int:
    """Write a whole split as shards of about `SHARD_BYTES` each; returns how many.

    The crops of Pascal3D+ (`ViewDataset.crops`) are not kept.
    """
    count = dataset.num_objects
    step = max(1, SHARD_BYTES * count // max(1, dataset.images.nbytes))
    for number, start in enumerate(range(0, count, step)):
        objects = slice(start, min(start + step, count))
        part = dataset.select(np.flatnonzero((dataset.object_ids >= start) & (dataset.object_ids < objects.stop)))
        names = [name for name in ("voxels", "points", "object_names") if getattr(dataset, name) is not None]
        own = {name: getattr(dataset, name)[objects] for name in names}
        write_shard(folder, number, dataclasses.replace(part, object_ids=part.object_ids - start, **own))
    finish_set(folder, layout, number + 1, dataset)
    return number + 1


def remove(folder: Path) -> None:
    """Remove the shards of a split's folder with their reports, and nothing else that may be there."""
    for path in itertools.chain(*(folder.glob(pattern) for pattern in (SET_FILE, _FILES, _REPORTS))):
        path.unlink()


def _fields(poses: Poses | None) -> dict[str, Tensor | float]:
    return {} if poses is None else {field.name: getattr(poses, field.name) for field in dataclasses.fields(poses)}


def _crc(objects: list[str] | tuple[str, ...], tables: dict[str, np.ndarray]) -> int:
    """CRC-32 of the names of objects, and of tables in the order of their names."""
    crc = zlib.crc32("\n".join(objects).encode())
    for name in sorted(tables):
        crc = zlib.crc32(np.ascontiguousarray(tables[name]), crc)
    return crc


# ------------------------------------------------------------------------------------------------------------- reading


def read_set(folder: Path) -> SetFile:
    """`set.json` of a split's folder. Raises MissingFile and DamagedFile."""
    content = read_bytes(folder / SET_FILE, limits.JSON_BYTES, "the description of shards as JSON")
    try:
        return SetFile(**parse_json(content))
    except (ValueError, TypeError) as error:
        raise DamagedFile(folder / SET_FILE, f"is no description of shards ({error}); {_MAKE_AGAIN}") from None


def read_shard(path: Path, facts: SetFile) -> Shard:
    """The names and tables of a shard, if it agrees with the facts about the set. Raises MissingFile, DamagedFile."""
    with open_file(path, MOST_BYTES, WANTED) as file:
        try:
            size = int.from_bytes(file.read(8), "little")
            if size > limits.JSON_BYTES:
                raise ValueError(f"its header would have {size} bytes")
            header = parse_json(file.read(size))
            metadata, end = parse_json(header.pop("__metadata__")["shard"]), file.seek(0, 2)
            objects, tables, positions = metadata["objects"], {}, {}
            wanted = _wanted_tensors(facts, header, len(objects))
            if missing := wanted.keys() - header.keys():
                raise ValueError(f"it has no {min(missing)}")
            for name, info in header.items():
                code, shape = wanted[name]
                begin, stop = (8 + size + offset for offset in info["data_offsets"])
                if (info["dtype"], info["shape"]) != (code, shape):
                    raise ValueError(f"{name} is {info['dtype']} {info['shape']}; expected {code} {shape}")
                dtype = np.dtype(_DTYPES[code])
                if not 8 + size <= begin <= stop <= end or stop - begin != math.prod(shape) * dtype.itemsize:
                    raise ValueError(f"{name} is not as long as it should be; the file has {end} bytes")
                if name in _ARRAYS:
                    positions[name] = begin
                else:
                    file.seek(begin)
                    tables[name] = np.fromfile(file, dtype, math.prod(shape)).reshape(shape)
            if _crc(objects, tables) != metadata["crc"]:
                raise ValueError("its content is not as it was written: another CRC-32")
            _check_values(facts, tables, len(objects))
        except (ValueError, TypeError, LookupError, AttributeError, OSError) as error:
            text = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
            raise DamagedFile(path, f"cannot be read as {WANTED} ({text}); {_MAKE_AGAIN}") from error
    arrays = {}
    for name, position in positions.items():
        code, (_, *row_shape) = wanted[name]
        checksums = tables.pop(f"{name}.checksums")
        arrays[name] = DiskArray.of_file(path, position, checksums, tuple(row_shape), np.dtype(_DTYPES[code]))
    return Shard(path, objects, tables, arrays)


def _wanted_tensors(facts: SetFile, header: dict[str, Any], objects: int) -> dict[str, tuple[str, list[int]]]:
    """Type and shape of all tensors that a shard must have, given those in its header."""
    views, size = header["images"]["shape"][0], facts.image_size
    points = header["points"]["shape"][1] if "points" in header else 0
    arrays = {
        "images": ("U8", [views, 4, size, size]),
        "masks": ("U8", [views, MASK_SIZE, MASK_SIZE]),
        "voxels": ("BOOL", [objects, VOXEL_SIZE, VOXEL_SIZE, VOXEL_SIZE]),
        "points": ("F32", [objects, points, 3]),
    }
    arrays = {name: wanted for name, wanted in arrays.items() if name in header}
    tables = {"object_ids": ("I32", [views]), "view_ids": ("I32", [views]), "sides": ("F32", [views])}
    for name in facts.pose_fields:
        if name not in facts.constants:
            tables[name] = ("F32", [views, 3, 3] if name == "rotation" else [views])
    checksums = {f"{name}.checksums": ("U32", shape[:1]) for name, (_, shape) in arrays.items()}
    return tables | checksums | arrays


def _check_values(facts: SetFile, tables: dict[str, np.ndarray], objects: int) -> None:
    """Raise a ValueError for values of the tables that are out of range."""
    ends = {"object_ids": objects - 1, "view_ids": len(facts.view_names) - 1, "sides": 1}
    for name, end in ends.items():
        if not ((tables[name] >= 0) & (tables[name] <= end)).all():
            raise ValueError(f"{name} must lie in 0 .. {end}")
    poses = _poses(facts, tables)
    if poses is not None and not poses.in_range().all():
        raise ValueError(f"the pose of view {int(poses.in_range().int().argmin())} is out of range")


def _poses(facts: SetFile, tables: dict[str, np.ndarray]) -> Poses | None:
    values = {name: tables.get(name, facts.constants.get(name)) for name in facts.pose_fields}
    return None if facts.poses is None else _POSES[facts.poses](**values)


def load(folder: Path | str, category: str, split: str, *, layout: str, image_size: int | None = None) -> ViewDataset:
    """The split, with its arrays on disk. Shards that are missing or damaged are left out: see `ViewDataset.notes`.

    Only names and tables are read, about 60 bytes for each view; images are compared with their checksums when a batch
    needs them. Raises DamagedFile if no shard can be read, ValueError for another layout or image size.
    """
    where = split_folder(folder, category, split)
    facts = read_set(where)
    if facts.layout != layout:
        raise ValueError(f"{where} is a data set of the layout {facts.layout!r}, not {layout!r}")
    if image_size not in (None, facts.image_size):
        raise ValueError(
            f"{where} has images of {facts.image_size} pixels, but {image_size} are wanted; convert the data set "
            f"again with --image-size {image_size}"
        )
    there = set(where.glob(_FILES))
    first_missing = next(path for n in itertools.count() if (path := shard_path(where, n)) not in there)
    shards, notes = [], []
    if missing := max(0, facts.shards - len(there)):
        notes.append(f"left out {missing} of {facts.shards} shards, which are missing: {first_missing} ...")
    for path in sorted(there):
        try:
            shard = read_shard(path, facts)
            if shards and _row_shapes(shard) != _row_shapes(shards[0]):
                raise DamagedFile(path, f"does not go with {shards[0].path}: it has other arrays; {_MAKE_AGAIN}")
            shards.append(shard)
        except (DamagedFile, MissingFile) as error:
            notes.append(f"left out one of {facts.shards} shards: {error}")
    if not shards:
        raise DamagedFile(where, f"none of its {facts.shards} shards can be read; the first: {notes[0]}")
    tables = {name: np.concatenate([shard.tables[name] for shard in shards]) for name in shards[0].tables}
    starts = np.cumsum([0] + [len(shard.objects) for shard in shards])[:-1]
    views = [len(shard.tables["object_ids"]) for shard in shards]
    arrays = {name: DiskArray.join([shard.arrays[name] for shard in shards]) for name in shards[0].arrays}
    properties = READERS[layout].PROPERTIES
    return ViewDataset(
        category=category,
        split=split,
        poses=_poses(facts, tables),
        view_ids=tables["view_ids"],
        view_names=tuple(facts.view_names),
        object_ids=tables["object_ids"] + np.repeat(starts, views).astype(np.int32),
        object_names=tuple(name for shard in shards for name in shard.objects),
        convention=properties.convention,
        inverted=properties.inverted,
        sides=tables["sides"],
        notes=tuple(notes),
        **({"voxels": None} | arrays),
    )


def _row_shapes(shard: Shard) -> dict[str, tuple[int, ...]]:
    return {name: array.row_shape for name, array in shard.arrays.items()}


# ------------------------------------------------------------------------------------------------------------ checking


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories of a folder that are kept in shards, and the splits of each."""
    found = {}
    for path in sorted(Path(folder).glob(f"*/*/{SET_FILE}")):
        found.setdefault(path.parents[1].name, set()).add(path.parent.name)
    return {category: tuple(s for s in SPLITS if s in splits) for category, splits in found.items()}


def count(folder: Path | str, category: str, split: str) -> int:
    """How many objects a split holds in its sound shards."""
    where = split_folder(folder, category, split)
    return load(folder, category, split, layout=read_set(where).layout).num_objects


def problems(
    folder: Path | str, category: str, split: str, *, layout: str, progress: bool = False
) -> Iterator[Problem]:
    """Everything that is wrong with the files of a split, which are read as a whole. `load` leaves such shards out."""
    where = str(split_folder(folder, category, split))
    try:
        dataset = load(folder, category, split, layout=layout)
    except ValueError as error:
        yield Problem(str(getattr(error, "path", where)), getattr(error, "message", str(error)))
        return
    yield from (Problem(where, note) for note in dataset.notes)
    for array in (dataset.images, dataset.masks, dataset.voxels, dataset.points):
        for start, end in [] if array is None else itertools.pairwise(array.starts.tolist()):
            try:
                for rows in range(start, end, _ROWS_AT_ONCE):
                    array[np.arange(rows, min(rows + _ROWS_AT_ONCE, end))]
            except DamagedFile as error:
                yield Problem(str(error.path), error.message)
    if warning := dataset.check_masks():
        yield Problem(where, warning, "warning")
