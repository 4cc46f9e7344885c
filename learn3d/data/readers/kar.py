"""The renderings of Kar et al. 2017 (LSM): objects of ShapeNet from 20 random viewpoints.

- `splits.json` of the LSM code, beside the data: {synset: {"name": .., "train": [id, ..], "val": .., "test": ..}}.
- `renders/{synset}/{id}/render_0.png` .. `render_19.png`, 224x224, and `depth_0.png` .., white as background.
- `renders/{synset}/{id}/view.txt`: a row per render: azimuth (-180 .. 180 degrees), elevation (-20 .. 40), an unused
  column, distance of the camera.
- `voxels/modelVoxels32/{synset}/{id}.mat`: the array 'Volume' [32, 32, 32].

Deviations from the published code of Peng et al. 2020 are marked (*):

- Cameras are `nmr.points_from_angles(distance, elevation, azimuth)` with a HALF field of view of 14.9314 degrees
  (atan(16 / 60): a 60 mm lens on a 32 mm sensor), the published renderer's viewing_angle.
- The mask is depth < 250 in 8 bits (the high byte of 16-bit files, as OpenCV converts them). If there is no depth file,
  it is the alpha channel of the render (*).
- Colours are not inverted, over white; their order is R, G, B, not OpenCV's (*).
- Colours and mask are reduced from 224 to 64 pixels by the mean over each pixel's area, so the mask has soft borders.
  skimage.transform.resize(anti_aliasing=True) of the published code is a little softer (*).
- Training uses render 0 of each object alone (single view: `training_views` of the layout). Validation and test use as
  many renders as view.txt of the first object has rows, 20 at most. `views_per_object` changes both.
- Three objects with broken renders are skipped, as by Kato and Harada 2019 (*).
"""

import math
from pathlib import Path

import numpy as np
import torch

from learn3d.data.conventions import LAYOUTS, SPLITS, VOXEL_SIZE, synset_of
from learn3d.data.dataset import ViewDataset
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers.objects import Files, check_lists, read_objects
from learn3d.data.view_bins import AngleBins
from learn3d.files import formats, images, limits
from learn3d.files.reading import (
    DamagedFile,
    FaultHandler,
    attempt,
    faults_of,
    read_bytes,
    read_json,
    refuse,
)
from learn3d.files.sandbox import Call

NUM_RENDERS = 20
HALF_FOV_DEG = math.degrees(math.atan(16 / 60))  # 14.9314
VIEW_BINS = "15x20"  # K = 72
BROKEN = frozenset(
    {
        "187f32df6f393d18490ad276cd2af3a4",
        "391fa4da294c70d0a4e97ce1d10a5ae6",
        "50cdaa9e33fc853ecb2a965e75be701c",
    }
)
_TABLE = "a row per render: azimuth, elevation, (unused), distance"
_LISTS = 'splits.json of the LSM code: {synset: {"name": .., "train": [id, ..], "val": [..], "test": [..]}}'


def load(
    folder: Path | str,
    category: str,
    split: str,
    *,
    image_size: int = 64,
    views_per_object: int | None = None,
    on_fault: FaultHandler = refuse,
) -> ViewDataset:
    """Read a split. View classes are cells of azimuth and elevation, see `VIEW_BINS`.

    image_size: side of the images in pixels, up to 224; masks always have 64. views_per_object:
    use at most the first so many renders of each object; None: all.
    """
    folder = Path(folder)
    synset = synset_of(category)
    path = folder / "splits.json"
    lists = read_splits(folder)
    if synset not in lists:
        there = ", ".join(sorted(lists)) or "none"
        raise DamagedFile(path, f"has no entry {synset} ({category}); it has: {there}")
    lists = {s: [name for name in lists[synset].get(s, []) if name not in BROKEN] for s in SPLITS}
    ids = check_lists(path, lists, split, on_fault)
    root = folder / "renders" / synset
    views = views_per_object or NUM_RENDERS
    if views > 1:
        rows = attempt(on_fault, _count_rows, root / ids[0] / "view.txt")
        views = min(views, rows or NUM_RENDERS)

    def files(name: str) -> Files:
        grid = folder / "voxels" / "modelVoxels32" / synset / f"{name}.mat"
        paths = [
            (root / name / f"render_{k}.png", root / name / f"depth_{k}.png") for k in range(views)
        ]
        return Files(
            Call(formats.read_table, root / name / "view.txt", (views, 4, _TABLE), _TABLE),
            Call(formats.read_matlab, grid, ("Volume", VOXEL_SIZE)),
            [
                Call(images.read_with_depth, path, (depth, image_size), "a rendering")
                for path, depth in paths
            ],
        )

    def build(files: Files, table: np.ndarray, volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return check_poses(files.cameras.path, table[:, [0, 1, 3]], _TABLE), volume

    objects = read_objects(ids, files, build, image_size, on_fault, f"{category} {split}")
    cameras = LookAtPoses(*np.concatenate(objects.poses).T, HALF_FOV_DEG)
    bins = AngleBins.parse(VIEW_BINS)
    return ViewDataset(
        **LAYOUTS["kar"].about(category, split),
        images=objects.images,
        masks=objects.masks,
        poses=cameras,
        view_ids=bins.ids(cameras).numpy(),
        view_names=tuple(bins.names()),
        object_ids=np.repeat(np.arange(len(objects.names)), views),
        object_names=tuple(objects.names),
        voxels=np.stack(objects.shapes),
    )


def check_poses(path: Path, poses: np.ndarray, wanted: str) -> np.ndarray:
    """Return poses float64 [V, 3] (azimuth, elevation, distance).

    Raises DamagedFile if one is out of range.
    """
    sound = LookAtPoses(*torch.from_numpy(poses.T), HALF_FOV_DEG).in_range().numpy()
    if not sound.all():
        row = sound.argmin()
        azimuth, elevation, distance = poses[row]
        found = f"azimuth {azimuth:g}, elevation {elevation:g} and distance {distance:g}"
        raise DamagedFile(path, f"row {row} has {found}; expected {wanted}")
    return poses


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The listed categories (synset ids) with renders, and the splits of each."""
    return {
        synset: tuple(split for split in SPLITS if entry.get(split))
        for synset, entry in sorted(read_splits(Path(folder)).items())
        if (Path(folder) / "renders" / synset).is_dir()
    }


def read_splits(folder: Path) -> dict[str, dict[str, list[str]]]:
    """Read splits.json of a folder: synset -> split -> ids. Raises MissingFile and DamagedFile."""
    path = folder / "splits.json"
    lists = read_json(path, limits.JSON_BYTES, _LISTS)
    with faults_of(path, _LISTS):
        named = [entry.get(split, []) for entry in lists.values() for split in SPLITS]
        if not all(
            isinstance(ids, list) and all(isinstance(name, str) for name in ids) for ids in named
        ):
            raise ValueError("ids must be lists of text")
    return lists


def _count_rows(path: Path) -> int:
    """Number of rows of a table."""
    lines = read_bytes(path, limits.TEXT_BYTES, _TABLE).splitlines()
    return sum(bool(line.strip()) for line in lines)
