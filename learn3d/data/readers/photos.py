"""Your own photographs: a folder with images, masks and a table of where the camera stood.

    mug/poses.csv      one row per photograph: file, azimuth_deg, elevation_deg, distance, fov_deg, and where you like
                       object, split, mask, framing
    mug/images/*.jpg   the photographs; PNG files with transparency need no mask
    mug/masks/*.png    white where the object is, named like its photograph

Angles: azimuth 0 is in front of the object, and grows as you walk around it to your right (anti-clockwise, seen from
above); elevation is 0 at the object's height and 90 above it. distance: from the middle of the object to the camera, in
lengths of the object's longest side. fov_deg: the full field of view across the longer side of the photograph.
`docs/your-own-category.md` tells it step by step, with a drawing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

import nmr
from learn3d.data.conventions import KATO
from learn3d.data.dataset import MASK_SIZE, SPLITS, ViewDataset
from learn3d.data.framing import Framed, read_framed
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers.photo_table import TABLE, Photo, find_table, read_table, split_objects
from learn3d.data.readers.properties import LayoutProperties
from learn3d.data.readers.renderings import check_split
from learn3d.data.view_bins import AngleBins
from learn3d.files.findings import DamagedFile, Findings, MissingFile, Problem
from learn3d.files.sandbox import Call, read_all

PROPERTIES = LayoutProperties(voxels=False, convention=KATO, inverted=True, options=("image_size", "progress"))
AZIMUTH_WIDTHS_DEG = (15, 20, 30, 45, 60, 90)
ELEVATION_WIDTH_DEG = 20
PHOTOS_PER_CLASS = 8  # on average, at least: fewer tell a discriminator nothing
_SUFFIXES = {".png", ".jpg", ".jpeg", ".webp", ".bmp"}
_SCALE_ODD = 1.7  # the same, worth a warning: half an angle for a whole one makes 2
_SCALE_OFF = 5.0  # times larger or smaller than the distances say: then they are in another unit


def load(
    folder: Path | str, category: str, split: str, *, image_size: int = MASK_SIZE, progress: bool = False
) -> ViewDataset:
    """Read one split ("train", "val" or "test") of the photographs in `folder/category`, or in `folder` itself.

    Images have Kato's form (`framing`), so that methods and presets made for renderings take them; there are no voxels.
    View classes are cells of azimuth and elevation, see `choose_bins`; only those that training photographs occupy
    count, and another photograph gets the class of the training photograph whose direction is nearest. Where the table
    has no column "split", whole objects are put into the splits by a hash of their names: 20 % test, 10 % val.

    Raises FileNotFoundError and ValueError naming the file, the row and what was expected; `problems` lists them all.
    """
    check_split(split)
    table = find_table(folder, category)
    photos, faults = read_table(table)
    if faults:
        raise DamagedFile(table.parent, faults[0] + (f" (and {len(faults) - 1} more)" if faults[1:] else ""))
    splits = split_objects(table, photos)
    chosen = [photo for photo in photos if splits[photo.object] == split]
    if not chosen or "train" not in splits.values():
        there = ", ".join(sorted(set(splits.values())))
        raise ValueError(
            f"{table} has no photograph in the split {split if not chosen else 'train'!r}; it has: {there}"
        )
    images = np.empty((len(chosen), 4, image_size, image_size), np.uint8)
    masks = np.empty((len(chosen), MASK_SIZE, MASK_SIZE), np.uint8)
    half_fovs, scales = [], []
    for k, (photo, result) in enumerate(_read(chosen, image_size, "photographs", progress)):
        framed = Findings(strict=True).take(result)
        images[k], masks[k] = framed.image, framed.mask
        half_fovs.append(framed.half_fov_deg)
        scales.append(_scale(photo, framed))
    _check_scale(table, scales)
    poses = _poses(chosen, half_fovs)
    training = [photo for photo in photos if splits[photo.object] == "train"]
    view_ids, view_names = _view_classes(poses, _poses(training, [photo.fov_deg / 2 for photo in training]))
    names = sorted({photo.object for photo in chosen})
    numbers = {name: number for number, name in enumerate(names)}
    return ViewDataset(
        category=category,
        split=split,
        images=images,
        masks=None if image_size == MASK_SIZE else masks,
        poses=poses,
        view_ids=view_ids,
        view_names=view_names,
        object_ids=np.array([numbers[photo.object] for photo in chosen]),
        object_names=tuple(names),
        voxels=None,
        convention=KATO,
    )


def problems(folder: Path | str, category: str, split: str, *, progress: bool = False) -> Iterator[Problem]:
    """Everything that is wrong with one split; where the table has faults, with all photographs that it lists."""
    try:
        table = find_table(folder, category)
        photos, faults = read_table(table)
        splits = None if faults else split_objects(table, photos)
    except (ValueError, OSError) as error:
        yield Problem(str(folder), str(error))
        return
    yield from (Problem(str(table), fault) for fault in faults)
    scales, scaled = [], []
    chosen = [photo for photo in photos if splits is None or splits[photo.object] == split]
    for photo, framed in _read(chosen, MASK_SIZE, f"{category} {split}", progress):
        if isinstance(framed, (DamagedFile, MissingFile)):
            yield Problem(str(framed.path), framed.message)
            continue
        left, top, right, bottom = framed.box
        if left == 0 or top == 0 or right == framed.shape[1] or bottom == framed.shape[0]:
            message = "its object touches the border; what lies outside counts as empty"
            yield Problem(str(photo.file), message, "warning")
        scales.append(_scale(photo, framed))
        scaled.append(photo)
    try:
        _check_scale(table, scales)
    except ValueError as error:
        yield Problem(str(table), str(error).removeprefix(f"{table}: "))
    else:
        if not 1 / _SCALE_ODD < _middle(scales) < _SCALE_ODD:
            text = f"{_said_of(scales)}; is fov_deg the full angle across the longer side?"
            yield Problem(str(table), text, "warning")
        middle = _middle(scales)
        for photo, scale in zip(scaled, scales, strict=True):
            if not 1 / _SCALE_OFF < scale / middle < _SCALE_OFF:
                text = f"beside the others its object is {scale / middle:.2g} times as large as its row says"
                yield Problem(str(photo.file), f"{text} ({photo.where}); is the distance right?", "warning")
    images, listed = table.parent / "images", {photo.file for photo in photos}
    for path in sorted(images.iterdir()) if split == "train" and images.is_dir() and not faults else []:
        if path.suffix.lower() in _SUFFIXES and path not in listed:
            yield Problem(str(path), f"it is not in {table.name}", "warning")


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories of a folder, or of one that is a category itself, and the splits of each."""
    folder = Path(folder)
    places = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())] if folder.is_dir() else []
    found = {}
    for place in places:
        if (place / TABLE).is_file():
            try:
                table = find_table(place, "")
                photos, faults = read_table(table)
                splits = set() if faults else set(split_objects(table, photos).values())
            except (ValueError, OSError):
                splits = set()
            found[place.resolve().name] = tuple(name for name in SPLITS if name in splits) or ("train",)
    return found


