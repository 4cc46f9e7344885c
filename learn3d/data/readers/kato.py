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

import contextlib
import math
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

import nmr
from learn3d.data.conventions import KATO, VOXEL_SIZE
from learn3d.data.dataset import SPLITS, ViewDataset
from learn3d.data.poses import LookAtPoses
from learn3d.files import npz
from learn3d.files.findings import AGAIN, DamagedFile, Problem

NUM_VIEWS = 24
IMAGE_SIZE = 64
DISTANCE = 2.732
ELEVATION_DEG = 30.0
AZIMUTH_STEP_DEG = -15.0
HALF_FOV_DEG = 15.0
VIEW_NAMES = tuple(f"azimuth {AZIMUTH_STEP_DEG * view:g}°" for view in range(NUM_VIEWS))

_KINDS = ("images", "voxels")
_KEY = "arr_0"
_ARRAYS = {  # dtype and shape of one object
    "images": (np.dtype(np.uint8), (NUM_VIEWS, 4, IMAGE_SIZE, IMAGE_SIZE)),
    "voxels": (np.dtype(np.bool_), (VOXEL_SIZE,) * 3),
}

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
    if not category.isprintable():
        raise ValueError(f"category must be a plain name, without control characters, got {category!r}")
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


def view_poses(view_ids: torch.Tensor) -> LookAtPoses:
    """Poses of Kato's views, one per entry of `view_ids` (int64 [B] in 0 .. 23)."""
    azimuth_deg = AZIMUTH_STEP_DEG * torch.as_tensor(view_ids).to(torch.float32)
    return LookAtPoses(azimuth_deg, ELEVATION_DEG, DISTANCE, HALF_FOV_DEG)


def view_cameras(view_ids: torch.Tensor) -> nmr.LookAt:
    """Cameras of Kato's views, one per entry of `view_ids` (int64 [B] in 0 .. 23)."""
    return view_poses(view_ids).cameras()


