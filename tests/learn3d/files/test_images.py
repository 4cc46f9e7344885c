"""Images are decoded if their kind and size are known to be right."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from learn3d.data.framing import read_photo
from learn3d.files import limits, renderings, sandbox
from learn3d.files.images import PHOTOGRAPHS, RENDERINGS, open_image


def png(width: int, height: int) -> bytes:
    """A grey PNG whose header promises so many pixels; its data hold none."""
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(b"")), (b"IEND", b"")]
    body = (struct.pack(">I", len(c)) + kind + c + struct.pack(">I", zlib.crc32(kind + c)) for kind, c in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(body)


@pytest.mark.parametrize("size", [(60_000, 60_000), (10_001, 1), (1, 10_001), (9000, 9000), (2**31 - 1, 2**31 - 1)])
def test_images_that_promise_too_many_pixels_are_not_decoded(tmp_path, size):
    (tmp_path / "a.png").write_bytes(png(*size))
    for read in (read_photo, lambda path: sandbox.read(renderings.read_with_alpha, path, 64)):
        with pytest.raises(ValueError, match=r"a\.png: .*(make it smaller|DecompressionBomb)"):
            read(tmp_path / "a.png")


def test_renderings_may_be_smaller_than_photographs(tmp_path):
    Image.new("L", (2049, 1)).save(tmp_path / "a.png")
    assert open_image(tmp_path / "a.png", PHOTOGRAPHS, limits.IMAGE_SIDE).size == (2049, 1)
    with pytest.raises(ValueError, match="is 2049x1 pixels; at most 2048 a side"):
        open_image(tmp_path / "a.png", RENDERINGS, limits.RENDER_SIDE)


@pytest.mark.parametrize("kind", ["GIF", "EPS", "PPM", "ICO", "TIFF"])
def test_decoders_of_other_formats_are_never_tried(tmp_path, kind):
    content = io.BytesIO()
    Image.new("RGB", (16, 16)).save(content, kind)
    (tmp_path / "a.png").write_bytes(content.getvalue())
    for formats in (RENDERINGS, PHOTOGRAPHS):
        with pytest.raises(ValueError, match=r"a\.png: cannot be decoded as an image of the kind PNG, JPEG"):
            open_image(tmp_path / "a.png", formats, 100)


def test_damaged_exif_data_do_not_cost_the_photograph(tmp_path):
    Image.fromarray(np.full((9, 6), 255, np.uint8)).save(tmp_path / "m.png")
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\xff\xff\xff\x7f\xff\xff\xff\xff"
    Image.fromarray(np.full((9, 6, 3), 7, np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    assert read_photo(tmp_path / "a.jpg", tmp_path / "m.png")[0].shape == (9, 6, 3)
