"""The NMR_Dataset of DVR (Niemeyer et al. 2020): Kato's renderings as one folder per object.

- `{synset}/{id}/image/0000.png` .. `0023.png`, 64x64, objects on white; `{synset}/{id}/mask/0000.png` ..: the alpha.
- `{synset}/{id}/cameras.npz`: `world_mat_0` .. `world_mat_23`, 4x4 (or 3x4), world to camera with x right and the
  object in front. The focal length is that of Kato's cameras; `camera_mat_k` is not read.
- `{synset}/{id}/pointcloud.npz`: `points` [P, 3] on the surface in the world of the cameras. May be absent.
- `{synset}/softras_{train,val,test}.lst`, or `{train,val,test}.lst`: one id per line.

The data set that comes out has the content of Kato's npz files: colours inverted over black, views 0 .. 23, Kato's
object frame. Its cameras are Kato's to the last bit. Those of the file only have to agree with them: the rotation (and
reflection) between the file's world and Kato's object frame is found by fitting the 24 eyes, and then each camera must
stand where Kato's does, look at the origin and have the same right side. So no axes of the file's world are assumed,
and a file whose views have another order, direction or distance is refused. The points go through the same fit.

There is no voxel ground truth here, so `voxels` is None: measure by the points (Chamfer distance, F-score). Kato's own
voxels file is not taken from beside it, because nothing says that its objects stand in the order of the lists.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from learn3d.data.conventions import AZIMUTH_STEP_DEG, IMAGE_SIZE, KATO, NUM_VIEWS, view_poses
from learn3d.data.dataset import SPLITS, ViewDataset
from learn3d.data.readers import kato
from learn3d.data.readers.properties import LayoutProperties
from learn3d.data.readers.renderings import (
    ObjectReader,
    ReadObject,
    category_folder,
    check_ids,
    check_split,
    join_images,
    warn_if_empty,
    warn_of_repeats,
)
from learn3d.files import limits, npz, renderings
from learn3d.files.findings import FETCH_AGAIN, DamagedFile, Findings, MissingFile, Problem
from learn3d.files.reading import read_text
from learn3d.files.sandbox import Call

PROPERTIES = LayoutProperties(voxels=False, convention=KATO, inverted=True, options=("progress",))
POINTS = 10_000  # kept of each object's point cloud, which holds 100,000
_EYE_TOLERANCE = 0.01  # units of the object frame
_LEAST_COSINE = 0.9995
_MATRICES = [f"world_mat_{k}" for k in range(NUM_VIEWS)]
_CAMERAS = "an npz file with world_mat_0 .. world_mat_23, 4x4, from the world to Kato's 24 cameras"
_CLOUD = "an npz file with the array 'points' [P, 3]: finite, within the unit cube"


def load(folder: Path | str, category: str, split: str, *, points: int = POINTS, progress: bool = False) -> ViewDataset:
    """Read one category (name or synset id) and split of a folder.

    points: keep at most so many surface points of each object (0: none; the first ones, which are a random sample).
    Raises FileNotFoundError or ValueError naming the first file that is missing or not as described above.
    """
    folder, ids = Path(folder), object_ids(folder, category, split)
    objects = _Reader(category_folder(folder, category), points).read(ids, category, progress)
    images, _, _, clouds = join_images(objects, len(ids), NUM_VIEWS, IMAGE_SIZE)
    view_ids = np.tile(np.arange(NUM_VIEWS), len(ids))
    return ViewDataset(
        category=category,
        split=split,
        images=images,
        poses=view_poses(torch.from_numpy(view_ids)),
        view_ids=view_ids,
        view_names=kato.VIEW_NAMES,
        object_ids=np.repeat(np.arange(len(ids)), NUM_VIEWS),
        object_names=tuple(ids),
        voxels=None,
        convention=KATO,
        points=_equally_many(clouds),
    )


def problems(folder: Path | str, category: str, split: str, *, progress: bool = False) -> Iterator[Problem]:
    """Everything that is wrong with one category and split."""
    folder, findings = Path(folder), Findings()
    ids = findings.attempt(object_ids, folder, category, split)
    if ids is None:
        yield from findings.problems
        return
    path = _list_path(folder, category, split)
    others = {s: _read_list(_list_path(folder, category, s)) for s in _splits(folder, category) if s != split}
    warn_of_repeats(findings, path, f"{category} {split}", ids, others)
    yield from findings.problems
    yield from _Reader(category_folder(folder, category), POINTS).problems(ids, f"{category} {split}", progress)


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories (synset ids) of a folder and the splits of each."""
    roots = sorted(path for path in Path(folder).iterdir() if path.is_dir())
    return {root.name: splits for root in roots if (splits := _splits(Path(folder), root.name))}


