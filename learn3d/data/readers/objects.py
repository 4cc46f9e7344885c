"""Shared functions of the readers kar and dvr: the files of many objects, read to arrays."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from learn3d.data.dataset import MASK_SIZE
from learn3d.files import limits
from learn3d.files.reading import FAULTS, DamagedFile, FaultHandler, MissingFile, OddFile, attempt
from learn3d.files.sandbox import Call, read_all
from learn3d.terminal import progress


class Files(NamedTuple):
    """The files of one object, all in one folder but for the shape."""

    cameras: Call
    shape: Call  # voxels or points
    views: list[Call]  # each returns an image, a mask and the mask's largest value


class Objects(NamedTuple):
    """N objects of V views each."""

    names: list[str]
    images: np.ndarray  # uint8 [N * V, 4, S, S]
    masks: np.ndarray | None  # uint8 [N * V, 64, 64]; None if they are the images' fourth channel
    poses: list[Any]  # results of `build`
    shapes: list[np.ndarray]


def read_objects(
    names: Sequence[str],
    files: Callable[[str], Files],
    build: Callable[[Files, Any, Any], tuple[Any, np.ndarray]],
    image_size: int,
    on_fault: FaultHandler,
    title: str,
) -> Objects:
    """Read objects. Those with faults are left out, if `on_fault` does not raise them.

    build: the poses and the shape of an object, from its files and the content of the first two; it
    may raise DamagedFile. title: of the progress. Raises DamagedFile if no object is left.
    """
    count = len(files(names[0]).views)
    images = np.empty((len(names) * count, 4, image_size, image_size), np.uint8)
    masks = None
    if image_size != MASK_SIZE:
        masks = np.empty((len(images), MASK_SIZE, MASK_SIZE), np.uint8)
    sound, poses, shapes = [], [], []
    calls = ([cameras, shape, *views] for cameras, shape, views in map(files, names))
    read = progress(read_all(calls), title, unit="object", total=len(names))
    for name, (cameras, shape, *views) in zip(names, read, strict=True):
        wanted = files(name)
        folder = wanted.cameras.path.parent
        faults = [found for found in (cameras, shape, *views) if isinstance(found, FAULTS)]
        if not folder.is_dir():
            faults = [MissingFile(folder, "is missing; expected the folder of an object")]
        for fault in faults:
            on_fault(fault)
        built = None if faults else attempt(on_fault, build, wanted, cameras, shape)
        if built is None:
            continue
        if not built[1].any():
            on_fault(OddFile(wanted.shape.path, "the grid is empty"))
        pairs = zip(wanted.views, views, strict=True)
        for row, (call, view) in enumerate(pairs, len(sound) * count):
            images[row], mask, brightest = view
            if masks is not None:
                masks[row] = mask
            if brightest < 128:
                message = f"its mask is empty: the brightest of its values 0 .. 255 is {brightest}"
                on_fault(OddFile(call.path, message))
        sound.append(name)
        poses.append(built[0])
        shapes.append(built[1])
    if not sound:
        raise DamagedFile(folder, "no object of the split is whole")
    rows = len(sound) * count
    return Objects(sound, images[:rows], None if masks is None else masks[:rows], poses, shapes)


def check_lists(
    path: Path, lists: dict[str, list[str]], split: str, on_fault: FaultHandler
) -> list[str]:
    """The ids of the objects of a split. lists: split -> ids. path: file of the lists, for
    messages.

    Raises DamagedFile if there are no ids, or if one is not a plain name of a folder.
    """
    ids = lists.get(split, [])
    if not ids:
        raise DamagedFile(path, f"names no object for {split}")
    for name in ids:
        if name in ("", ".", "..") or len(name) > limits.NAME_LENGTH or set(name) & set("/\\:\0"):
            raise DamagedFile(
                path, f"names the object {name[:40]!r}; expected the plain name of a folder"
            )
    if repeated := sorted(name for name, times in Counter(ids).items() if times > 1):
        on_fault(OddFile(path, f"{split} lists {', '.join(repeated[:8])} more than once"))
    for other, others in lists.items():
        if other != split and (shared := sorted(set(ids) & set(others))):
            found = f"{split} shares {len(shared)} objects with {other}, such as {shared[0]}"
            on_fault(OddFile(path, found))
    return ids