def voxelize(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Occupancy bool [B, 32, 32, 32] of meshes in the object frame, in Kato's axes: comparable with the stored voxels.

    vertices float [B, V, 3] or [V, 3] within [-0.5, 0.5]; faces integer [F, 3] or [B, F, 3].
    """
    return KATO.voxelize(vertices, faces)


def load(folder: Path | str, category: str, split: str) -> ViewDataset:
    """Read and check one category (name or synset id) and split ("train", "val" or "test") of a folder.

    Sample `object * 24 + view` is one view of one object; the pose classes are the 24 views.
    Raises FileNotFoundError where a file is missing (the message lists what the folder holds) and ValueError where
    a file is no such npz, or its array has another shape or dtype, or the two files disagree on the object count.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {', '.join(SPLITS)}; got {split!r}")
    for path in split_paths(folder, category, split):
        _check_there(path, category, split)
    objects, grids = (_count(folder, category, split, kind) for kind in _KINDS)
    _check_counts(folder, category, split, objects, grids)
    images = _read(folder, category, split, "images")
    voxels = _read(folder, category, split, "voxels", objects=objects)  # mostly zeros: no expansion would be suspect
    return from_arrays(images, voxels, category, split)


def from_arrays(images: np.ndarray, voxels: np.ndarray, category: str, split: str) -> ViewDataset:
    """The data set of images uint8 [N, 24, 4, 64, 64] and voxels bool [N, 32, 32, 32], as the files hold them."""
    count = len(images)
    view_ids = np.tile(np.arange(NUM_VIEWS), count)
    return ViewDataset(
        category=category,
        split=split,
        images=images.reshape(count * NUM_VIEWS, 4, IMAGE_SIZE, IMAGE_SIZE),
        poses=view_poses(torch.from_numpy(view_ids)),
        view_ids=view_ids,
        view_names=VIEW_NAMES,
        object_ids=np.repeat(np.arange(count), NUM_VIEWS),
        object_names=tuple(f"{i:04d}" for i in range(count)),
        voxels=voxels,
        convention=KATO,
    )


def problems(folder: Path | str, category: str, split: str, *, progress: bool = False) -> Iterator[Problem]:
    """Everything that is wrong with the two files of one category and split."""
    arrays = {}
    for kind, path in zip(_KINDS, split_paths(folder, category, split), strict=True):
        try:
            objects = len(arrays["images"]) if "images" in arrays else None
            arrays[kind] = _read(folder, category, split, kind, objects=objects)
        except DamagedFile as error:
            yield Problem(str(path), error.message)
            continue
        except FileNotFoundError as error:
            yield Problem(str(path), str(error))
            continue
        whole = arrays[kind][:, :, 3].max((2, 3)) < 128 if kind == "images" else ~arrays[kind].any((1, 2, 3))
        for index in np.argwhere(whole).tolist():
            what = "the mask of object {}, view {}," if kind == "images" else "the grid of object {}"
            yield Problem(str(path), f"{what.format(*index)} is empty", "warning")
    if len(arrays) == len(_KINDS):
        try:
            _check_counts(folder, category, split, *map(len, arrays.values()))
        except DamagedFile as error:
            yield Problem(str(error.path), error.message)


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories (synset ids or prefixes) of a folder and the splits of each, by the names of its files."""
    found: dict[str, set[str]] = {}
    for kind in _KINDS:
        for path in Path(folder).glob(f"*_{kind}.npz"):
            prefix, _, split = path.name.removesuffix(f"_{kind}.npz").rpartition("_")
            if prefix and split in SPLITS:
                found.setdefault(prefix, set()).add(split)
    return {prefix: tuple(s for s in SPLITS if s in splits) for prefix, splits in sorted(found.items())}


def count(folder: Path | str, category: str, split: str) -> int:
    """How many objects a split holds, from the header of its voxels (or images) file alone; 0 where it has none."""
    for kind in reversed(_KINDS):
        with contextlib.suppress(OSError, ValueError):
            return _count(folder, category, split, kind)
    return 0


def _count(folder: Path | str, category: str, split: str, kind: str) -> int:
    """The number of objects that the header of the images or of the voxels file states."""
    with _open(folder, category, split, kind) as (archive, _):
        return npz.header(archive, _KEY).shape[0]


def _read(folder: Path | str, category: str, split: str, kind: str, *, objects: int | None = None) -> np.ndarray:
    """The array of the images or of the voxels file, of at most so many objects where it is known how many they are."""
    with _open(folder, category, split, kind) as (archive, size):
        return npz.read(archive, _KEY, max_bytes=None if objects is None else objects * size)


@contextlib.contextmanager
def _open(folder: Path | str, category: str, split: str, kind: str) -> Iterator[tuple[zipfile.ZipFile, int]]:
    """The images or the voxels file, whose header is right, and the bytes that an object takes in it."""
    path = split_paths(folder, category, split)[_KINDS.index(kind)]
    _check_there(path, category, split)
    dtype, shape = _ARRAYS[kind]
    wanted = f"{dtype} [N, {', '.join(map(str, shape))}] under the key '{_KEY}'"
    try:
        with npz.open_npz(path) as archive:
            if _KEY not in npz.keys(archive):
                keys = npz.keys(archive)[:8]
                raise DamagedFile(path, f"holds the keys {keys}; the {kind} file must hold {wanted}")
            head = npz.header(archive, _KEY)
            if not head.dtype.hasobject and (head.dtype != dtype or head.shape[1:] != shape or not head.shape):
                raise DamagedFile(path, f"the {kind} file must hold {wanted}, got {head}")
            yield archive, math.prod(shape) * dtype.itemsize
    except DamagedFile:
        raise
    except ValueError as error:
        raise DamagedFile(
            path,
            f"cannot read the {kind} file: {error}; it must be an npz file with {wanted} and no pickled objects. "
            f"{AGAIN}",
        ) from error


def _check_there(path: Path, category: str, split: str) -> None:
    if not path.is_file():
        raise FileNotFoundError(_what_is_there(category, split, path))


def _check_counts(folder: Path | str, category: str, split: str, images: int, voxels: int) -> None:
    paths = split_paths(folder, category, split)
    if images != voxels:
        raise DamagedFile(
            paths[0],
            f"holds {images} objects but {paths[1].name} holds {voxels}; "
            "the two files must come from the same data set: fetch or make both again",
        )
    if images == 0:
        raise DamagedFile(paths[0], "holds no object; make the data set with more meshes or another split")


def _what_is_there(category: str, split: str, missing: Path) -> str:
    """Message for a missing file: what was wanted, what the folder holds, what to do."""
    folder = missing.parent
    wanted = f"no {missing.name} ({category}, {split}) in {folder}"
    if not folder.is_dir():
        return f"{wanted}: there is no such folder; give the one that holds the npz files, or make it (make_dataset)"
    pair = split_paths(folder, category, split)
    for other, kind, lacking in zip(pair, _KINDS, reversed(_KINDS), strict=True):
        if other.is_file():
            return (
                f"{wanted}: the {kind} are there ({other.name}), but a split needs the {lacking}, too. Fetch or copy "
                "that file from where the other came from, or make both again (make_dataset --overwrite)"
            )
    names = {synset: name for name, synset in SYNSETS.items()}
    found = []
    for prefix, splits in contents(folder).items():
        whole = [s for s in splits if all(path.is_file() for path in split_paths(folder, prefix, s))]
        found += [f"{names.get(prefix, prefix)} {s}" for s in whole]
    if found:
        return f"{wanted}; the folder holds: {', '.join(found)}. Choose one of these, or make the split (make_dataset)"
    return (
        f"{wanted}; the folder holds no '*_images.npz' with its '*_voxels.npz' at all. Give another folder, or make "
        "one (make_dataset)"
    )
