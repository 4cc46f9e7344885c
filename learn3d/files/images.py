"""Untrusted image files, decoded by Pillow in the sandbox."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from learn3d.files import limits, sandbox
from learn3d.files.findings import FETCH_AGAIN, DamagedFile
from learn3d.files.reading import open_file

# TIFF is no format here: its tables may name millions of strips, each an object before the first pixel.
RENDERINGS = ("PNG", "JPEG")
PHOTOGRAPHS = ("PNG", "JPEG", "WEBP", "BMP")
_MEMORY_PER_PIXEL = 16  # bytes; two copies of four channels, and one to work with
_PIXELS_PER_SECOND = 2e7


def open_image(path: Path, formats: Sequence[str], most_side: int) -> Image.Image:
    """A decoded image in its own mode, of one of the formats (Pillow's names) and at most `most_side` pixels a side.

    For functions that run in the sandbox. Raises MissingFile, and DamagedFile for a file of another kind or above 256
    MiB, and for more than 64 million pixels.
    """
    with open_file(path, limits.IMAGE_FILE_BYTES, "an image") as file:
        try:
            image = Image.open(file, formats=formats)
            pixels = image.width * image.height
            if max(image.size) <= most_side and pixels <= limits.IMAGE_PIXELS:
                sandbox.allow(_MEMORY_PER_PIXEL * pixels, pixels / _PIXELS_PER_SECOND)
                image.load()
                return image
            fault = f"is {image.width}x{image.height} pixels; at most {most_side} a side and {limits.IMAGE_PIXELS} in "
            fault += "all are read: make it smaller"
        except UnidentifiedImageError:
            fault = f"cannot be decoded as an image of the kind {', '.join(formats)}. Convert it if it is of another"
        except MemoryError:
            raise
        except Exception as error:  # Pillow's decoders raise whatever a damaged file leads them to
            fault = f"cannot be decoded as an image ({sandbox.reason(error)}). {FETCH_AGAIN}"
    raise DamagedFile(path, fault)
