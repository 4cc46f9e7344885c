"""Objects with a thick front and a thin back, in Kato's views."""

from __future__ import annotations

import numpy as np
import torch

import nmr
from learn3d.data.dataset import ViewDataset
from learn3d.data.readers import kato


def dart_shapes(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices and faces of objects with a thick front and a thin back."""
    sphere, faces = nmr.icosphere(2)
    width = torch.from_numpy(
        np.random.default_rng(0).uniform(0.9, 1.1, (count, 1, 3))
    ) * torch.tensor([0.3, 0.1, 0.5])
    taper = torch.stack(
        [1 - 0.9 * sphere[:, 2], 1 - 0.9 * sphere[:, 2], torch.ones(len(sphere))], 1
    )
    return (sphere * taper * width).float(), faces


def darts(objects: int) -> ViewDataset:
    """`dart_shapes` in Kato's 24 views."""
    shapes, faces = dart_shapes(objects)
    images = np.zeros((objects, 24, 4, 64, 64), np.uint8)
    cameras = kato.from_arrays(images[:1], None, "dart", "train").poses.cameras()
    for image, vertices in zip(images, shapes, strict=True):
        drawn = nmr.render_silhouette(vertices.expand(24, -1, -1), faces, cameras, image_size=64)
        image[:, 3] = (255 * drawn).byte().numpy()
    return kato.from_arrays(images, None, "dart", "train")
