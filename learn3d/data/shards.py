"""Data sets of any size, kept in shards: .npy files of which training reads only the rows of each batch.

`FOLDER/CATEGORY/SPLIT/` holds, for shard k of n objects and m views:

    k.images.npy    uint8 [m, 4, S, S], as `ViewDataset.images`; likewise k.masks.npy, where there are any
    k.voxels.npy    bool [n, 32, 32, 32]; likewise k.points.npy. Not where there are none
    k.views.npz     of each view: its object 0 .. n-1, its pose class, its pose, the side of its object
    k.json          names of the objects, and the CRC-32 of every file; written last, so it says that k is complete
    set.json        what holds for all shards; written when all of them are there

The layout (`kato`, `kar` ...) is what it was: it is named when the set is read, and says what its voxels mean.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field, ValidationError
from torch import Tensor

from learn3d.data.categories import synset_of
from learn3d.data.conventions import VOXEL_SIZE, VoxelConvention
from learn3d.data.dataset import SPLITS, ViewDataset
from learn3d.data.poses import LookAtPoses, Poses, RotationPoses
from learn3d.data.stored import StoredArray
from learn3d.files import npz
from learn3d.files.findings import DamagedFile, MissingFile, Problem
from learn3d.files.reading import parse_json, read_bytes
from learn3d.files.sandbox import Call, read_all
from learn3d.files.writing import replacing, write_json

SET_FILE = "set.json"
_NUMBERS = 5 * "[0-9]" + "*"  # what the names of a shard's files begin with
SHARD_BYTES = 2**28  # of images in a shard, about
_ARRAYS = ("images", "masks", "voxels", "points")  # the two first have a row for each view, the others for each object
_POSES = {kind.__name__: kind for kind in (LookAtPoses, RotationPoses)}
_MAKE_AGAIN = "make or convert the data set again"
_VIEWS = "the tables of a shard's views (.npz)"

Number = Annotated[int, Field(ge=0, le=2**40)]
Text = Annotated[str, Field(max_length=1000)]


class Convention(BaseModel):
    """A `VoxelConvention`."""

    name: Text
    swap: tuple[int, int] | None
    flip: tuple[int, ...]
    box: Annotated[float, Field(gt=0, le=1000)]
    kato18_scale: Annotated[float, Field(gt=0, le=1)]


class SetFile(BaseModel):
    """`set.json`: what all shards have in common."""

    layout: Text
    shards: Annotated[int, Field(ge=1, le=10**7)]
    image_size: Annotated[int, Field(ge=1, le=4096)]
    inverted: bool
    view_names: list[Text]
    convention: Convention
    poses: Text | None  # kind of the poses; None: they are not known
    constants: dict[str, float]  # entries of the poses that are the same for all views


class ShardFile(BaseModel):
    """`k.json`."""

    objects: list[Text]
    views: Number
    crcs: dict[Text, Number]  # by the name of the array, or "views"


def split_folder(folder: Path | str, category: str, split: str) -> Path:
    """Where the shards of a split are."""
    return Path(folder) / synset_of(category) / split


def holds(folder: Path | str, category: str, split: str) -> bool:
    """Whether the folder has this split in shards; not for a name that is no category, of which the reader says so."""
    try:
        return (split_folder(folder, category, split) / SET_FILE).is_file()
    except (ValueError, OSError):
        return False


def made(folder: Path, number: int) -> ShardFile | None:
    """What a shard of a split's folder holds; None where it is not complete."""
    path = folder / f"{number:05d}.json"
    return _parsed(ShardFile, path) if path.is_file() else None


# ------------------------------------------------------------------------------------------------------------- writing


