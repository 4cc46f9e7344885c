"""Images, meshes and voxel grids: valid files are read, others are refused."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from PIL import Image

from learn3d.data.framing import read_photo
from learn3d.files import formats, images, limits, sandbox
from learn3d.files.formats import read_table
from learn3d.files.images import PHOTOGRAPHS, RENDERINGS, open_image, resample, split_alpha
from learn3d.files.reading import DamagedFile


def png(width: int, height: int) -> bytes:
    """A grey PNG whose header promises so many pixels; its data hold none."""
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(b"")), (b"IEND", b"")]
    body = (
        struct.pack(">I", len(c)) + kind + c + struct.pack(">I", zlib.crc32(kind + c))
        for kind, c in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(body)


@pytest.mark.parametrize(
    "size", [(60_000, 60_000), (10_001, 1), (9000, 9000), (2**31 - 1, 2**31 - 1)]
)
def test_images_that_promise_too_many_pixels_are_not_decoded(tmp_path, size):
    (tmp_path / "a.png").write_bytes(png(*size))
    for read in (
        read_photo,
        lambda path: sandbox.read(images.read_with_depth, path, path.with_name("none"), 64),
    ):
        with pytest.raises(ValueError, match=r"a\.png: .*make it smaller$"):
            read(tmp_path / "a.png")


@pytest.mark.parametrize("kind", ["GIF", "EPS", "TIFF"])
def test_decoders_of_other_formats_are_never_tried(tmp_path, kind):
    content = io.BytesIO()
    Image.new("RGB", (16, 16)).save(content, kind)
    (tmp_path / "a.png").write_bytes(content.getvalue())
    for kinds in (RENDERINGS, PHOTOGRAPHS):
        with pytest.raises(
            ValueError,
            match=r"a\.png: cannot be read \(it has another format\); expected an image in .*\. Save it as one",
        ):
            open_image(tmp_path / "a.png", kinds, 100)


def test_a_photograph_with_damaged_exif_data_is_read(tmp_path):
    Image.fromarray(np.full((9, 6), 255, np.uint8)).save(tmp_path / "m.png")
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\xff\xff\xff\x7f\xff\xff\xff\xff"
    Image.fromarray(np.full((9, 6, 3), 7, np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    assert read_photo(tmp_path / "a.jpg", tmp_path / "m.png")[0].shape == (9, 6, 3)


def test_shrinking_takes_the_mean_over_each_pixels_area():
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (128, 128, 3), np.uint8)
    mask = rng.integers(0, 256, (128, 128), np.uint8)
    pixels = np.dstack([color, mask])
    image = resample(pixels.transpose(2, 0, 1).astype(np.float32), 64)
    blocks = pixels.reshape(64, 2, 64, 2, 4).mean((1, 3)).transpose(2, 0, 1)
    assert image.dtype == np.uint8 and np.abs(image - blocks).max() <= 0.51


def test_shrinking_by_three_and_a_half_keeps_the_covered_area():
    mask = np.zeros((224, 224), np.uint8)
    mask[10:101, 50:171] = 255
    np.testing.assert_array_equal(resample(mask[None].astype(np.float32), 224)[0], mask)
    small = resample(mask[None].astype(np.float32), 64)[0]
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
    np.testing.assert_array_equal(
        read_table(path, 2, 4, "a table"), [[10, 20, 0, 1.5], [33.2, 20, 0, 1.5]]
    )
    for text in (
        "10 20 0 1.5\n33.2",
        "10 20 0 1.5\n",
        "10 20 0 1.5\n33.2 20 0 nan",
        "10 20 0 1.5\n33.2 20 x 1.5",
    ):
        path.write_text(text)
        with pytest.raises(DamagedFile, match=r"view\.txt: cannot be read \(.*; expected a table"):
            sandbox.read(read_table, path, 2, 4, "a table", wanted="a table")


CELLS = np.random.default_rng(0).random((8, 8, 8)) < 0.3


def saved(compressed: bool = False, **arrays: object) -> bytes:
    content = io.BytesIO()
    scipy.io.savemat(content, arrays, do_compression=compressed)
    return content.getvalue()


def matlab(folder: Path, content: bytes, name: str = "Volume", size: int = 8) -> np.ndarray:
    (folder / "a.mat").write_bytes(content)
    return sandbox.read(formats.read_matlab, folder / "a.mat", name, size)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", ["u1", "?", "f8"])
def test_the_array_is_found_among_others(tmp_path, compressed, dtype):
    cell = np.array([np.zeros(2), "a"], object)
    content = saved(compressed, other=CELLS + 1, Volume=CELLS.astype(dtype), text="abc", cell=cell)
    np.testing.assert_array_equal(matlab(tmp_path, content), CELLS)
    for name, size in (("missing", 8), ("text", 8), ("cell", 8), ("Volume", 5)):
        with pytest.raises(ValueError, match=rf"a\.mat: has .*; expected .*{name}"):
            matlab(tmp_path, content, name, size)


def test_other_files_than_matlab_are_refused(tmp_path):
    for content in (b"MATLAB", saved(Volume=CELLS)[:-5], b"", bytes(limits.VOLUME_BYTES + 1)):
        with pytest.raises(ValueError, match=r"a\.mat: "):
            matlab(tmp_path, content)
