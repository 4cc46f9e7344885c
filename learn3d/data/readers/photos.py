"""Your own photographs: a folder with images, masks and a table of camera poses.

    mug/poses.csv      one row per photograph: file, azimuth_deg, elevation_deg, distance, fov_deg, and optionally
                       object, split
    mug/images/*.jpg   the photographs; PNG files with transparency need no mask
    mug/masks/*.png    masks with a white object, named like the photographs, also in folders

`docs/your-own-category.md` defines angles and distances with a drawing.
"""

import contextlib
import csv
import hashlib
import math
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from learn3d.data.conventions import LAYOUTS, SPLITS, synset_of
from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.data.framing import Framed, read_framed
from learn3d.data.poses import LookAtPoses
from learn3d.data.view_bins import view_classes
from learn3d.files import identity, limits
from learn3d.files.reading import (
    FAULTS,
    DamagedFile,
    FaultHandler,
    MissingFile,
    OddFile,
    attempt,
    faults_of,
    read_text,
    refuse,
)
from learn3d.files.sandbox import Call, read_all
from learn3d.settings import checked
from learn3d.terminal import progress

_SCALE_ODD = 1.7  # factor between sizes in images and table that gives a warning; half angles for whole ones give 2
_SCALE_OFF = 5.0  # factor that is an error: distances are in another unit
TABLE = "poses.csv"
NUMBERS = ("azimuth_deg", "elevation_deg", "distance", "fov_deg")
OPTIONAL = ("object", "split")
_WANTED = f"a table of photographs with the columns file, {', '.join(NUMBERS)}, and perhaps {', '.join(OPTIONAL)}"
VAL_SHARE, TEST_SHARE = 0.1, 0.2  # shares of the objects if the table has no splits


@checked
class Photo:
    """One row of the table. Its numbers may be given as text."""

    line: int
    file: Path
    mask: Path | None
    object: str
    split: Literal[(None, *SPLITS)]
    azimuth_deg: (
        Annotated[float, Field(strict=False, gt=-limits.ANGLE_DEG, lt=limits.ANGLE_DEG)] | None
    ) = None
    elevation_deg: Annotated[float, Field(strict=False, gt=-90, lt=90)] | None = None
    distance: Annotated[float, Field(strict=False, gt=0.5, lt=limits.CAMERA_DISTANCE[1])] | None = (
        None
    )
    fov_deg: (
        Annotated[float, Field(strict=False, gt=limits.FOV_DEG[0], lt=limits.FOV_DEG[1])] | None
    ) = None


def load(
    folder: Path | str,
    category: str,
    split: str,
    *,
    image_size: int = MASK_SIZE,
    on_fault: FaultHandler = refuse,
) -> ViewDataset:
    """Read a split of the photographs in `folder/category`.

    image_size: side of the images in pixels. They have Kato's form (`framing.frame`), for which
    methods and presets are made. View classes are those of `view_bins.view_classes`, from the
    training photographs.
    """
    synset_of(category)  # raises ValueError for a path, which would lead to other folders
    table = Path(folder) / category / TABLE
    if not table.parent.is_dir():
        there = f"the folder holds: {', '.join(contents(folder)) or 'no category'}"
        inside = (Path(folder) / "images").is_dir()
        raise MissingFile(
            table.parent,
            f"is missing; {'give the folder that holds the category' if inside else there}",
        )
    photos = read_photo_table(table, on_fault)
    splits = split_objects(table, photos)
    chosen, training = (
        [photo for photo in photos if splits[photo.object] == s] for s in (split, "train")
    )
    if not chosen or not training:
        there = ", ".join(sorted(set(splits.values())))
        raise DamagedFile(
            table, f"has no photograph for {'train' if chosen else split}; it has: {there}"
        )
    if unlisted := _unlisted(table, photos):
        on_fault(OddFile(table, unlisted))
    _check_angles(table, photos, on_fault)
    pairs = list(_read_photos(chosen, image_size, category, on_fault))
    if not pairs:
        raise DamagedFile(table, f"no photograph for {split} is whole")
    poses = None
    view_ids = np.zeros(len(pairs), np.int64)
    view_names = ("unknown",)
    if chosen[0].distance is not None:
        _check_scales(table, pairs, on_fault)
        poses = _poses([photo for photo, _ in pairs])
        view_ids, view_names = view_classes(poses, _poses(training))
    names, object_ids = np.unique([photo.object for photo, _ in pairs], return_inverse=True)
    return ViewDataset(
        **LAYOUTS["photos"].about(category, split),
        images=np.stack([framed.image for _, framed in pairs]),
        masks=None if image_size == MASK_SIZE else np.stack([framed.mask for _, framed in pairs]),
        poses=poses,
        view_ids=view_ids,
        view_names=view_names,
        object_ids=object_ids,
        object_names=tuple(names.tolist()),
        voxels=None,
    )


