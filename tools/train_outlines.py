"""Trains the network that finds objects in photographs, and stores it in the package.

python tools/free_meshes/fetch.py --output models
python tools/train_outlines.py --models models

Objects are generated, drawn by nmr, and composed before drawn rooms and parts of photographs. The
photographs, textures, and cut-outs of other things come from Debian's packages, which apt-get
downloads (500 MB). `tools/measure_cutouts.py` measures the result; none of its photographs and
objects is used here. It takes fifty minutes of processor time.
"""

import io
import time
import zipfile
from collections import deque
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import safetensors.torch
import torch
import torch.nn.functional as F
import trimesh
import tyro
from free_meshes.debs import get_package, read_package
from PIL import Image
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

import nmr
from learn3d.data.conventions import mesh_to_object
from learn3d.data.masks import mask_box
from learn3d.pictures import photograph, save_png, tile
from learn3d.studio.make_data.looks import natural_look
from learn3d.studio.make_data.meshes import check, fit_to_box, mesh_sources
from learn3d.studio.picture_to_mesh.outline_network import (
    WEIGHTS,
    OutlineNetwork,
    place_view,
)
from learn3d.studio.shapes import CATEGORIES, numbered_shape

# Debian's packages with photographs of landscapes, plants and things, and with textures of walls
PHOTOGRAPHS = (
    "mate-backgrounds",
    "gnome-backgrounds",
    "lomiri-wallpapers-16.04",
    "lomiri-wallpapers-20.04",
    "ukui-wallpapers",
)
TEXTURES = ("openarena-081-textures",)
THINGS = (
    "tuxpaint-stamps-default",
    "openclipart-png",
)  # cut-outs of other things, with transparency
MOST_THINGS = 1500  # from each of these packages
LARGEST_THING = 2000  # longest side in pixels of their pictures; larger ones are left out
SEED = 1_000_000  # tools/measure_cutouts.py has smaller seeds
SMALLEST, LARGEST = 128, 640  # sides of photographs and textures in pixels; larger ones are reduced
BRIGHT = 100  # least mean of their values, 0 .. 255; darker ones are made brighter, by 4 at most
FLAT = 8  # least standard deviation of their values, 0 .. 255
NARROWEST = 8  # least side in pixels of a cut-out
OBJECT = 176  # side in pixels of drawn objects
SIDES = (96, 128)  # side in pixels of the views, one after the other
BATCH = 16
RADIUS = 0.87  # of the sphere around an object that fits the unit cube
NEW = 4  # views of a batch that are new; the others were seen before
KEPT = 2048  # views that may be seen again
CALIBRATED = 512  # last views, by which batch norms are set
AVERAGE = 0.995  # decay of the moving average of the weights


def read_backgrounds(packages: tuple[str, ...], folder: Path) -> list[np.ndarray]:
    """The pictures of packages, uint8 [H, W, 3], which are downloaded into the folder."""
    suffixes, pictures = (".jpg", ".jpeg", ".png", ".webp", ".tga"), []
    for package in packages:
        files = read_package(get_package(package, folder), (*suffixes, ".pk3"))
        for name in [name for name in files if name.endswith(".pk3")]:
            archive = zipfile.ZipFile(io.BytesIO(files.pop(name)))
            inner = [name for name in archive.namelist() if name.lower().endswith(suffixes)]
            files |= {name: archive.read(name) for name in inner}
        for _, content in sorted(files.items()):
            try:
                picture = Image.open(io.BytesIO(content))
                picture.draft("RGB", (2 * LARGEST, 2 * LARGEST))
                picture = picture.convert("RGB")
            except OSError:
                continue
            picture.thumbnail((LARGEST, LARGEST), Image.Resampling.BOX, reducing_gap=2)
            pixels = np.asarray(picture)
            brighter = min(4, BRIGHT / max(1, pixels.mean()))
            if brighter > 1:
                pixels = (brighter * pixels).clip(0, 255).astype(np.uint8)
            if min(pixels.shape[:2]) >= SMALLEST and pixels.std() > FLAT:
                pictures.append(pixels)
    return pictures


