"""Which files of a folder show an object, and which of them the same one: one rule for meshes,
photographs and masks.

An object has the relative name of its file, without the ending. A folder or file that is reached
in several ways, through links, counts once. Hidden files never count.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path, PurePosixPath

import numpy as np

HIDDEN = {"__macosx", "thumbs.db", "desktop.ini"}  # files of systems, beside names with a dot
_CLOSE = 1e-4  # difference of `measure` below which two geometries are equal; 6 digits give 1e-6


def is_hidden(name: str) -> bool:
    """Whether a file or folder is hidden, or written by a system beside the files of people."""
    return name.startswith(".") or name.lower() in HIDDEN


def object_name(name: str) -> str:
    """The object that a file shows, from its relative name."""
    path = PurePosixPath(name)
    return str(path).removesuffix(path.suffix)


def find_files(
    folder: Path, endings: Collection[str] = ()
) -> tuple[dict[str, Path], dict[str, str]]:
    """The files of a folder and its subfolders with one of these endings (default: all), by
    relative name, and what was left out: name -> reason.

    Of a file or folder and links to it, the name without a link counts.
    """
    found, left_out, seen = {}, {}, set()
    waiting, links = [("", folder)], []
    while waiting or links:
        name, path = waiting.pop() if waiting else links.pop()
        wanted = not endings or path.suffix.lower() in endings
        if not path.exists():
            if wanted:
                left_out[name] = "links to missing files"
            continue
        status = path.stat()
        if (status.st_dev, status.st_ino) in seen:
            if wanted or path.is_dir():
                left_out[name] = "links to files or folders that are there already"
            continue
        seen.add((status.st_dev, status.st_ino))
        if path.is_dir():
            for child in sorted(path.iterdir(), reverse=True):
                below = f"{name}/{child.name}".lstrip("/")
                if not is_hidden(child.name):
                    (links if child.is_symlink() else waiting).append((below, child))
                elif child.is_dir() or not endings or child.suffix.lower() in endings:
                    left_out[below] = "hidden files or folders"
        elif wanted:
            found[name] = path
    return {name: found[name] for name in sorted(found)}, left_out


def one_format(names: Iterable[str]) -> tuple[list[str], dict[str, str]]:
    """One file of each object, sorted, and the others with the reason. names: the file that counts
    comes first.
    """
    best: dict[str, str] = {}
    others = {}
    for name in names:
        if best.setdefault(object_name(name), name) != name:
            others[name] = "other formats of an object"
    return sorted(best.values()), others


def measure(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Numbers [13] that equal geometries share, whatever their triangles, scale and place: sides
    of the box, area, centroid and second moments of the surface in a box of longest side 1.
    """
    corners = vertices[faces]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    side = (high - low).max()
    corners = (corners - (low + high) / 2) / side
    a, b, c = corners.swapaxes(0, 1)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    middles, total = corners.mean(axis=1), areas.sum()
    # The integral of x x' over a triangle is its area / 12 (aa' + bb' + cc' + 9 mm').
    rows = np.concatenate([corners, 3 * middles[:, None]], axis=1)
    second = np.einsum("f,fki,fkj->ij", areas / 12, rows, rows)
    moments = np.concatenate([areas @ middles, second[np.triu_indices(3)]])
    return np.concatenate([(high - low) / side, [total], moments / max(total, 1e-30)])


def find_equal(measures: Mapping[str, np.ndarray]) -> dict[str, str]:
    """The first object with an equal geometry of each that is not the first."""
    names, first = sorted(measures, key=lambda name: measures[name][3]), {}
    order = {name: number for number, name in enumerate(measures)}
    for place, name in enumerate(names):
        for other in names[place + 1 :]:
            difference = np.abs(measures[other] - measures[name])
            if difference[3] > _CLOSE:
                break
            if difference.max() < _CLOSE:
                earlier, later = sorted((name, other), key=order.get)
                first.setdefault(later, first.get(earlier, earlier))
    return first


def describe(left_out: Mapping[str, str]) -> list[str]:
    """A sentence for each reason, with the number of files and an example."""
    examples = {left_out[name]: name for name in sorted(left_out, reverse=True)}
    return [
        f"left out: {count} {reason}, such as {examples[reason]}"
        for reason, count in Counter(left_out.values()).items()
    ]
