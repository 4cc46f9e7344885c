"""Composes photographs of cut-out objects, for training (train_outlines.py) and measuring (measure_cutouts.py)."""

from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np

import nmr
from learn3d.data.conventions import mesh_to_object
from learn3d.data.masks import mask_box
from learn3d.pictures import photograph
from learn3d.studio.make_data.looks import natural_look
from learn3d.studio.make_data.meshes import fit_to_box

RADIUS = 0.87  # of the sphere around an object that fits the unit cube

Box = tuple[float, float, float, float]  # left, top, width, height in pixels
Surroundings = Literal["photograph", "room", "plain room"]


def draw_object(
    vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator, side: int
) -> np.ndarray:
    """A mesh [V, 3], [F, 3] (y up, front +z) in random colours from a random side, RGBA uint8 [h, w, 4].

    side: that of the image, whose empty margin is cut off.
    """
    vertices = np.float32(fit_to_box(vertices) @ mesh_to_object("y", "z").T)
    colors, lights = natural_look(vertices, faces, rng)
    distance = rng.uniform(1.5, 4)
    camera = nmr.LookAt.from_angles(
        distance,
        rng.uniform(-5, 45),
        [rng.uniform(-180, 180)],
        half_fov_deg=float(np.degrees(np.arcsin(RADIUS / distance))),
    )
    (rgb,), (alpha,) = photograph(vertices, faces, colors, camera, image_size=side, lights=lights)
    # the background is white; a cut-out stores its own colours, not multiplied by alpha
    share = np.maximum(alpha, 1)[..., None] / 255
    own = ((rgb - 255 * (1 - share)) / share).clip(0, 255)
    left, top, right, bottom = mask_box(alpha)
    return np.dstack([own, alpha]).astype(np.uint8)[top:bottom, left:right]


class Composer:
    """Makes photographs: a cut-out in a room or before a part of a picture, with shadows and other things.

    All random numbers come from the generator that is given. Inside, colours are float32 in
    0 .. 255.
    """

    def __init__(
        self, pictures: Sequence[np.ndarray], things: Sequence[np.ndarray] = (), mess: float = 0.0
    ) -> None:
        """pictures: photographs and textures, uint8 [H, W, 3].

        things: cut-outs RGBA uint8 [h, w, 4] that may stand beside the object. mess: mean number
        of them.
        """
        self.pictures, self.things, self.mess = pictures, things, mess

    def __call__(
        self,
        rng: np.random.Generator,
        sprite: np.ndarray,
        box: Box,
        size: tuple[int, int],
        around: Surroundings,
    ) -> tuple[np.ndarray, np.ndarray]:
        """The photograph uint8 [H, W, 3] of a cut-out RGBA [h, w, 4], and its alpha, float32 [H, W] in 0 .. 1.

        box: its place, which may reach out of the photograph. size: W, H.
        """
        left, top, wide, tall = box
        if around == "photograph":
            scene = self.part(rng, *size)
        else:
            scene = self._room(rng, *size, top + tall, around == "plain room")
        if rng.random() < 0.1:  # a background with the colour of the object
            own = sprite[sprite[..., 3] > 127][:, :3]
            scene += rng.uniform(0.6, 1) * (own.mean(0) - scene.mean((0, 1)))
        for _ in range(rng.poisson(self.mess)):
            thing = self.things[rng.integers(len(self.things))]
            larger = rng.uniform(0.15, 0.8) * max(wide, tall) / max(thing.shape)
            high, broad = larger * np.array(thing.shape[:2])
            beside = left + rng.uniform(-broad, wide), top + tall - high * rng.uniform(0.5, 1.2)
            scene, _ = _paste(rng, scene, thing, (*beside, broad, high))
        scene, alpha = _paste(rng, scene, sprite, box)
        return _develop(rng, scene), alpha

    def part(self, rng: np.random.Generator, width: int, height: int) -> np.ndarray:
        """A random part of a random picture, perhaps blurred, float32 [height, width, 3]."""
        picture = self.pictures[rng.integers(len(self.pictures))]
        tall, wide = picture.shape[:2]
        high = rng.uniform(0.25, 1) * min(tall, wide * height / width)
        cut = np.ceil([high, high * width / height]).astype(int)
        (top, left), (high, broad) = rng.integers(picture.shape[:2] - cut + 1), cut
        found = picture[top : top + high, left : left + broad]
        found = cv2.resize(found, (width, height), interpolation=cv2.INTER_AREA)
        if rng.random() < 0.5:
            found = cv2.GaussianBlur(found, (0, 0), rng.choice([0.4, 0.7, 1.5, 4]))
        return np.float32(found * rng.uniform(0.6, 1.15) * rng.uniform(0.85, 1.1, 3))

    def _surface(
        self, rng: np.random.Generator, width: int, height: int, plain: bool
    ) -> np.ndarray:
        """A wall, a floor or a board: a part of a picture, or paint with noise, stripes or checks; faint if plain."""
        if rng.random() < 0.4 and not plain:
            return self.part(rng, width, height)
        y, x = np.mgrid[:height, :width] / height
        # no waves along one axis make stripes, none at all plain paint
        across, along = rng.uniform(10, 150, 2) * (rng.random(2) < 0.5)
        grain = rng.standard_normal(rng.integers(4, 150, 2), np.float32)
        tone = np.sign(np.sin(across * x)) + np.sign(np.sin(along * y))
        tone = rng.uniform(2, 25) * tone + rng.uniform(0, 15) * cv2.resize(grain, (width, height))
        color = rng.uniform(40, 245) + rng.normal(0, rng.choice([6, 25]), 3)
        return np.float32(color + (0.1 if plain else 1) * tone[..., None])

    def _room(
        self, rng: np.random.Generator, width: int, height: int, ground: float, plain: bool
    ) -> np.ndarray:
        """One or two walls with pictures, a skirting board, and a floor that reaches up behind `ground`."""
        scene = self._surface(rng, width, height, plain)
        for _ in range(rng.integers(4)):  # pictures, windows, shelves
            (left, top), (right, bottom) = np.sort(rng.integers((width, height), size=(2, 2)), 0)
            if min(right - left, bottom - top) > 2:
                scene[top:bottom, left:right] = self._surface(
                    rng, right - left, bottom - top, plain
                )
        if rng.random() < 0.35:  # another wall, in other light
            scene[:, rng.integers(width) :] *= rng.uniform(0.65, 1.2)
        y, x = np.mgrid[:height, :width]
        slope = rng.uniform(-0.1, 0.1)
        line = np.clip(ground - rng.uniform(-0.02, 0.45) * height, 0.1 * height, 0.9 * height)
        edge = line + slope * (x - width / 2)
        if rng.random() < 0.6:
            board = rng.uniform(20, 245) + rng.normal(0, 10, 3)
            scene[y > edge - rng.uniform(0.005, 0.06) * height] = board
        far, near = line - abs(slope) * width / 2, rng.uniform(0.5, 4) * width
        corners = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
        laid = [[0, far], [width, far], [width + near, height], [-near, height]]
        view = cv2.getPerspectiveTransform(corners, np.float32(laid))
        floor = cv2.warpPerspective(self._surface(rng, width, height, plain), view, (width, height))
        scene = np.where((y > edge)[..., None], floor, scene)
        light = rng.uniform(-0.5, 0.5, 2) @ [(x / width - 0.5).ravel(), (y / height - 0.5).ravel()]
        return np.float32(scene * (1 + light.reshape(height, width, 1)))


