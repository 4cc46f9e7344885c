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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from learn3d.data.categories import synset_of
from learn3d.data.conventions import INNER, VOXEL_SIZE, VoxelConvention
from learn3d.data.dataset import SPLITS, ViewDataset
from learn3d.data.readers.properties import LayoutProperties
from learn3d.data.readers.renderings import (
    ObjectReader,
    ReadObject,
    check_ids,
    check_poses,
    check_split,
    check_views,
    join_objects,
    take_views,
    warn_of_repeats,
)
from learn3d.files import limits, renderings, volumes
from learn3d.files.findings import FETCH_AGAIN, DamagedFile, Findings, MissingFile, Problem
from learn3d.files.reading import parse_json, read_bytes, read_text
from learn3d.files.sandbox import Call

#: The .mat volumes, as the paper's code reads them: axes (-z, y, x) of the object frame.
KAR = VoxelConvention("kar", swap=(1, 3), flip=(1,), kato18_scale=INNER)
PROPERTIES = LayoutProperties(
    voxels=True,
    convention=KAR,
    inverted=False,
    options=("image_size", "views_per_object", "progress"),
)
NUM_RENDERS = 20
HALF_FOV_DEG = math.degrees(math.atan(16 / 60))  # 14.9314
VIEW_BINS = "15x20"  # K = 72
BROKEN = frozenset(
    {"187f32df6f393d18490ad276cd2af3a4", "391fa4da294c70d0a4e97ce1d10a5ae6", "50cdaa9e33fc853ecb2a965e75be701c"}
)
_TABLE = "a row per render: azimuth, elevation, (unused), distance"


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
    check_views(views_per_object, NUM_RENDERS)
    folder, ids = Path(folder), object_ids(folder, category, split)
    there = 1 if split == "train" else renders_of(folder / "renders" / synset_of(category) / ids[0])
    views = there if views_per_object is None else views_per_object
    return join_objects(
        _Reader(folder, synset_of(category), views, image_size).read(ids, category, progress),
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
    if ids is not None:
        views = renders_of(folder / "renders" / synset_of(category) / ids[0])
        yield from _Reader(folder, synset_of(category), views, 64).problems(ids, f"{category} {split}", progress)


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
        raise DamagedFile(path, f"cannot be read as JSON ({error}); {wanted}. {FETCH_AGAIN}") from error
    entries = lists.values() if isinstance(lists, dict) else [None]
    for entry in entries:
        named = [entry.get(split, []) for split in SPLITS] if isinstance(entry, dict) else [None]
        if not all(isinstance(ids, list) and all(isinstance(name, str) for name in ids) for ids in named):
            raise DamagedFile(path, f"has another structure; {wanted}")
        for ids in named:
            check_ids(path, ids)
    return lists


@dataclass(frozen=True)
class _Reader(ObjectReader):
    folder: Path
    synset: str
    views: int
    size: int

    def _paths(self, name: str) -> tuple[Path, Path]:
        voxels = self.folder / "voxels" / "modelVoxels32" / self.synset / f"{name}.mat"
        return voxels, self.folder / "renders" / self.synset / name

    def calls(self, name: str) -> list[Call]:
        voxels, root = self._paths(name)
        calls = [
            Call(volumes.read_matlab, voxels, ("Volume", VOXEL_SIZE), "a MATLAB file of voxels"),
            Call(renderings.check_folder, root, (f"the folder of an object that splits.json names. {FETCH_AGAIN}",)),
        ]
        if root.is_dir():
            calls.append(Call(renderings.read_table, root / "view.txt", (self.views, 4, _TABLE), _TABLE))
            for k in range(self.views):
                files = root / f"render_{k}.png", (root / f"depth_{k}.png", self.size)
                calls.append(Call(renderings.read_with_depth, *files, "a rendering"))
        return calls

    def build(self, name: str, found: list[Any], findings: Findings) -> ReadObject:
        path, root = self._paths(name)
        voxels, _, *rest = map(findings.take, found[:3])
        if voxels is not None and not voxels.any():
            findings.warn(path, "the grid is empty")
        poses = None
        if rest and rest[0] is not None:
            poses = findings.attempt(check_poses, root / "view.txt", rest[0][:, [0, 1, 3]], _TABLE)
        paths = [root / f"render_{k}.png" for k in range(len(found) - 3)]
        return ReadObject(take_views(findings, paths, found[3:]), poses, voxels)