def _read_photos(
    photos: list[Photo], size: int, title: str, on_fault: FaultHandler
) -> Iterator[tuple[Photo, Framed]]:
    """The sound ones of some photographs, framed."""
    calls = ([Call(read_framed, p.file, (p.mask, size), "a photograph")] for p in photos)
    read = progress(read_all(calls), title, unit="photograph", total=len(photos))
    for photo, (found,) in zip(photos, read, strict=True):
        if isinstance(found, FAULTS):
            where = f"({TABLE}, line {photo.line})"
            on_fault(type(found)(found.path, f"{found.message} {where}"))
            continue
        if found.touches_border:
            cut = "its object touches the border; parts outside the image count as empty"
            on_fault(OddFile(photo.file, cut))
        if found.left_out:
            on_fault(OddFile(photo.file, found.left_out))
        yield photo, found


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories of a folder and the splits of each."""
    found = {}
    for table in sorted(
        {
            path.parent / TABLE
            for name in (TABLE, "images")
            for path in Path(folder).glob(f"*/{name}")
        }
    ):
        splits = {"train"}
        with contextlib.suppress(ValueError, OSError):  # `load` raises the same fault
            photos = read_photo_table(table, lambda found: None)
            splits = set(split_objects(table, photos).values()) or splits
        found[table.parent.name] = tuple(name for name in SPLITS if name in splits)
    return found


def _poses(photos: list[Photo]) -> LookAtPoses:
    numbers = [(p.azimuth_deg, p.elevation_deg, p.distance, p.fov_deg / 2) for p in photos]
    return LookAtPoses(*np.array(numbers).T)


def _check_scales(table: Path, pairs: list[tuple[Photo, Framed]], on_fault: FaultHandler) -> None:
    """Compare the objects' sizes in the photographs with those from distances and fields of view."""
    scales = [
        2 * f.object_size * p.distance * math.tan(math.radians(p.fov_deg) / 2) for p, f in pairs
    ]
    middle = float(np.median(scales))
    message = f"the objects are {middle:.2g} times as large in the photographs as in the table; distance must be in "
    message += "units of the object's longest side, fov_deg the full angle across the photograph's longer side"
    if not 1 / _SCALE_OFF < middle < _SCALE_OFF:
        on_fault(DamagedFile(table, message))
    elif not 1 / _SCALE_ODD < middle < _SCALE_ODD:
        on_fault(OddFile(table, message))
    for (photo, _), scale in zip(pairs, scales, strict=True):
        if not 1 / _SCALE_OFF < scale / middle < _SCALE_OFF:
            message = f"compared with the others, its object is {scale / middle:.2g} times as large as in the table"
            message += f"; is the distance in line {photo.line} right?"
            on_fault(OddFile(photo.file, message))


def _check_angles(table: Path, photos: list[Photo], on_fault: FaultHandler) -> None:
    """Report azimuths that are all alike, and angles that are probably in radians."""
    if len(photos) < 3 or photos[0].distance is None:
        return
    for name, turn in (("azimuth_deg", 2 * math.pi), ("elevation_deg", math.pi / 2)):
        angles = [getattr(photo, name) for photo in photos]
        found = (
            f"{name} lies within {min(angles):.3g} .. {max(angles):.3g} in all {len(angles)} rows"
        )
        if max(map(abs, angles)) <= turn and min(angles) < max(angles):
            on_fault(OddFile(table, f"{found}; is it in degrees, not in radians?"))
    if len({photo.azimuth_deg % 360 for photo in photos}) == 1:
        same = f"all {len(photos)} rows have the azimuth {photos[0].azimuth_deg:g}"
        on_fault(OddFile(table, f"{same}; the back of the objects is not seen"))


def read_photo_table(table: Path, on_fault: FaultHandler) -> list[Photo]:
    """The valid rows of a table; faults of the others are reported.

    Without a table, all images without poses.

    Raises MissingFile, and DamagedFile if the file is not a table of photographs.
    """
    if not table.exists() and (table.parent / "images").is_dir():
        names, left_out = identity.find_files(table.parent / "images")
        for line in identity.describe(left_out):
            on_fault(OddFile(table.parent / "images", line))
        if not names:
            raise DamagedFile(
                table.parent / "images", f"is empty; expected photographs, and {_WANTED} in {TABLE}"
            )
        lines = ["file", *('"' + name.replace('"', '""') + '"' for name in names)]
    else:
        lines = read_text(
            table, limits.PHOTO_TABLE_BYTES, _WANTED, encoding="utf-8-sig"
        ).splitlines()
    delimiter = ";" if lines and ";" in lines[0] else ","
    reader = csv.DictReader(lines, delimiter=delimiter, skipinitialspace=True)
    reader.fieldnames = names = [name.strip() for name in reader.fieldnames or []]
    numbers = set(names) & set(NUMBERS)
    if (
        "file" not in names
        or len(numbers) not in (0, 4)
        or not set(names) <= {"file", *NUMBERS, *OPTIONAL}
    ):
        raise DamagedFile(table, f"has the columns {', '.join(names)[:200]}; expected {_WANTED}")
    masks = _find_masks(table.parent / "masks", on_fault)
    photos: dict[Path, Photo] = {}
    with faults_of(table, _WANTED):  # csv.Error
        rows = [(reader.line_num, row) for row in reader]
        shared = Counter(identity.object_name(_image_name(row)) for _, row in rows)
        for line, row in rows:
            if photo := attempt(on_fault, _photo, table, line, row, masks, photos, shared):
                photos[photo.file] = photo
    if "object" not in names:
        _check_names(table, [_image_name(row) for _, row in rows], shared, on_fault)
    return list(photos.values())


