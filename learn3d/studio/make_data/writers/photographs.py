"""Writes renderings on photo-like backgrounds: Pascal3D+ as packed in 2019, photo folders."""

import csv
import functools
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import nmr
from learn3d.data import conventions
from learn3d.data.poses import RotationPoses
from learn3d.data.readers import pascal3d
from learn3d.studio.make_data.writers.writer import (
    WORLD_FROM_OBJECT,
    RenderedObject,
    Writer,
    random_views,
    uniform,
    write_png,
)

HEIGHTS, WIDTHS = (160, 300), (200, 400)  # ranges for photographs, in pixels
SHARES = (0.5, 0.9)  # range of the side of the rendering over the shorter side of the photograph


def _write_pascal3d(
    objects: Iterable[RenderedObject], category: str, folder: Path, _: Path
) -> None:
    """Write `{class}_{train,imagenet,val}.npz`: renderings on out-of-focus backgrounds.

    Training images go to the first two files alternately. Raises ValueError if there is only one.
    """
    rows, val_rows = [], []
    for item in objects:
        for rgba, rotation in zip(item.rgba(), item.poses.rotation.numpy(), strict=True):
            row = _photograph(rgba, item.rng)
            row |= {
                "rotation_matrices": rotation * np.float32([[-1], [1], [1]]),
                "voxels": item.voxels,
            }
            (val_rows if item.split == "val" else rows).append(row)
    if len(rows) == 1:
        raise ValueError(
            "the layout pascal3d needs two pictures or more for training; give more meshes or views"
        )
    for path, part in zip(
        PASCAL3D_WRITER.paths(category), (rows[::2], rows[1::2], val_rows), strict=True
    ):
        if part:
            images = np.empty(len(part), dtype=object)
            images[:] = [row.pop("images") for row in part]
            stacked = {key: np.stack([row[key] for row in part]) for key in part[0]}
            np.savez_compressed(folder / path, images=images, **stacked)


def _pascal3d_views(vertices: np.ndarray, count: int, rng: np.random.Generator) -> RotationPoses:
    """Poses of hand-held cameras: any azimuth, elevations in -10 .. 40, tilts up to 15 degrees."""
    ranges = ((-180.0, 180.0), (-10.0, 40.0), (-15.0, 15.0))
    azimuth_deg, elevation_deg, tilt_deg = (uniform(rng, limits, count) for limits in ranges)
    look = nmr.LookAt.from_angles(
        1.0, torch.from_numpy(elevation_deg), torch.from_numpy(azimuth_deg)
    )
    upright = look.projection(torch.float64).matrix[:, :, :3].numpy() * np.array(
        [[1.0], [-1.0], [1.0]]
    )
    cos, sin = np.cos(np.deg2rad(tilt_deg)), np.sin(np.deg2rad(tilt_deg))
    roll = np.tile(np.eye(3), (count, 1, 1))
    roll[:, 0, 0], roll[:, 0, 1], roll[:, 1, 0], roll[:, 1, 1] = cos, -sin, sin, cos
    # rows: the right, up and away of the image
    return RotationPoses(roll @ upright @ WORLD_FROM_OBJECT.T)


