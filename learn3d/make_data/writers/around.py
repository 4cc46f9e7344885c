"""Makes views of objects from all sides, with everyday colours and lights."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import nmr
from learn3d.data.dataset import ViewDataset, depth_levels
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers.around import BINS, PROPERTIES
from learn3d.make_data.writers.kato import KatoWriter
from learn3d.make_data.writers.writer import RenderedObject, Writer, distances, uniform
from learn3d.pictures.studio import studio_lights

ELEVATIONS_DEG = (-10.0, 60.0)
HALF_FOVS_DEG = (7.0, 20.0)


class AroundWriter(Writer):
    """Makes shards only, see `learn3d.data.readers.around`."""

    default_views = 12
    only_shards = True
    convention = PROPERTIES.convention

    @staticmethod
    def paths(category: str) -> tuple[str, ...]:
        return ()

    def write(self, item: RenderedObject) -> None:
        raise NotImplementedError("this layout exists as shards only, which `dataset` makes")

    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> LookAtPoses:
        azimuth, elevation = uniform(rng, (-180.0, 180.0), count), uniform(rng, ELEVATIONS_DEG, count)
        half_fov = uniform(rng, HALF_FOVS_DEG, count)
        return LookAtPoses(azimuth, elevation, distances(rng, vertices, half_fov), half_fov)

    def paint(
        self, vertices: np.ndarray, faces: np.ndarray, color: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, nmr.Lights]:
        return natural_look(vertices, faces, rng)

    @classmethod
    def dataset(cls, objects: Sequence[RenderedObject], category: str, split: str) -> ViewDataset:
        count = len(objects)
        images, depth = np.zeros((0, 4, 64, 64), np.uint8), np.zeros((0, 64, 64), np.uint8)
        poses, views = LookAtPoses(*np.zeros((4, 0), np.float32)), 0
        if count:
            views = len(objects[0].poses)
            images, depth = (np.concatenate([f(o) for o in objects]) for f in (KatoWriter.images, _depth))
            names = ("azimuth_deg", "elevation_deg", "distance", "half_fov_deg")
            poses = LookAtPoses(*(torch.cat([getattr(o.poses, name) for o in objects]) for name in names))
        return ViewDataset(
            category=category,
            split=split,
            images=images,
            depth=depth,
            poses=poses,
            view_ids=BINS.ids(poses).numpy(),
            view_names=tuple(BINS.names()),
            object_ids=np.repeat(np.arange(count), views),
            object_names=tuple(o.name for o in objects),
            voxels=np.stack([o.voxels for o in objects]) if count else np.zeros((0, 32, 32, 32), bool),
            convention=PROPERTIES.convention,
            inverted=PROPERTIES.inverted,
        )


def natural_look(vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, nmr.Lights]:
    """Random colours [F, 3] and lights for a mesh [V, 3], [F, 3].

    Connected parts with the same number of faces get the same colour out of three. The light comes from any side.
    """
    joined = coo_array((np.ones(len(faces) * 2), (faces[:, :2].ravel(), faces[:, 1:].ravel())), 2 * [len(vertices)])
    part = connected_components(joined, directed=False)[1][faces[:, 0]]
    kinds = np.unique(np.bincount(part)[part], return_inverse=True)[1]
    palette = np.array([_material(rng) for _ in range(3)])
    colors = palette[rng.choice(3, size=kinds.max() + 1, p=(0.6, 0.25, 0.15))][kinds]
    side, height = rng.normal(size=2), rng.uniform(0.3, 1.5)
    return colors, studio_lights((side[0], height, side[1]), rng.uniform(0.35, 0.7))


def _material(rng: np.random.Generator) -> tuple[float, float, float]:
    """A random colour of wood, of paint or cloth, or a grey."""
    kind = rng.choice(3, p=(0.25, 0.4, 0.35))
    if kind == 0:
        return colorsys.hsv_to_rgb(rng.uniform(0.05, 0.11), rng.uniform(0.3, 0.75), rng.uniform(0.2, 0.85))
    if kind == 1:
        return colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.2, 0.9), rng.uniform(0.2, 0.95))
    return colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.0, 0.08), rng.uniform(0.05, 0.98))


def _depth(item: RenderedObject) -> np.ndarray:
    depth = nmr.render_depth(item.vertices, item.faces, item.poses.cameras(), image_size=64, anti_aliasing=False)
    return depth_levels(depth, item.poses).numpy()
