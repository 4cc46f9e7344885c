"""The renderings of 3D-R2N2 (Choy et al. 2016): objects of ShapeNet from 24 random viewpoints.

- `ShapeNetRendering/{synset}/{id}/rendering/00.png` .. `23.png`, RGBA, 137x137. The published network uses random crops
  of 127x127; here whole images are used, so that all have one field of view. Colours are not inverted, over white.
- `.../rendering/rendering_metadata.txt`: a row per image: azimuth (0 .. 360 degrees), elevation (25 .. 30), yaw (0),
  ratio of the distance (0.65 .. 0.95), field of view (25).
- `ShapeNetVox32/{synset}/{id}/model.binvox`: 32^3 cells.
- Split as published: ids sorted, the first 80 % for training, the rest for test. There is no validation split.

Cameras. The distance is 1.75 times the ratio, in units of the mesh. The camera is Blender's default, a 35 mm lens on a
32 mm sensor: half the field of view is atan(16 / 35), 24.567 degrees. The 25 in the table has no effect on it. In the
mesh's frame (y up) the eye is at d (cos e cos a, sin e, cos e sin a). So in the object frame, (-z, y, -x) of the mesh,
the azimuth of `nmr.points_from_angles` is -a.

Voxels. Grids have the axes (x, y, z) of the mesh. The binvox header has the side of the grid's cube. Each object frame
is scaled so that this side is 1; distances are divided by it. The headers of the published archive are believed to have
the side 1 for meshes of any size. If so, predictions and voxels differ in size: do not compare IoUs on this data set
with those on another.
"""

import math
from pathlib import Path

import numpy as np

from learn3d.data.categories import synset_of
from learn3d.data.conventions import INNER, VOXEL_SIZE, LayoutProperties, VoxelConvention
from learn3d.data.dataset import ViewDataset
from learn3d.data.readers.renderings import category_folder, check_poses, join_objects, read_objects
from learn3d.files import formats, renderings
from learn3d.files.reading import STRICT, DamagedFile, Findings
from learn3d.files.sandbox import Call

#: binvox grids have the axes (-z, y, -x) of the object frame, and span the cube in the header.
R2N2 = VoxelConvention("r2n2", swap=(1, 3), flip=(1, 3), kato18_scale=INNER)
PROPERTIES = LayoutProperties(voxels=True, convention=R2N2, inverted=False, validation=False, options=("image_size",))
NUM_RENDERS = 24
DISTANCE = 1.75  # distance of the camera at ratio 1
HALF_FOV_DEG = math.degrees(math.atan(16 / 35))
VIEW_BINS = "15x5:25:30"  # K = 24: all elevations share one cell
SPLITS = ("train", "test")
_TABLE = "a row per image: azimuth, elevation, yaw, ratio of the distance, field of view"


def load(
    folder: Path | str, category: str, split: str, *, image_size: int = 64, findings: Findings = STRICT
) -> ViewDataset | None:
    """Read a split, "train" or "test". View classes are cells of azimuth and elevation, see `VIEW_BINS`.

    image_size: side of the images in pixels, up to 137; masks always have 64.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {', '.join(SPLITS)}; got {split!r}")
    folder, synset = Path(folder), synset_of(category)
    root = category_folder(folder / "ShapeNetRendering", category)
    ids = sorted(path.name for path in root.iterdir() if path.is_dir())
    border = len(ids) * 8 // 10
    chosen = ids[:border] if split == "train" else ids[border:]
    if not chosen:
        raise DamagedFile(root, f"holds {len(ids)} objects, which leaves none for {split}; expected at least 2")

    def files(name: str) -> list[Call]:
        images, voxels = root / name / "rendering", folder / "ShapeNetVox32" / synset / name / "model.binvox"
        return [
            Call(renderings.read_table, images / "rendering_metadata.txt", (NUM_RENDERS, 5, _TABLE), _TABLE),
            Call(formats.read_binvox, voxels, (VOXEL_SIZE,), "a voxel grid in the binvox format"),
            *(Call(renderings.read_with_alpha, images / f"{k:02d}.png", (image_size,)) for k in range(NUM_RENDERS)),
        ]

    objects = read_objects(chosen, files, _build, image_size, findings, f"{category} {split}")
    return join_objects(objects, chosen, HALF_FOV_DEG, VIEW_BINS, PROPERTIES.about(category, split))


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories (synset ids) of a folder and the splits of each."""
    return {path.name: SPLITS for path in sorted(Path(folder).glob("ShapeNetRendering/*/"))}


def _build(path: Path, table: np.ndarray, _: Path, grid: tuple[np.ndarray, float]) -> tuple[np.ndarray, np.ndarray]:
    (azimuth, elevation, _, ratio, _), (voxels, side) = table.T, grid
    poses = check_poses(path, np.stack([-azimuth, elevation, DISTANCE * ratio], axis=1), _TABLE)
    poses[:, 2] /= side
    return poses, voxels
