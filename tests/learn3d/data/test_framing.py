"""Framing a photograph: the image and the camera of the photograph must belong together, whatever its shape."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from shapenet_files import box_mesh

import nmr
from learn3d.data.framing import frame, read_framed, read_photo
from learn3d.data.masks import mask_box


def silhouette(size: int) -> np.ndarray:
    """A box of sides 0.5, 1, 0.7 with its centre at the origin, uint8 [size, size]."""
    camera = nmr.LookAt.from_angles([2.5], [25.0], [40.0], half_fov_deg=24.0)
    vertices, faces = map(
        torch.from_numpy, box_mesh(np.array([[[-0.25, -0.5, -0.35], [0.25, 0.5, 0.35]]]))
    )
    drawn = nmr.render_silhouette(vertices.float(), faces, camera, image_size=size)[0]
    return (255 * drawn).round().byte().numpy()


def gray(mask: np.ndarray, value: int = 200) -> np.ndarray:
    return np.where(mask[..., None] > 0, value, 90).astype(np.uint8).repeat(3, axis=2)


def share_that_differs(a: np.ndarray, b: np.ndarray) -> float:
    return np.abs(a.astype(float) - b).sum() / b.astype(float).sum()


@pytest.mark.parametrize("shape", [(240, 240), (180, 240), (240, 151), (150, 241)])
def test_the_photo_keeps_its_camera(shape: tuple[int, int]) -> None:
    """A photograph is the middle of the square that the camera sees; padding gives the square back."""
    side = max(shape)
    whole = silhouette(side)
    top, left = (side - shape[0]) // 2, (side - shape[1]) // 2
    mask = whole[top : top + shape[0], left : left + shape[1]]
    assert mask.sum() == whole.astype(int).sum()  # nothing was cut off
    for size in (64, 96):
        image = frame(gray(mask), mask, size)
        assert image.shape == (4, size, size) and image.dtype == np.uint8
        wanted = silhouette(size)
        assert share_that_differs(image[3], wanted) < 0.02
        # it would notice a pixel's shift
        assert share_that_differs(image[3], np.roll(wanted, 1, axis=1)) > 0.03


def test_colours_have_katos_form() -> None:
    """255 - colour over white: black background, and a light object is dark."""
    mask = np.zeros((64, 64), np.uint8)
    mask[20:40, 20:40] = 255
    mask[40:50, 20:40] = 51  # a fifth
    image = frame(gray(mask), mask, 64)
    assert (image[:3, 25, 25] == 55).all() and image[3, 25, 25] == 255
    assert (image[:3, 45, 25] == 11).all() and image[3, 45, 25] == 51
    assert (image[:, 5, 5] == 0).all()
    plain = frame(gray(mask), mask, 64, inverted=False)
    assert (plain[:3] == 255 - image[:3]).all() and (plain[3] == image[3]).all()


@pytest.mark.parametrize("factor", [1, 64])
def test_small_photos_are_enlarged_and_large_ones_averaged(factor: int) -> None:
    mask = np.zeros((20, 20), np.uint8)
    mask[5:15, 5:15] = 255
    large = np.kron(mask, np.ones((factor, factor), np.uint8))
    image = frame(gray(large), large, 64)
    assert mask_box(image[3]) == (16, 16, 48, 48)


def save(path: Path, array: np.ndarray, **options: object) -> Path:
    Image.fromarray(array).save(path, **options)
    return path


def test_masks_come_from_files_or_transparency(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    colors, mask = rng.integers(0, 256, (8, 6, 3), np.uint8), np.zeros((8, 6), np.uint8)
    mask[2:5, 1:4] = 255
    rgba = np.concatenate([colors, mask[..., None]], axis=2)
    photo, cut_out = save(tmp_path / "a.png", colors), save(tmp_path / "rgba.png", rgba)
    for result in (
        read_photo(cut_out),
        read_photo(cut_out, optional=True),
        read_photo(photo, save(tmp_path / "m.png", mask)),
        read_photo(photo, cut_out),
        read_photo(photo, save(tmp_path / "bits.png", mask > 0)),
    ):
        np.testing.assert_array_equal(result[0], colors)
        np.testing.assert_array_equal(result[1], mask)
    assert read_photo(photo, optional=True)[1] is None
    opaque = [
        save(tmp_path / name, np.dstack([values, np.full((8, 6), 255, np.uint8)]))
        for name, values in (("o.png", colors), ("om.png", mask[..., None].repeat(3, 2)))
    ]
    assert read_photo(opaque[0], optional=True)[1] is None, "nothing is cut out"
    np.testing.assert_array_equal(read_photo(*opaque)[1], mask)


@pytest.mark.parametrize("shape", [(30, 50), (50, 30)])
@pytest.mark.parametrize(
    ("rows", "columns", "touches"),
    [
        ((1, -1), (1, -1), False),
        ((0, -1), (1, -1), True),
        ((1, None), (1, -1), True),
        ((1, -1), (0, -1), True),
        ((1, -1), (1, None), True),
    ],
)
def test_objects_at_the_border_are_noticed(tmp_path: Path, shape, rows, columns, touches) -> None:
    rgba = np.full((*shape, 4), 100, np.uint8)
    rgba[..., 3] = 0
    rgba[slice(*rows), slice(*columns), 3] = 255
    framed = read_framed(save(tmp_path / "a.png", rgba), None, 64)
    assert framed.touches_border == touches


def test_photos_are_turned_upright(tmp_path: Path) -> None:
    colors, mask = np.full((8, 6, 3), 10, np.uint8), np.zeros((8, 6), np.uint8)
    colors[0] = 250
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was turned: rotate by 90 degrees clockwise to see it upright
    path = save(tmp_path / "a.jpg", np.rot90(colors).copy(), exif=exif, quality=100)
    got, _ = read_photo(path, save(tmp_path / "m.png", mask))
    assert got.shape == (8, 6, 3) and got[0].min() > 200 and got[4:].max() < 60
    mask[0] = 255
    _, turned = read_photo(path, save(tmp_path / "turned.png", np.rot90(mask).copy(), exif=exif))
    np.testing.assert_array_equal(turned, mask)
    with pytest.raises(
        ValueError, match=r"has 6x8 pixels, its mask .*m.png 8x6 pixels; is one of them rotated"
    ):
        read_photo(path, save(tmp_path / "m.png", np.rot90(mask).copy()))


def test_unreadable_photos_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"a.png: is missing"):
        read_photo(tmp_path / "a.png")
    with pytest.raises(
        ValueError, match=r"a.png: has no transparency and no mask: cut it out, or give a mask"
    ):
        read_photo(save(tmp_path / "a.png", np.full((8, 6, 3), 10, np.uint8)))
    # Pillow would cut values of more than 8 bits off at 255, which leaves all white.
    path = save(tmp_path / "b.png", np.full((8, 6), 30_000, np.uint16))
    with pytest.raises(
        ValueError, match=r"b.png: has more than 8 bits a pixel and channel \(.*\); save it with 8"
    ):
        read_photo(path, path)


def test_masks_of_more_than_8_bits_are_refused(tmp_path: Path) -> None:
    photo = save(tmp_path / "a.png", np.full((8, 6, 3), 10, np.uint8))
    mask = save(tmp_path / "m.png", np.full((8, 6), 3_000, np.uint16))
    with pytest.raises(ValueError, match=r"m\.png: has more than 8 bits a pixel"):
        read_photo(photo, mask)
