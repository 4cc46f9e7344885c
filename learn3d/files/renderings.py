"""Decodes untrusted images with Pillow in the sandbox, and reads the renderings of data sets."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from learn3d.files import limits, sandbox
from learn3d.files.reading import FETCH_AGAIN, DamagedFile, MissingFile, open_file, read_text

# TIFF is not supported: a small file can list millions of strips, for which Pillow makes objects before it decodes.
RENDERINGS = ("PNG", "JPEG")
PHOTOGRAPHS = ("PNG", "JPEG", "WEBP", "BMP")
_MEMORY_PER_PIXEL = 16  # bytes; three copies of four channels, and some room
_PIXELS_PER_SECOND = 2e7


def open_image(path: Path, formats: Sequence[str], max_side: int) -> Image.Image:
    """Decode an image, in the sandbox. formats: Pillow's names of the allowed formats.

    Raises MissingFile, and DamagedFile for another format, a file above 256 MiB, a side above `max_side` pixels, and
    more than 64 million pixels.
    """
    with open_file(path, limits.IMAGE_FILE_BYTES, "an image") as file:
        try:
            image = Image.open(file, formats=formats)
            pixels = image.width * image.height
            if max(image.size) <= max_side and pixels <= limits.IMAGE_PIXELS:
                sandbox.allow(_MEMORY_PER_PIXEL * pixels, pixels / _PIXELS_PER_SECOND)
                image.load()
                return image
            fault = f"is {image.width}x{image.height} pixels; at most {max_side} a side and {limits.IMAGE_PIXELS} in "
            fault += "all are read: make it smaller"
        except UnidentifiedImageError:
            fault = f"cannot be decoded as an image in the format {', '.join(formats)}; convert it from other formats"
        except MemoryError:
            raise
        except Exception as error:  # Pillow raises various errors for damaged files
            fault = f"cannot be decoded as an image ({sandbox.reason(error)}). {FETCH_AGAIN}"
    raise DamagedFile(path, fault)


MASK_SIZE = 64
View = tuple[np.ndarray, np.ndarray, int]


def read_with_alpha(path: Path, size: int) -> View:
    """A square rendering, reduced to `size`: colours over white, and its alpha channel as the mask."""
    image = _read_square(path, size)
    color, alpha = split_alpha(image)
    if alpha is None:
        raise DamagedFile(path, f"has the channels {image.mode}; expected RGBA, whose alpha is the mask")
    return *shrink(_planes(color, alpha), size), int(alpha.max())


def read_with_depth(path: Path, depth_path: Path, size: int) -> View:
    """A square rendering, reduced to `size`. Mask: depth below 250 in 8 bits, or alpha if there is no depth file."""
    image = _read_square(path, size)
    color, mask = split_alpha(image)
    if depth_path.exists():
        depth = open_image(depth_path, RENDERINGS, limits.RENDER_SIDE)
        if depth.size != image.size:
            sizes = [f"{i.width}x{i.height} pixels" for i in (depth, image)]
            raise DamagedFile(depth_path, f"is {sizes[0]}, but {path.name} is {sizes[1]}")
        is_16_bit = depth.mode.startswith("I")  # then the high byte counts
        grey = np.asarray(depth) >> 8 if is_16_bit else np.asarray(depth.convert("L"))
        mask = np.where(grey < 250, 255, 0).astype(np.uint8)
    elif mask is None:
        raise MissingFile(depth_path, f"is missing, and {path.name} has no alpha channel; expected the depth image")
    return *shrink(_planes(color, mask), size), int(mask.max())


def read_with_mask(path: Path, mask_path: Path, size: int) -> View:
    """A rendering and its mask, both size x size; colours are inverted, as in Kato's files."""
    color, mask = (_read_exactly(each, size) for each in (path, mask_path))
    return np.dstack([255 - color, mask[..., 0]]).transpose(2, 0, 1), mask[..., 0], int(mask.max())


def _read_exactly(path: Path, size: int) -> np.ndarray:
    image = open_image(path, RENDERINGS, limits.RENDER_SIDE)
    if image.size != (size, size) or image.mode.startswith("I"):
        found = f"{image.width}x{image.height} pixels of the format {image.mode}"
        raise DamagedFile(path, f"is {found}; expected {size}x{size} of 8 bits")
    return split_alpha(image)[0]


def _read_square(path: Path, size: int) -> Image.Image:
    image, least = open_image(path, RENDERINGS, limits.RENDER_SIDE), max(size, MASK_SIZE)
    if image.width != image.height or image.width < least:
        found = f"{image.width}x{image.height} pixels"
        raise DamagedFile(path, f"is {found}; expected a square image of at least {least}x{least}")
    if image.mode not in ("1", "L", "LA", "P", "PA", "RGB", "RGBA"):
        raise DamagedFile(path, f"has the pixel format {image.mode}; expected 8-bit grey, RGB or RGBA")
    return image


def split_alpha(image: Image.Image) -> tuple[np.ndarray, np.ndarray | None]:
    """Colours over white, uint8 [H, W, 3], and the alpha channel, uint8 [H, W], or None if the image has none."""
    if image.mode == "P":
        image = image.convert("RGBA" if "transparency" in image.info else "RGB")
    if image.mode not in ("RGBA", "LA", "PA"):
        return np.asarray(image.convert("RGB")), None
    image = image.convert("RGBA")
    alpha = image.getchannel("A")
    white = Image.new("RGB", image.size, (255, 255, 255))
    white.paste(image, mask=alpha)
    return np.asarray(white), np.asarray(alpha)


def _planes(color: np.ndarray, mask: np.ndarray) -> np.ndarray:
    planes = np.empty((4, *mask.shape), np.float32)
    planes[:3], planes[3] = color.transpose(2, 0, 1), mask
    return planes


def shrink(planes: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """An image uint8 [4, size, size] and its mask uint8 [64, 64] of colours and mask float32 [4, H, W], 0 .. 255.

    The planes are padded with 0 to a square. Each pixel is the mean over its area, fractions of pixels included.
    """
    image = _shrink(planes, size)
    return image, image[3] if size == MASK_SIZE else _shrink(planes[3:], MASK_SIZE)[0]


def _shrink(planes: np.ndarray, size: int) -> np.ndarray:
    if planes.shape[1:] == (size, size):
        return planes.astype(np.uint8)
    side = max(planes.shape[1:])
    rows, columns = (_area_weights(side, size)[:, (side - n) // 2 :][:, :n] for n in planes.shape[1:])
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
    text = read_text(path, limits.TABLE_BYTES, wanted)
    lines = [line.split() for line in text.splitlines() if line.strip()]
    if len(lines) < rows:
        raise DamagedFile(path, f"has {len(lines)} rows, {rows} are needed; expected {wanted}. {FETCH_AGAIN}")
    table = np.full((rows, columns), np.nan)
    for k, line in enumerate(lines[:rows]):
        try:
            table[k] = [float(word) for word in line[:columns]]
            sound = len(line) >= columns and np.isfinite(table[k]).all()
        except ValueError:
            sound = False
        if not sound:
            raise DamagedFile(path, f"row {k} is {' '.join(line)!r}; expected {wanted}, all finite")
    return table
