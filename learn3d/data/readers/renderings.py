"""What the readers of folders share: images, arrays and tables with errors that name the file, many objects at once."""

from __future__ import annotations

import functools
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from PIL import Image
from tqdm import tqdm

from learn3d.data.conventions import VoxelConvention
from learn3d.data.dataset import MASK_SIZE, SPLITS, ViewDataset
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers.kato import synset_of
from learn3d.data.view_bins import AngleBins
from learn3d.files import limits, npz
from learn3d.files.findings import AGAIN, DamagedFile, Findings, MissingFile
from learn3d.files.images import RENDERINGS, open_image
from learn3d.files.reading import read_text

T = TypeVar("T")
R = TypeVar("R")


def map_objects(function: Callable[[T], R], items: Sequence[T], what: str, progress: bool) -> Iterator[R]:
    """function of every item, in order, computed in parallel threads; nothing more is started after an exception."""
    executor = ThreadPoolExecutor(min(16, 2 * (os.cpu_count() or 1)))
    try:
        yield from tqdm(executor.map(function, items), what, len(items), disable=not progress, unit="object")
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def check_split(split: str, splits: Sequence[str] = SPLITS) -> None:
    """Raise a ValueError for a split that the layout does not have."""
    if split not in splits:
        raise ValueError(f"split must be one of {', '.join(splits)}; got {split!r}")


def category_folder(folder: Path, category: str) -> Path:
    """The folder of a category (name or synset id) below `folder`; a MissingFile says which there are."""
    path = folder / synset_of(category)
    if not folder.is_dir():
        raise MissingFile(folder, "there is no such folder")
    if not path.is_dir():
        found = sorted(p.name for p in folder.iterdir() if p.is_dir())
        raise MissingFile(path, f"there is no folder of {category!r}; those here are: {', '.join(found) or 'none'}")
    return path


def warn_of_repeats(
    findings: Findings, path: Path, what: str, ids: Sequence[str], others: dict[str, Iterable[str]]
) -> None:
    """Note ids that the list of a split (`what`) holds twice, and those that it shares with the lists of others."""
    if repeated := sorted(name for name, times in Counter(ids).items() if times > 1):
        findings.warn(path, f"{what} lists {', '.join(repeated[:8])}{' ...' * (len(repeated) > 8)} more than once")
    for split, other in others.items():
        if shared := sorted(set(ids) & set(other)):
            findings.warn(path, f"{what} shares {len(shared)} objects with {split}, such as {shared[0]}")


def warn_if_empty(findings: Findings, path: Path, mask: np.ndarray) -> None:
    """Note a mask, uint8 [H, W], in which nothing is inside."""
    if mask.max() < 128:
        findings.warn(path, f"its mask is empty: the brightest of its values 0 .. 255 is {mask.max()}")


def read_image(path: Path) -> Image.Image:
    """A decoded rendering of at most 2048 pixels a side, in its own mode; DamagedFile or MissingFile."""
    return open_image(path, RENDERINGS, limits.RENDER_SIDE)


def split_alpha(image: Image.Image) -> tuple[np.ndarray, np.ndarray | None]:
    """Colours over white, uint8 [H, W, 3], and the alpha channel, uint8 [H, W], or None where there is none."""
    if image.mode == "P":
        image = image.convert("RGBA" if "transparency" in image.info else "RGB")
    if image.mode not in ("RGBA", "LA", "PA"):
        return np.asarray(image.convert("RGB")), None
    image = image.convert("RGBA")
    alpha = image.getchannel("A")
    white = Image.new("RGB", image.size, (255, 255, 255))
    white.paste(image, mask=alpha)
    return np.asarray(white), np.asarray(alpha)


def check_square(path: Path, image: Image.Image, least: int) -> None:
    """Raise DamagedFile for an image that is not square, smaller than `least`, or has more than 8 bits a channel."""
    if image.width != image.height or image.width < least:
        raise DamagedFile(
            path, f"is {image.width}x{image.height} pixels; expected a square image of at least {least}x{least}"
        )
    if image.mode not in ("1", "L", "LA", "P", "PA", "RGB", "RGBA"):
        raise DamagedFile(path, f"has the pixel format {image.mode}; expected 8-bit grey, RGB or RGBA")


