"""Images and tables of cameras: decoded if their kind and size are known to be right; smaller, over white."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from learn3d.data.framing import read_photo
from learn3d.files import renderings, sandbox
from learn3d.files.findings import DamagedFile
from learn3d.files.images import PHOTOGRAPHS, RENDERINGS, open_image
from learn3d.files.renderings import read_table, shrink, split_alpha


def png(width: int, height: int) -> bytes:
    """A grey PNG whose header promises so many pixels; its data hold none."""
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(b"")), (b"IEND", b"")]
    body = (struct.pack(">I", len(c)) + kind + c + struct.pack(">I", zlib.crc32(kind + c)) for kind, c in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(body)


@pytest.mark.parametrize("size", [(60_000, 60_000), (10_001, 1), (9000, 9000), (2**31 - 1, 2**31 - 1)])
def test_images_that_promise_too_many_pixels_are_not_decoded(tmp_path, size):
    (tmp_path / "a.png").write_bytes(png(*size))
    for read in (read_photo, lambda path: sandbox.read(renderings.read_with_alpha, path, 64)):
        with pytest.raises(ValueError, match=r"a\.png: .*(make it smaller|DecompressionBomb)"):
            read(tmp_path / "a.png")


@pytest.mark.parametrize("kind", ["GIF", "EPS", "TIFF"])
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


def test_shrinking_takes_the_mean_over_each_pixels_area():
    rng = np.random.default_rng(0)
    color, mask = rng.integers(0, 256, (128, 128, 3), np.uint8), rng.integers(0, 256, (128, 128), np.uint8)
    image, small = shrink(color, mask, 64)
    blocks = np.dstack([color, mask]).reshape(64, 2, 64, 2, 4).mean((1, 3)).transpose(2, 0, 1)
    assert image.dtype == np.uint8 and np.abs(image - blocks).max() <= 0.51
    np.testing.assert_array_equal(small, image[3])


def test_shrinking_by_three_and_a_half_keeps_the_covered_area():
    mask = np.zeros((224, 224), np.uint8)
    mask[10:101, 50:171] = 255
    image, small = shrink(np.dstack([mask] * 3), mask, 224)
    np.testing.assert_array_equal(image[3], mask)
    assert small.sum() * 3.5**2 == pytest.approx(mask.sum(), rel=1e-3)
    assert small[:, 10].max() == 0 and small[20, 20] == 255


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P"])
def test_transparent_pixels_become_white(tmp_path, mode):
    pixels = np.zeros((4, 4, 4), np.uint8)
    pixels[1, 2] = (90, 90, 90, 255)
    image = Image.fromarray(pixels)
    if mode == "P":
        image = image.convert("RGB").quantize(2)
        image.info["transparency"] = image.getpixel((0, 0))
    image = image.convert(mode) if mode == "LA" else image
    image.save(tmp_path / "image.png", transparency=image.info.get("transparency"))
    image = open_image(tmp_path / "image.png", RENDERINGS, 64)
    assert image.mode == mode
    color, alpha = split_alpha(image)
    assert color[1, 2].tolist() == [90] * 3 and color[0, 0].tolist() == [255] * 3
    assert alpha[1, 2] == 255 and alpha.sum() == 255


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB"])
def test_images_without_transparency_have_no_alpha(tmp_path, mode):
    Image.fromarray(np.full((4, 4), 255, np.uint8)).convert(mode).save(tmp_path / "image.png")
    color, alpha = split_alpha(open_image(tmp_path / "image.png", RENDERINGS, 64))
    assert alpha is None and color.shape == (4, 4, 3) and (color == 255).all()


def test_rows_that_are_cut_short_are_damage(tmp_path):
    path = tmp_path / "view.txt"
    path.write_text("10 20 0 1.5\n33.2 20 0 1.5 9")
    np.testing.assert_array_equal(read_table(path, 2, 4, "a table"), [[10, 20, 0, 1.5], [33.2, 20, 0, 1.5]])
    path.write_text("10 20 0 1.5\n33.2")
    with pytest.raises(DamagedFile, match=r"row 1 is '33\.2'; expected a table"):
        read_table(path, 2, 4, "a table")
