"""Image files that somebody else may have made, decoded by Pillow once their size is known to be one we can hold."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from learn3d.files import limits
from learn3d.files.findings import AGAIN, DamagedFile
from learn3d.files.reading import check_file

RENDERINGS = ("PNG", "JPEG", "TIFF")
PHOTOGRAPHS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")


def open_image(path: Path, formats: Sequence[str], most_side: int) -> Image.Image:
    """A decoded image in its own mode, of one of the formats (Pillow's names) and at most `most_side` pixels a side.

    Only the decoders of these formats are ever tried. Raises MissingFile, and DamagedFile for what is no such image,
    a file above 256 MiB, and more than 64 million pixels; nothing has been decoded then.
    """
    check_file(path, limits.IMAGE_FILE_BYTES, "an image")
    try:
        with Image.open(path, formats=formats) as image:
            _check_size(path, *image.size, most_side)
            image.load()
            return image
    except DamagedFile:
        raise
    except UnidentifiedImageError as error:
        raise DamagedFile(path, f"cannot be decoded as an image of the kind {', '.join(formats)}. {AGAIN}") from error
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        most = limits.IMAGE_PIXELS
        raise DamagedFile(path, f"has too many pixels ({error}); at most {most} are read: make it smaller") from error
    except Exception as error:  # Pillow's decoders raise whatever a damaged file leads them to
        raise DamagedFile(path, f"cannot be decoded as an image ({type(error).__name__}: {error}). {AGAIN}") from error


def _check_size(path: Path, width: int, height: int, most_side: int) -> None:
    if max(width, height) > most_side or width * height > limits.IMAGE_PIXELS:
        raise DamagedFile(
            path,
            f"is {width}x{height} pixels; at most {most_side} a side and {limits.IMAGE_PIXELS} in all are read: "
            "make it smaller",
        )