def write_shard(folder: Path, number: int, part: ViewDataset) -> None:
    """Write shard `number` of a split's folder: a part of a data set, whose arrays are in memory."""
    folder.mkdir(parents=True, exist_ok=True)
    ids = {name: getattr(part, name).astype(np.int32) for name in ("object_ids", "view_ids")}
    views = {**ids, "sides": part.object_sides().astype(np.float32)}
    views |= {name: value.numpy() for name, value in _pose_values(part.poses).items() if isinstance(value, Tensor)}
    crcs = {}
    for name in _ARRAYS:
        array = getattr(part, name)
        if array is not None:
            with replacing(folder / f"{number:05d}.{name}.npy", sync=True) as path, open(path, "wb") as file:
                np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
            crcs[name] = zlib.crc32(np.ascontiguousarray(array))
    with replacing(folder / f"{number:05d}.views.npz", sync=True) as path, open(path, "wb") as file:
        np.savez(file, **views)
    crcs["views"] = zlib.crc32((folder / f"{number:05d}.views.npz").read_bytes())
    shard = ShardFile(objects=list(part.object_names), views=len(part), crcs=crcs)
    write_json(folder / f"{number:05d}.json", shard.model_dump(), sync=True)


def finish_set(folder: Path, layout: str, shards: int, part: ViewDataset) -> None:
    """Say that all shards are there; `part`: any part of the data set."""
    constants = {name: float(v) for name, v in _pose_values(part.poses).items() if not isinstance(v, Tensor)}
    together = SetFile(
        layout=layout,
        shards=shards,
        image_size=part.image_size,
        inverted=part.inverted,
        view_names=list(part.view_names),
        convention=Convention(**dataclasses.asdict(part.convention)),
        poses=None if part.poses is None else type(part.poses).__name__,
        constants=constants,
    )
    write_json(folder / SET_FILE, together.model_dump(), sync=True)


def remove(folder: Path) -> None:
    """Remove the shards of a split's folder, and nothing else that may lie there."""
    for pattern in (SET_FILE, f"{_NUMBERS}.npy", f"{_NUMBERS}.views.npz", f"{_NUMBERS}.json"):
        for path in folder.glob(pattern):
            path.unlink()


def write_set(folder: Path, layout: str, dataset: ViewDataset) -> int:
    """Write a whole split as shards of about `SHARD_BYTES` each; returns how many.

    The crops of Pascal3D+ (`ViewDataset.crops`) are not kept.
    """
    per_object = dataset.images.itemsize * dataset.images.size / max(1, dataset.num_objects)
    step = max(1, int(SHARD_BYTES / max(1.0, per_object)))
    starts = range(0, dataset.num_objects, step)
    for number, start in enumerate(starts):
        part = _objects(dataset, start, min(start + step, dataset.num_objects))
        write_shard(folder, number, part)
    finish_set(folder, layout, len(starts), part)
    return len(starts)


def _objects(dataset: ViewDataset, start: int, end: int) -> ViewDataset:
    """The objects start .. end-1 with their views."""
    part = dataset.select(np.flatnonzero((dataset.object_ids >= start) & (dataset.object_ids < end)))
    own = {
        name: getattr(dataset, name)[start:end]
        for name in ("voxels", "points", "class_ids", "object_names")
        if getattr(dataset, name) is not None
    }
    return dataclasses.replace(part, object_ids=part.object_ids - start, **own)


def _pose_values(poses: Poses | None) -> dict[str, Tensor | float]:
    return {} if poses is None else {field.name: getattr(poses, field.name) for field in dataclasses.fields(poses)}


# ------------------------------------------------------------------------------------------------------------- reading


