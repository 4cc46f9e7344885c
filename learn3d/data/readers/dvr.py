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
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from learn3d.data.conventions import KATO
from learn3d.data.dataset import SPLITS, ViewDataset
from learn3d.data.readers import kato
from learn3d.data.readers.renderings import (
    category_folder,
    check_ids,
    check_split,
    map_objects,
    read_image,
    read_npz,
    split_alpha,
    warn_if_empty,
    warn_of_repeats,
)
from learn3d.files import limits
from learn3d.files.findings import AGAIN, DamagedFile, Findings, MissingFile, Problem
from learn3d.files.reading import read_text

POINTS = 10_000  # kept of each object's point cloud, which holds 100,000
_EYE_TOLERANCE = 0.01  # units of the object frame
_LEAST_COSINE = 0.9995


class _Object(NamedTuple):
    images: np.ndarray | None  # uint8 [24, 4, 64, 64]
    points: np.ndarray | None  # float32 [P, 3], None where the file is absent


def load(folder: Path | str, category: str, split: str, *, points: int = POINTS, progress: bool = False) -> ViewDataset:
    """Read one category (name or synset id) and split of a folder.

    points: keep at most so many surface points of each object (0: none; the first ones, which are a random sample).
    Raises FileNotFoundError or ValueError naming the first file that is missing or not as described above.
    """
    folder, ids = Path(folder), object_ids(folder, category, split)
    root = category_folder(folder, category)
    images = np.empty((len(ids) * kato.NUM_VIEWS, 4, kato.IMAGE_SIZE, kato.IMAGE_SIZE), np.uint8)
    clouds = []
    read = map_objects(lambda name: _read(root / name, points, Findings(strict=True)), ids, category, progress)
    for i, item in enumerate(read):
        images[i * kato.NUM_VIEWS : (i + 1) * kato.NUM_VIEWS] = item.images
        clouds.append(item.points)
    view_ids = np.tile(np.arange(kato.NUM_VIEWS), len(ids))
    return ViewDataset(
        category=category,
        split=split,
        images=images,
        poses=kato.view_poses(torch.from_numpy(view_ids)),
        view_ids=view_ids,
        view_names=kato.VIEW_NAMES,
        object_ids=np.repeat(np.arange(len(ids)), kato.NUM_VIEWS),
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
    root, path = category_folder(folder, category), _list_path(folder, category, split)
    others = {s: _read_list(_list_path(folder, category, s)) for s in _splits(folder, category) if s != split}
    warn_of_repeats(findings, path, f"{category} {split}", ids, others)
    yield from findings.problems

    def examine(name: str) -> list[Problem]:
        findings = Findings()
        _read(root / name, POINTS, findings)
        return findings.problems

    for found in map_objects(examine, ids, f"{category} {split}", progress):
        yield from found


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
        raise DamagedFile(path, f"names no object; expected one id per line. {AGAIN}")
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


def _read(root: Path, points: int, findings: Findings) -> _Object:
    """One object; None for the parts that findings tell of."""
    if findings.attempt(_check_folder, root) is None:
        return _Object(None, None)
    views = [_read_view(root, k, findings) for k in range(kato.NUM_VIEWS)]
    to_object = findings.attempt(_fit_world, root / "cameras.npz")
    cloud, path = None, root / "pointcloud.npz"
    if not path.exists():
        findings.warn(path, "is missing: without it the set has no ground-truth shape")
    elif points and to_object is not None:
        cloud = findings.attempt(_read_points, path, points, to_object)
    return _Object(np.stack(views) if all(view is not None for view in views) else None, cloud)


def _check_folder(root: Path) -> Path:
    if not root.is_dir():
        raise MissingFile(root, f"is missing; expected the folder of an object that a list names. {AGAIN}")
    return root


def _read_view(root: Path, k: int, findings: Findings) -> np.ndarray | None:
    """View k in Kato's form: inverted colours over black and the mask, uint8 [4, 64, 64]."""
    color, mask = (findings.attempt(_read_64, root / kind / f"{k:04d}.png") for kind in ("image", "mask"))
    if mask is not None:
        warn_if_empty(findings, root / "mask" / f"{k:04d}.png", mask[..., 0])
    if color is None or mask is None:
        return None
    return np.concatenate([255 - color.transpose(2, 0, 1), mask[None, :, :, 0]])


def _read_64(path: Path) -> np.ndarray:
    image = read_image(path)
    if image.size != (kato.IMAGE_SIZE, kato.IMAGE_SIZE) or image.mode.startswith(("I", "F")):
        raise DamagedFile(
            path, f"is {image.width}x{image.height} pixels of the format {image.mode}; expected 64x64 of 8 bits"
        )
    return split_alpha(image)[0]


def _fit_world(path: Path) -> np.ndarray:
    """Orthogonal [3, 3] that takes the world of cameras.npz to the object frame; DamagedFile where it does not fit."""
    wanted = "world_mat_0 .. world_mat_23, 4x4, from the world to Kato's 24 cameras"
    names = [f"world_mat_{k}" for k in range(kato.NUM_VIEWS)]
    arrays = read_npz(path, names, wanted)
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
    true_eyes = kato.view_poses(torch.arange(kato.NUM_VIEWS)).features().double().numpy()
    u, _, v = np.linalg.svd(true_eyes.T @ eyes)
    to_object = u @ v
    off = np.linalg.norm(eyes @ to_object.T - true_eyes, axis=1)
    if off.max() > _EYE_TOLERANCE:
        k = int(off.argmax())
        raise DamagedFile(
            path,
            f"the camera of view {k} stands {off[k]:.3g} away from where Kato's does (distance 2.732, elevation 30, "
            f"azimuth {kato.AZIMUTH_STEP_DEG:g} degrees per view); this is another set of views, which the layout "
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


def _read_points(path: Path, count: int, to_object: np.ndarray) -> np.ndarray:
    """The first `count` points in the object frame, float32 [P, 3]."""
    wanted = "the array 'points' [P, 3]: finite, within the unit cube"
    points = read_npz(path, ["points"], wanted).get("points")
    if points is None or points.ndim != 2 or points.shape[1] != 3 or not len(points):
        shape = "no such array" if points is None else f"the shape {list(points.shape)}"
        raise DamagedFile(path, f"has {shape}; expected {wanted}")
    points = points[:count].astype(np.float64)
    if not np.abs(points).max() < 1:
        raise DamagedFile(path, f"has coordinates up to {np.abs(points).max():.3g}; expected {wanted}")
    return (points @ to_object.T).astype(np.float32)


def _equally_many(clouds: list[np.ndarray | None]) -> np.ndarray | None:
    """Point clouds [N, P, 3] with P of the smallest one; None where an object has none."""
    if not clouds or any(cloud is None for cloud in clouds):
        return None
    least = min(map(len, clouds))
    return np.stack([cloud[:least] for cloud in clouds])