def count(folder: Path | str, category: str, split: str) -> int:
    """How many objects the list of a split names."""
    return len(object_ids(folder, category, split))


def object_ids(folder: Path | str, category: str, split: str) -> list[str]:
    """The ids that the list of a split names, in its order."""
    check_split(split)
    path = _list_path(Path(folder), category, split)
    if not path.is_file():
        found = ", ".join(_splits(Path(folder), category)) or "none"
        raise MissingFile(path, f"is missing; expected a list of object ids, one per line. Splits here: {found}")
    if not (ids := _read_list(path)):
        raise DamagedFile(path, f"names no object; expected one id per line. {FETCH_AGAIN}")
    check_ids(path, ids)
    return ids


def _list_path(folder: Path, category: str, split: str) -> Path:
    root = category_folder(folder, category)
    plain = root / f"{split}.lst"
    softras = root / f"softras_{split}.lst"
    return plain if plain.is_file() and not softras.is_file() else softras


def _read_list(path: Path) -> list[str]:
    return read_text(path, limits.TEXT_BYTES, "a list of object ids", errors="replace").split()


def _splits(folder: Path, category: str) -> tuple[str, ...]:
    return tuple(split for split in SPLITS if _list_path(folder, category, split).is_file())


@dataclass(frozen=True)
class _Reader(ObjectReader):
    root: Path
    points: int

    def calls(self, name: str) -> list[Call]:
        root = self.root / name
        calls = [Call(renderings.check_folder, root, (f"the folder of an object that a list names. {FETCH_AGAIN}",))]
        if root.is_dir():
            paths = [path for view in _view_paths(root) for path in view]
            calls += [Call(renderings.read_exactly, path, (IMAGE_SIZE,), "a rendering") for path in paths]
            arrays = (_MATRICES, limits.OBJECT_BYTES)
            calls.append(Call(npz.read_those_there, root / "cameras.npz", arrays, _CAMERAS))
            if self.points and (root / "pointcloud.npz").exists():
                points = (("points",), limits.OBJECT_BYTES)
                calls.append(Call(npz.read_those_there, root / "pointcloud.npz", points, _CLOUD))
        return calls

    def build(self, name: str, found: list[Any], findings: Findings) -> ReadObject:
        root = self.root / name
        if len(found) == 1:
            findings.take(found[0])
            return ReadObject([], None, None)
        pairs = zip(found[1 : 2 * NUM_VIEWS : 2], found[2 : 2 * NUM_VIEWS + 1 : 2], strict=True)
        views = [_view(paths, pair, findings) for paths, pair in zip(_view_paths(root), pairs, strict=True)]
        arrays, *rest = map(findings.take, found[2 * NUM_VIEWS + 1 :])
        to_object = None if arrays is None else findings.attempt(_fit_world, root / "cameras.npz", arrays)
        points, path = None, root / "pointcloud.npz"
        if not path.exists():
            findings.warn(path, "is missing: without it the set has no ground-truth shape")
        elif rest and rest[0] is not None and to_object is not None:
            points = findings.attempt(_points, path, rest[0], self.points, to_object)
        return ReadObject(views, None, points)


def _view_paths(root: Path) -> list[tuple[Path, Path]]:
    return [(root / "image" / f"{k:04d}.png", root / "mask" / f"{k:04d}.png") for k in range(NUM_VIEWS)]


