"""Makes views of objects from all sides, with everyday colours and lights."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

import nmr
from learn3d.data.dataset import ViewDataset, depth_levels
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers.around import BINS, PROPERTIES
from learn3d.make_data.writers.kato import KatoWriter
from learn3d.make_data.writers.writer import RenderedObject, Writer, distances, uniform
from learn3d.pictures.studio import natural_look

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


def _depth(item: RenderedObject) -> np.ndarray:
    depth = nmr.render_depth(item.vertices, item.faces, item.poses.cameras(), image_size=64, anti_aliasing=False)
    return depth_levels(depth, item.poses).numpy()