def load(folder: Path | str, category: str, split: str, *, layout: str, image_size: int | None = None) -> ViewDataset:
    """The split, with its arrays on disk. Shards that are missing or damaged are left out: see `ViewDataset.notes`.

    Only names, sizes and the tables of views are read: 20 to 36 bytes for each view. Raises DamagedFile where the whole
    set cannot be read, ValueError where it is of another layout or image size.
    """
    where = split_folder(folder, category, split)
    together = _set_file(where)
    if together.layout != layout:
        raise ValueError(f"{where} is a data set of the layout {together.layout!r}, not {layout!r}")
    if image_size not in (None, together.image_size):
        raise ValueError(
            f"{where} has images of {together.image_size} pixels, but {image_size} are wanted; convert the data set "
            f"again with --image-size {image_size}"
        )
    shards, notes = [], []
    for number in range(together.shards):
        try:
            shards.append(_Shard.open(where, number, together))
        except (DamagedFile, MissingFile) as error:
            notes.append(f"left out shard {number} of {together.shards}: {error}")
    calls = ([Call(npz.read_those_there, shard.path("views.npz"), _tables(shard), _VIEWS)] for shard in shards)
    sound = []
    for shard, (tables,) in zip(shards, read_all(calls), strict=True):
        try:
            sound.append((shard, _checked(shard, tables, together)))
        except (DamagedFile, MissingFile) as error:
            notes.append(f"left out shard {shard.number} of {together.shards}: {error}")
    if not sound:
        raise DamagedFile(where, f"none of its {together.shards} shards can be read; the first: {notes[0]}")
    return _joined(category, split, together, sound, tuple(notes))


@dataclasses.dataclass(frozen=True)
class _Shard:
    folder: Path
    number: int
    file: ShardFile
    arrays: dict[str, StoredArray]

    @classmethod
    def open(cls, folder: Path, number: int, together: SetFile) -> _Shard:
        file = _parsed(ShardFile, folder / f"{number:05d}.json")
        count, size = len(file.objects), together.image_size
        wanted = {
            "images": (file.views, (4, size, size), np.uint8),
            "masks": (file.views, (64, 64), np.uint8),
            "voxels": (count, (VOXEL_SIZE,) * 3, np.bool_),
            "points": (count, (None, 3), np.float32),
        }
        names = [name for name in _ARRAYS if name in file.crcs]
        if "images" not in names:
            raise DamagedFile(folder / f"{number:05d}.json", f"it names no images; {_MAKE_AGAIN}")
        paths = {name: folder / f"{number:05d}.{name}.npy" for name in names}
        arrays = {name: StoredArray.open(path, *wanted[name], file.crcs[name]) for name, path in paths.items()}
        return cls(folder, number, file, arrays)

    def path(self, name: str) -> Path:
        return self.folder / f"{self.number:05d}.{name}"


def _tables(shard: _Shard) -> tuple[tuple[str, ...], int]:
    """Names of all tables that there can be, and their greatest size in bytes."""
    fields = {field.name for kind in _POSES.values() for field in dataclasses.fields(kind)}
    return ("object_ids", "view_ids", "sides", *sorted(fields)), 72 * max(1, shard.file.views)


def _checked(shard: _Shard, tables: Any, together: SetFile) -> dict[str, np.ndarray]:
    """The tables of a shard's views, if they are as they should be."""
    if isinstance(tables, (DamagedFile, MissingFile)):
        raise tables
    kind, m = _POSES.get(together.poses), shard.file.views
    fields = [] if kind is None else [f.name for f in dataclasses.fields(kind) if f.name not in together.constants]
    ends = {"object_ids": len(shard.file.objects), "view_ids": len(together.view_names)}
    for name in ("object_ids", "view_ids", "sides", *fields):
        table = tables.get(name)
        shape = (m, 3, 3) if name == "rotation" else (m,)
        if table is None or table.shape != shape or table.dtype.kind not in ("i" if name in ends else "f"):
            raise DamagedFile(shard.path("views.npz"), f"{name} is not a table of {m} views; {_MAKE_AGAIN}")
        if name in ends and m and not (table.min() >= 0 and table.max() < ends[name]):
            raise DamagedFile(shard.path("views.npz"), f"{name} must lie in 0 .. {ends[name] - 1}; {_MAKE_AGAIN}")
    return tables


