"""Writes Kato's renderings: in his files and in those of DVR's copy; also shards of views from all sides."""

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch

import nmr
from learn3d.data import conventions
from learn3d.data.categories import SPLITS, synset_of
from learn3d.data.dataset import ViewDataset, depth_levels
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers import around, kato
from learn3d.studio.make_data.writers.writer import WORLD_FROM_OBJECT, RenderedObject, Writer, random_views, write_png

NUM_POINTS = 10_000


def _write_kato(objects: Iterable[RenderedObject], category: str, folder: Path, _: Path) -> None:
    """Write `{synset}_{split}_images.npz` and `{synset}_{split}_voxels.npz`; all objects are in memory until then."""
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
    """Images of an object, uint8 [n, 4, 64, 64]: inverted colours (255 - composite over white) and alpha."""
    return np.concatenate([255 - item.rgb, item.alpha[..., None]], axis=-1).transpose(0, 3, 1, 2)


def _join_kato(objects: Sequence[RenderedObject], category: str, split: str) -> ViewDataset:
    images = np.array([_images(item) for item in objects], np.uint8).reshape(-1, 24, 4, 64, 64)
    dataset = kato.from_arrays(images, _voxels(objects), category, split)
    return dataclasses.replace(dataset, object_names=tuple(item.name for item in objects))


def _voxels(objects: Sequence[RenderedObject]) -> np.ndarray:
    return np.array([item.voxels for item in objects], bool).reshape(-1, 32, 32, 32)


KATO = Writer(
    paths=lambda category: tuple(path.name for split in SPLITS for path in kato.split_paths("", category, split)),
    write=_write_kato,
    join=_join_kato,
    fixed=("views",),
)


def _write_dvr(objects: Iterable[RenderedObject], category: str, root: Path, _: Path) -> None:
    """Write a folder for each object, and the lists `softras_{split}.lst`.

    World coordinates are ShapeNet's: right-handed, y up, x towards the camera of view 0, longest side 1. The points of
    `pointcloud.npz` are world coordinates. `world_mat_k` [4, 4], whose rotation has determinant 1, takes them to camera
    axes (x right, y down, z away). `camera_mat_k` = diag(f, f, 1, 1), f = 1 / tan 15 deg, takes these to [-1, 1] across
    the image.
    """
    root /= synset_of(category)
    focal = 1 / np.tan(np.deg2rad(conventions.HALF_FOV_DEG))
    camera, turn = np.diag([focal, focal, 1.0, 1.0]), WORLD_FROM_OBJECT.T.astype(np.float32)
    for item in objects:
        folder, cameras = root / item.name, {}
        for k, (rgb, alpha, matrix) in enumerate(zip(item.rgb, item.alpha, item.world_to_camera(), strict=True)):
            write_png(folder / "image" / f"{k:04d}.png", rgb)
            write_png(folder / "mask" / f"{k:04d}.png", alpha)
            world = np.vstack([matrix, [0, 0, 0, 1]])
            cameras |= {f"world_mat_{k}": world, f"world_mat_inv_{k}": np.linalg.inv(world)}
            cameras |= {f"camera_mat_{k}": camera, f"camera_mat_inv_{k}": np.linalg.inv(camera)}
        np.savez(folder / "cameras.npz", **cameras)
        generator = torch.Generator().manual_seed(int(item.rng.integers(2**62)))
        points, normals, *_ = nmr.metrics.sample_surface(item.vertices, item.faces, NUM_POINTS, generator)
        np.savez(folder / "pointcloud.npz", points=points.numpy() @ turn, normals=normals.numpy() @ turn)
        with (root / f"softras_{item.split}.lst").open("a") as listing:
            listing.write(f"{item.name}\n")


DVR = Writer(paths=lambda category: (synset_of(category),), write=_write_dvr, fixed=("views",))


def _join_around(objects: Sequence[RenderedObject], category: str, split: str) -> ViewDataset:
    depth = []
    for item in objects:
        seen = nmr.render_depth(item.vertices, item.faces, item.poses.cameras(), image_size=64, anti_aliasing=False)
        depth.append(depth_levels(seen, item.poses).numpy())
    poses = LookAtPoses.join([item.poses for item in objects] or [LookAtPoses(*np.zeros((4, 0), np.float32))])
    return ViewDataset(
        **around.PROPERTIES.about(category, split),
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
AROUND = Writer(
    join=_join_around, default_views=12, views=functools.partial(random_views, (-10.0, 60.0), (7.0, 20.0)), natural=True
)
