"""From a picture to a mesh: a mask by the colour of the background, and the files of each model's mesh."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from scipy.ndimage import binary_dilation, binary_erosion

import nmr
from learn3d.data.conventions import DISTANCE, HALF_FOV_DEG, mesh_to_object
from learn3d.data.framing import TOLERANCE, check_mask, read_picture
from learn3d.fitting.cutting import find_mask
from learn3d.fitting.fit import Progress
from learn3d.make_data.shapes import make_shape
from learn3d.make_data.writers.around import natural_look
from learn3d.pictures.studio import photograph
from learn3d.pictures.surfaces import CLAY, Surface
from learn3d.reconstruction import Model, Reconstruction, export_mesh, reconstruct_picture

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
    found = find_mask(colors, tolerance) if alpha is None else alpha
    height, width = colors.shape[:2]
    top, left = (SIDE - height) // 2, (SIDE - width) // 2
    around = (top, SIDE - height - top), (left, SIDE - width - left)
    padded = np.pad(colors, (*around, (0, 0)), mode="edge")  # the background goes on
    mask = np.pad(found, around)
    if alpha is None:
        return Picture(padded, mask, path.stem)
    padded[mask == 0] = 255
    return Picture(padded, mask, path.stem)


def example(category: str, seed: int) -> Picture:
    """A generated object of `make_data.shapes.CATEGORIES` in natural colours, seen half from the front."""
    rng = np.random.default_rng(seed)
    mesh = make_shape(category, rng)
    vertices = mesh.vertices @ mesh_to_object("y", "z").T
    colors, lights = natural_look(vertices, mesh.faces, rng)
    azimuth = rng.choice([-1, 1]) * rng.uniform(20, 70)
    camera = nmr.LookAt.from_angles(DISTANCE, 22.0, [azimuth], half_fov_deg=HALF_FOV_DEG)
    faces = torch.tensor(mesh.faces)
    rgb, alpha = photograph(np.float32(vertices), faces, colors, camera, image_size=SIDE, lights=lights)
    return Picture(rgb[0], alpha[0], category, framed=True)


def outline(picture: Picture) -> np.ndarray:
    """The picture with a line around its object, uint8 [SIDE, SIDE, 3]: white, with a dark rim."""
    inside = picture.mask > 127
    shown = picture.colors.copy()
    for width, color in ((5, (30, 30, 30)), (3, (255, 255, 255))):
        shown[binary_dilation(inside, iterations=width) & ~binary_erosion(inside, iterations=width - 2)] = color
    return shown


def make_mesh(model: Model, picture: Picture, progress: Progress | None = None) -> Reconstruction:
    """What the model makes of a picture; `progress` as `fit` has it. Raises ValueError if the mask cannot be right."""
    try:
        check_mask(picture.mask)
    except ValueError:
        raise ValueError("no object was found in the picture; correct the outline with the brush") from None
    return reconstruct_picture(model, picture.colors, picture.mask, crop=not picture.framed, progress=progress)


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
