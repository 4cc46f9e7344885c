"""Drawing shapes and putting pictures together and into files; nothing here knows a method or a data set."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

import nmr
from learn3d.data.conventions import DISTANCE
from learn3d.data.poses import LookAtPoses, Poses
from learn3d.files import writing
from learn3d.make_data.studio import photograph, studio_lights
from learn3d.methods import Grids, Meshes
from learn3d.methods.surfaces import grid_surface

CLAY = (0.62, 0.68, 0.78)
_LIGHT = (-0.5, 0.45, -0.75)  # towards the light: left of, above and behind the camera, in its own axes
_FAR = 5.0  # where orthographic cameras stand: outside of any object, so that faces turn to the right side


class Surface(NamedTuple):
    """One shape as triangles, on the CPU."""

    vertices: Tensor  # float32 [V, 3], object frame
    faces: Tensor  # int64 [F, 3]; F = 0 is an empty shape, of which nothing is drawn
    colors: Tensor | None = None  # float32 [V, 3] in [0, 1], R, G, B of each vertex; None: clay


def as_meshes(shapes: Meshes | Grids) -> list[Surface]:
    """The predicted shapes one by one as triangles; grids by marching cubes at their threshold."""
    if isinstance(shapes, Meshes):
        colors = [None] * len(shapes.vertices) if shapes.colors is None else shapes.colors
        return [Surface(vertices, shapes.faces, color) for vertices, color in zip(shapes.vertices, colors, strict=True)]
    return [Surface(*grid_surface(grid, level=shapes.threshold)) for grid in shapes.occupancy]


def orbit(poses: Poses, turns_deg: Sequence[float], *, zoom: float = 1.0) -> nmr.LookAt | nmr.Orthographic:
    """The camera of a single pose, carried around the object's vertical axis by these angles: one camera each.

    It keeps its elevation, distance, field of view and roll; 0 is the pose itself, a positive turn adds to the azimuth.
    `zoom` magnifies the picture about its centre.
    """
    if len(poses) != 1:
        raise ValueError(f"orbit turns one camera, got {len(poses)} poses; pick one as poses[torch.tensor([i])]")
    turns = torch.as_tensor(turns_deg, dtype=torch.float64)
    if isinstance(poses, LookAtPoses):
        elevation, distance, half_fov = (
            float(torch.as_tensor(value).reshape(-1)[0])
            for value in (poses.elevation_deg, poses.distance, poses.half_fov_deg)
        )
        half_fov = math.degrees(math.atan(math.tan(math.radians(half_fov)) / zoom))
        azimuths = float(poses.azimuth_deg[0]) + turns
        return nmr.LookAt.from_angles(distance, elevation, azimuths, half_fov_deg=half_fov)
    _, up, forward = poses.rotation[0].double()
    return nmr.Orthographic(_turn(-_FAR * forward, turns), up=_turn(up, turns), scale=zoom)


def _turn(point: Tensor, turns_deg: Tensor) -> Tensor:
    """A point [3] turned about the y axis, by the azimuth's sense: [N, 3]."""
    cos, sin = turns_deg.deg2rad().cos(), turns_deg.deg2rad().sin()
    x, y, z = point
    return torch.stack([x * cos - z * sin, y.expand_as(cos), z * cos + x * sin], dim=1)


def azimuths_deg(poses: Poses) -> Tensor:
    """Azimuth of every camera, float64 [M] in -180 .. 180: the eye is at (sin a, ., -cos a) of the object frame.

    Of a rotation it is that of the direction against which the camera looks.
    """
    if poses is None:
        raise ValueError("these data do not say where the cameras stood, which this figure needs")
    eye = poses.features() if isinstance(poses, LookAtPoses) else -poses.rotation[:, 2]
    return torch.rad2deg(torch.atan2(eye[:, 0].double(), -eye[:, 2].double()))


def reach(surface: Surface, cameras: nmr.LookAt | nmr.Orthographic) -> float:
    """How far the shape goes from the picture's centre in any camera, 1 being the border; 0 for an empty shape."""
    if len(surface.faces) == 0:
        return 0.0
    seen = cameras.transform(surface.vertices[surface.faces.unique()][None])
    return float(seen[..., :2].abs().max())


def common_zoom(shapes: Sequence[tuple[Surface, nmr.LookAt | nmr.Orthographic]], masks: Tensor) -> float:
    """The largest magnification, at least 1, at which shapes and photographed objects stay inside their pictures.

    masks: float [B, S, S] of the input images; one that touches its border allows no magnification.
    """
    farthest = max([reach(surface, cameras) for surface, cameras in shapes], default=0.0)
    inside = torch.nonzero(masks > 0.5)[:, 1:]
    if len(inside):
        farthest = max(farthest, float(((2 * inside + 1) / masks.shape[-1] - 1).abs().max()))
    return max(1.0, 0.95 / max(farthest, 0.05))