def _view(paths: tuple[Path, Path], pair: tuple[Any, Any], findings: Findings) -> tuple[np.ndarray, np.ndarray] | None:
    """A view in Kato's form, inverted colours over black and the mask, of the results of its two files."""
    color, mask = map(findings.take, pair)
    if mask is not None:
        warn_if_empty(findings, paths[1], mask.max())
    if color is None or mask is None:
        return None
    image = np.concatenate([255 - color.transpose(2, 0, 1), mask[None, :, :, 0]])
    return image, image[3]


def _fit_world(path: Path, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Orthogonal [3, 3] that takes the world of cameras.npz to the object frame; DamagedFile where it does not fit."""
    wanted, names = _CAMERAS, _MATRICES
    if missing := [name for name in names if name not in arrays]:
        raise DamagedFile(path, f"lacks {missing[0]} ({len(missing)} of {len(names)} matrices); expected {wanted}")
    if wrong := [name for name in names if arrays[name].shape not in ((4, 4), (3, 4))]:
        raise DamagedFile(path, f"{wrong[0]} has the shape {list(arrays[wrong[0]].shape)}; expected {wanted}")
    matrices = np.stack([arrays[name][:3].astype(np.float64) for name in names])
    if not np.isfinite(matrices).all():
        raise DamagedFile(path, f"has numbers that are not finite; expected {wanted}")
    rotations = matrices[:, :, :3]
    if (skew := np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2))).max() > 1e-3:
        raise DamagedFile(path, f"the left 3x3 part of {names[skew.argmax()]} is no rotation; expected {wanted}")
    eyes = -np.einsum("kij,ki->kj", rotations, matrices[:, :, 3])
    true_eyes = view_poses(torch.arange(NUM_VIEWS)).features().double().numpy()
    u, _, v = np.linalg.svd(true_eyes.T @ eyes)
    to_object = u @ v
    off = np.linalg.norm(eyes @ to_object.T - true_eyes, axis=1)
    if off.max() > _EYE_TOLERANCE:
        k = int(off.argmax())
        raise DamagedFile(
            path,
            f"the camera of view {k} stands {off[k]:.3g} away from where Kato's does (distance 2.732, elevation 30, "
            f"azimuth {AZIMUTH_STEP_DEG:g} degrees per view); this is another set of views, which the layout "
            "'dvr' has no place for",
        )
    forward = -true_eyes / np.linalg.norm(true_eyes, axis=1, keepdims=True)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    for row, axis, fault in ((2, forward, "does not look at the object"), (0, right, "is rolled or mirrored")):
        cosine = (rotations[:, row] @ to_object.T * axis).sum(1)
        if cosine.min() < _LEAST_COSINE:
            raise DamagedFile(path, f"the camera of view {cosine.argmin()} {fault}, unlike Kato's; expected {wanted}")
    return to_object


def _points(path: Path, arrays: dict[str, np.ndarray], count: int, to_object: np.ndarray) -> np.ndarray:
    """The first `count` points in the object frame, float32 [P, 3]."""
    points = arrays.get("points")
    if points is None or points.ndim != 2 or points.shape[1] != 3 or not len(points):
        shape = "no such array" if points is None else f"the shape {list(points.shape)}"
        raise DamagedFile(path, f"has {shape}; expected {_CLOUD}")
    points = points[:count].astype(np.float64)
    if not np.abs(points).max() < 1:
        raise DamagedFile(path, f"has coordinates up to {np.abs(points).max():.3g}; expected {_CLOUD}")
    return (points @ to_object.T).astype(np.float32)


def _equally_many(clouds: list[np.ndarray | None]) -> np.ndarray | None:
    """Point clouds [N, P, 3] with P of the smallest one; None where an object has none."""
    if not clouds or any(cloud is None for cloud in clouds):
        return None
    least = min(map(len, clouds))
    return np.stack([cloud[:least] for cloud in clouds])
