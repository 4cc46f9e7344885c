"""Trains the network that finds objects in photographs, and stores it in the package.

python tools/free_meshes/fetch.py --output models
python tools/train_outlines.py --models models

Objects are generated, drawn by nmr, and composed with rooms and parts of photographs (composing.py).
The photographs, textures, and cut-outs of other things come from Debian's packages, which apt-get
downloads (500 MB). `tools/measure_cutouts.py` measures the result; none of its photographs and
objects is used here. It takes fifty minutes of processor time. The weights in the package were trained with
views of 96 and 128 pixels first, and then by `--start FILE --steps 6000 --learning-rate 1e-3`.
"""

import io
import time
import zipfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

import cv2
import numpy as np
import safetensors.torch
import torch
import torch.nn.functional as F
import trimesh
import tyro
from composing import Composer, draw_object
from free_meshes.debs import get_package, read_package
from PIL import Image, ImageOps
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn, update_bn

from learn3d.data.masks import mask_box
from learn3d.pictures import save_png, tile
from learn3d.studio.make_data.meshes import check, mesh_sources
from learn3d.studio.picture_to_mesh.outline_network import WEIGHTS, OutlineNetwork, place_view
from learn3d.studio.shapes import CATEGORIES, numbered_shape
from nmr.losses import soft_iou_loss

# Debian's packages with photographs of landscapes, plants and things, and with textures of walls
PICTURES = (
    "mate-backgrounds",
    "gnome-backgrounds",
    "lomiri-wallpapers-16.04",
    "lomiri-wallpapers-20.04",
    "ukui-wallpapers",
    "openarena-081-textures",
)
THINGS = "tuxpaint-stamps-default", "openclipart-png"  # cut-outs with transparency
MOST_THINGS = 1500  # from each of these packages
LARGEST_THING = 2000  # longest side in pixels of their pictures; larger ones are left out
SEED = 1_000_000  # tools/measure_cutouts.py has smaller seeds
SMALLEST, LARGEST = 128, 640  # sides of pictures in pixels; larger ones are reduced
FLAT = 8  # least standard deviation of their values, 0 .. 255
NARROWEST = 8  # least side in pixels of a cut-out
OBJECT = 256  # side in pixels of drawn objects
BATCHES = {96: 16, 128: 16, 192: 8, 256: 8}  # views of a batch, for each of their sides in pixels
NEW = 0.25  # share of a batch's views that are new; the others were seen before
KEPT = 1024  # views of each size that may be seen again
CALIBRATED = 128  # last views of each size, by which batch norms are set
AVERAGE = 0.995  # decay of the moving average of the weights


def read_images(package: str, folder: Path, largest: int | None = None) -> Iterator[Image.Image]:
    """The images of a package, in one random order; it is downloaded into the folder.

    largest: the longest side in pixels, None for images of any size.
    """
    suffixes = (".jpg", ".jpeg", ".png", ".webp", ".tga")
    files = read_package(get_package(package, folder), (*suffixes, ".pk3"))
    for name in [name for name in files if name.endswith(".pk3")]:
        archive = zipfile.ZipFile(io.BytesIO(files.pop(name)))
        files |= {inner: archive.read(inner) for inner in archive.namelist()}
    names = sorted(name for name in files if name.lower().endswith(suffixes))
    for number in np.random.default_rng(SEED).permutation(len(names)):
        try:
            image = Image.open(io.BytesIO(files[names[number]]))
            if largest is not None and max(image.size) > largest:
                continue
            image.draft("RGB", (2 * LARGEST, 2 * LARGEST))
            image.load()
        except (OSError, Image.DecompressionBombError):
            continue
        yield image


def read_pictures(folder: Path) -> list[np.ndarray]:
    """The photographs and textures, uint8 [H, W, 3], with their full range of brightness."""
    pictures = []
    for package in PICTURES:
        for image in read_images(package, folder):
            image = image.convert("RGB")
            image.thumbnail((LARGEST, LARGEST), Image.Resampling.BOX, reducing_gap=2)
            if min(image.size) >= SMALLEST and np.asarray(image).std() > FLAT:
                pictures.append(np.asarray(ImageOps.autocontrast(image, 0.5)))
    return pictures


def read_things(package: str, folder: Path) -> Iterator[np.ndarray]:
    """Cut-outs RGBA uint8 [h, w, 4] of other things: the partly transparent images of a package."""
    for image in read_images(package, folder, LARGEST_THING):
        image = image.convert("RGBA")
        image.thumbnail((OBJECT, OBJECT), Image.Resampling.BOX)
        pixels = np.asarray(image)
        if 0.06 < (pixels[..., 3] > 127).mean() < 0.97:
            left, top, right, bottom = mask_box(pixels[..., 3])
            yield pixels[top:bottom, left:right]