def draw_surface(surface: Surface, cameras: nmr.LookAt | nmr.Orthographic, *, image_size: int) -> np.ndarray:
    """One shape on white, in its colours or as plain clay, as each of N cameras sees it: uint8 [N,S,S,3].

    The light goes with the camera (from above its left shoulder), so that no side of the shape lies in the dark.
    """
    eyes, ups = (torch.as_tensor(v, dtype=torch.float64).reshape(-1, 3) for v in (cameras.eye, cameras.up))
    if len(surface.faces) == 0:
        return np.full((len(eyes), image_size, image_size, 3), 255, np.uint8)
    pictures, colors = [], np.asarray(CLAY)
    if surface.colors is not None:
        colors = surface.colors.detach()[surface.faces].mean(dim=1).numpy()  # of each face
    for eye, up in zip(eyes, ups.expand_as(eyes), strict=True):  # one at a time: the fine images take memory
        if isinstance(cameras, nmr.LookAt):
            camera = nmr.LookAt(eye[None], up=up, half_fov_deg=cameras.half_fov_deg)
        else:
            camera = nmr.Orthographic(eye[None], up=up, scale=cameras.scale)
        light = tuple((_camera_axes(eye, up).T @ torch.tensor(_LIGHT, dtype=torch.float64)).tolist())
        fine = {"image_size": image_size, "supersample": 4, "lights": studio_lights(light, ambient=0.4)}
        rgb, _ = photograph(surface.vertices, surface.faces, colors, camera, **fine)
        pictures.append(rgb)
    return np.concatenate(pictures)


def _camera_axes(eye: Tensor, up: Tensor) -> Tensor:
    """Rows x (right), y (up), z (away) of a camera that looks at the origin, float64 [3, 3]."""
    z = -eye / eye.norm()
    x = torch.linalg.cross(up, z)
    x = x / x.norm()
    return torch.stack([x, torch.linalg.cross(z, x), z])


def draw_around(
    surface: Surface, azimuths_deg: Sequence[float], *, elevation_deg: float = 20.0, image_size: int
) -> np.ndarray:
    """One shape from several azimuths, by a camera that just holds it at each of them: uint8 [N,S,S,3]."""
    radius = float(surface.vertices.norm(dim=1).max()) if len(surface.vertices) else 0.0
    half_fov_deg = max(1.0, math.degrees(math.asin(min(1.03 * radius / DISTANCE, 0.9))))
    cameras = nmr.LookAt.from_angles(DISTANCE, elevation_deg, list(azimuths_deg), half_fov_deg=half_fov_deg)
    return draw_surface(surface, cameras, image_size=image_size)


def turntable(surface: Surface, *, frames: int = 36, image_size: int = 256) -> np.ndarray:
    """One full turn around a shape: uint8 [frames,S,S,3]."""
    return draw_around(surface, [-360.0 * frame / frames for frame in range(frames)], image_size=image_size)


def natural_colors(images: np.ndarray, *, inverted: bool = True) -> np.ndarray:
    """Stored images uint8 [..., 4, H, W] -> uint8 [..., H, W, 3] as a person wants to see them.

    inverted: colours stored as 255 - colour over black, see `ViewDataset.inverted`.
    """
    colors = np.moveaxis(images[..., :3, :, :], -3, -1)
    return 255 - colors if inverted else colors


def to_uint8(values: Tensor) -> np.ndarray:
    """Grey values in [0,1], any shape -> uint8 with a last axis of 3 equal channels."""
    grey = (values.detach().cpu().float().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    return np.repeat(grey[..., None], 3, axis=-1)


def stacked(blocks: Sequence[np.ndarray], *, gap: int = 0) -> np.ndarray:
    """Pictures uint8 [h,w,3] below each other, flush left."""
    width = max(block.shape[1] for block in blocks)
    padding = [((0, gap if i < len(blocks) - 1 else 0), (0, width - b.shape[1]), (0, 0)) for i, b in enumerate(blocks)]
    return np.concatenate([np.pad(b, p, constant_values=255) for b, p in zip(blocks, padding, strict=True)])


def magnified(pictures: np.ndarray, zoom: float) -> np.ndarray:
    """The central part of pictures uint8 [N,h,w,3], a share 1 / zoom of each side; they become smaller by it."""
    height, width = pictures.shape[1:3]
    top, left = (round(side * (1 - 1 / zoom) / 2) for side in (height, width))
    return pictures[:, top : height - top, left : width - left]


def with_ending(path: Path, suffix: str) -> Path:
    """The path with the ending of another kind of picture, such as ".svg"; a name without one gets it added."""
    path = Path(path)
    return path.with_suffix(suffix) if path.suffix in (".png", ".svg", ".gif", ".json") else Path(f"{path}{suffix}")


def save_png(path: Path, rgb: np.ndarray) -> None:
    """Write a picture uint8 [H,W,3]."""
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, format="PNG", optimize=True)
    writing.write_bytes(path, buffer.getvalue())


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
    writing.write_bytes(path, buffer.getvalue())
