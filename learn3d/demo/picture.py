"""From a picture to a mesh: a mask by the colour of the background, and the files of each model's mesh."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image

import nmr
from learn3d.data.conventions import DISTANCE, HALF_FOV_DEG, mesh_to_object
from learn3d.data.framing import TOLERANCE, check_mask, read_picture, threshold_mask
from learn3d.make_data.shapes import make_shape
from learn3d.pictures.studio import photograph
from learn3d.pictures.surfaces import CLAY, Surface
from learn3d.reconstruction import Model, export_mesh, input_azimuth_deg, reconstruct

SIDE = 512  # pixels of the square on which pictures lie; the networks see 64 to 224


class Picture(NamedTuple):
    """A picture on a square, and where its object is."""

    colors: np.ndarray  # uint8 [SIDE, SIDE, 3]
    mask: np.ndarray  # uint8 [SIDE, SIDE], 255: object
    name: str = "picture"
    framed: bool = False  # as the networks' training images are: the object is as large in it as its distance makes it


def open_picture(path: Path, tolerance: float = TOLERANCE) -> Picture:
    """Read a picture file. Its mask is its transparency or, if it has none, that of `threshold_mask`.

    Raises ValueError for a file that is no picture.
    """
    colors, alpha = read_picture(path, SIDE)
    height, width = colors.shape[:2]
    top, left = (SIDE - height) // 2, (SIDE - width) // 2
    around = (top, SIDE - height - top), (left, SIDE - width - left)
    padded = np.pad(colors, (*around, (0, 0)), mode="edge")  # the background goes on
    if alpha is None:
        return Picture(padded, threshold_mask(padded, tolerance), path.stem)
    mask = np.pad(alpha, around)
    padded[mask == 0] = 255
    return Picture(padded, mask, path.stem)


def example(category: str, seed: int) -> Picture:
    """A generated object of `make_data.shapes.CATEGORIES`, as Kato's camera sees it from some side."""
    rng = np.random.default_rng(seed)
    mesh = make_shape(category, rng)
    vertices = torch.from_numpy(np.asarray(mesh.vertices @ mesh_to_object("y", "z").T, np.float32))
    camera = nmr.LookAt.from_angles(DISTANCE, 30.0, [rng.uniform(0, 360)], half_fov_deg=HALF_FOV_DEG)
    rgb, alpha = photograph(vertices, torch.tensor(mesh.faces), rng.uniform(0.3, 0.9, 3), camera, image_size=SIDE)
    return Picture(rgb[0], alpha[0], category, framed=True)


def make_mesh(model: Model, picture: Picture) -> tuple[Surface, float]:
    """The model's mesh of a picture and, in degrees, the azimuth from which it looks like the picture.

    Raises ValueError if the mask cannot be right.
    """
    try:
        check_mask(picture.mask)
    except ValueError as error:
        raise ValueError(f"{error} (correct it with the threshold or the brush)") from None
    stored = model.prepare(picture.colors, picture.mask, crop=not picture.framed)
    (surface,) = reconstruct(model.method, stored[None])
    return surface, input_azimuth_deg(surface, stored[3])


def write_cutout(picture: Picture, folder: Path) -> Path:
    """Write <name>.png, the square picture with its mask as transparency, which `open_picture` reads; its path."""
    path = folder / f"{picture.name}.png"
    Image.fromarray(np.dstack([picture.colors, picture.mask])).save(path)
    return path


def write_mesh(surface: Surface, folder: Path, name: str) -> tuple[Path, Path]:
    """Write <name>.glb (in clay if the shape has no colours) and <name>.obj; returns both paths."""
    folder.mkdir(parents=True, exist_ok=True)
    if surface.colors is None:
        surface = surface._replace(colors=torch.tensor(CLAY).expand_as(surface.vertices))
    paths = folder / f"{name}.glb", folder / f"{name}.obj"
    for path in paths:
        export_mesh(path, surface)
    return paths
