"""Kato's data protocol: 24 views per object, 64x64, kept in two npz files per category and split.

The oddities that this module hides (Kato et al. 2018):

- Files are `{synset}_{split}_images.npz`, uint8 [N, 24, 4, 64, 64], and `{synset}_{split}_voxels.npz`, bool
  [N, 32, 32, 32]; each holds the single array 'arr_0'.
- Colours are stored inverted: 255 * (1 - composite over white), so the background is black. Channel 3 is the alpha.
- View k has azimuth -15 k degrees, elevation 30 degrees, distance 2.732, half field of view 15 degrees.
- Voxel axes (1, 2, 3) are (y, x, -z) of the object frame, and the box [-0.5, 0.5] fills cells 0.5 .. 31.5 of the grid.
- The object frame is that of the renderer, which is LEFT-handed (x right, y up, z away from the camera of view 0),
  while mesh files are right-handed. `mesh_to_object` is the one place where that reflection is made.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

import nmr
from learn3d.data.batch import Batch

NUM_VIEWS = 24
IMAGE_SIZE = 64
VOXEL_SIZE = 32
DISTANCE = 2.732
ELEVATION_DEG = 30.0
AZIMUTH_STEP_DEG = -15.0
HALF_FOV_DEG = 15.0
SPLITS = ("train", "val", "test")

SYNSETS = {
    "airplane": "02691156",
    "bench": "02828884",
    "cabinet": "02933112",
    "car": "02958343",
    "chair": "03001627",
    "display": "03211117",
    "lamp": "03636649",
    "loudspeaker": "03691459",
    "rifle": "04090263",
    "sofa": "04256520",
    "table": "04379243",
    "telephone": "04401088",
    "vessel": "04530566",
}


def synset_of(category: str) -> str:
    """File name prefix of a category: the ShapeNet synset id of Kato's 13 names; any other name is its own prefix.

    Raises ValueError for an empty name or one that cannot be part of a file name.
    """
    if not isinstance(category, str) or not category or set(category) & set('/\\:*?"<>|\0') or category.startswith("."):
        raise ValueError(f"category must be a plain name such as 'chair' or a synset id, got {category!r}")
    return SYNSETS.get(category, category)


def split_paths(folder: Path | str, category: str, split: str) -> tuple[Path, Path]:
    """Paths of the images file and of the voxels file of one category and split."""
    stem = f"{synset_of(category)}_{split}"
    return Path(folder) / f"{stem}_images.npz", Path(folder) / f"{stem}_voxels.npz"


def mesh_to_object(up: str = "y", front: str = "x") -> np.ndarray:
    """Matrix [3, 3] that takes right-handed mesh coordinates to the object frame: object = matrix @ mesh.

    `up` is the mesh axis that points up, `front` the one that faces the camera of view 0 ("x", "-x", "y" ...). A viewer
    in front of the mesh looks along -front and has (-front) x up = up x front on the right, so the rows are
    [up x front, up, -front]. The determinant is -1: mesh files are right-handed, the renderer's frame is left-handed.
    The default, (x, y, z) -> (-z, y, -x), is what Kato's rendering of ShapeNet amounts to.
    """
    axes = {s + a: np.float64(-1 if s else 1) * row for s in ("", "-") for a, row in zip("xyz", np.eye(3), strict=True)}
    if up not in axes or front not in axes:
        raise ValueError(f"up and front must be one of {sorted(axes)}, got up={up!r}, front={front!r}")
    if up[-1] == front[-1]:
        raise ValueError(f"up and front must be two different axes, got up={up!r}, front={front!r}")
    return np.stack([np.cross(axes[up], axes[front]), axes[up], -axes[front]]) + 0.0


def view_cameras(view_ids: torch.Tensor) -> nmr.LookAt:
    """Cameras of Kato's views, one per entry of `view_ids` (int64 [B] in 0 .. 23)."""
    azimuth_deg = AZIMUTH_STEP_DEG * torch.as_tensor(view_ids).to(torch.float32)
    return nmr.LookAt.from_angles(DISTANCE, ELEVATION_DEG, azimuth_deg, half_fov_deg=HALF_FOV_DEG)