def _paste(
    rng: np.random.Generator, scene: np.ndarray, sprite: np.ndarray, box: Box
) -> tuple[np.ndarray, np.ndarray]:
    """The scene with a cut-out in a box and its shadows, and the cut-out's alpha in 0 .. 1."""
    left, top, wide, tall = box
    size = max(2, round(wide)), max(2, round(tall))
    share = sprite[..., 3:] / np.float32(255)
    paint = cv2.resize(
        np.dstack([sprite[..., :3] * share, share]), size, interpolation=cv2.INTER_AREA
    )
    move = np.float32([[1, 0, left], [0, 1, top]])
    paint = cv2.warpAffine(paint, move, scene.shape[1::-1])
    alpha = paint[..., 3]
    scene = scene * (1 - _shadow(rng, alpha, box))[..., None]
    return scene * (1 - alpha[..., None]) + paint[..., :3], alpha


def _shadow(rng: np.random.Generator, alpha: np.ndarray, box: Box) -> np.ndarray:
    """The darkness in 0 .. 1 of a cast shadow, the outline tilted about its foot, and of a contact shadow."""
    left, top, wide, tall = box
    foot, size = top + tall, alpha.shape[::-1]
    lean, rise = tall * rng.uniform((-1.2, 0.15), (1.2, 1)) * [1, rng.choice([-1, 1, 1])]
    upright = np.float32([[left, foot], [left + wide, foot], [left, top]])
    fallen = upright + np.float32([[0, 0], [0, 0], [lean, tall - rise]])
    cast = cv2.warpAffine(alpha, cv2.getAffineTransform(upright, fallen), size)
    cast = cv2.GaussianBlur(cast, (0, 0), rng.uniform(0.004, 0.035) * max(size))
    low = alpha * (np.arange(len(alpha)) > foot - rng.uniform(0.05, 0.15) * tall)[:, None]
    contact = cv2.GaussianBlur(low, (0, 0), 0.03 * max(size), sigmaY=0.012 * max(size))
    return 1 - (1 - rng.uniform(0, 0.6) * cast) * (1 - rng.uniform(0, 0.6) * contact)


def _develop(rng: np.random.Generator, scene: np.ndarray) -> np.ndarray:
    """A scene as a camera stores it, uint8: white balance, contrast, blur, noise, JPEG."""
    scene = 255 * (scene.clip(0, 255) / 255) ** rng.uniform(0.75, 1.35)
    scene = (scene - 128) * rng.normal(0.95, 0.06, 3) + 128 + rng.normal(0, 10)
    if rng.random() < 0.06:
        scene[:] = scene.mean(2, keepdims=True)
    scene = cv2.GaussianBlur(scene, (0, 0), rng.uniform(0.2, 0.8))
    scene = (scene + rng.normal(0, rng.uniform(0, 5), scene.shape)).clip(0, 255).astype(np.uint8)
    quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 100))]
    return cv2.imdecode(cv2.imencode(".jpg", scene, quality)[1], cv2.IMREAD_COLOR)