def _image_name(row: Mapping[str | None, Any]) -> str:
    """The name in `images` of a row of the table."""
    return (row["file"] or "").strip().replace("\\", "/").removeprefix("images/")


def _find_masks(folder: Path, on_fault: FaultHandler) -> dict[str, Path]:
    """The mask of each photograph, by its name without ending; of several formats the PNG file."""
    if not folder.is_dir():
        return {}
    paths, left_out = identity.find_files(folder)
    kept, others = identity.one_format(sorted(paths, key=lambda name: not name.endswith(".png")))
    for line in identity.describe(left_out | others):
        on_fault(OddFile(folder, line))
    return {identity.object_name(name): paths[name] for name in kept}


def _check_names(
    table: Path, names: Sequence[str], shared: Mapping[str, int], on_fault: FaultHandler
) -> None:
    """Report names by which photographs of one object may count as several objects."""
    alike = [name for name in names if shared[identity.object_name(name)] > 1]
    if alike:
        found = f"{len(alike)} files share a name but for its ending, such as {alike[0]}"
        on_fault(OddFile(table, f"{found}; each is an object of its own"))
    if any("/" in name for name in names):
        advice = "if a folder has photographs of one object, add a column object"
        on_fault(OddFile(table, f"each photograph in a folder is an object of its own; {advice}"))


def _unlisted(table: Path, photos: list[Photo]) -> str | None:
    """A sentence about images without a row in the table; None if there are none."""
    listed = {photo.file for photo in photos}
    found, _ = identity.find_files(table.parent / "images")
    files = [name for name, path in found.items() if path not in listed]
    if not files:
        return None
    return f"images without a row, which are not used: {len(files)}, the first is {files[0]}"


def split_objects(table: Path, photos: list[Photo]) -> dict[str, str]:
    """The split of each object.

    Without splits in the table, a hash of the names selects 20 % test and 10 % val.

    Raises DamagedFile if an object is in two splits or in none, or if there are too few objects
    to split.
    """
    given: dict[str, set[str | None]] = {}
    for photo in photos:
        given.setdefault(photo.object, set()).add(photo.split)
    if any(splits != {None} for splits in given.values()):
        for name, splits in given.items():
            if len(splits) > 1 or None in splits:
                there = ", ".join(sorted(map(str, splits)))
                raise DamagedFile(table, f"object {name!r} must be in one split, got {there}")
        return {name: splits.pop() for name, splits in given.items()}
    names = sorted(given, key=lambda name: hashlib.sha256(name.encode()).digest())
    if len(names) < 3:
        needed = "train, val and test need 3. Photograph more, or give every row a split"
        raise DamagedFile(table, f"lists {len(names)} objects; {needed}")
    test, val = (max(1, round(share * len(names))) for share in (TEST_SHARE, VAL_SHARE))
    return {
        name: "test" if k < test else "val" if k < test + val else "train"
        for k, name in enumerate(names)
    }


def _photo(
    table: Path,
    line: int,
    row: dict[str, Any],
    masks: dict[str, Path],
    others: Container[Path],
    shared: Mapping[str, int],
) -> Photo:
    """Check one row of the table."""
    try:
        # csv.DictReader marks too long and too short rows with None
        if None in row or None in row.values():
            raise ValueError("it has more or fewer values than there are columns")
        values = {name: value.strip() for name, value in row.items()}
        name = Path(_image_name(row))
        if not name.name or name.is_absolute() or ".." in name.parts or "\0" in str(name):
            raise ValueError(f"it must name a file in images/, got {values['file']!r:.80}")
        file = table.parent / "images" / name
        if file in others:
            raise ValueError(f"{file.name} is in two lines")
        own = identity.object_name(name.as_posix())
        return Photo(
            line=line,
            file=file,
            mask=masks.get(own),
            object=values.get("object") or (name.as_posix() if shared[own] > 1 else own),
            split=values.get("split") or None,
            **{name: values[name] for name in NUMBERS if name in values},
        )
    except ValueError as error:
        raise DamagedFile(table, f"line {line}: {error}") from None
