"""The table of your own photographs, poses.csv, checked row by row; and the split of each object."""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from learn3d.data.dataset import SPLITS
from learn3d.data.framing import Framing
from learn3d.files import limits
from learn3d.files.reading import read_bytes

TABLE = "poses.csv"
NUMBERS = {  # columns, and between what their numbers lie
    "azimuth_deg": (-limits.ANGLE_DEG, limits.ANGLE_DEG),
    "elevation_deg": (-90.0, 90.0),
    "distance": (0.5, limits.DISTANCE[1]),
    "fov_deg": limits.FOV_DEG,
}
OPTIONAL = ("object", "split", "mask", "framing")
VAL_SHARE, TEST_SHARE = 0.1, 0.2  # of the objects, where the table does not say which split they are in


@dataclass(frozen=True)
class Photo:
    """One row of the table."""

    where: str  # "poses.csv, line 7"
    file: Path
    mask: Path | None
    azimuth_deg: float
    elevation_deg: float
    distance: float
    fov_deg: float
    object: str
    split: str | None
    framing: Framing


def find_table(folder: Path | str, category: str) -> Path:
    """poses.csv of a category.

    Raises FileNotFoundError, and ValueError for a category that is no plain name: that of a stranger's model leads
    nowhere else, neither to read nor, as part of the names of files, to write.
    """
    if category in (".", "..") or set(category) & set("/\\") or not category.isprintable():
        raise ValueError(f"category must be the plain name of a folder such as 'mug', got {_short(category)}")
    places = [Path(folder) / category / TABLE, Path(folder) / TABLE]
    for table in places:
        if table.is_file():
            return table
    raise FileNotFoundError(
        f"there is no {places[0]} and no {places[1]}; it must list the photographs: file, {', '.join(NUMBERS)}"
    )


def split_objects(table: Path, photos: list[Photo]) -> dict[str, str]:
    """The split of every object: the table's, or, ordered by a hash of the names, 20 % test, 10 % val, the rest train.

    Raises ValueError where an object is in two splits or in none, or there are too few to split.
    """
    given: dict[str, set[str | None]] = {}
    for photo in photos:
        given.setdefault(photo.object, set()).add(photo.split)
    if any(splits != {None} for splits in given.values()):
        for name, splits in given.items():
            if len(splits) > 1 or None in splits:
                there = ", ".join(sorted(str(s) if s else "none" for s in splits))
                raise ValueError(f"{table}: object {name!r} must be in one split, got {there}")
        return {name: next(iter(splits)) for name, splits in given.items()}
    names = sorted(given, key=lambda name: hashlib.sha256(name.encode()).digest())
    if len(names) < 3:
        raise ValueError(
            f"{table} lists {len(names)} object(s); at least 3 are needed for train, val and test. Photograph more, or "
            "give every row a split"
        )
    test, val = (max(1, round(share * len(names))) for share in (TEST_SHARE, VAL_SHARE))
    return {name: "test" if k < test else "val" if k < test + val else "train" for k, name in enumerate(names)}


def read_table(table: Path) -> tuple[list[Photo], list[str]]:
    """The rows that can be understood, and what is wrong with the others."""
    rows = list(_rows(table))
    if not rows:
        raise ValueError(f"{table} lists no photographs")
    if len(rows) > limits.OBJECTS:
        raise ValueError(f"{table} lists {len(rows)} photographs; at most {limits.OBJECTS} are read")
    masks = table.parent / "masks"
    by_stem = {path.stem: path for path in sorted(masks.iterdir())} if masks.is_dir() else {}
    photos, faults = [], []
    for where, row in rows:
        try:
            photos.append(_photo(table.parent, where, row, by_stem))
        except ValueError as error:
            faults.append(f"{where}: {error}")
    seen: dict[Path, str] = {}
    for photo in photos:
        if first := seen.get(photo.file):
            faults.append(f"{photo.where}: {photo.file.name} is in {first} already")
        seen.setdefault(photo.file, photo.where)
    return photos, faults


def _rows(table: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    content = read_bytes(table, limits.PHOTO_TABLE_BYTES, "the table of photographs")
    try:
        lines = content.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{table} is not UTF-8 text ({error}); save it as 'CSV UTF-8'") from None
    header = lines[0] if lines else ""
    reader = csv.DictReader(lines, delimiter=";" if ";" in header else ",", skipinitialspace=True)
    try:
        _check_columns(table, [name.strip() for name in reader.fieldnames or []])
        reader.fieldnames = [name.strip() for name in reader.fieldnames]
        for row in reader:
            yield f"{table.name}, line {reader.line_num}", row
    except csv.Error as error:
        raise ValueError(f"{table}, line {reader.line_num} is no line of a table: {error}") from None


def _check_columns(table: Path, names: list[str]) -> None:
    missing = [name for name in ("file", *NUMBERS) if name not in names]
    unknown = [name for name in names if name not in ("file", *NUMBERS, *OPTIONAL)]
    if missing or unknown:
        wrong = [f"lacks {', '.join(missing)}"] * bool(missing)
        wrong += [f"has unknown {', '.join(unknown)[:200]}"] * bool(unknown)
        raise ValueError(
            f"{table} {' and '.join(wrong)}; the columns are file, {', '.join(NUMBERS)}, and where you like "
            f"{', '.join(OPTIONAL)}"
        )


def _photo(folder: Path, where: str, row: dict[str, Any], masks: dict[str, Path]) -> Photo:
    """One row, checked."""
    if None in row:  # what csv.DictReader calls the values beyond the last column
        raise ValueError(f"there are more values than columns: {', '.join(row[None])[:200]}")
    file = _inside(folder / "images", "file", row["file"])
    values = {name: _number(name, row[name], *between) for name, between in NUMBERS.items()}
    split = _choice("split", row.get("split"), SPLITS)
    framing = _choice("framing", row.get("framing"), get_args(Framing)) or "whole"
    mask = _inside(folder / "masks", "mask", row["mask"]) if row.get("mask") else masks.get(file.stem)
    name = str(row.get("object") or file.stem).strip()
    return Photo(where, file, mask, object=name, split=split, framing=framing, **values)


def _inside(folder: Path, name: str, value: str | None) -> Path:
    """A file of the folder; a table must not make us read others."""
    path = Path((value or "").strip().removeprefix(f"{folder.name}/"))
    if not path.name or path.is_absolute() or ".." in path.parts or "\0" in value:
        raise ValueError(f"{name} must be the name of a file in {folder.name}/, got {_short(value)}")
    return folder / path


def _number(name: str, value: str | None, low: float, high: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        comma = "; write a point, not a comma" if "," in (value or "") else ""
        raise ValueError(f"{name} must be a number, got {_short(value)}{comma}") from None
    if not low < number < high:
        unit = " lengths of the longest side" if name == "distance" else ""
        raise ValueError(f"{name} must lie between {low:g} and {high:g}{unit}, got {number:g}")
    return number


def _choice(name: str, value: str | None, choices: tuple[str, ...]) -> Any:
    value = (value or "").strip()
    if value and value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {_short(value)}")
    return value or None


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}..."
