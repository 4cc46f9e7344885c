"""Data sets of any size, stored as shards: files from which training reads the rows of one batch
at a time.

The folder `FOLDER/CATEGORY/SPLIT/` of a split has the files

    00000.safetensors, 00001 ...    shards: some objects with their views, in the safetensors format
    set.json                        facts about all shards, written last: with it the split is complete

A shard of n objects and m views has the tensors

    images                          uint8 [m, 4, S, S], see `ViewDataset`; also `masks` and `depth` if known
    voxels                          bool [n, 32, 32, 32] if known; also `points` float32 [n, P, 3]
    images.checksums ...            uint32: CRC-32 of each row of these arrays
    object_ids, view_ids, sides     int32 [m] in 0 .. n-1, int32 [m], float32 [m]: tables of the views; object sizes
    azimuth_deg ... or rotation     float32 [m, ...]: the poses; fields with one value for all views are in set.json

Its metadata are the names of the objects, and a CRC-32 of names and tables. The bytes of a shard
depend on its content alone. Axes and colours are those of the layout (`kato`, `kar` ...).
"""

import dataclasses
import itertools
import json
import os
import socket
import zlib
from pathlib import Path
from typing import Annotated, BinaryIO, Literal

import numpy as np
from pydantic import Field
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from torch import Tensor

from learn3d.data.conventions import LAYOUTS, SET_FILE, shards_folder
from learn3d.data.dataset import ViewDataset, join_datasets
from learn3d.data.disk_array import CHANGED, MAX_BYTES, ROW, WANTED, DiskArray
from learn3d.data.poses import LookAtPoses, RotationPoses
from learn3d.files import limits
from learn3d.files.reading import (
    DamagedFile,
    FaultHandler,
    OddFile,
    attempt,
    open_file,
    parse_json,
    read_json,
    refuse,
)
from learn3d.files.writing import replacing, write_json
from learn3d.settings import checked

SHARD_BYTES = 2**28  # approximate size of the images in a shard
_FILES = 5 * "[0-9]" + "*.safetensors"
_REPORTS = 5 * "[0-9]" + "*.report.json"  # lists of meshes from `make_data.render`
_PARTIALS = (".*.partial", ".tmp??????")  # half-written files; safetensors uses the second name
_ARRAYS = ("images", "masks", "depth", "voxels", "points")
_DTYPES = {  # by tensor; all others are float32
    **dict.fromkeys(("images", "masks", "depth"), np.uint8),
    **dict.fromkeys(("object_ids", "view_ids"), np.int32),
    "voxels": np.bool_,
    "checksums": np.uint32,
}
_POSES = {kind.__name__: kind for kind in (LookAtPoses, RotationPoses)}
_MAKE_AGAIN = "make or copy it again"

Text = Annotated[str, Field(max_length=1000)]


@checked
class SetFile:
    """`set.json`: facts about all shards of a split."""

    layout: Literal[tuple(LAYOUTS)]
    shards: Annotated[int, Field(ge=1)]
    image_size: Annotated[int, Field(ge=1, le=4096)]
    view_names: Annotated[list[Text], Field(max_length=limits.VIEW_CLASSES)]
    poses: Literal[(None, *_POSES)]  # class of the poses; None if they are unknown
    constants: dict[Text, float]  # fields of the poses with one value for all
    # CRC-32 of the other fields; None in files of versions that had none
    crc: Annotated[int, Field(ge=0)] | None = None

    def checksum(self) -> int:
        """The value for `crc`."""
        facts = dataclasses.asdict(self) | {"crc": None}
        return zlib.crc32(json.dumps(facts, sort_keys=True).encode())


def shard_path(folder: Path, number: int) -> Path:
    """Path of shard `number` in the folder of its split. The file exists only if it is complete."""
    return folder / f"{number:05d}.safetensors"


def write_shard(folder: Path, number: int, part: ViewDataset) -> None:
    """Write `part` of a data set as shard `number` in the folder of its split."""
    tensors = {name: getattr(part, name).astype(np.int32) for name in ("object_ids", "view_ids")}
    tensors["sides"] = part.object_sizes().astype(np.float32)
    tensors |= {name: v.numpy() for name, v in _pose_fields(part).items() if isinstance(v, Tensor)}
    arrays = {
        name: np.ascontiguousarray(a) for name in _ARRAYS if (a := getattr(part, name)) is not None
    }
    for name, array in arrays.items():
        tensors[f"{name}.checksums"] = np.array([zlib.crc32(row) for row in array], np.uint32)
    metadata = {"objects": list(part.object_names), "crc": _crc(part.object_names, tensors)}
    folder.mkdir(parents=True, exist_ok=True)
    writer = f".{socket.gethostname()}-{os.getpid()}"  # another machine may have lost its worker, and still write it
    with replacing(shard_path(folder, number), sync=True, writer=writer) as path:
        save_file(tensors | arrays, path, {"shard": json.dumps(metadata)})


