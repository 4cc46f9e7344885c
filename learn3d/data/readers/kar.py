"""The renderings of Kar et al. 2017 (LSM): objects of ShapeNet from 20 viewpoints drawn at random.

- `splits.json` of the LSM code, laid beside the data: {synset: {"name": .., "train": [id, ..], "val": .., "test": ..}}.
- `renders/{synset}/{id}/render_0.png` .. `render_19.png`, 224x224, and `depth_0.png` .., where the background is white.
- `renders/{synset}/{id}/view.txt`: a row per render; column 0 is the azimuth (-180 .. 180 degrees), 1 the elevation
  (-20 .. 40), 3 the distance of the camera; column 2 is not used.
- `voxels/modelVoxels32/{synset}/{id}.mat`: the array 'Volume' [32, 32, 32].

What is done with them follows the published code of Peng et al. 2020, except where this says otherwise:

- Cameras are `nmr.points_from_angles(distance, elevation, azimuth)` with a HALF field of view of 14.9314 degrees
  (atan(16 / 60): a 60 mm lens on a 32 mm sensor), the published renderer's viewing_angle.
- The mask is depth < 250 in 8 bits (the high byte of 16-bit files, as OpenCV converts them). Where there is no depth
  file, the alpha channel of the render is the mask.
- Colours stay as they are, over white (transparent renders are laid on white, as LSM's own reader does; the published
  code reads them with OpenCV, which drops alpha, and keeps OpenCV's order B, G, R: here it is R, G, B).
- 224 -> 64 pixels by the mean over each pixel's area, for colours and mask alike, so that the mask has soft borders.
  The published code's skimage.transform.resize(anti_aliasing=True) blurs with a Gaussian of 1.25 pixels and samples
  bilinearly: a little softer.
- Training uses render 0 of each object alone (single view), validation and test use all 20 (a data set of your own may
  have fewer: as many as its first object has); `views_per_object`.
- Three objects whose renders are broken are left out, as by Kato and Harada 2019; the published code keeps them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from learn3d.data.conventions import KAR, VOXEL_SIZE
from learn3d.data.dataset import SPLITS, ViewDataset
from learn3d.data.readers.kato import synset_of
from learn3d.data.readers.renderings import (
    ReadObject,
    check_ids,
    check_split,
    check_square,
    join_objects,
    map_objects,
    read_image,
    read_table,
    shrink,
    split_alpha,
    warn_if_empty,
    warn_of_repeats,
)
from learn3d.files import limits
from learn3d.files.findings import AGAIN, DamagedFile, Findings, MissingFile, Problem
from learn3d.files.matlab import read_matlab
from learn3d.files.reading import parse_json, read_bytes, read_text

NUM_RENDERS = 20
HALF_FOV_DEG = math.degrees(math.atan(16 / 60))  # 14.9314
VIEW_BINS = "15x20"  # K = 72
BROKEN = frozenset(
    {"187f32df6f393d18490ad276cd2af3a4", "391fa4da294c70d0a4e97ce1d10a5ae6", "50cdaa9e33fc853ecb2a965e75be701c"}
)


def load(
    folder: Path | str,
    category: str,
    split: str,
    *,
    image_size: int = 64,
    views_per_object: int | None = None,
    progress: bool = False,
) -> ViewDataset:
    """Read one category (name or synset id) and split of a folder.

    Pose classes are cells of 15 x 20 degrees of azimuth and elevation over elevations -20 .. 40 (K = 72).

    image_size: side of the images in pixels, 64 or up to 224. The masks to be matched have 64 pixels in any case.
    views_per_object: use the first 1 .. 20 renders of each object; None: 1 for training, all for the other splits.
    Raises FileNotFoundError or ValueError naming the first file that is missing or not as described above.
    """
    if views_per_object is not None and not 1 <= views_per_object <= NUM_RENDERS:
        raise ValueError(f"views_per_object must lie in 1 .. {NUM_RENDERS}, got {views_per_object}")
    folder, ids = Path(folder), object_ids(folder, category, split)
    there = 1 if split == "train" else renders_of(folder / "renders" / synset_of(category) / ids[0])
    views = there if views_per_object is None else views_per_object
    findings = Findings(strict=True)
    read = map_objects(
        lambda name: _read(folder, synset_of(category), name, views, image_size, findings), ids, category, progress
    )
    return join_objects(
        read,
        ids,
        views,
        image_size,
        category=category,
        split=split,
        half_fov_deg=HALF_FOV_DEG,
        view_bins=VIEW_BINS,
        convention=KAR,
    )


def problems(folder: Path | str, category: str, split: str, *, progress: bool = False) -> Iterator[Problem]:
    """Everything that is wrong with one category and split, all renders of every object included."""
    folder, findings = Path(folder), Findings()
    ids = findings.attempt(object_ids, folder, category, split)
    if ids is not None:
        lists = read_splits(folder)[synset_of(category)]
        others = {other: lists[other] for other in SPLITS if other != split and other in lists}
        warn_of_repeats(findings, folder / "splits.json", f"{category} {split}", ids, others)
    yield from findings.problems

    views = renders_of(folder / "renders" / synset_of(category) / ids[0]) if ids else NUM_RENDERS

    def examine(name: str) -> list[Problem]:
        findings = Findings()
        _read(folder, synset_of(category), name, views, 64, findings)
        return findings.problems

    for found in map_objects(examine, ids or [], f"{category} {split}", progress):
        yield from found


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories (synset ids) that are listed and whose renders are there, and the splits of each."""
    lists = read_splits(Path(folder))
    return {
        synset: tuple(split for split in SPLITS if entry.get(split))
        for synset, entry in sorted(lists.items())
        if (Path(folder) / "renders" / synset).is_dir()
    }


