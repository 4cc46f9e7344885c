"""Images are decoded where their kind and size are known to be right."""

from __future__ import annotations

import io
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from learn3d.data.framing import read_photo
from learn3d.files import limits, renderings, sandbox
from learn3d.files.images import PHOTOGRAPHS, RENDERINGS, open_image


def png(width: int, height: int) -> bytes:
    """A grey PNG whose header promises so many pixels; its data hold none."""
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(b"")),
        (b"IEND", b""),
    ]
    body = (struct.pack(">I", len(c)) + kind + c + struct.pack(">I", zlib.crc32(kind + c)) for kind, c in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(body)


def read_image(path: Path) -> object:
    return sandbox.read(renderings.read_with_alpha, path, 64)


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
@pytest.mark.parametrize("size", [(60_000, 60_000), (10_001, 1), (1, 10_001), (9000, 9000), (2**31 - 1, 2**31 - 1)])
def test_images_that_promise_too_many_pixels_are_not_decoded(tmp_path, size):
    path = written(tmp_path / "a.png", png(*size))
    for read in (read_photo, read_image):
        with pytest.raises(ValueError, match=r"a\.png: .*(make it smaller|DecompressionBomb)"):
            read(path)


def test_renderings_may_be_smaller_than_photographs(tmp_path):
    Image.new("L", (2049, 1)).save(tmp_path / "a.png")
    assert open_image(tmp_path / "a.png", PHOTOGRAPHS, limits.IMAGE_SIDE).size == (2049, 1)
    with pytest.raises(ValueError, match="is 2049x1 pixels; at most 2048 a side"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize("kind", ["GIF", "EPS", "PPM", "ICO"])
def test_decoders_of_other_formats_are_never_tried(tmp_path, kind):
    content = io.BytesIO()
    Image.new("RGB", (16, 16)).save(content, kind)
    path = written(tmp_path / "a.png", content.getvalue())
    for formats in (RENDERINGS, PHOTOGRAPHS):
        with pytest.raises(ValueError, match=r"a\.png: cannot be decoded as an image of the kind PNG, JPEG"):
            open_image(path, formats, 100)


def test_large_files_and_pipes_are_not_opened(tmp_path):
    with open(tmp_path / "a.png", "wb") as file:
        file.truncate(limits.IMAGE_FILE_BYTES + 1)
    with pytest.raises(ValueError, match=r"a\.png: has \d+ bytes, and at most"):
        read_image(tmp_path / "a.png")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "b.png")
        with pytest.raises(ValueError, match=r"b\.png: cannot be read: it is no plain file"):
            read_image(tmp_path / "b.png")


def test_damaged_exif_data_do_not_cost_the_photograph(tmp_path):
    image = Image.fromarray(np.full((9, 6, 3), 7, np.uint8))
    mask = Image.fromarray(np.full((9, 6), 255, np.uint8))
    mask.save(tmp_path / "m.png")
    image.save(tmp_path / "a.jpg", exif=b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\xff\xff\xff\x7f\xff\xff\xff\xff")
    assert read_photo(tmp_path / "a.jpg", tmp_path / "m.png")[0].shape == (9, 6, 3)
