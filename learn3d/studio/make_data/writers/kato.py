"""Writes Kato's renderings, in his files or in shards, and shards of views from all sides."""

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

import nmr
from learn3d.data.conventions import LAYOUTS, SPLITS
from learn3d.data.dataset import ViewDataset, depth_levels
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers import around, kato
from learn3d.studio.make_data.writers.writer import RenderedObject, Writer, random_views


def _write_kato(objects: Iterable[RenderedObject], category: str, folder: Path, _: Path) -> None:
    """Write `{synset}_{split}_images.npz` and `..._voxels.npz`; all objects are in memory."""
    arrays: dict[Path, list[np.ndarray]] = {}
    for item in objects:
        paths = kato.split_paths(folder, category, item.split)
        for path, array in zip(paths, (_images(item), item.voxels), strict=True):
            arrays.setdefault(path, []).append(array)
    for path, kept in arrays.items():
        whole = np.empty((len(kept), *kept[0].shape), kept[0].dtype)
        for index in reversed(range(len(kept))):  # all images are in memory once, not twice
            whole[index] = kept.pop()
        np.savez_compressed(path, whole)


def _images(item: RenderedObject) -> np.ndarray:
    """Images of an object, uint8 [n, 4, 64, 64]: 255 - composite over white, and alpha."""
    return np.concatenate([255 - item.rgb, item.alpha[..., None]], axis=-1).transpose(0, 3, 1, 2)


def _join_kato(objects: Sequence[RenderedObject], category: str, split: str) -> ViewDataset:
    images = np.array([_images(item) for item in objects], np.uint8).reshape(-1, 24, 4, 64, 64)
    dataset = kato.from_arrays(images, _voxels(objects), category, split)
    return dataclasses.replace(dataset, object_names=tuple(item.name for item in objects))


def _voxels(objects: Sequence[RenderedObject]) -> np.ndarray:
    return np.array([item.voxels for item in objects], bool).reshape(-1, 32, 32, 32)


KATO_WRITER = Writer(
    paths=lambda category: tuple(
        path.name for split in SPLITS for path in kato.split_paths("", category, split)
    ),
    write=_write_kato,
    join=_join_kato,
    fixed=("views",),
)


def _join_around(objects: Sequence[RenderedObject], category: str, split: str) -> ViewDataset:
    depth = []
    for item in objects:
        seen = nmr.render_depth(
            item.vertices, item.faces, item.poses.cameras(), image_size=64, anti_aliasing=False
        )
        depth.append(depth_levels(seen, item.poses).numpy())
    poses = LookAtPoses.join(
        [item.poses for item in objects] or [LookAtPoses(*np.zeros((4, 0), np.float32))]
    )
    return ViewDataset(
        **LAYOUTS["around"].about(category, split),
        images=np.array([_images(item) for item in objects], np.uint8).reshape(-1, 4, 64, 64),
        depth=np.array(depth, np.uint8).reshape(-1, 64, 64),
        poses=poses,
        view_ids=around.BINS.ids(poses).numpy(),
        view_names=tuple(around.BINS.names()),
        object_ids=np.repeat(np.arange(len(objects)), len(poses) // max(1, len(objects))),
        object_names=tuple(item.name for item in objects),
        voxels=_voxels(objects),
    )


#: See `learn3d.data.readers.around`.
AROUND_WRITER = Writer(
    join=_join_around,
    default_views=12,
    views=functools.partial(random_views, (-10.0, 60.0), (7.0, 20.0)),
    natural=True,
)