def count(folder: Path | str, category: str, split: str) -> int:
    """How many objects a split names, without the three whose renders are broken."""
    return len(object_ids(folder, category, split))


def object_ids(folder: Path | str, category: str, split: str) -> list[str]:
    """The ids of a split in the order of splits.json, without those whose renders are known to be broken."""
    check_split(split)
    path, synset = Path(folder) / "splits.json", synset_of(category)
    lists = read_splits(Path(folder))
    if synset not in lists:
        raise DamagedFile(path, f"has no entry {synset} ({category}); it has: {', '.join(sorted(lists)) or 'none'}")
    ids = [name for name in lists[synset].get(split, []) if name not in BROKEN]
    if not ids:
        raise DamagedFile(path, f"names no object for {synset} ({category}), {split}")
    return ids


def renders_of(folder: Path) -> int:
    """How many renders an object has, by the files or by the rows of view.txt, whichever are more; 20 where none."""
    numbers = [path.stem.removeprefix("render_") for path in folder.glob("render_*.png")]
    files = max((int(number) + 1 for number in numbers if number.isdecimal()), default=0)
    try:
        table = read_text(folder / "view.txt", limits.TABLE_BYTES, "a row per render")
        rows = sum(bool(line.strip()) for line in table.splitlines())
    except (OSError, ValueError):  # reading the object will tell
        rows = 0
    return min(max(files, rows), NUM_RENDERS) or NUM_RENDERS


def read_splits(folder: Path) -> dict[str, dict[str, list[str]]]:
    path = folder / "splits.json"
    wanted = 'expected {synset: {"name": .., "train": [id, ..], "val": [..], "test": [..]}}'
    if not path.exists():
        hint = "take data/splits.json of the LSM code" if folder.is_dir() else "there is no such folder"
        raise MissingFile(path, f"is missing: {hint}; {wanted}")
    content = read_bytes(path, limits.JSON_BYTES, "the lists of objects as JSON")
    try:
        lists = parse_json(content)
    except ValueError as error:
        raise DamagedFile(path, f"cannot be read as JSON ({error}); {wanted}. {AGAIN}") from error
    entries = lists.values() if isinstance(lists, dict) else [None]
    for entry in entries:
        named = [entry.get(split, []) for split in SPLITS] if isinstance(entry, dict) else [None]
        if not all(isinstance(ids, list) and all(isinstance(name, str) for name in ids) for ids in named):
            raise DamagedFile(path, f"has another structure; {wanted}")
        for ids in named:
            check_ids(path, ids)
    return lists