def _photograph(rgba: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Paste a rendering [224, 224, 4] into a photograph.

    Returns its images, images_ref and bounding_boxes entries.
    """
    height, width = int(rng.integers(*HEIGHTS)), int(rng.integers(*WIDTHS))
    side = int(rng.uniform(*SHARES) * min(height, width))
    small = Image.fromarray(rgba).resize((side, side), Image.Resampling.BICUBIC)
    rows, columns = (
        np.flatnonzero((np.asarray(small)[..., 3] > 127).any(axis=axis)) for axis in (1, 0)
    )
    if not len(rows):
        rows = columns = np.array([0, side - 1])  # the object vanished when the image was reduced
    size = np.array([columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1])
    # the whole object is in the photograph
    corner = rng.integers(0, np.array([width, height]) - size + 1)
    left, top = corner[0] - columns[0], corner[1] - rows[0]
    photo = Image.fromarray(photo_background(height, width, rng))
    photo.paste(small, (int(left), int(top)), small)
    cut = photo.crop((left, top, left + side, top + side)).resize(
        rgba.shape[:2], Image.Resampling.BICUBIC
    )
    reference = np.concatenate([np.asarray(cut), rgba[..., 3:]], axis=-1)
    box = np.array([*corner, *size], dtype=np.int64)
    return {"images": np.asarray(photo), "images_ref": reference, "bounding_boxes": box}


#: All rotations are proper (determinant 1), so the object frame is right-handed: x to the front,
#: y up, z to the left as seen from the front. Objects are symmetric about z = 0, as the symmetric
#: generator requires. Half the diagonal of the bounding box is 1, so that a rotated object stays
#: in [-1, 1].
PASCAL3D_WRITER = Writer(
    paths=lambda category: tuple(
        f"{pascal3d.class_name(category)}_{n}.npz" for n in ("train", "imagenet", "val")
    ),
    write=_write_pascal3d,
    views=_pascal3d_views,
    image_size=224,
    default_views=8,
    default_test=0.0,
    default_val=0.2,
    fixed=("test",),
    convention=conventions.PASCAL3D,
    turn=WORLD_FROM_OBJECT,
    diagonal=2.0,
)


def _write_photos(objects: Iterable[RenderedObject], category: str, root: Path, _: Path) -> None:
    """Write RGB images with out-of-focus backgrounds, anti-aliased masks and `poses.csv`."""
    folder, size = root / category, PHOTOS_WRITER.image_size
    folder.mkdir()
    table = [("file", "azimuth_deg", "elevation_deg", "distance", "fov_deg", "object", "split")]
    for item in objects:
        poses = item.poses
        images = over(item, np.stack([photo_background(size, size, item.rng) for _ in item.rgb]))
        numbers = np.stack(
            [poses.azimuth_deg, poses.elevation_deg, poses.distance, 2 * poses.half_fov_deg], axis=1
        )
        for k, (image, mask, row) in enumerate(zip(images, item.alpha, numbers, strict=True)):
            file = f"{item.name}_{k:02d}.png"
            write_png(folder / "images" / file, image)
            write_png(folder / "masks" / file, mask)
            table.append((file, *(f"{value:.4f}" for value in row), item.name, item.split))
    with (folder / "poses.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(table)


PHOTOS_WRITER = Writer(
    paths=lambda category: (category,),
    write=_write_photos,
    views=functools.partial(
        random_views, (-10.0, 50.0), (12.0, 25.0)
    ),  # lenses of 84 .. 38 mm on a square of 36 mm
    image_size=256,
    default_views=12,
)


def over(item: RenderedObject, backgrounds: np.ndarray) -> np.ndarray:
    """The images of an object over backgrounds instead of white; all are uint8 [n, S, S, 3]."""
    clear = 1 - item.alpha[..., None] / np.float32(255)
    return (
        np.rint(item.rgb + (backgrounds.astype(np.float32) - 255) * clear)
        .clip(0, 255)
        .astype(np.uint8)
    )


def photo_background(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Draw an out-of-focus background, uint8 [H, W, 3]: smooth colours, blotches and noise."""

    def enlarge(small: np.ndarray) -> np.ndarray:
        channels = [
            Image.fromarray(channel.astype(np.float32)) for channel in np.moveaxis(small, 2, 0)
        ]
        return np.stack(
            [c.resize((width, height), Image.Resampling.BILINEAR) for c in channels], axis=-1
        )

    corners = rng.uniform(40, 230, (2, 2, 3))
    blotches = rng.normal(0, 25, (8, 8, 1))
    grain = rng.normal(0, 4, (height, width, 1))
    return (enlarge(corners) + enlarge(blotches) + grain).clip(0, 255).astype(np.uint8)