def make_solid(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random thing: one to six boxes, cylinders, cones, balls and rings that overlap."""
    make = trimesh.creation
    kinds = (
        make.box,
        lambda: make.cylinder(0.4, 1),
        lambda: make.cone(0.4, 1),
        lambda: make.icosphere(3, 0.5),
        lambda: make.torus(0.4, 0.1),
    )
    parts = []
    for _ in range(rng.integers(1, 7)):
        part = kinds[rng.integers(len(kinds))]()
        part.apply_scale(rng.uniform(0.15, 1.1, 3))
        if rng.random() < 0.5:
            part.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        parts.append(part.apply_translation(rng.uniform(-0.45, 0.45, 3)))
    return trimesh.util.concatenate(parts)


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
        sprites += [draw_object(mesh.vertices, mesh.faces, rng, OBJECT) for _ in range(2)]
    return sprites


def make_view(
    compose: Composer, sprites: Sequence[np.ndarray], rng: np.random.Generator, side: int
) -> np.ndarray:
    """A view of the network, uint8 [S, S, 5]: the colours, the allowed part of the view, and the mask."""
    sprite = _recolor(compose, sprites[rng.integers(len(sprites))], rng)
    tall, wide = sprite.shape[:2]
    boxed, near = rng.random(2) < (0.45, 0.5)
    # how wrong the box is: little if drawn by hand, more if found in a first look
    edges = rng.uniform(-0.01, 0.07, 4) if boxed else rng.normal(0.02, 0.07, 4)
    box = np.array([0, 0, wide, tall]) + edges * [-wide, -tall, wide, tall]
    if boxed or near:
        far = 9 * max(wide, tall)
        view = np.array(place_view(tuple(box + far), 3 * far, 3 * far)) - far
        # sides of the picture that are near, or cut a part of the object off
        cut = np.where(rng.random(4) < 0.15, rng.uniform(-0.5, 1, 4), 1)
        view = np.where(cut < 1, box + cut * (view - box), view)
    else:  # the whole picture
        aspect = np.exp(rng.uniform(-0.45, 0.45))
        high = max(tall, wide / aspect) / rng.uniform(0.25, 0.92)
        room = np.array([high * aspect - wide, high - tall])
        share = rng.normal((0.5, 0.58), 0.17).clip(0.02, 0.98)
        start = -room * share
        if rng.random() < 0.1:  # cut off by a side of the picture
            axis, lost = rng.integers(2), rng.uniform(0.05, 0.4)
            size = (wide, tall)[axis]
            start[axis] = lost * size - rng.integers(2) * (room[axis] + 2 * lost * size)
        view = np.concatenate([start, start + [high * aspect, high]])
    scale = side / (view[2:] - view[:2])
    at = (*(-view[:2] * scale), *(scale * [wide, tall]))
    place = rng.choice(("room", "plain room", "photograph"), p=(0.4, 0.2, 0.4))
    colors, alpha = compose(rng, sprite, at, (side, side), place)
    allowed = np.full((side, side), 0 if boxed else 255, np.uint8)
    if boxed:
        (left, top), (right, bottom) = np.rint((box.reshape(2, 2) - view[:2]) * scale).astype(int)
        allowed[max(0, top) : bottom, max(0, left) : right] = 255
    return np.dstack([colors, allowed, np.uint8(255 * alpha)])


def _recolor(compose: Composer, sprite: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A cut-out in other colours, perhaps mirrored or with a pattern."""
    sprite = sprite[:, :: rng.choice([-1, 1])]
    colors = sprite[..., :3] * rng.normal(1, 0.1, 3) * rng.uniform(0.7, 1.25)
    if rng.random() < 0.15:  # little shading
        colors = rng.uniform(15, 240, 3) + rng.uniform(0, 0.3) * (colors - colors.mean((0, 1)))
    if rng.random() < 0.35:
        pattern = compose.part(rng, *sprite.shape[1::-1]).mean(2, keepdims=True)
        colors *= 1 + rng.uniform(0.1, 0.7) * (pattern / max(pattern.mean(), 20) - 1)
    return np.dstack([colors.clip(0, 255), sprite[..., 3]])


def vary(views: Sequence[np.ndarray], rng: np.random.Generator) -> Tensor:
    """Views uint8 [S, S, 5] as float [B, 5, S, S] in 0 .. 1, half of them mirrored, in other colours."""
    values = torch.from_numpy(np.stack(views)).movedim(-1, 1).float() / 255
    for view in values:
        if rng.random() < 0.5:
            view[:] = view.flip(-1)
        if rng.random() < 0.5:
            view[:3] = view[torch.from_numpy(rng.permutation(3))]
        gains = torch.from_numpy(rng.uniform(0.85, 1.15, (3, 1, 1)).astype(np.float32))
        view[:3] = (gains * view[:3]).clamp(0, 1)
    return values


def train(
    make: Callable[[np.random.Generator, int], np.ndarray],
    network: OutlineNetwork,
    weights: Path,
    steps: int,
    learning_rate: float = 2e-3,
) -> None:
    """Train the network on views of all sizes, and write the moving average of its weights in float16.

    make(rng, S): a new view uint8 [S, S, 5].
    """
    rng = np.random.default_rng([SEED, 1])
    network.to(memory_format=torch.channels_last)
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(AVERAGE))
    optimizer = torch.optim.AdamW(network.parameters(), learning_rate, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, learning_rate, total_steps=steps, pct_start=0.05
    )
    losses = []
    seen: dict[int, deque[np.ndarray]] = {side: deque(maxlen=KEPT) for side in BATCHES}
    for step in range(1, steps + 1):
        side = int(rng.choice([*BATCHES]))
        batch, views = BATCHES[side], seen[side]
        new = round(NEW * batch) if len(views) > batch else batch
        views.extend(make(rng, side) for _ in range(new))
        numbers = [*range(-new, 0), *rng.integers(len(views), size=batch - new)]
        inputs = vary([views[number] for number in numbers], rng)
        logits = network(inputs[:, :4].contiguous(memory_format=torch.channels_last))
        loss = F.binary_cross_entropy_with_logits(logits, inputs[:, 4])
        loss = loss + soft_iou_loss(logits.sigmoid(), inputs[:, 4])
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        average.update_parameters(network)
        losses.append(loss.item())
        if step % 100 == 0:
            print(
                f"step {step}: loss {np.mean(losses[-100:]):.3f}, "
                f"{time.process_time():.0f} s of processor",
                flush=True,
            )
        if step % 500 == 0 or step == steps:
            recent = [[*views][-CALIBRATED:] for views in seen.values()]
            size = min(BATCHES.values())
            starts = range(0, CALIBRATED, size)
            batches = [part for each in recent for k in starts if (part := each[k : k + size])]
            update_bn((vary(each, rng)[:, :4] for each in batches), average.module)
            halves = {
                name: (value.half() if value.is_floating_point() else value).contiguous()
                for name, value in average.module.state_dict().items()
            }
            partial = weights.with_suffix(".partial")
            safetensors.torch.save_file(halves, partial)
            partial.replace(weights)