def _read(folder: Path, synset: str, name: str, views: int, size: int, findings: Findings) -> ReadObject:
    """One object; None for the parts that findings tell of."""
    root = folder / "renders" / synset / name
    voxels = findings.attempt(_read_voxels, folder / "voxels" / "modelVoxels32" / synset / f"{name}.mat")
    if voxels is not None and not voxels.any():
        findings.warn(folder / "voxels" / "modelVoxels32" / synset / f"{name}.mat", "the grid is empty")
    if findings.attempt(_check_folder, root) is None:
        return ReadObject([], None, voxels)
    table = findings.attempt(_read_views, root / "view.txt", views)
    return ReadObject([_read_view(root, k, size, findings) for k in range(views)], table, voxels)


def _check_folder(root: Path) -> Path:
    if not root.is_dir():
        raise MissingFile(root, f"is missing; expected the folder of an object that splits.json names. {AGAIN}")
    return root


def _read_views(path: Path, rows: int) -> np.ndarray:
    """Azimuth, elevation and distance of each render, float64 [rows, 3]."""
    wanted = "a row per render: azimuth, elevation, (unused), distance"
    table = read_table(path, rows, 4, wanted)
    low, high = limits.DISTANCE
    turns = np.abs(table[:, 0]) > limits.ANGLE_DEG
    if (bad := turns | (np.abs(table[:, 1]) >= 90) | (table[:, 3] < low) | (table[:, 3] > high)).any():
        k = int(bad.argmax())
        raise DamagedFile(
            path,
            f"row {k} has azimuth {table[k, 0]:g}, elevation {table[k, 1]:g} and distance {table[k, 3]:g}; "
            f"expected {wanted}",
        )
    return table[:, [0, 1, 3]]


def _read_view(root: Path, k: int, size: int, findings: Findings) -> tuple[np.ndarray, np.ndarray] | None:
    pair = findings.attempt(_read_render, root, k, size)
    if pair is None:
        return None
    warn_if_empty(findings, root / f"render_{k}.png", pair[1])
    return shrink(*pair, size)


def _read_render(root: Path, k: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Colours over white and the mask of render k, at their own size."""
    path, depth_path = root / f"render_{k}.png", root / f"depth_{k}.png"
    image = read_image(path)
    check_square(path, image, max(size, 64))
    color, alpha = split_alpha(image)
    if not depth_path.exists():
        if alpha is None:
            raise MissingFile(depth_path, f"is missing, and {path.name} has no alpha channel; expected the depth image")
        return color, alpha
    depth = read_image(depth_path)
    if depth.size != image.size:
        raise DamagedFile(
            depth_path, f"is {depth.width}x{depth.height} pixels, but {path.name} is {image.width}x{image.height}"
        )
    return color, np.where(_grey(depth_path, depth) < 250, 255, 0).astype(np.uint8)


def _grey(path: Path, depth: Image.Image) -> np.ndarray:
    """Depth in 8 bits: the high byte of 16, the luminance of colours."""
    if depth.mode.startswith("I"):
        values = np.asarray(depth)
        if values.min() < 0 or values.max() > 65535:
            raise DamagedFile(path, f"has values {values.min()} .. {values.max()}; expected 8 or 16 bits")
        return values >> 8
    if depth.mode == "F":
        raise DamagedFile(path, "holds floating-point numbers; expected 8 or 16 bits")
    return np.asarray(depth.convert("L"))


def _read_voxels(path: Path) -> np.ndarray:
    wanted = "a MATLAB file with the array 'Volume' [32, 32, 32]"
    volume = read_matlab(path, "Volume", wanted)
    if volume is None or volume.shape != (VOXEL_SIZE,) * 3:
        found = "no such array of numbers" if volume is None else f"{volume.dtype} {list(volume.shape)}"
        raise DamagedFile(path, f"has {found}; expected {wanted}")
    return volume != 0
