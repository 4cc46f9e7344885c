"""Drawing: meshes as pictures, the cameras around them, pictures in rows and columns, image files."""

import io
import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo
from skimage.measure import marching_cubes
from torch import Tensor

import nmr
from learn3d.data.conventions import DISTANCE
from learn3d.data.poses import LookAtPoses, Poses
from learn3d.files import writing

PROGRAM = "learn3d"  # named in the files
# towards the light, object frame (x right, y up, -z towards the camera of view 0)
KEY_LIGHT = (0.45, 0.8, -0.4)
BACK_LIGHT = 0.35  # strength of the light from the opposite side, relative to the key light


def studio_lights(
    light: Sequence[float] = KEY_LIGHT, ambient: float = 0.5, smooth: bool = False
) -> nmr.Lights:
    """A key light, a weaker one from behind, and ambient light.

    light: direction of the key light, of any length but 0. ambient: its share in 0 .. 1; a surface
    that faces the key light has the brightness 1. smooth: interpolate normals.
    """
    key = 1.0 - ambient
    direction = torch.as_tensor(light, dtype=torch.float64)
    direction = direction / direction.norm()
    return nmr.Lights(
        ambient, [key, BACK_LIGHT * key], torch.stack([direction, -direction]), smooth=smooth
    )


@torch.no_grad()
def photograph(
    vertices: torch.Tensor | np.ndarray,
    faces: torch.Tensor | np.ndarray,
    colors: np.ndarray | Sequence[float] | nmr.VertexColors,
    cameras: nmr.cameras.Camera,
    *,
    image_size: int,
    lights: nmr.Lights | None = None,
    supersample: int = 2,
) -> tuple[np.ndarray, np.ndarray]:
    """One mesh in B views on white, without gradients. Both sides of its faces are lit alike.

    vertices float [V, 3] in the object frame, faces integer [F, 3], a camera of nmr with B poses.
    colors: those of the vertices, or of the faces, float [F, 3] or [3] in [0, 1]. supersample:
    subpixels per pixel and axis, an even number; 2 covers exactly the pixels that
    `nmr.render_silhouette` covers. Returns rgb uint8 [B, S, S, 3], row 0 = top, and alpha uint8
    [B, S, S], 255 * the covered share of each pixel. Raises TypeError and ValueError as
    `nmr.render` does.
    """
    faces = torch.as_tensor(faces).cpu()
    if not isinstance(colors, nmr.VertexColors):
        colors = nmr.FaceColors(
            torch.as_tensor(np.float32(colors)).clamp(0.0, 1.0).expand(len(faces), 3)
        )
    finer = supersample // 2  # the renderer halves once more
    images = nmr.render(
        torch.as_tensor(vertices, dtype=torch.float32).cpu(),
        faces,
        cameras,
        outputs=("rgb", "alpha"),
        colors=colors,
        lights=lights or studio_lights(),
        background=1.0,
        image_size=image_size * finer,
    )
    channels = torch.cat([images.rgb, images.alpha.unsqueeze(-1)], dim=-1)
    if finer > 1:
        channels = F.avg_pool2d(channels.movedim(-1, 1), finer).movedim(1, -1)
    pixels = np.rint(255.0 * channels.numpy()).astype(np.uint8)
    return np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])


CLAY = (0.62, 0.68, 0.78)
# towards the light: left of, above and behind the camera, in its axes (y is down)
_LIGHT = (-0.5, -0.45, -0.75)
_FAR = 5.0  # distance of orthographic cameras, outside of any object: faces behind a camera would be lit from behind

Cameras = Sequence[nmr.LookAt | nmr.Orthographic]  # each of one view


class Surface(NamedTuple):
    """One shape as triangles, on the CPU."""

    vertices: Tensor  # float32 [V, 3], object frame
    faces: Tensor  # int64 [F, 3]; F = 0 is an empty shape
    colors: Tensor | None = None  # float32 [V, 3] in [0, 1], R, G, B of each vertex; None: clay


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


def azimuths_deg(poses: Poses | None) -> Tensor:
    """Azimuth of every camera, float64 [M] in -180 .. 180: the eye is at (sin a, ., -cos a) of the object frame.

    Raises ValueError without poses.
    """
    if poses is None:
        raise ValueError("this figure needs camera poses, and these data have none")
    x, _, z = poses.eyes().double().T
    return torch.rad2deg(torch.atan2(x, -z))