def voxelize(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Occupancy bool [B, 32, 32, 32] of meshes in the object frame, in Kato's axes: comparable with the stored voxels.

    vertices float [B, V, 3] or [V, 3] within [-0.5, 0.5]; faces integer [F, 3] or [B, F, 3].
    """
    scale = (VOXEL_SIZE - 1) / VOXEL_SIZE
    return to_kato_axes(nmr.voxelize(vertices * scale + 0.5, faces, size=VOXEL_SIZE))


def to_kato_axes(grid: torch.Tensor) -> torch.Tensor:
    """Grids [B, s, s, s] with axes (x, y, z) of the object frame, in the axes (y, x, -z) of the stored voxels."""
    return grid.transpose(1, 2).flip(3)


@dataclass(frozen=True, eq=False)
class KatoDataset:
    """One category and split of Kato's data, in memory. Sample `object * 24 + view` is one view of one object."""

    images: np.ndarray  # uint8 [N, 24, 4, 64, 64], as stored
    voxels: np.ndarray  # bool [N, 32, 32, 32], as stored
    category: str
    split: str

    @classmethod
    def load(cls, folder: Path | str, category: str, split: str) -> KatoDataset:
        """Read and check one category (name or synset id) and split ("train", "val" or "test") of a folder.

        Raises FileNotFoundError where a file is missing (the message lists what the folder holds) and ValueError where
        a file is no such npz, or its array has another shape or dtype, or the two files disagree on the object count.
        """
        if split not in SPLITS:
            raise ValueError(f"split must be one of {', '.join(SPLITS)}; got {split!r}")
        folder = Path(folder)
        paths = split_paths(folder, category, split)
        for path in paths:
            if not path.is_file():
                raise FileNotFoundError(_what_is_there(folder, category, split, path))
        images = _read_array(paths[0], np.uint8, (NUM_VIEWS, 4, IMAGE_SIZE, IMAGE_SIZE), "images")
        voxels = _read_array(paths[1], np.bool_, (VOXEL_SIZE,) * 3, "voxels")
        if len(images) != len(voxels):
            raise ValueError(
                f"{paths[0].name} holds {len(images)} objects but {paths[1].name} holds {len(voxels)}; "
                "the two files must come from the same data set: fetch or make both again"
            )
        if len(images) == 0:
            raise ValueError(f"{paths[0]} holds no object; make the data set with more meshes or another split")
        return cls(images, voxels, category, split)

    @property
    def num_objects(self) -> int:
        return len(self.images)

    @property
    def num_views(self) -> int:
        return NUM_VIEWS

    def __len__(self) -> int:
        return self.num_objects * self.num_views

    def batch(self, indices: torch.Tensor) -> Batch:
        """The samples `indices` (integer [B], each object * 24 + view) as one Batch on the CPU."""
        indices = torch.as_tensor(indices)
        if indices.ndim != 1 or indices.is_floating_point() or indices.dtype == torch.bool:
            raise TypeError(f"indices must be an integer tensor [B], got {indices.dtype} {list(indices.shape)}")
        indices = indices.to(torch.int64)
        if len(indices) and (indices.min() < 0 or indices.max() >= len(self)):
            raise ValueError(
                f"indices must lie in 0 .. {len(self) - 1} ({self.num_objects} objects x {self.num_views} views), "
                f"got {int(indices.min())} .. {int(indices.max())}"
            )
        object_ids, view_ids = indices // self.num_views, indices % self.num_views
        images = torch.from_numpy(self.images[object_ids.numpy(), view_ids.numpy()])
        return Batch(
            images=images,
            masks=images[:, 3].to(torch.float32) / 255,
            cameras=self.cameras(view_ids),
            view_ids=view_ids,
            object_ids=object_ids,
            voxels=torch.from_numpy(self.voxels[object_ids.numpy()]),
        )

    def cameras(self, view_ids: torch.Tensor) -> nmr.LookAt:
        """Cameras of the views `view_ids` (int64 [B]); see `view_cameras`."""
        return view_cameras(view_ids)

    def voxelize(self, vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
        """Occupancy bool [B, 32, 32, 32] of predictions in the data set's voxel convention; see `voxelize`."""
        return voxelize(vertices, faces)


def _read_array(path: Path, dtype: type, shape: tuple[int, ...], what: str) -> np.ndarray:
    """The array 'arr_0' of an npz file, checked: `dtype` and [N, *shape]."""
    wanted = f"{np.dtype(dtype)} [N, {', '.join(map(str, shape))}] under the key 'arr_0'"
    try:
        archive = np.load(path, allow_pickle=False)
        if isinstance(archive, np.ndarray):
            raise ValueError("it is a single npy array")
        with archive:
            keys = archive.files
            array = archive["arr_0"] if "arr_0" in keys else None
    except (OSError, EOFError, ValueError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        raise ValueError(
            f"cannot read the {what} file {path}: {error}; it must be an npz file with {wanted} "
            "and no pickled objects. Perhaps the download or copy was cut short: fetch it again"
        ) from error
    if array is None:
        raise ValueError(f"{path} holds the keys {keys}; the {what} file must hold {wanted}")
    if array.dtype != dtype or array.ndim != len(shape) + 1 or array.shape[1:] != shape:
        raise ValueError(f"the {what} file {path} must hold {wanted}, got {array.dtype} {list(array.shape)}")
    return array


def _what_is_there(folder: Path, category: str, split: str, missing: Path) -> str:
    """Message for a missing file: what was wanted, what the folder holds, what to do."""
    wanted = f"no {missing.name} ({category}, {split}) in {folder}"
    if not folder.is_dir():
        return f"{wanted}: there is no such folder; give the one that holds the npz files, or make it (make_dataset)"
    names = {synset: name for name, synset in SYNSETS.items()}
    found = []
    for path in sorted(folder.glob("*_images.npz")):
        prefix, _, found_split = path.name.removesuffix("_images.npz").rpartition("_")
        found.append(f"{names.get(prefix, prefix)} {found_split}")
    if found:
        return f"{wanted}; the folder holds: {', '.join(found)}. Choose one of these, or make the split (make_dataset)"
    return f"{wanted}; the folder holds no '*_images.npz' at all. Give another folder, or make one (make_dataset)"