def _stored(path: Path, make: Callable[[], Iterable[np.ndarray]]) -> list[np.ndarray]:
    """The arrays of an npz file, made if there is none."""
    if not path.exists():
        np.savez(partial := path.with_suffix(".partial.npz"), *make())
        partial.rename(path)
    with np.load(path) as archive:
        return [archive[name] for name in archive.files]


def main(
    output: Path = Path("output/outlines"),
    models: Path | None = None,
    objects: int = 4000,
    steps: int = 13000,
    learning_rate: float = 2e-3,
    weights: Path = WEIGHTS,
    start: Path | None = None,
    threads: int = 1,
) -> None:
    """Draw objects, and train the network on pictures that are composed of them.

    output: a folder for packages and drawn objects, which are used again. models: a folder of
    meshes, as `tools/free_meshes/fetch.py` writes it. objects: to be drawn. weights: the file to
    write. start: weights to begin with.
    """
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    debs = output / "packages"
    debs.mkdir(parents=True, exist_ok=True)

    def things() -> Iterator[np.ndarray]:
        return chain.from_iterable(islice(read_things(each, debs), MOST_THINGS) for each in THINGS)

    sprites = _stored(output / "objects.npz", lambda: draw_objects(objects, models))
    sprites += _stored(output / "things.npz", things)
    sprites = [sprite for sprite in sprites if min(sprite.shape[:2]) > NARROWEST]
    pictures = _stored(output / "pictures.npz", lambda: read_pictures(debs))
    print(f"{len(sprites)} cut-outs, {len(pictures)} photographs and textures")
    compose = Composer(pictures, sprites, mess=0.9)

    def make(rng: np.random.Generator, side: int) -> np.ndarray:
        return make_view(compose, sprites, rng, side)

    rng = np.random.default_rng([SEED, 2])
    shown = [make(rng, 128) for _ in range(48)]
    pairs = [(view[..., :3], view[..., :3] * np.uint8(view[..., 4:] > 127)) for view in shown]
    rows = [[*chain.from_iterable(pairs[k : k + 8])] for k in range(0, 48, 8)]
    save_png(output / "views.png", tile(rows, tile_size=128))
    torch.manual_seed(0)
    network = OutlineNetwork()
    if start is not None:
        network.load_state_dict(safetensors.torch.load_file(start))
    train(make, network, weights, steps, learning_rate)


if __name__ == "__main__":
    tyro.cli(main)