def _joined(
    category: str,
    split: str,
    together: SetFile,
    sound: Sequence[tuple[_Shard, dict[str, np.ndarray]]],
    notes: tuple[str, ...],
) -> ViewDataset:
    counts = np.cumsum([0] + [len(shard.file.objects) for shard, _ in sound])

    def table(name: str) -> np.ndarray:
        return np.concatenate([tables[name] for _, tables in sound])

    arrays = {
        name: StoredArray.join([shard.arrays[name] for shard, _ in sound])
        for name in _ARRAYS
        if all(name in shard.arrays for shard, _ in sound)
    }
    poses = None
    if (kind := _POSES.get(together.poses)) is not None:
        constants = together.constants
        names = [field.name for field in dataclasses.fields(kind)]
        poses = kind(**{name: constants[name] if name in constants else table(name) for name in names})
    starts = zip(sound, counts.tolist(), strict=False)
    return ViewDataset(
        category=category,
        split=split,
        poses=poses,
        view_ids=table("view_ids"),
        view_names=tuple(together.view_names),
        object_ids=np.concatenate([tables["object_ids"] + np.int32(first) for (_, tables), first in starts]),
        object_names=tuple(name for shard, _ in sound for name in shard.file.objects),
        images=arrays["images"],
        voxels=arrays.get("voxels"),
        masks=arrays.get("masks"),
        points=arrays.get("points"),
        convention=VoxelConvention(**together.convention.model_dump()),
        inverted=together.inverted,
        sides=table("sides"),
        notes=notes,
    )


def _set_file(where: Path) -> SetFile:
    return _parsed(SetFile, where / SET_FILE)


def _parsed(kind: type[BaseModel], path: Path) -> Any:
    """A JSON file of these shards, checked."""
    try:
        return kind(**parse_json(read_bytes(path, 2**28, "a JSON file")))
    except DamagedFile:
        raise
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise DamagedFile(path, f"is no description of shards ({where}: {first['msg']}); {_MAKE_AGAIN}") from None
    except (ValueError, TypeError) as error:
        raise DamagedFile(path, f"is no description of shards ({error}); {_MAKE_AGAIN}") from None


# ------------------------------------------------------------------------------------------------------------ checking


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories of a folder that are kept in shards, and the splits of each."""
    found = {}
    for path in sorted(Path(folder).glob(f"*/*/{SET_FILE}")):
        if path.parent.name in SPLITS:
            found.setdefault(path.parents[1].name, set()).add(path.parent.name)
    return {category: tuple(s for s in SPLITS if s in splits) for category, splits in found.items()}


def count(folder: Path | str, category: str, split: str) -> int:
    """How many objects a split holds in its sound shards."""
    where = split_folder(folder, category, split)
    shards = (where / f"{number:05d}.json" for number in range(_set_file(where).shards))
    return sum(len(_parsed(ShardFile, path).objects) for path in shards if path.is_file())


def problems(
    folder: Path | str, category: str, split: str, *, layout: str, progress: bool = False
) -> Iterator[Problem]:
    """Everything that is wrong with the files of a split, which are read as a whole. `load` leaves such shards out."""
    where = split_folder(folder, category, split)
    try:
        dataset = load(folder, category, split, layout=layout)
    except (DamagedFile, MissingFile) as error:
        yield Problem(str(error.path), error.message)
        return
    except ValueError as error:  # another layout's
        yield Problem(str(where), str(error))
        return
    yield from (Problem(str(where), note) for note in dataset.notes)
    files = [
        (path, offset, crc)
        for array in (dataset.images, dataset.masks, dataset.voxels, dataset.points)
        if array is not None
        for path, offset, crc in zip(array.files, array.offsets, array.crcs, strict=True)
    ]
    for path, offset, crc in files:
        if _crc_of_rows(path, offset) != crc:
            yield Problem(str(path), f"its content is not what was written (another CRC-32); {_MAKE_AGAIN}")
    if warning := dataset.check_masks():
        yield Problem(str(where), warning, "warning")


def _crc_of_rows(path: Path, offset: int) -> int:
    crc = 0
    with open(path, "rb") as file:
        file.seek(offset)
        while piece := file.read(2**22):
            crc = zlib.crc32(piece, crc)
    return crc
