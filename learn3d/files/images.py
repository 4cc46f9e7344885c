"""Image files that somebody else may have made, decoded by Pillow in a worker process."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from PIL import Image, UnidentifiedImageError

from learn3d.files import limits, sandbox
from learn3d.files.findings import FETCH_AGAIN, DamagedFile
from learn3d.files.reading import check_file

RENDERINGS = ("PNG", "JPEG", "TIFF")
PHOTOGRAPHS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")
_MEMORY_PER_PIXEL = 16  # bytes; two copies of four channels, and one to work with
_PIXELS_PER_SECOND = 2e7


def open_image(path: Path, formats: Sequence[str], most_side: int) -> Image.Image:
    """A decoded image in its own mode, of one of the formats (Pillow's names) and at most `most_side` pixels a side.

    For functions that run in a worker. Raises MissingFile, and DamagedFile for what is no such image, a file above
    256 MiB, and more than 64 million pixels.
    """
    check_file(path, limits.IMAGE_FILE_BYTES, "an image")
    try:
        image = Image.open(path, formats=formats)
    except UnidentifiedImageError:
        hint = "Convert HEIC to JPEG" if path.suffix.lower() in (".heic", ".heif") else FETCH_AGAIN
        raise DamagedFile(path, f"cannot be decoded as an image of the kind {', '.join(formats)}. {hint}") from None
    except Image.DecompressionBombError as error:
        raise DamagedFile(path, f"has too many pixels ({error}): make it smaller") from None
    with image:
        pixels = image.width * image.height
        if max(image.size) > most_side or pixels > limits.IMAGE_PIXELS:
            raise DamagedFile(
                path,
                f"is {image.width}x{image.height} pixels; at most {most_side} a side and {limits.IMAGE_PIXELS} in all "
                "are read: make it smaller",
            )
        sandbox.allow(_MEMORY_PER_PIXEL * pixels, pixels / _PIXELS_PER_SECOND)
        try:
            image.load()
        except MemoryError:
            raise
        except Exception as error:  # Pillow's decoders raise whatever a damaged file leads them to
            raise DamagedFile(path, f"cannot be decoded as an image ({sandbox.reason(error)}). {FETCH_AGAIN}") from None
        return image


@contextlib.contextmanager
def opening_only(formats: Sequence[str]) -> Iterator[None]:
    """Let libraries that use Pillow open images of these formats only, and decode them at once.

    Pillow knows one, EPS, that it hands to Ghostscript: a program, run with what a stranger wrote.
    """
    usual = Image.open

    def open_whole(file: Any, mode: str = "r", _: Any = None) -> Image.Image:
        image = usual(file, mode, formats)
        image.load()
        return image

    Image.open = open_whole
    try:
        yield
    finally:
        Image.open = usual