def draw_surface(surface: Surface, cameras: Cameras, *, image_size: int) -> np.ndarray:
    """One shape on white, in its colours or as clay, from each of N cameras: uint8 [N,S,S,3].

    The light moves with the camera (from above, left of it), so that no side of the shape is dark.
    """
    if len(surface.faces) == 0:
        return np.full((len(cameras), image_size, image_size, 3), 255, np.uint8)
    colored = surface.colors is not None  # colours of a photograph have its light: shade them less
    colors = nmr.VertexColors(surface.colors.detach()) if colored else CLAY
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


TILE = 96  # pixels: side of a picture
MARGIN = 4  # pixels between pictures
HEADER = 18  # pixels: height of the column titles
_TEXT = (60, 60, 60)
_RULE = (205, 205, 205)


def tile(
    rows: Sequence[Sequence[np.ndarray | None]],
    titles: Sequence[str] = (),
    *,
    tile_size: int = TILE,
    row_titles: Sequence[str] = (),
    rules: Collection[int] = (),
) -> np.ndarray:
    """Arrange pictures uint8 [h,w,3] on a white sheet, each scaled to the same square; uint8 [H,W,3].

    None leaves a place free. Titles are above the columns and to the left of the rows. rules:
    numbers of the rows that have a thin line above them.
    """
    font = ImageFont.load_default(12)
    top = HEADER + MARGIN if titles else MARGIN
    left = (
        max((math.ceil(font.getlength(title)) + 2 * MARGIN for title in row_titles), default=0)
        + MARGIN
    )
    step = tile_size + MARGIN
    half = tile_size // 2
    size = (left + max(map(len, rows)) * step, top + len(rows) * step)
    sheet = Image.new("RGB", size, (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    for column, title in enumerate(titles):
        draw.text(
            (left + column * step + half, HEADER - 4), title, fill=_TEXT, anchor="ms", font=font
        )
    for row, title in enumerate(row_titles):
        draw.text(
            (left - 2 * MARGIN, top + row * step + half), title, fill=_TEXT, anchor="rm", font=font
        )
    for height in (top + row * step - MARGIN // 2 for row in rules):
        draw.line([(0, height), (sheet.width, height)], fill=_RULE)
    for r, row in enumerate(rows):
        for c, picture in enumerate(row):
            if picture is not None:  # `resize` copies a picture that has the size already
                image = Image.fromarray(picture).resize(
                    (tile_size, tile_size), Image.Resampling.BICUBIC
                )
                sheet.paste(image, (left + c * step, top + r * step))
    return np.asarray(sheet)


def natural_colors(images: np.ndarray, *, inverted: bool = True) -> np.ndarray:
    """The colours uint8 [..., H, W, 3] of stored images uint8 [..., 4, H, W].

    inverted: colours are stored as 255 - colour over black, see `ViewDataset.inverted`.
    """
    colors = np.moveaxis(images[..., :3, :, :], -3, -1)
    return 255 - colors if inverted else colors


def save_png(path: Path, rgb: np.ndarray) -> None:
    """Write a picture uint8 [H,W,3], or [H,W,4] with opacity."""
    buffer, about = io.BytesIO(), PngInfo()
    about.add_text("Software", PROGRAM)
    Image.fromarray(rgb).save(buffer, format="PNG", optimize=True, pnginfo=about)
    writing.write_bytes(path, buffer.getvalue())


def save_gif(path: Path, frames: np.ndarray, *, frames_per_second: float = 15.0) -> None:
    """Write an animation that repeats for ever, frames uint8 [N,H,W,3]."""
    buffer = io.BytesIO()
    first, *rest = [
        Image.fromarray(f).convert("P", palette=Image.Palette.ADAPTIVE, colors=64) for f in frames
    ]
    about = {"duration": round(1000 / frames_per_second), "loop": 0, "comment": PROGRAM}
    first.save(buffer, format="GIF", save_all=True, append_images=rest, optimize=True, **about)
    writing.write_bytes(path, buffer.getvalue())
