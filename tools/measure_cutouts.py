"""Measures how well objects are cut out of photographs with walls, floors and shadows.

python tools/measure_cutouts.py --images 40 --seed 2 --sheet cutouts.png
python tools/measure_cutouts.py --images 40 --seed 2 --kind cut-off
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
import tyro
from composing import Composer, Surroundings, draw_object

from learn3d.data.masks import keep_object, mask_box
from learn3d.pictures import save_png, tile
from learn3d.studio.picture_to_mesh.cutting import Box, find_outline
from learn3d.studio.picture_to_mesh.options import DEFAULTS, CutOptions
from learn3d.studio.shapes import CATEGORIES, make_shape

SIZES = ((480, 360), (400, 400), (360, 480))  # width and height in pixels
GOOD = 0.85  # least IoU of an outline that needs no hand


Kind = Literal["usual", "plain-room", "cut-off"]


class Scene(NamedTuple):
    """A composed photograph."""

    colors: np.ndarray  # uint8 [H, W, 3]
    mask: np.ndarray  # bool [H, W]: the object
    around: Surroundings

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


def compose_scene(rng: np.random.Generator, compose: Composer, kind: Kind = "usual") -> Scene:
    """A generated object in a drawn room or before a part of a photograph; a part of it may be cut off by a side."""
    size = np.array(SIZES[rng.integers(len(SIZES))])
    around: Surroundings = "room" if rng.random() < 0.6 else "photograph"
    if kind == "plain-room":
        around = "plain room"
    mesh = make_shape(str(rng.choice(CATEGORIES)), rng)
    sprite = draw_object(mesh.vertices, mesh.faces, rng, 512)
    own = min(size) * rng.uniform(0.55, 0.85) * np.array(sprite.shape[1::-1]) / max(sprite.shape)
    free = size - own
    place = (free * rng.uniform((0.35, 0.45), (0.65, 0.8))).clip(2, free - 2)
    if kind == "cut-off":
        axis, end = rng.integers(2, size=2)
        place[axis] = end * free[axis] + (2 * end - 1) * rng.uniform(0.08, 0.35) * own[axis]
    colors, alpha = compose(rng, sprite, (*place, *own), tuple(size.tolist()), around)
    return Scene(colors, alpha > 0.5, around)


def package_photographs() -> list[np.ndarray]:
    """Photographs of walls, grounds and places in scikit-image and scikit-learn, without those of one other thing."""
    from skimage import color, data
    from sklearn.datasets import load_sample_image

    pictures = [
        data.brick(),
        data.gravel(),
        data.grass(),
        data.rocket(),
        data.stereo_motorcycle()[0],
    ]
    pictures.append(load_sample_image("china.jpg"))
    return [color.gray2rgb(picture) if picture.ndim == 2 else picture for picture in pictures]


def scenes(images: int, seed: int, kind: Kind = "usual") -> Iterator[Scene]:
    """Composed photographs; the same number, seed and kind give the same ones."""
    compose = Composer(package_photographs())
    for number in range(images):
        yield compose_scene(np.random.default_rng([seed, number]), compose, kind)


def iou(found: np.ndarray, mask: np.ndarray) -> float:
    """IoU of a mask uint8 [H, W] and the object, bool [H, W]."""
    return float(((found > 127) & mask).sum() / ((found > 127) | mask).sum())


def main(
    images: int = 40,
    seed: int = 2,
    kind: Kind = "usual",
    sheet: Path | None = None,
    options: CutOptions = DEFAULTS.cut,
) -> None:
    """Print the share of outlines with an IoU above 0.85, found without a hand and with a box, and of doubts.

    The objects are generated, before drawn rooms and photographs out of scikit-image and
    scikit-learn. kind: usual scenes, rooms with plain walls and floors, or objects that a side of
    the picture cuts off, which are to be doubted.
    sheet: a PNG of the pictures with the outlines that were found without a hand and with a box.
    """
    torch.set_num_threads(1)
    backgrounds, values, shown = [], [], []
    for number, scene in enumerate(scenes(images, seed, kind)):
        box = scene.box(np.random.default_rng([seed, number, 1]))
        for each in (None, box):
            outline = find_outline(scene.colors, each, options)
            mask = keep_object(outline.mask)[0]
            right, doubted = iou(mask, scene.mask) > GOOD, outline.doubt is not None
            silent = not doubted and (not right or kind == "cut-off")
            values.append((right, silent, right and doubted))
            shown.append(_draw(scene.colors, mask))
        backgrounds.append(scene.around)
    shares = np.reshape(values, (-1, 6))
    print(f"{'':24}{'no hand':>27}{'box':>27}")
    titles = ("right", "silent", "asked") * 2
    print(f"{'':12}{'pictures':>12}" + "".join(f"{title:>9}" for title in titles))
    for name in (*dict.fromkeys(backgrounds), "all"):
        rows = np.array([name in (each, "all") for each in backgrounds])
        means = shares[rows].mean(axis=0)
        print(f"{name:12}{rows.sum():12}" + "".join(f"{share:9.0%}" for share in means))
    print("silent: wrong or cut off without a doubt; asked: right, with a doubt")
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
