"""Pictures of shapes: cameras around them, and how they are drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

import nmr
from learn3d.data.conventions import DISTANCE
from learn3d.data.poses import LookAtPoses, Poses
from learn3d.pictures.studio import photograph, studio_lights

CLAY = (0.62, 0.68, 0.78)
_LIGHT = (-0.5, 0.45, -0.75)  # towards the light: left of, above and behind the camera, in its own axes
_FAR = 5.0  # where orthographic cameras stand: outside of any object, so that faces turn to the right side


class Surface(NamedTuple):
    """One shape as triangles, on the CPU."""

    vertices: Tensor  # float32 [V, 3], object frame
    faces: Tensor  # int64 [F, 3]; F = 0 is an empty shape, of which nothing is drawn
    colors: Tensor | None = None  # float32 [V, 3] in [0, 1], R, G, B of each vertex; None: clay


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
