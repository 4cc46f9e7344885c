"""Framing a photograph: the image and the camera that it returns must belong together, whatever was cut or turned."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import nmr
from learn3d.data.framing import OBJECT_SHARE, check_mask, frame, mask_box, read_photo


def silhouette(camera: nmr.LookAt, size: int) -> np.ndarray:
    """A box of sides 0.5, 1, 0.7 with its centre at the origin, uint8 [size, size]."""
    corners = torch.tensor([[x, y, z] for x in (-0.25, 0.25) for y in (-0.5, 0.5) for z in (-0.35, 0.35)])
    quads = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    faces = torch.tensor([triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))])
    return (255 * nmr.render_silhouette(corners, faces, camera, image_size=size)[0]).round().byte().numpy()


def gray(mask: np.ndarray, value: int = 200) -> np.ndarray:
    return np.where(mask[..., None] > 0, value, 90).astype(np.uint8).repeat(3, axis=2)


def share_that_differs(a: np.ndarray, b: np.ndarray) -> float:
    return np.abs(a.astype(float) - b).sum() / b.astype(float).sum()


@pytest.mark.parametrize("shape", [(240, 240), (180, 240), (240, 151), (150, 241)])
def test_the_whole_photo_keeps_its_camera(shape: tuple[int, int]) -> None:
    """A photograph is the middle of the square that the camera sees; padding gives the square back."""
    side = max(shape)
    whole = silhouette(nmr.LookAt.from_angles([2.5], [25.0], [40.0], half_fov_deg=24.0), side)
    top, left = (side - shape[0]) // 2, (side - shape[1]) // 2
    mask = whole[top : top + shape[0], left : left + shape[1]]
    assert mask.sum() == whole.astype(int).sum()  # nothing was cut off
    image, half_fov = frame(gray(mask), mask, 48.0, 25.0, "whole", 64)
    assert image.shape == (4, 64, 64) and image.dtype == np.uint8 and half_fov == 24.0
    wanted = silhouette(nmr.LookAt.from_angles([2.5], [25.0], [40.0], half_fov_deg=24.0), 64)
    assert share_that_differs(image[3], wanted) < 0.02
    assert share_that_differs(image[3], np.roll(wanted, 1, axis=1)) > 0.03  # it would notice a pixel's shift


def camera_at_the_box(eye: torch.Tensor, half_fov: float) -> nmr.LookAt:
    """The upright camera at `eye` that has the box of what it sees in the middle of its image."""
    at = torch.zeros(3)
    for _ in range(8):
        camera = nmr.LookAt([eye.tolist()], [at.tolist()], half_fov_deg=half_fov)
        left, top, right, bottom = mask_box(silhouette(camera, 1024))
        shift = torch.tensor([left + right - 1024, 1024 - top - bottom]) / 1024 * math.tan(math.radians(half_fov))
        axes = camera.projection(torch.float32).matrix[0, :, :3] * torch.tensor([[1.0], [-1.0], [1.0]])  # right, up
        at = at + (at - eye).norm() * (shift @ axes[:2])
    return nmr.LookAt([eye.tolist()], [at.tolist()], half_fov_deg=half_fov)


@pytest.mark.parametrize("at", [(0.5, 0.0, 0.0), (-0.3, 0.35, 0.3), (0.1, -0.4, -0.6)])
def test_turning_the_camera_to_the_object_keeps_the_camera_right(at: tuple[float, float, float]) -> None:
    """The photograph looks past the object; what comes out is what a camera at the same place sees that looks at it."""
    distance, elevation, azimuth = 2.6, 30.0, 35.0
    eye = nmr.cameras.points_from_angles(distance, elevation, azimuth).float()
    mask = silhouette(nmr.LookAt([eye.tolist()], [list(at)], half_fov_deg=32.0), 640)
    left, top, right, bottom = mask_box(mask)
    assert 0 < left and right < 640 and max(abs(left + right - 640), abs(top + bottom - 640)) > 90  # off centre
    image, half_fov = frame(gray(mask), mask, 64.0, elevation, "object", 128)
    wanted = silhouette(camera_at_the_box(eye, half_fov), 128)
    assert share_that_differs(image[3], wanted) < 0.015
    # A square cut out of the photograph, scaled to the same box, has another shape.
    box = mask_box(image[3])
    cut = Image.fromarray(mask).crop((left, top, right, bottom))
    naive = np.zeros((128, 128))
    naive[box[1] : box[3], box[0] : box[2]] = np.asarray(cut.resize((box[2] - box[0], box[3] - box[1])))
    assert share_that_differs(naive, wanted) > 0.03
    # The middle of the box stands for the middle of the object: that is the approximation.
    assumed = silhouette(nmr.LookAt.from_angles([distance], [elevation], [azimuth], half_fov_deg=half_fov), 128)
    offset = np.subtract(mask_box(image[3]), mask_box(assumed))
    assert np.abs(offset).max() <= 5


def test_an_object_in_the_middle_is_only_zoomed() -> None:
    camera = dict(distance=2.6, elevation_deg=0.0, azimuth_deg=0.0)
    mask = silhouette(nmr.LookAt.from_angles([2.6], [0.0], [0.0], half_fov_deg=32.0), 200)
    image, half_fov = frame(gray(mask), mask, 64.0, 0.0, "object", 128)
    wanted = silhouette(nmr.LookAt.from_angles(*([v] for v in camera.values()), half_fov_deg=half_fov), 128)
    assert share_that_differs(image[3], wanted) < 0.03
    # The front face, 0.35 nearer, is 1 high: it decides what must be seen.
    assert math.tan(math.radians(half_fov)) == pytest.approx(0.5 / 2.25 / OBJECT_SHARE, rel=0.02)


def test_colours_have_katos_form() -> None:
    """255 - colour over white: black background, and a light object is dark."""
    mask = np.zeros((64, 64), np.uint8)
    mask[20:40, 20:40] = 255
    mask[40:50, 20:40] = 51  # a fifth
    image, _ = frame(gray(mask), mask, 40.0, 0.0, "whole", 64)
    assert (image[:3, 25, 25] == 55).all() and image[3, 25, 25] == 255
    assert (image[:3, 45, 25] == 11).all() and image[3, 45, 25] == 51
    assert (image[:, 5, 5] == 0).all()


def test_small_photos_are_enlarged_and_large_ones_ema_weights() -> None:
    mask = np.zeros((20, 20), np.uint8)
    mask[5:15, 5:15] = 255
    for factor in (1, 64):
        big = np.kron(mask, np.ones((factor, factor), np.uint8))
        for framing in ("whole", "object"):
            image, _ = frame(gray(big), big, 40.0, 0.0, framing, 64)
            side = 32 if framing == "whole" else 64 * OBJECT_SHARE
            assert math.sqrt(image[3].sum() / 255) == pytest.approx(side, abs=1.5)


def save(path: Path, array: np.ndarray, **options: object) -> Path:
    Image.fromarray(array).save(path, **options)
    return path


def test_masks_come_from_files_or_transparency(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    colors, mask = rng.integers(0, 256, (8, 6, 3), np.uint8), np.zeros((8, 6), np.uint8)
    mask[2:5, 1:4] = 255
    rgba = np.concatenate([colors, mask[..., None]], axis=2)
    photo = save(tmp_path / "a.png", colors)
    for result in (
        read_photo(save(tmp_path / "rgba.png", rgba)),
        read_photo(photo, save(tmp_path / "m.png", mask)),
        read_photo(photo, save(tmp_path / "cutout.png", rgba)),
        read_photo(photo, save(tmp_path / "bits.png", mask > 0)),
    ):
        np.testing.assert_array_equal(result[0], colors)
        np.testing.assert_array_equal(result[1], mask)


def test_photos_are_turned_upright(tmp_path: Path) -> None:
    colors, mask = np.full((8, 6, 3), 10, np.uint8), np.zeros((8, 6), np.uint8)
    colors[0] = 250
    mask[1:3, 1:3] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was turned: rotate by 90 degrees clockwise to see it upright
    path = save(tmp_path / "a.jpg", np.rot90(colors).copy(), exif=exif, quality=100)
    got, _ = read_photo(path, save(tmp_path / "m.png", mask))
    assert got.shape == (8, 6, 3) and got[0].min() > 200 and got[4:].max() < 60
    with pytest.raises(ValueError, match=r"lies on its side"):
        read_photo(path, save(tmp_path / "m.png", np.rot90(mask).copy()))
    with pytest.raises(ValueError, match=r"mask .*m.png has 3x3$"):
        read_photo(path, save(tmp_path / "m.png", mask[:3, :3]))


def test_unreadable_photos_are_named(tmp_path: Path) -> None:
    colors = np.full((8, 6, 3), 10, np.uint8)
    with pytest.raises(FileNotFoundError, match=r"a.png: is missing"):
        read_photo(tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"a.png: has no transparency and no mask: give a mask image"):
        read_photo(save(tmp_path / "a.png", colors))
    (tmp_path / "b.heic").write_bytes(b"\0\0\0\x18ftypheic")
    with pytest.raises(ValueError, match=r"b.heic: .*the kind PNG, JPEG, WEBP, BMP. Convert it"):
        read_photo(tmp_path / "b.heic")
    content = save(tmp_path / "c.png", np.random.default_rng(0).integers(0, 256, (90, 90, 3), np.uint8)).read_bytes()
    (tmp_path / "c.png").write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"c.png: cannot be decoded as an image"):
        read_photo(tmp_path / "c.png")


def test_photos_of_more_than_8_bits_are_refused(tmp_path: Path) -> None:
    """Pillow cuts their values off at 255, which leaves all white."""
    path = save(tmp_path / "a.png", np.full((8, 6), 30_000, np.uint16))
    mask = save(tmp_path / "m.png", np.full((8, 6), 255, np.uint8))
    with pytest.raises(ValueError, match=r"a.png: has more than 8 bits a pixel and channel \(.*\); save it with 8"):
        read_photo(path, mask)
    assert read_photo(mask, save(tmp_path / "n.png", np.full((8, 6), 65_535, np.uint16)))[1].min() == 255


def test_wrong_masks_are_told_apart() -> None:
    with pytest.raises(ValueError, match="its mask is empty: no pixel is brighter than half; white must be the object"):
        check_mask(np.full((5, 5), 100, np.uint8))
    with pytest.raises(ValueError, match="its mask is all white"):
        check_mask(np.full((5, 5), 255, np.uint8))
    inverted = np.full((50, 50), 255, np.uint8)
    inverted[10:40, 10:40] = 0
    with pytest.raises(ValueError, match=r"its mask covers 100% of the border; is it black where the object is, or"):
        check_mask(inverted)
    check_mask(255 - inverted)
    with pytest.raises(ValueError, match="its mask covers 100% of the border"):
        check_mask(inverted, cropped=True)
    tight = np.full((50, 50), 255, np.uint8)
    tight[:8, :8] = 0  # a cabinet, cut out at its edges
    check_mask(tight, cropped=True)
    with pytest.raises(ValueError, match="of the border"):
        check_mask(tight)
