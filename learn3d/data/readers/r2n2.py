"""The renderings of 3D-R2N2 (Choy et al. 2016): objects of ShapeNet from 24 viewpoints drawn at random.

- `ShapeNetRendering/{synset}/{id}/rendering/00.png` .. `23.png`, RGBA, 137x137 (the published network crops 127x127 of
  it at random; here the whole image is taken, so that one field of view holds for all).
- `.../rendering/rendering_metadata.txt`: a row per image: azimuth (0 .. 360 degrees), elevation (25 .. 30), yaw (0),
  ratio of the distance (0.65 .. 0.95), field of view (25).
- `ShapeNetVox32/{synset}/{id}/model.binvox`: 32^3 cells.
- Split as published: ids sorted, the first 80 % for training, the rest for test. There is no validation split.

Cameras. The distance is 1.75 times the ratio, in units of the mesh. The field of view in the table was handed to the
rendering code, but not used by it: the camera is Blender's default one, with a 35 mm lens on a 32 mm sensor. That is a
focal length of 35 / 16 = 2.1875 where the image spans -1 .. 1, hence half of the field of view is atan(16 / 35), 24.567
degrees (which the table's 25 comes near, if read as the half). In the mesh's frame (y up) the eye is at
d (cos e cos a, sin e, cos e sin a), as in Kato's rendering, so that in the object frame, (-z, y, -x) of the mesh, the
azimuth of `nmr.points_from_angles` is -a.

Voxels. binvox keeps the mesh's axes; see conventions.R2N2. The header says which cube of the mesh's frame the grid
spans. The object frame of each object is scaled by that cube's side, which makes it 1 (distances are divided by it).
The headers of the published archive are believed to read scale 1 throughout, whatever the size of the mesh that was
rendered; if so, predictions and voxels differ in size by up to the ratio of the mesh's longest side to 1, and no figure
of IoU on this data set should be compared with one on another.

Colours stay as they are, over white. 137 -> 64 pixels by the mean over each pixel's area.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from learn3d.data.conventions import R2N2, VOXEL_SIZE
from learn3d.data.dataset import ViewDataset
from learn3d.data.readers.kato import synset_of
from learn3d.data.readers.renderings import (
    ReadObject,
    category_folder,
    check_split,
    check_square,
    join_objects,
    map_objects,
    read_image,
    read_table,
    shrink,
    split_alpha,
    warn_if_empty,
)
from learn3d.files import limits
from learn3d.files.binvox import Binvox, read_binvox
from learn3d.files.findings import DamagedFile, Findings, MissingFile, Problem

NUM_RENDERS = 24
DISTANCE = 1.75  # of the ratio 1
HALF_FOV_DEG = math.degrees(math.atan(16 / 35))
VIEW_BINS = "15x5:25:30"  # K = 24: elevations differ by five degrees only
SPLITS = ("train", "test")


def load(
    folder: Path | str,
    category: str,
    split: str,
    *,
    image_size: int = 64,
    views_per_object: int | None = None,
    progress: bool = False,
) -> ViewDataset:
    """Read one category (name or synset id) and split ("train" or "test") of a folder.

    Pose classes are cells of 15 x 5 degrees of azimuth and elevation over elevations 25 .. 30 (K = 24).

    image_size: side of the images in pixels, up to 137. The masks to be matched have 64 pixels in any case.
    views_per_object: use the first 1 .. 24 images of each object; None: all.
    Raises FileNotFoundError or ValueError naming the first file that is missing or not as described above.
    """
    views = NUM_RENDERS if views_per_object is None else views_per_object
    if not 1 <= views <= NUM_RENDERS:
        raise ValueError(f"views_per_object must lie in 1 .. {NUM_RENDERS}, got {views}")
    folder, ids = Path(folder), object_ids(folder, category, split)
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
        convention=R2N2,
    )


def problems(folder: Path | str, category: str, split: str, *, progress: bool = False) -> Iterator[Problem]:
    """Everything that is wrong with one category and split."""
    folder, findings = Path(folder), Findings()
    ids = findings.attempt(object_ids, folder, category, split)
    yield from findings.problems

    def examine(name: str) -> list[Problem]:
        findings = Findings()
        _read(folder, synset_of(category), name, NUM_RENDERS, 64, findings)
        return findings.problems

    for found in map_objects(examine, ids or [], f"{category} {split}", progress):
        yield from found


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories (synset ids) of a folder and the splits of each."""
    root = Path(folder) / "ShapeNetRendering"
    found = sorted(path.name for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
    return {synset: SPLITS for synset in found}


def count(folder: Path | str, category: str, split: str) -> int:
    """How many objects a split has."""
    return len(object_ids(folder, category, split))


def object_ids(folder: Path | str, category: str, split: str) -> list[str]:
    """The ids of a split, sorted: of all that have renderings, the first 80 % (train) or the others (test)."""
    check_split(split, SPLITS)
    root = category_folder(Path(folder) / "ShapeNetRendering", category)
    ids = sorted(path.name for path in root.iterdir() if path.is_dir())
    border = len(ids) * 8 // 10
    if not (chosen := ids[:border] if split == "train" else ids[border:]):
        raise DamagedFile(root, f"holds {len(ids)} objects, which leaves none for {split}; expected at least 2")
    return chosen


def _read(folder: Path, synset: str, name: str, views: int, size: int, findings: Findings) -> ReadObject:
    """One object; None for the parts that findings tell of."""
    root = folder / "ShapeNetRendering" / synset / name / "rendering"
    path = folder / "ShapeNetVox32" / synset / name / "model.binvox"
    grid = findings.attempt(read_binvox, path, VOXEL_SIZE)
    if grid is not None:
        _warn_of_grid(path, grid, findings)
    if findings.attempt(_check_folder, root) is None:
        return ReadObject([], None, None)
    table = findings.attempt(_read_poses, root / "rendering_metadata.txt", views)
    if table is not None and grid is not None:
        table[:, 2] /= grid.scale
    images = [_read_view(root / f"{k:02d}.png", size, findings) for k in range(views)]
    return ReadObject(images, table, None if grid is None else grid.voxels)


def _warn_of_grid(path: Path, grid: Binvox, findings: Findings) -> None:
    if not grid.voxels.any():
        findings.warn(path, "the grid is empty")
    centre = grid.translate + grid.scale / 2
    if np.abs(centre).max() > grid.scale / VOXEL_SIZE / 2:
        findings.warn(
            path,
            f"the grid is centred at {centre.round(4).tolist()}, over half a cell from where the cameras look",
        )


def _check_folder(root: Path) -> Path:
    if not root.is_dir():
        raise MissingFile(root, "is missing; expected the folder of an object's images")
    return root


def _read_poses(path: Path, rows: int) -> np.ndarray:
    """Azimuth of the object frame, elevation and distance (in units of the mesh) of each image, float64 [rows, 3]."""
    wanted = "a row per image: azimuth, elevation, yaw 0, ratio of the distance, field of view"
    azimuth, elevation, yaw, ratio, _ = read_table(path, rows, 5, wanted).T
    low, high = limits.DISTANCE
    turns = np.abs(azimuth) > limits.ANGLE_DEG
    if (bad := turns | (np.abs(elevation) >= 90) | (np.abs(yaw) > 1e-3) | (ratio < low) | (ratio > high)).any():
        k = int(bad.argmax())
        found = f"azimuth {azimuth[k]:g}, elevation {elevation[k]:g}, yaw {yaw[k]:g} and ratio {ratio[k]:g}"
        raise DamagedFile(path, f"row {k} has {found}; expected {wanted}")
    return np.stack([-azimuth, elevation, DISTANCE * ratio], axis=1)


def _read_view(path: Path, size: int, findings: Findings) -> tuple[np.ndarray, np.ndarray] | None:
    pair = findings.attempt(_read_render, path, size)
    if pair is None:
        return None
    warn_if_empty(findings, path, pair[1])
    return shrink(*pair, size)


def _read_render(path: Path, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Colours over white and the mask, at their own size."""
    image = read_image(path)
    check_square(path, image, max(size, 64))
    color, alpha = split_alpha(image)
    if alpha is None:
        raise DamagedFile(path, f"has the channels {image.mode}; expected RGBA, whose alpha is the mask")
    return color, alpha
