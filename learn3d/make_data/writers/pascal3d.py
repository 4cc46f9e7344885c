"""Writes Pascal3D+ as packed by Kato and Harada 2019."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image

import nmr
from learn3d.data.poses import RotationPoses
from learn3d.data.readers.pascal3d import PASCAL3D, class_name
from learn3d.make_data.writers.writer import WORLD_FROM_OBJECT, RenderedObject, Writer, photo_background, uniform

FILES = ("train", "imagenet", "val")
HEIGHTS, WIDTHS = (160, 300), (200, 400)  # of the photographs, in pixels
SHARES = (0.5, 0.9)  # of the photograph's shorter side that the cube takes


class Pascal3dWriter(Writer):
    """`{class}_{train,imagenet,val}.npz`; the first two together are the training set. One row per image:

    - `images`, pickled object array of uint8 [H, W, 3] of all sizes; here renderings on out-of-focus backgrounds.
    - `bounding_boxes` [N, 4]: left, top, width, height of the object in `images`, pixels.
    - `images_ref` uint8 [N, 224, 224, 4]: the part of the image that the cube [-1, 1]^3 projects to, and the mask.
    - `rotation_matrices` [N, 3, 3]: R v has x to the LEFT and y up, both in [-1, 1] across `images_ref`, and z away;
      rays are parallel. All are proper rotations (determinant 1), so the object frame is right-handed.
    - `voxels` bool [N, 32, 32, 32] over [-1, 1], axes (-x, -z, -y) of the object frame.

    The object frame has x to the front, y up and z to the left as seen from the front, so that objects are symmetric
    about z = 0, as the symmetric generator wants it. Objects are scaled so that half the diagonal of their bounding box
    is 1: then no rotation takes them out of [-1, 1].
    """

    image_size = 224
    default_views = 8
    default_test = 0.0
    default_val = 0.2
    extra_bytes_per_view = 3 * 300 * 400 + 32**3
    convention = PASCAL3D
    turn = WORLD_FROM_OBJECT
    diagonal = 2.0

    def __init__(self, folder: Path, category: str) -> None:
        super().__init__(folder, category)
        self._trained_on = 0  # images of the training set so far: every second one goes to "imagenet"
        self._rows: dict[str, list[dict[str, np.ndarray]]] = {name: [] for name in FILES}

    @classmethod
    def paths(cls, category: str) -> tuple[str, ...]:
        return tuple(f"{class_name(category)}_{name}.npz" for name in FILES)

    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> RotationPoses:
        """Any azimuth, elevations in -10 .. 40, tilted by up to 15 degrees, as photographers hold a camera."""
        ranges = ((-180.0, 180.0), (-10.0, 40.0), (-15.0, 15.0))
        azimuth_deg, elevation_deg, tilt_deg = (uniform(rng, limits, count) for limits in ranges)
        look = nmr.LookAt.from_angles(1.0, torch.from_numpy(elevation_deg), torch.from_numpy(azimuth_deg))
        upright = look.projection(torch.float64).matrix[:, :, :3].numpy() * np.array([[1.0], [-1.0], [1.0]])
        cos, sin = np.cos(np.deg2rad(tilt_deg)), np.sin(np.deg2rad(tilt_deg))
        roll = np.tile(np.eye(3), (count, 1, 1))
        roll[:, 0, 0], roll[:, 0, 1], roll[:, 1, 0], roll[:, 1, 1] = cos, -sin, sin, cos
        return RotationPoses(roll @ upright @ self.turn.T)  # rows: the right, up and away of the image

    def write(self, item: RenderedObject) -> None:
        for rgba, rotation in zip(item.rgba(), item.poses.rotation.numpy(), strict=True):
            row = _photograph(rgba, item.rng)
            row |= {"rotation_matrices": rotation * np.float32([[-1], [1], [1]]), "voxels": item.voxels}
            file = "val" if item.split == "val" else FILES[self._trained_on % 2]
            self._trained_on += file != "val"
            self._rows[file].append(row)

    def finish(self, output: Path, objects: dict[str, list[str]]) -> dict[str, list[str]]:
        if self._trained_on < 2:
            raise ValueError("the layout pascal3d needs at least two pictures to train on: more meshes, or more views")
        for path, rows in zip(self.paths(self.category), self._rows.values(), strict=True):
            if rows:
                images = np.empty(len(rows), dtype=object)
                images[:] = [row.pop("images") for row in rows]
                stacked = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
                np.savez_compressed(self.folder / path, images=images, **stacked)
        return objects


def _photograph(rgba: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Put a rendering [224, 224, 4] somewhere on a photograph: its entries of images, images_ref, bounding_boxes."""
    height, width = int(rng.integers(*HEIGHTS)), int(rng.integers(*WIDTHS))
    side = int(rng.uniform(*SHARES) * min(height, width))
    small = Image.fromarray(rgba).resize((side, side), Image.Resampling.BICUBIC)
    rows, columns = (np.flatnonzero((np.asarray(small)[..., 3] > 127).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        rows = columns = np.array([0, side - 1])  # too thin for the small image
    size = np.array([columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1])
    corner = rng.integers(0, np.array([width, height]) - size + 1)  # the whole object is in the photograph
    left, top = corner[0] - columns[0], corner[1] - rows[0]
    photo = Image.fromarray(photo_background(height, width, rng))
    photo.paste(small, (int(left), int(top)), small)
    cut = photo.crop((left, top, left + side, top + side)).resize(rgba.shape[:2], Image.Resampling.BICUBIC)
    reference = np.concatenate([np.asarray(cut), rgba[..., 3:]], axis=-1)
    box = np.array([*corner, *size], dtype=np.int64)
    return {"images": np.asarray(photo), "images_ref": reference, "bounding_boxes": box}
