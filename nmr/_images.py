"""Image files, for textures."""

from __future__ import annotations

import io
import os

import numpy as np

_PILLOW = (
    "reading and writing texture images needs Pillow, which is not installed; run `pip install pillow`, or install "
    "nmr with the extra data"
)


_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "TGA", "WEBP", "GIF", "PPM")
_MOST_PIXELS = 2**26  # 8192 x 8192; reading takes about 30 bytes per pixel


def read_image(filename: str, content: bytes | None = None) -> np.ndarray:
    """Colours ``[H, W, 3]`` float32 in [0, 1], row 0 = top: grey becomes RGB, alpha is dropped,
    16 bits are kept.

    content: that of the file, if it is part of another one.
    """
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError(_PILLOW) from error
    if content is None and os.path.exists(filename) and not os.path.isfile(filename):
        raise ValueError(f"the image {filename} is not a regular file")
    try:
        source = filename if content is None else io.BytesIO(content)
        with Image.open(source, formats=_FORMATS) as image:
            if image.width * image.height > _MOST_PIXELS:
                raise ValueError(
                    f"{image.width}x{image.height} pixels, at most {_MOST_PIXELS} are read"
                )
            if image.mode.startswith("I"):
                grey = np.asarray(image, dtype=np.float32) / 65535
                return np.repeat(grey[:, :, None], 3, axis=2)
            return np.asarray(image.convert("RGB"), dtype=np.float32) / 255
    except FileNotFoundError:
        raise
    except Exception as error:  # Pillow raises errors of many types for damaged files
        raise ValueError(f"the image {filename} cannot be read: {error}") from error


def write_png(filename: str, image: np.ndarray) -> None:
    """Colours ``[H, W, 3]``, clamped to [0, 1], as 8 bits."""
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError(_PILLOW) from error
    partial = f"{filename}.part"
    Image.fromarray(np.round(np.clip(np.nan_to_num(image), 0, 1) * 255).astype(np.uint8)).save(
        partial, format="PNG"
    )
    os.replace(partial, filename)
