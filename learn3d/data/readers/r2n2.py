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

Voxels. binvox keeps the axes (x, y, z) of the mesh (y up, right-handed), of which the object frame is (-z, y, -x), as
Kato's is (`mesh_to_object`). The header says which cube of the mesh's frame the grid spans. The object frame of each
object is scaled by that cube's side, which makes it 1 (distances are divided by it).
The headers of the published archive are believed to read scale 1 throughout, whatever the size of the mesh that was
rendered; if so, predictions and voxels differ in size by up to the ratio of the mesh's longest side to 1, and no figure
of IoU on this data set should be compared with one on another.

Colours stay as they are, over white. 137 -> 64 pixels by the mean over each pixel's area.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from learn3d.data.categories import synset_of
from learn3d.data.conventions import INNER, VOXEL_SIZE, VoxelConvention
from learn3d.data.dataset import ViewDataset
from learn3d.data.readers.properties import LayoutProperties
from learn3d.data.readers.renderings import (
    ObjectReader,
    ReadObject,
    category_folder,
    check_poses,
    check_split,
    check_views,
    join_objects,
    take_views,
)
from learn3d.files import renderings, volumes
from learn3d.files.findings import DamagedFile, Findings, Problem
from learn3d.files.sandbox import Call

#: binvox's grids: axes (-z, y, -x) of the object frame, backwards. They span the cube that binvox fits to the object.
R2N2 = VoxelConvention("r2n2", swap=(1, 3), flip=(1, 3), kato18_scale=INNER)
PROPERTIES = LayoutProperties(
    voxels=True,
    convention=R2N2,
    inverted=False,
    validation=False,
    options=("image_size", "views_per_object", "progress"),
)
NUM_RENDERS = 24
DISTANCE = 1.75  # of the ratio 1
HALF_FOV_DEG = math.degrees(math.atan(16 / 35))
VIEW_BINS = "15x5:25:30"  # K = 24: elevations differ by five degrees only
SPLITS = ("train", "test")
_TABLE = "a row per image: azimuth, elevation, yaw 0, ratio of the distance, field of view"


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
    check_views(views_per_object, NUM_RENDERS)
    views = NUM_RENDERS if views_per_object is None else views_per_object
    folder, ids = Path(folder), object_ids(folder, category, split)
    return join_objects(
        _Reader(folder, synset_of(category), views, image_size).read(ids, category, progress),
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
    reader = _Reader(folder, synset_of(category), NUM_RENDERS, 64)
    yield from reader.problems(ids or [], f"{category} {split}", progress)


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


@dataclass(frozen=True)
class _Reader(ObjectReader):
    folder: Path
    synset: str
    views: int
    size: int

    def _paths(self, name: str) -> tuple[Path, Path]:
        voxels = self.folder / "ShapeNetVox32" / self.synset / name / "model.binvox"
        return voxels, self.folder / "ShapeNetRendering" / self.synset / name / "rendering"

    def calls(self, name: str) -> list[Call]:
        voxels, root = self._paths(name)
        calls = [
            Call(volumes.read_binvox, voxels, (VOXEL_SIZE,), "a voxel grid in the binvox format"),
            Call(renderings.check_folder, root, ("the folder of an object's images",)),
        ]
        if root.is_dir():
            table = root / "rendering_metadata.txt"
            calls.append(Call(renderings.read_table, table, (self.views, 5, _TABLE), _TABLE))
            paths = [root / f"{k:02d}.png" for k in range(self.views)]
            calls += [Call(renderings.read_with_alpha, path, (self.size,), "a rendering") for path in paths]
        return calls

    def build(self, name: str, found: list[Any], findings: Findings) -> ReadObject:
        path, root = self._paths(name)
        grid, _, *rest = map(findings.take, found[:3])
        if grid is not None:
            _warn_of_grid(path, grid, findings)
        poses = None
        if rest and rest[0] is not None:
            poses = findings.attempt(_poses, root / "rendering_metadata.txt", rest[0])
        if poses is not None and grid is not None:
            poses[:, 2] /= grid.scale
        paths = [root / f"{k:02d}.png" for k in range(len(found) - 3)]
        return ReadObject(take_views(findings, paths, found[3:]), poses, None if grid is None else grid.voxels)


def _warn_of_grid(path: Path, grid: volumes.Binvox, findings: Findings) -> None:
    if not grid.voxels.any():
        findings.warn(path, "the grid is empty")
    centre = grid.translate + grid.scale / 2
    if np.abs(centre).max() > grid.scale / VOXEL_SIZE / 2:
        findings.warn(
            path,
            f"the grid is centred at {centre.round(4).tolist()}, over half a cell from where the cameras look",
        )


def _poses(path: Path, table: np.ndarray) -> np.ndarray:
    """Azimuth of the object frame, elevation and distance (in units of the mesh) of each image, float64 [V, 3]."""
    azimuth, elevation, yaw, ratio, _ = table.T
    if (turned := np.abs(yaw) > 1e-3).any():
        k = int(turned.argmax())
        raise DamagedFile(path, f"row {k} has the yaw {yaw[k]:g}; expected {_TABLE}")
    return check_poses(path, np.stack([-azimuth, elevation, DISTANCE * ratio], axis=1), _TABLE)
