"""Decodes untrusted images with Pillow in the sandbox, and reads the renderings of data sets."""

import functools
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from learn3d.files import limits, sandbox
from learn3d.files.reading import DamagedFile, MissingFile, faults_of, open_file, read_text

# TIFF is not supported: a small file can list millions of strips, for which Pillow makes objects before it decodes.
RENDERINGS = ("PNG", "JPEG")
PHOTOGRAPHS = ("PNG", "JPEG", "WEBP", "BMP")


def open_image(path: Path, formats: Sequence[str], max_side: int) -> Image.Image:
    """Decode an image, in the sandbox. formats: Pillow's names of the allowed formats.

    Raises MissingFile, and DamagedFile for another format, a file above 256 MiB, a side above
    `max_side` pixels, and more than 64 million pixels.
    """
    wanted = f"an image in the format {', '.join(formats)}"
    with faults_of(path, wanted), open_file(path, limits.IMAGE_FILE_BYTES, wanted) as file:
        image = Image.open(file, formats=formats)
        pixels, most = image.width * image.height, limits.IMAGE_PIXELS
        if max(image.size) > max_side or pixels > most:
            size = f"{image.width}x{image.height} pixels"
            raise DamagedFile(
                path, f"is {size}; the limits are {max_side} a side and {most}: make it smaller"
            )
        sandbox.allow(56 * pixels, pixels / 1e7)  # for decoding, masking and framing
        image.load()
        return image


# image uint8 [4, S, S], mask uint8 [64, 64], largest value of the mask
View = tuple[np.ndarray, np.ndarray, int]


def read_with_alpha(path: Path, size: int) -> View:
    """A square rendering, reduced to `size`: colours over white, and its alpha channel as the mask."""
    color, alpha = _read_square(path, size)
    if alpha is None:
        raise DamagedFile(path, "has no alpha channel; expected RGBA, whose alpha is the mask")
    return _view(color, alpha, size)


def read_with_depth(path: Path, depth_path: Path, size: int) -> View:
    """A square rendering, reduced to `size`. Mask: depth below 250 in 8 bits, or alpha if there is no depth file."""
    color, mask = _read_square(path, size)
    if depth_path.exists():
        depth = open_image(depth_path, RENDERINGS, limits.RENDER_SIDE)
        if depth.size != (len(color),) * 2:
            raise DamagedFile(
                depth_path, f"is {_kind(depth)}, but {path.name} has {len(color)} pixels a side"
            )
        is_16_bit = depth.mode.startswith("I")  # then the high byte counts
        grey = np.asarray(depth) >> 8 if is_16_bit else np.asarray(depth.convert("L"))
        mask = np.where(grey < 250, 255, 0).astype(np.uint8)
    elif mask is None:
        raise MissingFile(
            depth_path,
            f"is missing, and {path.name} has no alpha channel; expected the depth image",
        )
    return _view(color, mask, size)


def read_with_mask(path: Path, mask_path: Path, size: int) -> View:
    """A rendering and its mask, both size x size; colours are inverted, as in Kato's files."""
    images = []
    for each in (path, mask_path):
        image = open_image(each, RENDERINGS, limits.RENDER_SIDE)
        if image.size != (size, size) or image.mode.startswith("I"):
            raise DamagedFile(each, f"is {_kind(image)}; expected {size}x{size} of 8 bits")
        images.append(split_alpha(image)[0])
    mask = images[1][..., 0]
    return np.dstack([255 - images[0], mask]).transpose(2, 0, 1), mask, int(mask.max())


def _read_square(path: Path, size: int) -> tuple[np.ndarray, np.ndarray | None]:
    image, least = open_image(path, RENDERINGS, limits.RENDER_SIDE), max(size, limits.MASK_SIZE)
    if image.width != image.height or image.width < least or image.mode.startswith(("I", "F", "C")):
        raise DamagedFile(
            path, f"is {_kind(image)}; expected a square image of at least {least}x{least}, 8 bits"
        )
    return split_alpha(image)


def _kind(image: Image.Image) -> str:
    return f"{image.width}x{image.height} pixels of the format {image.mode}"


def _view(color: np.ndarray, mask: np.ndarray, size: int) -> View:
    planes = np.stack([*color.transpose(2, 0, 1), mask]).astype(np.float32)
    return *shrink(planes, size), int(mask.max())


def split_alpha(image: Image.Image) -> tuple[np.ndarray, np.ndarray | None]:
    """Colours over white, uint8 [H, W, 3], and the alpha channel, uint8 [H, W], or None if the image has none."""
    if not image.has_transparency_data:
        return np.asarray(image.convert("RGB")), None
    image = image.convert("RGBA")
    alpha = image.getchannel("A")
    white = Image.new("RGB", image.size, (255, 255, 255))
    white.paste(image, mask=alpha)
    return np.asarray(white), np.asarray(alpha)


def shrink(planes: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """An image uint8 [4, size, size] and its mask uint8 [64, 64] of colours and mask float32 [4, H, W], 0 .. 255.

    The planes are padded with 0 to a square. Each pixel is the mean over its area, fractions of
    pixels included.
    """
    image = _shrink(planes, size)
    return image, image[3] if size == limits.MASK_SIZE else _shrink(planes[3:], limits.MASK_SIZE)[0]


def _shrink(planes: np.ndarray, size: int) -> np.ndarray:
    if planes.shape[1:] == (size, size):
        return planes.astype(np.uint8)
    side = max(planes.shape[1:])
    rows, columns = (
        _area_weights(side, size)[:, (side - n) // 2 :][:, :n] for n in planes.shape[1:]
    )
    return np.rint(rows @ planes @ columns.T).astype(np.uint8)


@functools.cache
def _area_weights(source: int, size: int) -> np.ndarray:
    """Share of each of `source` pixels in each of `size` larger ones, float32 [size, source]; rows sum to 1."""
    edges = np.arange(size + 1) * (source / size)
    pixels = np.arange(source)
    overlap = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return (overlap.clip(0) * (size / source)).astype(np.float32)


def read_table(path: Path, rows: int, columns: int, wanted: str) -> np.ndarray:
    """The first rows and columns of a table of numbers in a text file: float64 [rows, columns], all finite."""
    text = io.StringIO(read_text(path, limits.TEXT_BYTES, wanted))
    table = np.loadtxt(text, comments=None, usecols=range(columns), max_rows=rows, ndmin=2)
    if (found := np.isfinite(table).all(axis=1).sum()) < rows:
        raise ValueError(f"{found} rows of finite numbers, {rows} are needed")
    return table
