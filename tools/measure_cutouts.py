"""Measures how well objects are cut out of photographs with walls, floors and shadows.

python tools/measure_cutouts.py --images 40 --seed 2 --sheet cutouts.png
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import tyro
from PIL import Image, ImageFilter
from scipy import ndimage

import nmr
from learn3d.data.conventions import DISTANCE, HALF_FOV_DEG, mesh_to_object
from learn3d.data.masks import keep_object, mask_box
from learn3d.pictures import photograph, save_png, tile
from learn3d.studio.make_data.looks import natural_look
from learn3d.studio.picture_to_mesh.cutting import Box, find_outline
from learn3d.studio.shapes import make_shape

CATEGORIES = ("airplane", "car", "chair", "lamp", "sofa", "table")
SIZES = ((480, 360), (400, 400), (360, 480))  # width and height in pixels
GOOD = 0.85  # least IoU of an outline that needs no hand


class Scene(NamedTuple):
    """A composed photograph."""

    colors: np.ndarray  # uint8 [H, W, 3]
    mask: np.ndarray  # bool [H, W]: the object
    kind: str  # of the background: "room" or "photograph"

    def box(self, rng: np.random.Generator) -> Box:
        """The box that a hand would draw: up to a twentieth of its sides too large."""
        left, top, right, bottom = mask_box(255 * self.mask.astype(np.uint8))
        height, width = self.mask.shape
        wide, high = right - left, bottom - top
        shares = rng.uniform(0.01, 0.05, 4)
        left = max(1, round(left - shares[0] * wide))
        right = min(width - 1, round(right + shares[1] * wide))
        top = max(1, round(top - shares[2] * high))
        bottom = min(height - 1, round(bottom + shares[3] * high))
        return left, top, right - left, bottom - top


def compose(rng: np.random.Generator, photographs: list[Image.Image]) -> Scene:
    """An object of a random kind before a drawn room or a part of a photograph, with a shadow on the floor."""
    width, height = SIZES[rng.integers(len(SIZES))]
    photo = rng.random() < 0.4
    scene = (
        _part(rng, photographs[rng.integers(len(photographs))], width, height)
        if photo
        else _room(rng, width, height)
    )
    paint, alpha = _object(
        rng, str(rng.choice(CATEGORIES)), round(min(width, height) * rng.uniform(0.55, 0.85))
    )
    tall, wide = alpha.shape
    left = round((width - wide) / 2 + rng.uniform(-0.1, 0.1) * width)
    top = round((height - tall) * rng.uniform(0.45, 0.8))
    left, top = np.clip(left, 2, width - wide - 2), np.clip(top, 2, height - tall - 2)
    whole = np.zeros((height, width))
    whole[top : top + tall, left : left + wide] = alpha
    scene = scene * (1 - _shadow(rng, whole, top + tall))[..., None]
    scene *= 1 - whole[..., None]
    scene[top : top + tall, left : left + wide] += paint
    scene = ndimage.gaussian_filter(scene, (rng.uniform(0.3, 0.7),) * 2 + (0,))
    scene += rng.normal(0, rng.uniform(1, 4), scene.shape)
    return Scene(
        scene.clip(0, 255).astype(np.uint8), whole > 0.5, "photograph" if photo else "room"
    )


def _object(rng: np.random.Generator, category: str, side: int) -> tuple[np.ndarray, np.ndarray]:
    """A generated object from a random side: colours (0 .. 255) times alpha [h, w, 3], and alpha (0 .. 1) [h, w]."""
    mesh = make_shape(category, rng)
    vertices = np.float32(mesh.vertices @ mesh_to_object("y", "z").T)
    colors, lights = natural_look(vertices, mesh.faces, rng)
    angles = rng.uniform(5, 30), [rng.uniform(-180, 180)]
    camera = nmr.LookAt.from_angles(DISTANCE, *angles, half_fov_deg=HALF_FOV_DEG)
    (rgb,), (alpha,) = photograph(
        vertices, mesh.faces, colors, camera, image_size=512, lights=lights
    )
    left, top, right, bottom = mask_box(alpha)
    picture = Image.fromarray(np.dstack([rgb, alpha])).crop((left, top, right, bottom))
    scale = side / max(picture.size)
    size = max(8, round(picture.width * scale)), max(8, round(picture.height * scale))
    pixels = np.asarray(picture.resize(size, Image.Resampling.BOX)).astype(float)
    alpha = pixels[..., 3] / 255
    return (pixels[..., :3] - 255 * (1 - alpha[..., None])).clip(0), alpha


def _shadow(rng: np.random.Generator, alpha: np.ndarray, ground: int) -> np.ndarray:
    """The darkness in 0 .. 1 of a cast shadow, the flattened and sheared outline, and of a contact shadow."""
    height, width = alpha.shape
    y, x = np.indices(alpha.shape).astype(float)
    ground -= rng.uniform(0.0, 0.06) * height
    flat, shear = rng.uniform(0.15, 0.5), rng.uniform(-1.2, 1.2)
    side = rng.choice([-1, 1], p=(0.3, 0.7))  # before or behind the object
    up = side * (ground - y) / flat
    cast = ndimage.map_coordinates(alpha, [ground - up, x - shear * side * (ground - y)], order=1)
    cast[up < 0] = 0
    cast = rng.uniform(0.15, 0.55) * ndimage.gaussian_filter(cast, rng.uniform(1.5, 0.025 * height))
    low = alpha * (y > ground - 0.12 * height)
    contact = 0.5 * ndimage.gaussian_filter(low, (0.01 * height, 0.03 * width))
    return 1 - (1 - cast) * (1 - contact * rng.uniform(0, 1))


def _room(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """A wall with light from one side, perhaps papered or with a picture, a skirting board, and a floor."""
    y, x = np.indices((height, width)).astype(float)
    wall, floor, board = (_tint(rng, low) for low in (110, 60, 60))
    pattern, strength = rng.integers(4), rng.uniform(4, 14)
    if pattern == 1:
        wall = wall + strength * np.sign(np.sin(x / rng.uniform(3, 12)))[..., None]
    elif pattern == 2:
        wall = (
            wall
            + strength
            * (ndimage.gaussian_filter(rng.normal(size=(height, width)), 1.5) * 4)[..., None]
        )
    scene = np.broadcast_to(wall, (height, width, 3)).copy()
    if rng.random() < 0.4:
        left, top = rng.integers(0, width // 2), rng.integers(0, height // 4)
        frame = np.s_[
            top : top + height // rng.integers(3, 6), left : left + width // rng.integers(3, 6)
        ]
        scene[frame] = _tint(rng, 30)
        inner = scene[frame][4:-4, 4:-4]
        inner[:] = _tint(rng, 60)
    slope = rng.uniform(-0.08, 0.08)
    line = height * rng.uniform(0.45, 0.75) + slope * (x - width / 2)
    if rng.random() < 0.25:
        line += rng.uniform(0.1, 0.4) * np.maximum(0, x - rng.uniform(0.1, 0.9) * width)
    depth = np.maximum(1e-3, (y - line) / height) + 0.05
    boards = np.floor((x - width * rng.uniform(0.2, 0.8)) / depth * rng.uniform(0.003, 0.02))
    rows = np.floor(rng.uniform(0.5, 1.5) / depth)
    kind = rng.integers(4)
    tone = np.zeros((height, width))
    if kind == 1:
        tone = 12 * np.sin(boards * 12.9898) + 6 * np.sin(y * 0.7 + 5 * np.sin(x * 0.05))
    elif kind == 2:
        tone = 10 * np.sign(np.sin(np.pi * boards) + np.sin(np.pi * rows) + 1e-6 * x)
    elif kind == 3:
        tone = 10 * rng.normal(size=(height, width))
    on_floor = y > line
    scene[on_floor] = (floor + tone[..., None])[on_floor]
    if rng.random() < 0.7:
        scene[(y <= line) & (y > line - rng.uniform(0.01, 0.04) * height)] = board
    light = (
        1
        + rng.uniform(-0.25, 0.25) * (x / width - 0.5)
        + rng.uniform(-0.25, 0.25) * (y / height - 0.5)
    )
    spot = np.hypot(x / width - rng.random(), y / height - rng.random())
    return scene * (light * (1.05 - rng.uniform(0, 0.3) * spot))[..., None]


def _tint(rng: np.random.Generator, low: float) -> np.ndarray:
    """A pale colour [3], no channel darker than about `low`."""
    return rng.uniform(low, 235) + rng.normal(0, 14, 3)


def _part(rng: np.random.Generator, photo: Image.Image, width: int, height: int) -> np.ndarray:
    """A random part of a photograph in these sizes."""
    least = max(width / photo.width, height / photo.height)
    scale = max(least, min(2.5, least * rng.uniform(1, 1.8)))
    photo = photo.resize(
        (max(width, round(photo.width * scale)), max(height, round(photo.height * scale)))
    )
    left, top = rng.integers(photo.width - width + 1), rng.integers(photo.height - height + 1)
    part = photo.crop((left, top, left + width, top + height)).filter(
        ImageFilter.GaussianBlur(rng.uniform(0, 2))
    )
    return np.asarray(part) * rng.uniform(0.8, 1.0, 3)


def package_photographs() -> list[Image.Image]:
    """Photographs of walls, grounds and places in scikit-image and scikit-learn, without those of one other thing."""
    from skimage import data
    from sklearn.datasets import load_sample_image

    pictures = [
        data.brick(),
        data.gravel(),
        data.grass(),
        data.rocket(),
        data.stereo_motorcycle()[0],
    ]
    pictures.append(load_sample_image("china.jpg"))
    return [Image.fromarray(np.ascontiguousarray(picture)).convert("RGB") for picture in pictures]


def scenes(images: int, seed: int) -> Iterator[Scene]:
    """Composed photographs; the same number and seed give the same ones."""
    photographs = package_photographs()
    for number in range(images):
        yield compose(np.random.default_rng([seed, number]), photographs)


def iou(found: np.ndarray, mask: np.ndarray) -> float:
    """IoU of a mask uint8 [H, W] and the object, bool [H, W]."""
    return float(((found > 127) & mask).sum() / ((found > 127) | mask).sum())


def main(images: int = 40, seed: int = 2, sheet: Path | None = None) -> None:
    """Print the share of outlines with an IoU above 0.85, found without a hand and with a box.

    The objects are generated, before drawn rooms and photographs out of scikit-image and
    scikit-learn.
    sheet: a PNG of the pictures with the outlines that were found without a hand and with a box.
    """
    torch.set_num_threads(1)
    kinds, values, shown = [], [], []
    for number, scene in enumerate(scenes(images, seed)):
        box = scene.box(np.random.default_rng([seed, number, 1]))
        found = [keep_object(find_outline(scene.colors, each).mask)[0] for each in (None, box)]
        values.append([iou(mask, scene.mask) for mask in found])
        kinds.append(scene.kind)
        shown += [_draw(scene.colors, mask) for mask in found]
    good, kinds = np.array(values) > GOOD, np.array(kinds)
    print(f"{'':12}{'pictures':>12}{'no hand':>12}{'box':>12}")
    for name, rows in [
        *((kind, kinds == kind) for kind in ("room", "photograph")),
        ("all", kinds != ""),
    ]:
        print(
            f"{name:12}{rows.sum():12}"
            + "".join(f"{share:12.0%}" for share in good[rows].mean(axis=0))
        )
    if sheet is not None:
        save_png(
            sheet,
            tile([shown[start : start + 8] for start in range(0, len(shown), 8)], tile_size=192),
        )


def _draw(colors: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The picture, darker outside of the mask, on a square of white."""
    side = max(mask.shape)
    shown = np.full((side, side, 3), 255, np.uint8)
    shown[: mask.shape[0], : mask.shape[1]] = np.where(
        (mask > 127)[..., None], colors, colors // 4 + np.uint8([90, 0, 60])
    )
    return shown


if __name__ == "__main__":
    tyro.cli(main)
