"""Pictures for people: the grid shown during training, turntables, strips, and the files they go into."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

import nmr
from learn3d import files
from learn3d.data.kato import DISTANCE, HALF_FOV_DEG
from learn3d.data.poses import LookAtPoses, Poses
from learn3d.data.views import MASK_SIZE, ViewDataset
from learn3d.methods import Grids, Meshes, Method
from learn3d.shading import shade_mesh
from learn3d.surfaces import grid_surface

CLAY = (0.62, 0.68, 0.78)
GRID_COLUMNS = ("input", "target", "rendering", "same view", "+60°", "+120°", "+180°", "+240°", "+300°")
TILE = 96
MARGIN = 4
HEADER = 18


def as_meshes(shapes: Meshes | Grids) -> list[tuple[Tensor, Tensor]]:
    """Predictions as a mesh each: (vertices [V,3], faces [F,3]); grids by marching cubes."""
    if isinstance(shapes, Meshes):
        return [(vertices, shapes.faces) for vertices in shapes.vertices]
    return [grid_surface(grid, level=shapes.threshold) for grid in shapes.occupancy]


def view_angles(pose: Poses) -> tuple[float, float]:
    """(azimuth, elevation) in degrees of a single pose in the object frame; where it is a rotation, from it."""
    if isinstance(pose, LookAtPoses):
        return float(pose.azimuth_deg[0]), float(pose.elevations_deg[0])
    eye = -pose.rotation[0, 2]  # the camera looks along its third axis
    return float(torch.rad2deg(torch.atan2(eye[0], -eye[2]))), float(torch.rad2deg(eye[1].clamp(-1, 1).asin()))


def display_colors(images: np.ndarray, dataset: ViewDataset) -> np.ndarray:
    """Stored images uint8 [B,4,S,S] as pictures uint8 [B,S,S,3]."""
    return natural_colors(images) if dataset.inverted else np.moveaxis(images[:, :3], 1, -1)


def natural_colors(images: np.ndarray) -> np.ndarray:
    """Stored images uint8 [..., 4, H, W] (colours inverted on black) -> uint8 [..., H, W, 3], objects on white."""
    return 255 - np.moveaxis(images[..., :3, :, :], -3, -1)


def to_uint8(values: Tensor) -> np.ndarray:
    """Grey values in [0,1], any shape -> uint8 with a last axis of 3 equal channels."""
    grey = (values.detach().cpu().float().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    return np.repeat(grey[..., None], 3, axis=-1)


def draw_mesh(
    vertices: Tensor,
    faces: Tensor,
    azimuths_deg: Sequence[float],
    *,
    elevation_deg: float,
    image_size: int,
    fit: bool = False,
) -> np.ndarray:
    """One mesh [V,3] in the object frame as plain clay on white, from several azimuths: uint8 [N,S,S,3].

    The camera is the data set's, or with `fit` one whose field of view just holds the mesh at every azimuth.
    """
    half_fov_deg = HALF_FOV_DEG
    if fit:
        radius = float(vertices.norm(dim=1).max())
        half_fov_deg = max(1.0, math.degrees(math.asin(min(1.03 * radius / DISTANCE, 0.9))))
    pictures = []
    for azimuth in azimuths_deg:  # one at a time: the fine images that are averaged take memory
        cameras = nmr.LookAt.from_angles(DISTANCE, elevation_deg, [azimuth], half_fov_deg=half_fov_deg)
        rgb, _ = shade_mesh(
            vertices, faces, np.asarray(CLAY), cameras, image_size=image_size, supersample=4, ambient=0.35
        )
        pictures.append(rgb)
    return np.concatenate(pictures)


@torch.no_grad()
def picture_grid(method: Method, dataset: ViewDataset, indices: Tensor) -> np.ndarray:
    """What a method makes of some images: uint8 [H,W,3].

    A row per image: the input, the target silhouette, the rendered silhouette and the shaded mesh at the input's view,
    and the mesh from five new views around it.
    """
    batch = dataset.batch(indices)
    training = method.training
    method.set_training(False)
    meshes = as_meshes(method.decode(method.encode(batch.images)))
    method.set_training(training)
    inputs = display_colors(batch.images.numpy(), dataset)
    rows = []
    for i in range(len(indices)):
        vertices, faces = meshes[i]
        pose = batch.poses[torch.tensor([i])]
        silhouette = nmr.render_silhouette(vertices[None], faces, pose.cameras(), image_size=MASK_SIZE)[0]
        azimuth, elevation = view_angles(pose)
        views = draw_mesh(
            vertices, faces, [azimuth + 60 * k for k in range(6)], elevation_deg=elevation, image_size=TILE
        )
        flat = [inputs[i], to_uint8(batch.masks[i]), to_uint8(silhouette)]
        rows.append([*flat, *views])
    return tile(rows, GRID_COLUMNS)


def tile(
    rows: Sequence[Sequence[np.ndarray]], titles: Sequence[str] | None = None, *, tile_size: int = TILE
) -> np.ndarray:
    """Arrange pictures uint8 [h,w,3] on a white sheet, each scaled to the same square, titles above the columns."""
    columns = max(len(row) for row in rows)
    header = HEADER if titles else 0
    sheet = Image.new(
        "RGB",
        (columns * (tile_size + MARGIN) + MARGIN, header + len(rows) * (tile_size + MARGIN) + MARGIN),
        (255, 255, 255),
    )
    draw = ImageDraw.Draw(sheet)
    for column, title in enumerate(titles or ()):
        draw.text(
            (column * (tile_size + MARGIN) + MARGIN + tile_size // 2, header - 4), title, fill=(60, 60, 60), anchor="ms"
        )
    for r, row in enumerate(rows):
        for c, picture in enumerate(row):
            image = Image.fromarray(picture)
            if image.size != (tile_size, tile_size):
                image = image.resize((tile_size, tile_size), Image.Resampling.BICUBIC)
            sheet.paste(image, (c * (tile_size + MARGIN) + MARGIN, header + r * (tile_size + MARGIN) + MARGIN))
    return np.asarray(sheet)


def turntable(
    vertices: Tensor, faces: Tensor, *, frames: int = 36, image_size: int = 256, elevation_deg: float = 20.0
) -> np.ndarray:
    """One full turn around a mesh [V,3] in the object frame: uint8 [frames,S,S,3]."""
    azimuths = [-360.0 * frame / frames for frame in range(frames)]
    return draw_mesh(vertices, faces, azimuths, elevation_deg=elevation_deg, image_size=image_size, fit=True)


def save_png(path: Path, rgb: np.ndarray) -> None:
    """Write a picture uint8 [H,W,3]."""
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, format="PNG", optimize=True)
    files.write_bytes(path, buffer.getvalue())


def save_gif(path: Path, frames: np.ndarray, *, frames_per_second: float = 15.0) -> None:
    """Write an endless animation from frames uint8 [N,H,W,3]."""
    buffer = io.BytesIO()
    palette = Image.Palette.ADAPTIVE
    first, *others = [Image.fromarray(frame).convert("P", palette=palette, colors=64) for frame in frames]
    first.save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=round(1000 / frames_per_second),
        loop=0,
        optimize=True,
    )
    files.write_bytes(path, buffer.getvalue())