def shrink(color: np.ndarray, mask: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """An image uint8 [4, size, size] and a mask uint8 [64, 64] of colours uint8 [S, S, 3] and a mask uint8 [S, S].

    Each pixel becomes the mean over its area of the original; fractions of original pixels count as such.
    """
    planes = np.concatenate([color.transpose(2, 0, 1), mask[None]])
    image = _shrink(planes, size)
    return image, image[3] if size == MASK_SIZE else _shrink(planes[3], MASK_SIZE)


def _shrink(planes: np.ndarray, size: int) -> np.ndarray:
    if planes.shape[-1] == size:
        return planes
    weights = _area_weights(planes.shape[-1], size)
    return np.rint(weights @ planes.astype(np.float32) @ weights.T).astype(np.uint8)


@functools.cache
def _area_weights(source: int, size: int) -> np.ndarray:
    """Share of each of `source` pixels in each of `size` larger ones, float32 [size, source]; rows sum to 1."""
    edges = np.arange(size + 1) * (source / size)
    pixels = np.arange(source)
    overlap = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return (overlap.clip(0) * (size / source)).astype(np.float32)


def read_npz(path: Path, names: Iterable[str], wanted: str) -> dict[str, np.ndarray]:
    """Those of the named arrays that an npz file of one object has; `wanted` says what it should hold."""
    try:
        with npz.open_npz(path, most=limits.OBJECT_BYTES) as archive:
            there = set(npz.keys(archive))
            return {name: npz.read(archive, name) for name in names if name in there}
    except FileNotFoundError:
        raise MissingFile(path, f"is missing; expected {wanted}") from None
    except ValueError as error:
        raise DamagedFile(path, f"cannot be read ({error}); expected an npz file with {wanted}. {AGAIN}") from error


def check_ids(path: Path, ids: Sequence[str]) -> None:
    """Raise DamagedFile where the ids that a list names are too many, or one is no plain name of a folder."""
    if len(ids) > limits.OBJECTS:
        raise DamagedFile(path, f"names {len(ids)} objects; at most {limits.OBJECTS} are read")
    for name in ids:
        if name in ("", ".", "..") or len(name) > limits.NAME_LENGTH or set(name) & set("/\\:\0"):
            raise DamagedFile(
                path, f"names the object {name[:40]!r}; expected the plain name of a folder (no '/', no '..')"
            )


def read_table(path: Path, rows: int, columns: int, wanted: str) -> np.ndarray:
    """The first `rows` rows of a table of numbers in a text file, float64 [rows, C] with C >= `columns`, all finite."""
    text = read_text(path, limits.TABLE_BYTES, wanted)
    lines = [line.split() for line in text.splitlines() if line.strip()]
    if len(lines) < rows:
        raise DamagedFile(path, f"has {len(lines)} rows, {rows} are needed; expected {wanted}. {AGAIN}")
    table = np.empty((rows, columns))
    for k, line in enumerate(lines[:rows]):
        try:
            table[k] = [float(word) for word in line[:columns]]
        except ValueError:
            raise DamagedFile(path, f"row {k} is {' '.join(line)!r}; expected {wanted}") from None
        if not np.isfinite(table[k]).all():
            raise DamagedFile(path, f"row {k} has numbers that are not finite; expected {wanted}")
    return table


class ReadObject(NamedTuple):
    """One object as its files have it; None for the parts that findings tell of."""

    views: list[tuple[np.ndarray, np.ndarray] | None]  # V results of `shrink`
    poses: np.ndarray | None  # float64 [V, 3]: azimuth of the object frame, elevation (degrees), distance
    voxels: np.ndarray | None  # bool [32, 32, 32]


def join_objects(
    objects: Iterable[ReadObject],
    names: Sequence[str],
    views: int,
    image_size: int,
    *,
    category: str,
    split: str,
    half_fov_deg: float,
    view_bins: str,
    convention: VoxelConvention,
) -> ViewDataset:
    """The data set of objects with these names, each seen from `views` sides of its own by one kind of camera.

    view_bins: pose classes as `AngleBins.parse` takes them. Colours are as they are, not inverted.
    """
    count = len(names)
    images = np.empty((count * views, 4, image_size, image_size), np.uint8)
    masks = None if image_size == MASK_SIZE else np.empty((count * views, MASK_SIZE, MASK_SIZE), np.uint8)
    tables, grids = [], []
    for i, item in enumerate(objects):
        for row, (image, mask) in enumerate(item.views, i * views):
            images[row] = image
            if masks is not None:
                masks[row] = mask
        tables.append(item.poses)
        grids.append(item.voxels)
    poses = LookAtPoses(*np.concatenate(tables).T, half_fov_deg)
    bins = AngleBins.parse(view_bins)
    return ViewDataset(
        category=category,
        split=split,
        images=images,
        poses=poses,
        view_ids=bins.ids(poses).numpy(),
        view_names=tuple(bins.names()),
        object_ids=np.repeat(np.arange(count), views),
        object_names=tuple(names),
        voxels=np.stack(grids),
        convention=convention,
        masks=masks,
        inverted=False,
    )
