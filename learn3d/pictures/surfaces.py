"""Surfaces of reconstructed shapes, their pictures, and the cameras around them."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from skimage.measure import marching_cubes
from torch import Tensor

import nmr
from learn3d.data.conventions import DISTANCE
from learn3d.data.poses import LookAtPoses, Poses
from learn3d.pictures.photograph import photograph, studio_lights

CLAY = (0.62, 0.68, 0.78)
# towards the light: left of, above and behind the camera, in its axes (y is down)
_LIGHT = (
    -0.5,
    -0.45,
    -0.75,
)
_FAR = 5.0  # distance of orthographic cameras, outside of any object: faces behind a camera would be lit from behind

Cameras = Sequence[nmr.LookAt | nmr.Orthographic]  # each of one view


class Texture(NamedTuple):
    """An image on the faces of a surface."""

    image: Tensor  # float32 [H, W, 3] in [0, 1], row 0 = top
    uv: Tensor  # float32 [F, 3, 2]: place of each corner of each face; (0, 0) is the image's bottom left corner


class Surface(NamedTuple):
    """One shape as triangles, on the CPU."""

    vertices: Tensor  # float32 [V, 3], object frame
    faces: Tensor  # int64 [F, 3]; F = 0 is an empty shape
    colors: Tensor | None = None  # float32 [V, 3] in [0, 1], R, G, B of each vertex; None: clay
    texture: Texture | None = None  # it is shown instead of the colours


def grid_surface(grid: Tensor, *, level: float = 0.5, box: float = 1.0) -> Surface:
    """Marching cubes: the surface of a grid [s, s, s] with axes (x, y, z) over the cube [-box/2, box/2]^3.

    The surface is empty if no cell is above `level`, and closed at the border of the grid.
    Normals point outwards by the right-hand rule in these axes, as `nmr.icosphere`'s do.
    """
    size = grid.shape[-1]
    padded = np.pad(grid.detach().cpu().float().numpy(), 1)
    if not padded.max() > level:
        return Surface(torch.empty(0, 3), torch.empty(0, 3, dtype=torch.int64))
    vertices, faces, _, _ = marching_cubes(padded, level, gradient_direction="ascent")
    centred = (
        vertices - 0.5
    ) / size - 0.5  # cell i of the padded grid has its centre at (i - 1 + 1/2) / size
    points = torch.from_numpy((centred * box).astype(np.float32))
    return Surface(points, torch.from_numpy(faces.astype(np.int64)))


def orbit(poses: Poses, turns_deg: Sequence[float], *, zoom: float = 1.0) -> Cameras:
    """The camera of a single pose, turned about the object's vertical axis by each of these angles.

    A turn adds to the azimuth; elevation, distance, field of view and roll stay. `zoom` magnifies
    about the centre.
    """
    if isinstance(poses, LookAtPoses):
        elevation, distance, half_fov = (
            float(torch.as_tensor(value).reshape(-1)[0])
            for value in (poses.elevation_deg, poses.distance, poses.half_fov_deg)
        )
        half_fov = math.degrees(math.atan(math.tan(math.radians(half_fov)) / zoom))
        azimuths = float(poses.azimuth_deg[0]) + np.asarray(turns_deg, np.float64)
        return [
            nmr.LookAt.from_angles(distance, elevation, [a], half_fov_deg=half_fov)
            for a in azimuths
        ]
    cameras = []
    for angle in np.radians(turns_deg):
        cos, sin = math.cos(angle), math.sin(angle)
        turn = torch.tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]], dtype=torch.float64)
        _, up, forward = poses.rotation[0].double() @ turn
        cameras.append(nmr.Orthographic(-_FAR * forward[None], up=up, scale=zoom))
    return cameras


def eyes(poses: Poses) -> Tensor:
    """Directions from the object to every camera, float64 [M, 3], of any length."""
    return (poses.features() if isinstance(poses, LookAtPoses) else -poses.rotation[:, 2]).double()


def azimuths_deg(poses: Poses | None) -> Tensor:
    """Azimuth of every camera, float64 [M] in -180 .. 180: the eye is at (sin a, ., -cos a) of the object frame.

    Raises ValueError without poses.
    """
    if poses is None:
        raise ValueError("this figure needs camera poses, and these data have none")
    x, _, z = eyes(poses).T
    return torch.rad2deg(torch.atan2(x, -z))


def common_zoom(shapes: Iterable[tuple[Surface, Cameras]], masks: Tensor) -> float:
    """The largest magnification, at least 1, at which shapes and masks stay inside their pictures.

    masks: float [B, S, S] of the input images. A mask that touches the border allows no
    magnification.
    """
    inside = torch.nonzero(masks > 0.5)[:, 1:]
    # 1 is the border
    farthest = [
        0.05,
        *((2 * inside + 1) / masks.shape[-1] - 1).abs().flatten().tolist(),
    ]
    for surface, cameras in shapes:
        corners = surface.vertices[surface.faces.unique()][None]
        farthest += [
            float(camera.transform(corners)[..., :2].abs().max())
            for camera in cameras
            if corners.numel()
        ]
    return max(1.0, 0.95 / max(farthest))


def draw_surface(surface: Surface, cameras: Cameras, *, image_size: int) -> np.ndarray:
    """One shape on white, in its colours or as clay, from each of N cameras: uint8 [N,S,S,3].

    The light moves with the camera (from above, left of it), so that no side of the shape is dark.
    """
    if len(surface.faces) == 0:
        return np.full((len(cameras), image_size, image_size, 3), 255, np.uint8)
    colored = surface.colors is not None  # colours of a photograph have its light: shade them less
    if surface.texture is not None:
        image, uv = surface.texture
        colors = nmr.UVTexture(image, uv.flatten(0, 1), torch.arange(3 * len(uv)).view(-1, 3))
    else:
        colors = surface.colors.detach()[surface.faces].mean(dim=1).numpy() if colored else CLAY
    pictures = []
    for camera in cameras:  # one at a time, to save memory
        direction = torch.tensor(_LIGHT, dtype=torch.float64) @ camera.projection().matrix[0, :, :3]
        options = {
            "lights": studio_lights(direction, 0.85 if colored else 0.4, smooth=colored),
            "supersample": 4,
        }
        rgb, _ = photograph(
            surface.vertices, surface.faces, colors, camera, image_size=image_size, **options
        )
        pictures.append(rgb)
    return np.concatenate(pictures)


def draw_around(
    surface: Surface, azimuths_deg: Sequence[float], *, elevation_deg: float = 20.0, image_size: int
) -> np.ndarray:
    """One shape from N azimuths, with the field of view that just contains it at all of them: uint8 [N,S,S,3]."""
    radius = float(surface.vertices.norm(dim=1).max()) if len(surface.vertices) else 0.0
    half_fov = max(1.0, math.degrees(math.asin(min(1.03 * radius / DISTANCE, 0.9))))
    pose = LookAtPoses(torch.zeros(1), elevation_deg, DISTANCE, half_fov)
    return draw_surface(surface, orbit(pose, azimuths_deg), image_size=image_size)


def turntable(surface: Surface, *, frames: int = 36, image_size: int = 256) -> np.ndarray:
    """One full turn around a shape: uint8 [frames,S,S,3]."""
    return draw_around(
        surface, [-360.0 * frame / frames for frame in range(frames)], image_size=image_size
    )