def count(folder: Path | str, category: str, split: str) -> int:
    """How many objects a split has."""
    table = find_table(folder, category)
    photos, _ = read_table(table)
    return sum(name == split for name in split_objects(table, photos).values())


def choose_bins(poses: LookAtPoses) -> AngleBins:
    """Cells for photographs with these cameras: elevations as they occur in steps of about 20 degrees, azimuths in the
    smallest step from 15 degrees up with which a cell that is occupied has 8 photographs on average."""
    low, high = math.floor(float(poses.elevations_deg.min())), math.ceil(float(poses.elevations_deg.max()))
    high = max(high, low + 1)
    rows = max(1, round((high - low) / ELEVATION_WIDTH_DEG))
    for width in AZIMUTH_WIDTHS_DEG:
        bins = AngleBins(width, (high - low) / rows, low, high)
        if len(poses) >= PHOTOS_PER_CLASS * len(bins.ids(poses).unique()):
            break
    return bins


def _view_classes(poses: LookAtPoses, training: LookAtPoses) -> tuple[np.ndarray, tuple[str, ...]]:
    bins = choose_bins(training)
    cells, training_cells = bins.ids(poses).numpy(), bins.ids(training).numpy()
    kept = np.unique(training_cells)
    unseen = ~np.isin(cells, kept)
    eyes, training_eyes = (
        nmr.cameras.points_from_angles(1.0, p.elevations_deg, p.azimuth_deg).numpy() for p in (poses, training)
    )
    cells[unseen] = training_cells[(eyes[unseen] @ training_eyes.T).argmax(axis=1)]
    names = bins.names()
    return np.searchsorted(kept, cells), tuple(names[k] for k in kept)


def _poses(photos: list[Photo], half_fovs_deg: list[float]) -> LookAtPoses:
    columns = ([getattr(photo, name) for photo in photos] for name in ("azimuth_deg", "elevation_deg", "distance"))
    return LookAtPoses(*(torch.tensor(column, dtype=torch.float32) for column in (*columns, half_fovs_deg)))


def _read(photos: list[Photo], size: int, what: str, progress: bool) -> Iterator[tuple[Photo, Framed | Exception]]:
    """Every photograph with what it is to the networks, or what is wrong with it, named with its row."""

    def calls(photo: Photo) -> list[Call]:
        camera = photo.fov_deg, photo.elevation_deg, photo.framing
        return [Call(read_framed, photo.file, (photo.mask, *camera, size, MASK_SIZE), "a photograph")]

    found = tqdm(read_all(map(calls, photos)), what, len(photos), disable=not progress, dynamic_ncols=True)
    for photo, (item,) in zip(photos, found, strict=True):
        if isinstance(item, (DamagedFile, MissingFile)):
            item = type(item)(item.path, f"{item.message} ({photo.where})")
        yield photo, item


def _scale(photo: Photo, framed: Framed) -> float:
    """How large the object is in the photograph, over how large its distance and the field of view say it is."""
    left, top, right, bottom = framed.box
    share = max(right - left, bottom - top) / max(framed.shape)
    return share * 2 * photo.distance * math.tan(math.radians(photo.fov_deg) / 2)


def _middle(scales: list[float]) -> float:
    return float(np.median(scales)) if scales else 1.0


def _said_of(scales: list[float]) -> str:
    return f"the objects are {_middle(scales):.2g} times as large in the photographs as distance and fov_deg say"


def _check_scale(table: Path, scales: list[float]) -> None:
    if not 1 / _SCALE_OFF < _middle(scales) < _SCALE_OFF:
        raise ValueError(
            f"{table}: {_said_of(scales)}; "
            "distance must be in lengths of the object's longest side (a mug of 12 cm from 60 cm: 5), and fov_deg the "
            "full field of view in degrees"
        )