def read_things(folder: Path) -> list[np.ndarray]:
    """Cut-outs RGBA uint8 [h, w, 4] of other things: the partly transparent pictures of the packages."""
    things = []
    for package in THINGS:
        files = sorted(read_package(get_package(package, folder), (".png",)).items())
        found = 0
        for number in np.random.default_rng(SEED).permutation(len(files)):
            if found == MOST_THINGS:
                break
            try:
                picture = Image.open(io.BytesIO(files[number][1]))
                if max(picture.size) > LARGEST_THING:
                    continue
                picture = picture.convert("RGBA")
            except (OSError, Image.DecompressionBombError):
                continue
            picture.thumbnail((OBJECT, OBJECT), Image.Resampling.BOX)
            pixels = np.asarray(picture)
            if 0.06 < (pixels[..., 3] > 127).mean() < 0.97:
                left, top, right, bottom = mask_box(pixels[..., 3])
                things.append(pixels[top:bottom, left:right])
                found += 1
    return things


def make_solid(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random thing: one to six boxes, cylinders, cones, balls and rings that overlap."""
    parts = []
    for _ in range(rng.integers(1, 7)):
        kind = rng.integers(5)
        if kind == 0:
            part = trimesh.creation.box(rng.uniform(0.2, 1, 3))
        elif kind == 1:
            part = trimesh.creation.cylinder(rng.uniform(0.05, 0.5), rng.uniform(0.1, 1.2))
        elif kind == 2:
            part = trimesh.creation.cone(rng.uniform(0.1, 0.5), rng.uniform(0.2, 1.2))
        elif kind == 3:
            part = trimesh.creation.icosphere(3, 0.5)
            part.apply_scale(rng.uniform(0.3, 1, 3))
        else:
            part = trimesh.creation.torus(rng.uniform(0.2, 0.5), rng.uniform(0.03, 0.15))
        if rng.random() < 0.5:
            part.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        part.apply_translation(rng.uniform(-0.45, 0.45, 3))
        parts.append(part)
    return trimesh.util.concatenate(parts)


def draw_object(vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A mesh [V, 3], [F, 3] (y up, front +z) in random colours from a random side, RGBA uint8 [h, w, 4]."""
    vertices = np.float32(fit_to_box(vertices) @ mesh_to_object("y", "z").T)
    colors, lights = natural_look(vertices, faces, rng)
    distance = rng.uniform(1.5, 4)
    camera = nmr.LookAt.from_angles(
        distance,
        rng.uniform(-5, 45),
        [rng.uniform(-180, 180)],
        half_fov_deg=float(np.degrees(np.arcsin(RADIUS / distance))),
    )
    (rgb,), (alpha,) = photograph(vertices, faces, colors, camera, image_size=OBJECT, lights=lights)
    # the background is white; a sprite stores its own colours, not multiplied by alpha
    share = np.maximum(alpha, 1)[..., None] / 255
    own = ((rgb - 255 * (1 - share)) / share).clip(0, 255)
    left, top, right, bottom = mask_box(alpha)
    return np.dstack([own, alpha]).astype(np.uint8)[top:bottom, left:right]


def draw_objects(count: int, models: Path | None) -> list[np.ndarray]:
    """Cut-outs RGBA uint8 [h, w, 4] of generated objects, random solids and every second mesh of a folder.

    Each is drawn twice. Without a folder there are more generated objects.
    """
    sprites = []
    sources = list(mesh_sources(models).values())[::2] if models else []
    for number in range(count):
        rng = np.random.default_rng([SEED, number])
        if sources and number % 5 == 4:
            mesh = check(sources[number // 5 % len(sources)]())
        elif number % 5 == 3:
            mesh = make_solid(rng)
        else:
            mesh = numbered_shape(CATEGORIES[number % len(CATEGORIES)], SEED, number // 2)
        sprites += [draw_object(mesh.vertices, mesh.faces, rng) for _ in range(2)]
    return sprites


class Composer:
    """Makes pictures of objects before rooms and photographs, with the masks of the objects."""

    def __init__(
        self,
        sprites: list[np.ndarray],
        photographs: list[np.ndarray],
        textures: list[np.ndarray],
    ) -> None:
        self.sprites, self.photographs, self.textures = sprites, photographs, textures

    def __call__(self, rng: np.random.Generator, side: int) -> np.ndarray:
        """A view of the network, uint8 [S, S, 5]: R, G, B, place of the object, mask."""
        sprite = self._sprite(rng)
        tall, wide = sprite.shape[:2]
        boxed, near = rng.random(2) < (0.45, 0.5)
        if boxed or near:
            # how wrong the box is: little if drawn by hand, more if found in a first look
            edges = rng.uniform(-0.01, 0.07, 4) if boxed else rng.normal(0.02, 0.07, 4)
            box = np.array([0, 0, wide, tall]) + edges * [-wide, -tall, wide, tall]
            left, top, right, bottom = place_view(
                tuple(box + 9 * max(wide, tall)), 20 * max(wide, tall), 20 * max(wide, tall)
            )
            view = np.array([left, top, right, bottom]) - 9 * max(wide, tall)
            # sides of the picture that are near
            cut = np.where(rng.random(4) < 0.15, rng.random(4), 1)
            view = np.where(cut < 1, box + cut * (view - box), view)
        else:
            share, aspect = rng.uniform(0.25, 0.92), np.exp(rng.uniform(-0.45, 0.45))
            high = max(tall, wide / aspect) / share
            wider = high * aspect
            left = -(wider - wide) * np.clip(rng.normal(0.5, 0.17), 0.02, 0.98)
            top = -(high - tall) * np.clip(rng.normal(0.58, 0.17), 0.02, 0.98)
            view, box = np.array([left, top, left + wider, top + high]), None
        scale = side / (view[2:] - view[:2])
        x, y = -view[:2] * scale
        size = wide * scale[0], tall * scale[1]
        paint, alpha = _place(sprite, x, y, *size, side)
        scene = self._background(rng, side, float(y + size[1]), sprite)
        for _ in range(rng.choice(5, p=(0.55, 0.2, 0.12, 0.08, 0.05))):
            scene = self._clutter(rng, scene, (x, y, *size), boxed)
        scene *= 1 - _shadow(rng, alpha, y + size[1])[..., None]
        if rng.random() < 0.1:  # light behind the object
            scene *= rng.uniform(1, 1.4)
        scene = scene * (1 - alpha[..., None]) + paint * alpha[..., None]
        scene = _develop(rng, scene)
        place = np.full((side, side), 255, np.uint8)
        if boxed:
            place[:] = 0
            (left, right), (top, bottom) = (
                np.round((box[k::2] - view[k]) * scale[k]).astype(int).clip(0, side) for k in (0, 1)
            )
            place[top:bottom, left:right] = 255
        return np.dstack([scene, place, np.uint8(255 * alpha)])

    def _sprite(self, rng: np.random.Generator) -> np.ndarray:
        """A random object, in other colours and perhaps with a pattern, RGBA float [h, w, 4]."""
        sprite = self.sprites[rng.integers(len(self.sprites))].astype(np.float32)
        if rng.random() < 0.5:
            sprite = sprite[:, ::-1]
        colors = sprite[..., :3] * rng.normal(1, 0.1, 3) * rng.uniform(0.7, 1.25)
        if rng.random() < 0.35:
            pattern = self._crop(rng, self._any(rng), *sprite.shape[1::-1]).mean(2, keepdims=True)
            strength = rng.uniform(0.1, 0.7)
            colors = colors * (1 - strength + strength * pattern / max(pattern.mean(), 20))
        return np.dstack([colors.clip(0, 255), sprite[..., 3]])

    def _any(self, rng: np.random.Generator) -> np.ndarray:
        """A random photograph or texture, uint8 [H, W, 3]."""
        pictures = self.textures if rng.random() < 0.5 else self.photographs
        return pictures[rng.integers(len(pictures))]

    def _crop(
        self, rng: np.random.Generator, picture: np.ndarray, width: int, height: int
    ) -> np.ndarray:
        """A random part of a picture, float32 [height, width, 3]."""
        tall, wide = picture.shape[:2]
        zoom = rng.uniform(0.25, 1)
        high = max(8, int(zoom * min(tall, wide * height / width)))
        broad = max(8, min(wide, int(high * width / height)))
        top, left = rng.integers(tall - high + 1), rng.integers(wide - broad + 1)
        part = picture[top : top + high, left : left + broad]
        how = cv2.INTER_AREA if high > height else cv2.INTER_LINEAR
        return cv2.resize(part, (width, height), interpolation=how).astype(np.float32)

    def _background(
        self, rng: np.random.Generator, side: int, ground: float, sprite: np.ndarray
    ) -> np.ndarray:
        """A part of a photograph or a room, float32 [S, S, 3]."""
        if rng.random() < 0.45:
            scene = self._crop(rng, self._any(rng), side, side)
            if rng.random() < 0.25:  # the floor is another photograph
                line = round(side * rng.uniform(0.4, 0.9))
                scene[line:] = self._crop(rng, self._any(rng), side, side - line)
            if rng.random() < 0.5:
                scene = cv2.GaussianBlur(scene, (0, 0), rng.choice([0.4, 0.7, 1.5, 4]))
            scene *= rng.uniform(0.6, 1.15) * rng.uniform(0.85, 1.1, 3).astype(np.float32)
        else:
            scene = self._room(rng, side, ground)
        if rng.random() < 0.12:  # a background with the colour of the object
            target = sprite[..., :3][sprite[..., 3] > 127]
            if len(target):
                scene += rng.uniform(0.6, 1) * np.float32(target.mean(0) - scene.mean((0, 1)))
        return scene

    def _surface(
        self, rng: np.random.Generator, x: np.ndarray, y: np.ndarray, low: float
    ) -> np.ndarray:
        """A wall or floor with coordinates in sides of the view, float32 [S, S, 3]."""
        color = np.float32(rng.uniform(low, 245) + rng.normal(0, rng.choice([6, 25]), 3))
        kind, strength = rng.integers(8), rng.uniform(3, 40) ** rng.uniform(0.5, 1)
        if kind < 2:
            tone = np.zeros_like(x)
        elif kind == 2:  # stripes or planks
            stripes = np.floor(x * rng.uniform(4, 40))
            tone = strength * np.sin(stripes * rng.uniform(1, 13))
        elif kind == 3:  # tiles or bricks
            u, v = x * (count := rng.uniform(3, 25)), y * count * rng.uniform(0.5, 2)
            u = u + 0.5 * (np.floor(v) % 2) * rng.integers(2)
            joint = rng.uniform(0.03, 0.12)
            tone = -strength * ((u % 1 < joint) | (v % 1 < joint))
            tone = tone + rng.uniform(0, 10) * np.sin(37 * np.floor(u) + 91 * np.floor(v))
        elif kind == 4:  # a checkerboard
            count = rng.uniform(3, 20)
            tone = strength * ((np.floor(x * count) + np.floor(y * count)) % 2 - 0.5)
        elif kind == 5:  # plaster or carpet
            noise = rng.standard_normal(x.shape, np.float32)
            blurred = cv2.GaussianBlur(noise, (0, 0), width := rng.uniform(0.3, 3))
            tone = strength * blurred * (1 + width)
        else:  # a photographed texture, mapped onto the surface
            picture = self._any(rng)
            size = rng.uniform(100, 500)
            tall, wide = picture.shape[:2]
            columns, rows = (
                np.abs((z * size + rng.uniform(0, w)) % (2 * w) - w).astype(np.float32)
                for z, w in ((x, wide - 1), (y, tall - 1))
            )
            mapped = cv2.remap(picture, columns, rows, cv2.INTER_LINEAR).astype(np.float32)
            if kind == 6:
                return mapped * rng.uniform(0.6, 1.2)
            tone = (mapped.mean(2) - mapped.mean()) * rng.uniform(0.2, 0.9)
        return color + tone[..., None].astype(np.float32)

    def _room(self, rng: np.random.Generator, side: int, ground: float) -> np.ndarray:
        """One to three walls with pictures, windows or shelves, a skirting board, a floor, lights."""
        y, x = np.mgrid[:side, :side].astype(np.float32) / side
        zoom = rng.uniform(0.5, 1.5)
        scene = self._surface(rng, x * zoom, y * zoom, rng.choice([40, 110]))
        line = ground / side - rng.uniform(-0.02, 0.45) + rng.uniform(-0.12, 0.12) * (x - 0.5)
        if rng.random() < 0.35:  # another wall from an edge on
            edge = rng.uniform(0.05, 0.95)
            other = x > edge if rng.random() < 0.5 else x < edge
            line = line + rng.uniform(0.1, 0.6) * np.abs(x - edge) * other
            same = rng.random() < 0.5
            wall = scene * rng.uniform(0.65, 1.2) if same else self._surface(rng, y, x, 60)
            scene = np.where(other[..., None], wall, scene)
        for _ in range(rng.choice(5, p=(0.45, 0.25, 0.15, 0.1, 0.05))):
            self._hang(rng, scene)
        depth = np.maximum(y - line, 0) + rng.uniform(0.03, 0.3)
        across = (x - rng.uniform(-0.5, 1.5)) / depth * rng.uniform(0.05, 0.3)
        along = rng.uniform(0.05, 0.4) / depth
        if rng.random() < 0.3:
            across, along = across + along, across - along
        if rng.random() < 0.92:
            floor = self._surface(rng, across, along, rng.choice([20, 60, 110]))
            scene = np.where((y > line)[..., None], floor, scene)
            if rng.random() < 0.2:  # a carpet
                rug = np.abs(across - rng.normal(0, 0.5)) < rng.uniform(0.2, 1)
                rug &= (y > line + rng.uniform(0, 0.2)) & (y < line + rng.uniform(0.2, 0.8))
                scene = np.where(rug[..., None], self._surface(rng, across, along, 20), scene)
            if rng.random() < 0.6:
                board = (y <= line) & (y > line - rng.uniform(0.005, 0.06))
                scene[board] = rng.uniform(20, 245) + rng.normal(0, 10, 3)
            if rng.random() < 0.3:
                crease = np.exp(-np.abs(y - line) / rng.uniform(0.005, 0.08))
                scene = scene * (1 - rng.uniform(0.1, 0.4) * crease[..., None])
        light = 1 + rng.uniform(-0.5, 0.5) * (x - 0.5) + rng.uniform(-0.5, 0.5) * (y - 0.5)
        spot = np.hypot(x - rng.uniform(-0.3, 1.3), y - rng.uniform(-0.3, 1.3))
        light = light * (1.1 - rng.uniform(0, 0.6) * spot)
        if rng.random() < 0.15:  # a stripe of light or shade
            angle, width = rng.uniform(0, np.pi), rng.uniform(0.05, 0.3)
            away = np.abs(x * np.cos(angle) + y * np.sin(angle) - rng.uniform(0.2, 1))
            light = light * (1 + rng.uniform(-0.4, 0.4) / (1 + np.exp((away - width) * 80)))
        return (scene * light[..., None]).astype(np.float32)

    def _hang(self, rng: np.random.Generator, scene: np.ndarray) -> None:
        """Put a picture, a window, a door, or a board on the wall."""
        side = len(scene)
        if rng.random() < 0.2:
            left, right = np.sort(rng.uniform(-0.2, 1.2, 2)) * side
            top, bottom = np.array([0, rng.uniform(0.01, 0.1)]) * side + rng.uniform(0, 0.7) * side
        else:
            wide, high = rng.uniform(0.08, 0.5, 2) * side
            left, top = rng.uniform(-0.2, 1, 2) * side
            right, bottom = left + wide, top + high
        left, top, right, bottom = np.array([left, top, right, bottom]).round().astype(int)
        left, top, right, bottom = max(0, left), max(0, top), min(side, right), min(side, bottom)
        if right - left < 3 or bottom - top < 3:
            return
        scene[top:bottom, left:right] = rng.uniform(10, 250) + rng.normal(0, 15, 3)
        rim = rng.integers(0, 1 + min(right - left, bottom - top) // 4)
        inner = scene[top + rim : bottom - rim, left + rim : right - rim]
        if rng.random() < 0.5:
            inner[:] = rng.uniform(10, 250) + rng.normal(0, 25, 3)
        elif inner.size:
            inner[:] = self._crop(rng, self._any(rng), inner.shape[1], inner.shape[0])

    def _clutter(
        self,
        rng: np.random.Generator,
        scene: np.ndarray,
        place: tuple[float, float, float, float],
        boxed: bool,
    ) -> np.ndarray:
        """Another thing behind the object and beside it, smaller unless there is a box."""
        x, y, wide, tall = place
        sprite, side = self._sprite(rng), len(scene)
        share = rng.uniform(0.15, 1.2 if boxed else 0.6) * max(wide, tall)
        scale = share / max(sprite.shape[:2])
        width, height = sprite.shape[1] * scale, sprite.shape[0] * scale
        beside = rng.choice([-1, 1]) * (wide / 2 + rng.uniform(-0.3, 0.7) * width)
        left = x + wide / 2 + beside - width / 2
        top = y + tall - height - rng.uniform(-0.15, 0.7) * tall
        paint, alpha = _place(sprite, left, top, width, height, side)
        if rng.random() < 0.5:
            scene = scene * (1 - _shadow(rng, alpha, top + height)[..., None])
        if rng.random() < 0.4:
            blur = rng.uniform(0.4, 3)
            paint, alpha = (cv2.GaussianBlur(each, (0, 0), blur) for each in (paint, alpha))
        return scene * (1 - alpha[..., None]) + paint * alpha[..., None]


def _place(
    sprite: np.ndarray, x: float, y: float, width: float, height: float, side: int
) -> tuple[np.ndarray, np.ndarray]:
    """Colours [S, S, 3] and alpha [S, S] in 0 .. 1 of an object in a view, float32."""
    size = max(2, round(width)), max(2, round(height))
    smaller = cv2.resize(sprite, size, interpolation=cv2.INTER_AREA)
    canvas = np.zeros((side, side, 4), np.float32)
    left, top = round(x), round(y)
    at = slice(max(0, top), max(0, top + size[1])), slice(max(0, left), max(0, left + size[0]))
    part = smaller[max(0, -top) : max(0, side - top), max(0, -left) : max(0, side - left)]
    canvas[at] = part
    return canvas[..., :3], canvas[..., 3] / 255


def _shadow(rng: np.random.Generator, alpha: np.ndarray, ground: float) -> np.ndarray:
    """The darkness in 0 .. 1 of shadows on the floor and on the wall, and of a contact shadow."""
    side = len(alpha)
    y, x = np.mgrid[:side, :side].astype(np.float32)
    light = np.ones_like(alpha)
    if rng.random() < 0.75:
        start = ground - rng.uniform(0, 0.08) * side
        flat, shear = rng.uniform(0.1, 0.7) * rng.choice([-1, 1]), rng.uniform(-1.5, 1.5)
        up = (start - y) / flat
        columns, rows = np.float32(x - shear * up * abs(flat)), np.float32(start - up)
        cast = cv2.remap(alpha, columns, rows, cv2.INTER_LINEAR)
        cast[up < 0] = 0
        cast = cv2.GaussianBlur(cast, (0, 0), rng.uniform(0.4, 0.04 * side))
        light *= 1 - rng.uniform(0.1, 0.7) * cast
    if rng.random() < 0.25:
        shift = np.float32([[1, 0, rng.normal(0, 0.08) * side], [0, 1, rng.normal(0, 0.05) * side]])
        wall = cv2.warpAffine(alpha, shift, (side, side))
        wall = cv2.GaussianBlur(wall, (0, 0), rng.uniform(0.5, 0.05 * side))
        light *= 1 - rng.uniform(0.05, 0.45) * wall
    low = alpha * (y > ground - rng.uniform(0.05, 0.15) * side)
    contact = cv2.GaussianBlur(low, (0, 0), 0.03 * side, sigmaY=0.012 * side)
    return 1 - light * (1 - rng.uniform(0, 0.6) * contact)


def _develop(rng: np.random.Generator, scene: np.ndarray) -> np.ndarray:
    """A scene as a camera stores it, uint8: white balance, contrast, blur, noise, JPEG."""
    scene = scene.astype(np.float32) * rng.normal(1, 0.05, 3).astype(np.float32)
    scene = 255 * (scene.clip(0, 255) / 255) ** rng.uniform(0.75, 1.35)
    scene = (scene - 128) * rng.uniform(0.75, 1.15) + 128 + rng.normal(0, 10)
    if rng.random() < 0.06:
        scene[:] = scene.mean(2, keepdims=True)
    if rng.random() < 0.4:
        scene = cv2.GaussianBlur(scene, (0, 0), rng.uniform(0.2, 0.9))
    noise = rng.standard_normal(scene.shape, np.float32) * rng.uniform(0, 5)
    scene = (scene + noise).clip(0, 255).astype(np.uint8)
    if rng.random() < 0.3:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 95))]
        scene = cv2.imdecode(cv2.imencode(".jpg", scene, quality)[1], cv2.IMREAD_COLOR)
    return scene


def _stored(path: Path, make: Callable[[], list[np.ndarray]]) -> list[np.ndarray]:
    """The arrays of an npz file, made if there is none."""
    if not path.exists():
        np.savez(partial := path.with_suffix(".partial.npz"), *make())
        partial.rename(path)
    with np.load(path) as archive:
        return [archive[name] for name in archive.files]


def vary(views: np.ndarray, rng: np.random.Generator) -> Tensor:
    """Views uint8 [B, S, S, 5] as float [B, 5, S, S] in 0 .. 1, half of them mirrored, in other colours."""
    values = torch.from_numpy(views).movedim(-1, 1).float() / 255
    for view in values:
        if rng.random() < 0.5:
            view[:] = view.flip(-1)
        if rng.random() < 0.5:
            view[:3] = view[torch.from_numpy(rng.permutation(3))]
        gains = torch.from_numpy(rng.uniform(0.85, 1.15, (3, 1, 1)).astype(np.float32))
        view[:3] = (gains * view[:3]).clamp(0, 1)
    return values


@torch.no_grad()
def calibrate(network: OutlineNetwork, batches: list[Tensor]) -> None:
    """Set the statistics of batch norms to those of batches float [B, 5, S, S], for averaged weights."""
    norms = [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]
    momentum = norms[0].momentum
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # the mean of all batches
    network.train()
    for batch in batches:
        network(batch[:, :4])
    network.eval()
    for norm in norms:
        norm.momentum = momentum


def outline_loss(logits: Tensor, masks: Tensor) -> Tensor:
    """Cross-entropy, and 1 - soft IoU, of logits and masks [B, S, S] in 0 .. 1."""
    inside = logits.sigmoid()
    both = (inside * masks).sum((1, 2))
    soft_iou = both / (inside + masks - inside * masks).sum((1, 2)).clamp_min(1)
    return F.binary_cross_entropy_with_logits(logits, masks) + (1 - soft_iou).mean()


def main(
    output: Path = Path("output/outlines"),
    models: Path | None = None,
    objects: int = 4000,
    steps: int = 13000,
    learning_rate: float = 2e-3,
    coarse: float = 0.45,
    weights: Path = WEIGHTS,
    start: Path | None = None,
    threads: int = 1,
) -> None:
    """Draw objects, and train the network on pictures that are composed of them.

    output: a folder for packages and drawn objects, which are used again. models: a folder of
    meshes, as `tools/free_meshes/fetch.py` writes it. objects: to be drawn. weights: the file to
    write. start: weights to begin with. coarse: share of the steps with smaller views.
    """
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    debs = output / "packages"
    debs.mkdir(parents=True, exist_ok=True)
    sprites = _stored(output / "objects.npz", lambda: draw_objects(objects, models))
    sprites += _stored(output / "things.npz", lambda: read_things(debs))
    sprites = [sprite for sprite in sprites if min(sprite.shape[:2]) > NARROWEST]
    photographs = _stored(output / "photographs.npz", lambda: read_backgrounds(PHOTOGRAPHS, debs))
    textures = _stored(output / "textures.npz", lambda: read_backgrounds(TEXTURES, debs))
    print(f"{len(sprites)} cut-outs, {len(photographs)} photographs, {len(textures)} textures")
    compose, rng = Composer(sprites, photographs, textures), np.random.default_rng([SEED, 1])
    shown = [compose(rng, 128) for _ in range(48)]
    pictures = [np.where(view[..., 4:] > 127, view[..., :3], view[..., :3] // 3) for view in shown]
    rows = [view[..., :3] for view in shown]
    save_png(
        output / "views.png",
        tile([[*rows[k : k + 8], *pictures[k : k + 8]] for k in range(0, 48, 8)], tile_size=128),
    )
    torch.manual_seed(0)
    network = OutlineNetwork()
    if start is not None:
        network.load_state_dict(safetensors.torch.load_file(start))
    network.to(memory_format=torch.channels_last)
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(AVERAGE))
    optimizer = torch.optim.AdamW(network.parameters(), learning_rate, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, learning_rate, total_steps=steps, pct_start=0.05
    )
    began, losses, ious = time.monotonic(), [], []
    seen: deque[np.ndarray] = deque(maxlen=KEPT)
    for step in range(1, steps + 1):
        side = SIDES[step > coarse * steps]
        if seen and seen[0].shape[0] != side:
            seen.clear()
        seen.extend(compose(rng, side) for _ in range(BATCH if len(seen) < BATCH else NEW))
        numbers = [*range(-NEW, 0), *rng.integers(-len(seen), -NEW, BATCH - NEW)]
        views = vary(np.stack([seen[number] for number in numbers]), rng)
        logits = network(views[:, :4].contiguous(memory_format=torch.channels_last))
        loss = outline_loss(logits, views[:, 4])
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        average.update_parameters(network)
        losses.append(loss.item())
        found, masks = logits.detach()[:NEW] > 0, views[:NEW, 4] > 0.5
        ious += ((found & masks).sum((1, 2)) / (found | masks).sum((1, 2)).clamp_min(1)).tolist()
        if step % 100 == 0:
            print(
                f"step {step}: side {side}, loss {np.mean(losses):.3f}, IoU of new views "
                f"{np.mean(ious):.3f}, above 0.85 {np.mean(np.array(ious) > 0.85):.0%}, "
                f"{time.monotonic() - began:.0f} s, {time.process_time():.0f} s of processor",
                flush=True,
            )
            losses, ious = [], []
        if step % 500 == 0 or step == steps:
            recent = [*seen][-CALIBRATED:]
            starts = range(0, len(recent) - BATCH + 1, BATCH)
            calibrate(
                average.module,
                [vary(np.stack(recent[first : first + BATCH]), rng) for first in starts],
            )
            halves = {
                name: (value.half() if value.is_floating_point() else value).contiguous()
                for name, value in average.module.state_dict().items()
            }
            partial = weights.with_suffix(".partial")
            safetensors.torch.save_file(halves, partial)
            partial.replace(weights)


if __name__ == "__main__":
    tyro.cli(main)