def finish_set(folder: Path, layout: str, shards: int, part: ViewDataset) -> None:
    """Mark a split of `shards` shards as complete, and remove what killed processes left.

    `part`: any part of it.
    """
    for path in itertools.chain(*(folder.glob(pattern) for pattern in _PARTIALS)):
        path.unlink(missing_ok=True)
    facts = SetFile(
        layout=layout,
        shards=shards,
        image_size=part.image_size,
        view_names=list(part.view_names),
        poses=None if part.poses is None else type(part.poses).__name__,
        constants={name: v for name, v in _pose_fields(part).items() if not isinstance(v, Tensor)},
    )
    facts = dataclasses.replace(facts, crc=facts.checksum())
    write_json(folder / SET_FILE, dataclasses.asdict(facts), sync=True)


def write_set(folder: Path, layout: str, dataset: ViewDataset) -> int:
    """Write a whole split as shards of about `SHARD_BYTES` each. Returns their number.

    `ViewDataset.crops` is not written.
    """
    count = dataset.num_objects
    step = max(1, SHARD_BYTES * count // max(1, dataset.images.nbytes))
    for number, start in enumerate(range(0, count, step)):
        part = dataset.select(np.flatnonzero(dataset.object_ids // step == number))
        names = [
            name
            for name in ("voxels", "points", "object_names")
            if getattr(dataset, name) is not None
        ]
        own = {name: getattr(dataset, name)[start : start + step] for name in names}
        write_shard(
            folder, number, dataclasses.replace(part, object_ids=part.object_ids - start, **own)
        )
    finish_set(folder, layout, number + 1, dataset)
    return number + 1


def remove(folder: Path) -> None:
    """Remove the shards in the folder of a split, with their reports; other files stay."""
    for path in itertools.chain(
        *(folder.glob(pattern) for pattern in (SET_FILE, _FILES, _REPORTS))
    ):
        path.unlink()


def load(
    folder: Path | str,
    category: str,
    split: str,
    *,
    layout: str,
    image_size: int | None = None,
    on_fault: FaultHandler = refuse,
) -> ViewDataset:
    """Read names and tables of a split, about 60 bytes for each view; the arrays stay on disk.

    Raises MissingFile and DamagedFile if shards are missing, damaged, or of another layout or
    image size.
    """
    where = shards_folder(folder, category, split)
    content = read_json(where / SET_FILE, limits.JSON_BYTES, "the description of shards")
    try:
        facts = SetFile(**content)
    except (ValueError, TypeError) as error:
        raise DamagedFile(
            where / SET_FILE, f"is no description of shards ({error}); {_MAKE_AGAIN}"
        ) from None
    if facts.crc is None:
        old = "has no checksum of its cameras, as older versions wrote it; make the shards again for one"
        on_fault(OddFile(where / SET_FILE, old))
    elif facts.crc != facts.checksum():
        raise DamagedFile(where / SET_FILE, f"{CHANGED}; {_MAKE_AGAIN}")
    if facts.layout != layout or image_size not in (None, facts.image_size):
        found = f"images of {facts.image_size} pixels in the layout {facts.layout!r}"
        wanted = f"{image_size or facts.image_size} pixels in {layout!r}"
        hint = "give another --layout, or convert it with another --image-size"
        raise DamagedFile(where, f"has {found}, expected {wanted}; {hint}")
    paths = sorted(where.glob(_FILES))
    if len(paths) != facts.shards:
        numbers = {int(path.stem) for path in paths}
        first = next(number for number in itertools.count() if number not in numbers)
        which, number = "is missing", first
        if first >= facts.shards:
            which, number = "is not one of them", max(numbers)
        found = f"{which}: the split has {facts.shards} shards, and {len(paths)} files"
        on_fault(DamagedFile(shard_path(where, number), found))
    read = (attempt(on_fault, _read_shard, path, facts, category, split) for path in paths)
    parts = [part for part in read if part is not None]
    if not parts:
        raise DamagedFile(where, f"has no whole shard; {_MAKE_AGAIN}")
    try:
        return join_datasets(parts)
    except ValueError as error:
        raise DamagedFile(where, f"has shards that differ ({error}); {_MAKE_AGAIN}") from error


def check_arrays(dataset: ViewDataset, where: Path, on_fault: FaultHandler) -> None:
    """Read all arrays of the shards in the folder `where`, and report faults."""
    for name in _ARRAYS:
        if (array := getattr(dataset, name)) is not None:
            array.check(on_fault)
    if warning := dataset.check_masks():
        on_fault(OddFile(where, warning))


def _read_shard(path: Path, facts: SetFile, category: str, split: str) -> ViewDataset:
    """Read and check names and tables of a shard; its arrays stay on disk."""
    with open_file(path, MAX_BYTES, WANTED) as file:
        try:
            names, tables, arrays = _read_tables(path, file)
            poses = None
            if kind := _POSES.get(facts.poses):
                poses = kind(
                    **{f.name: (tables | facts.constants)[f.name] for f in dataclasses.fields(kind)}
                )
                if not (sound := poses.in_range()).all():
                    raise ValueError(
                        f"the pose of view {int(sound.int().argmin())} is out of range"
                    )
            if not ((tables["sides"] >= 0) & (tables["sides"] <= 1)).all():
                raise ValueError("sides must lie in 0 .. 1")
            dataset = ViewDataset(
                **LAYOUTS[facts.layout].about(category, split),
                poses=poses,
                view_ids=tables["view_ids"],
                view_names=tuple(facts.view_names),
                object_ids=tables["object_ids"],
                object_names=tuple(names),
                stored_sizes=tables["sides"],
                **{"voxels": None} | arrays,
            )
            if dataset.image_size != facts.image_size:
                raise ValueError(
                    f"its images have {dataset.image_size} pixels, not {facts.image_size}"
                )
            return dataset
        except (
            ValueError,
            TypeError,
            LookupError,
            AttributeError,
            OSError,
            SafetensorError,
        ) as error:
            text = (
                str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
            )
            raise DamagedFile(
                path, f"cannot be read as {WANTED} ({text}); {_MAKE_AGAIN}"
            ) from error


def _read_tables(
    path: Path, file: BinaryIO
) -> tuple[list[str], dict[str, np.ndarray], dict[str, DiskArray]]:
    """The names of objects, the tables, and the arrays of a shard."""
    with safe_open(
        path, "np"
    ) as shard:  # it compares shapes and positions with the length of the file
        metadata = parse_json(shard.metadata()["shard"])
        read = {
            name: shard.get_slice(name)[:0] if name in _ARRAYS else shard.get_tensor(name)
            for name in shard.keys()
        }
    for name, array in read.items():
        if array.dtype != (wanted := _DTYPES.get(name.partition(".")[2] or name, np.float32)):
            raise ValueError(f"{name} is {array.dtype}; expected {np.dtype(wanted)}")
    tables = {name: array for name, array in read.items() if name not in _ARRAYS}
    if _crc(metadata["objects"], tables) != metadata["crc"]:
        raise ValueError(CHANGED)
    size = int.from_bytes(file.read(8), "little")
    header = parse_json(file.read(size))
    arrays = {}
    for name in read.keys() - tables.keys():
        rows = np.zeros(len(tables[f"{name}.checksums"]), ROW)
        rows["row"] = np.arange(len(rows))
        rows["crc"] = tables[f"{name}.checksums"]
        if len(rows) != header[name]["shape"][0]:
            raise ValueError(
                f"{name} has {header[name]['shape'][0]} rows, but {len(rows)} checksums"
            )
        begin = 8 + size + header[name]["data_offsets"][0]
        arrays[name] = DiskArray(((path, begin),), rows, read[name].shape[1:], read[name].dtype)
    return metadata["objects"], tables, arrays


def _pose_fields(part: ViewDataset) -> dict[str, Tensor | float]:
    return {} if part.poses is None else vars(part.poses)


def _crc(objects: list[str] | tuple[str, ...], tables: dict[str, np.ndarray]) -> int:
    """CRC-32 of the names of objects and of the tables, sorted by name."""
    crc = zlib.crc32("\n".join(objects).encode())
    for name in sorted(tables):
        crc = zlib.crc32(np.ascontiguousarray(tables[name]), crc)
    return crc
