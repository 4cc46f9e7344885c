"""Decodes untrusted images in the sandbox, reads renderings, and resamples pictures."""

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from learn3d.files import limits, sandbox
from learn3d.files.reading import DamagedFile, MissingFile, faults_of, open_file

# TIFF is not supported: a small file can list millions of strips, for which Pillow makes objects before it decodes.
RENDERINGS = ("PNG", "JPEG")
PHOTOGRAPHS = ("PNG", "JPEG", "WEBP", "BMP")
_SAVE_AGAIN = "Save it as one of these, or fetch it again if its download was cut short"


def open_image(path: Path, formats: Sequence[str], max_side: int) -> Image.Image:
    """Decode an image, in the sandbox. formats: Pillow's names of the allowed formats.

    Raises MissingFile, and DamagedFile for another format, a file above 256 MiB, a side above
    `max_side` pixels, and more than 64 million pixels.
    """
    wanted = f"an image in the format {', '.join(formats)}"
    with faults_of(path, wanted), open_file(path, limits.IMAGE_FILE_BYTES, wanted) as file:
        most = limits.IMAGE_PIXELS
        limit = f"the limits are {max_side} a side and {most}: make it smaller"
        with faults_of(path, wanted, _SAVE_AGAIN):
            try:
                image = Image.open(file, formats=formats)
            except UnidentifiedImageError:
                raise ValueError("it has another format") from None
            except Image.DecompressionBombError:  # by Pillow's own limit: the size is not known yet
                raise DamagedFile(path, f"has too many pixels; {limit}") from None
        pixels = image.width * image.height
        if max(image.size) > max_side or pixels > most:
            raise DamagedFile(path, f"is {image.width}x{image.height} pixels; {limit}")
        sandbox.allow(56 * pixels, pixels / 1e7)  # for decoding, masking and framing
        image.load()
        return image


# image uint8 [4, S, S], mask uint8 [64, 64], largest value of the mask
Rendering = tuple[np.ndarray, np.ndarray, int]


def read_with_depth(path: Path, depth_path: Path, size: int) -> Rendering:
    """A square rendering, reduced to `size`.

    Mask: depth below 250 in 8 bits, or alpha if there is no depth file.
    """
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
    planes = np.stack([*color.transpose(2, 0, 1), mask]).astype(np.float32)
    small = resample(planes[3:], limits.MASK_SIZE)[0]
    return resample(planes, size), small, int(mask.max())


def read_with_mask(path: Path, mask_path: Path, size: int) -> Rendering:
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
    image = open_image(path, RENDERINGS, limits.RENDER_SIDE)
    least = max(size, limits.MASK_SIZE)
    if image.width != image.height or image.width < least or image.mode.startswith(("I", "F", "C")):
        raise DamagedFile(
            path, f"is {_kind(image)}; expected a square image of at least {least}x{least}, 8 bits"
        )
    return split_alpha(image)


def _kind(image: Image.Image) -> str:
    return f"{image.width}x{image.height} pixels of the format {image.mode}"


def split_alpha(image: Image.Image) -> tuple[np.ndarray, np.ndarray | None]:
    """Colours over white, uint8 [H, W, 3], and the alpha channel, uint8 [H, W], or None."""
    if not image.has_transparency_data:
        return np.asarray(image.convert("RGB")), None
    image = image.convert("RGBA")
    alpha = image.getchannel("A")
    white = Image.new("RGB", image.size, (255, 255, 255))
    white.paste(image, mask=alpha)
    return np.asarray(white), np.asarray(alpha)


def resample(
    planes: np.ndarray, size: int, square: tuple[float, float, float] | None = None
) -> np.ndarray:
    """What a square shows of planes float32 [C, H, W] with values 0 .. 255: uint8 [C, size, size].

    Each pixel is the mean over its area, fractions of pixels included. If the planes are magnified,
    it is interpolated linearly. The planes are 0 beyond their border.
    square: left, top and side in pixels; default: the planes padded to a square on both sides.
    """
    height, width = planes.shape[1:]
    side = max(height, width)
    left, top, side = square or (-((side - width) // 2), -((side - height) // 2), side)
    rows = _weights(height, top, side, size)
    columns = _weights(width, left, side, size)
    return np.rint(rows @ planes @ columns.T).astype(np.uint8)


@functools.lru_cache(16)
def _weights(count: int, start: float, side: float, size: int) -> np.ndarray:
    """Weights of `count` pixels for `size` pixels from `start` on: float32 [size, count]."""
    pixels = np.arange(count) - start
    edges = np.arange(size + 1) * (side / size)
    if side < size:
        centres = (edges[1:] + edges[:-1]) / 2
        return (1 - np.abs(centres[:, None] - (pixels + 0.5))).clip(0).astype(np.float32)
    overlap = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return (overlap.clip(0) * (size / side)).astype(np.float32)
