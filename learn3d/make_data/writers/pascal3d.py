"""Writes Pascal3D+ as packed by Kato and Harada 2019.

`{class}_{train,imagenet,val}.npz`, of which the first two together are what is trained on; one row per picture:

- `images`, pickled object array of uint8 [H, W, 3] of all sizes; here renderings on out-of-focus backgrounds
- `bounding_boxes` [N, 4]: left, top, width, height of the object in `images`, pixels
- `images_ref` uint8 [N, 224, 224, 4]: the part of the picture that the cube [-1, 1]^3 projects to, and the mask
- `rotation_matrices` [N, 3, 3]: R v has x to the LEFT and y up, both in [-1, 1] across `images_ref`, and z away; rays
  are parallel. All are proper rotations (determinant 1), so the object frame is right-handed.
- `voxels` [N, 32, 32, 32] in the axes of `readers.pascal3d.PASCAL3D`; the grid spans [-1, 1]

The object frame has x to the front, y up and z to the left as seen from the front, so that objects are symmetric
about z = 0, as the symmetric generator wants it. Objects are scaled so that half the diagonal of their bounding box
is 1: then no rotation takes them out of [-1, 1].
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from PIL import Image

import nmr
from learn3d.data.poses import RotationPoses
from learn3d.data.readers.pascal3d import PASCAL3D, class_name
from learn3d.make_data.viewpoints import uniform
from learn3d.make_data.writers.pictures import photo_background
from learn3d.make_data.writers.writer import WORLD_FROM_OBJECT, RenderedObject, Writer

FILES = ("train", "imagenet", "val")
ELEVATIONS_DEG = (-10.0, 40.0)
TILTS_DEG = (-15.0, 15.0)
HEIGHTS, WIDTHS = (160, 300), (200, 400)  # of the pictures, in pixels
SHARES = (0.5, 0.9)  # of the picture's shorter side that the cube takes


class Pascal3dWriter(Writer):
    """Pictures are kept in memory until all are made. Every second picture to train on goes to "imagenet"."""

    image_size = 224
    default_views = 8
    default_test = 0.0
    default_val = 0.2
    bytes_per_view = 4 * 224**2 + 3 * 300 * 400 + 32**3
    convention = PASCAL3D
    turn = WORLD_FROM_OBJECT
    objects_fill = "box centred at the origin, half its diagonal 1"
    card: ClassVar = {
        "images": "uint8 [H, W, 3] of all sizes; images_ref uint8 [N, 224, 224, 4]: what [-1, 1]^3 spans, mask",
        "voxels": "bool [N, 32, 32, 32] over [-1, 1], axes (-x, -z, -y) of the object frame",
        "views": "rotation_matrices: R v has x to the left, y up, z away; parallel rays",
    }

    def __init__(self, folder: Path, category: str) -> None:
        super().__init__(folder, category)
        self._trained_on = 0
        self._rows: dict[str, list[dict[str, np.ndarray]]] = {name: [] for name in FILES}

    @classmethod
    def paths(cls, category: str) -> tuple[str, ...]:
        return tuple(f"{class_name(category)}_{name}.npz" for name in FILES)

    def place(self, vertices: np.ndarray) -> np.ndarray:
        return super().place(vertices) * (2 / np.linalg.norm(np.ptp(vertices, axis=0)))

    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> RotationPoses:
        """Cameras as photographers hold them: any azimuth, elevations in -10 .. 40, tilted by up to 15 degrees."""
        azimuth_deg, elevation_deg, tilt_deg = (
            uniform(rng, limits, count) for limits in ((-180.0, 180.0), ELEVATIONS_DEG, TILTS_DEG)
        )
        look = nmr.LookAt.from_angles(1.0, torch.from_numpy(elevation_deg), torch.from_numpy(azimuth_deg))
        upright = look.projection(torch.float64).matrix[:, :, :3].numpy() * np.array([[1.0], [-1.0], [1.0]])
        cos, sin = np.cos(np.deg2rad(tilt_deg)), np.sin(np.deg2rad(tilt_deg))
        roll = np.tile(np.eye(3), (count, 1, 1))
        roll[:, 0, 0], roll[:, 0, 1], roll[:, 1, 0], roll[:, 1, 1] = cos, -sin, sin, cos
        return RotationPoses(roll @ upright @ self.turn.T)  # rows: the right, up and away of the image

    def write(self, item: RenderedObject) -> None:
        for rgba, rotation in zip(item.rgba(), item.poses.rotation.numpy(), strict=True):
            photo, reference, box = _photograph(rgba, item.rng)
            row = {
                "images": photo,
                "images_ref": reference,
                "bounding_boxes": box,
                "rotation_matrices": rotation * np.float32([[-1], [1], [1]]),
                "voxels": item.voxels,
            }
            file = "val" if item.split == "val" else FILES[self._trained_on % 2]
            self._trained_on += file != "val"
            self._rows[file].append(row)

    def finish(self, output: Path, objects: dict[str, list[str]]) -> dict[str, list[str]]:
        if self._trained_on < 2:
            raise ValueError("the layout pascal3d needs at least two pictures to train on: more meshes, or more views")
        for name, rows in self._rows.items():
            if not rows:
                continue
            arrays = {key: [row[key] for row in rows] for key in rows[0]}
            images = np.empty(len(rows), dtype=object)
            images[:] = arrays.pop("images")
            stacked = {key: np.stack(values) for key, values in arrays.items()}
            path = self.folder / self.paths(self.category)[FILES.index(name)]
            np.savez_compressed(path, images=images, **stacked)
        return objects


def _photograph(rgba: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A rendering [224, 224, 4] put somewhere on a picture: image [H, W, 3], reference [224, 224, 4] and box [4]."""
    height, width = int(rng.integers(*HEIGHTS)), int(rng.integers(*WIDTHS))
    side = int(rng.uniform(*SHARES) * min(height, width))
    small = Image.fromarray(rgba).resize((side, side), Image.Resampling.BICUBIC)
    rows, columns = (np.flatnonzero((np.asarray(small)[..., 3] > 127).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        rows = columns = np.array([0, side - 1])  # too thin for the small picture
    size = np.array([columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1])
    corner = rng.integers(0, np.array([width, height]) - size + 1)  # of the object: all of it is in the picture
    left, top = corner[0] - columns[0], corner[1] - rows[0]
    photo = Image.fromarray(photo_background(height, width, rng))
    photo.paste(small, (int(left), int(top)), small)
    cut = photo.crop((left, top, left + side, top + side)).resize(rgba.shape[:2], Image.Resampling.BICUBIC)
    reference = np.concatenate([np.asarray(cut), rgba[..., 3:]], axis=-1)
    return np.asarray(photo), reference, np.array([*corner, *size], dtype=np.int64)
