"""Inflated outlines of unknown objects."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from learn3d.pictures import draw_around
from learn3d.studio.picture_to_mesh.fit import Target, frame_target
from learn3d.studio.picture_to_mesh.inflation import inflate
from learn3d.studio.picture_to_mesh.make import load_model, reconstruct_picture
from learn3d.studio.picture_to_mesh.options import DEFAULTS
from learn3d.studio.picture_to_mesh.read import fill_drawing, keep_parts
from learn3d.studio.picture_to_mesh.reconstruction import reconstruct_files

SIZE = 200
Y, X = np.indices((SIZE, SIZE)) - (SIZE - 1) / 2
MASKS = {
    "disc": np.hypot(X, Y) < 60,
    "mug": ((np.abs(X + 15) < 45) & (np.abs(Y) < 55)) | (np.abs(np.hypot(X - 35, Y) - 28) < 7),
    "two": np.hypot(np.abs(X) - 45, Y) < 30,
    "line": (np.abs(Y) < 1) & (np.abs(X) < 80),
    "full": np.hypot(X, Y) < 400,
    "dots": (X.astype(int) % 6 < 3) & (Y.astype(int) % 6 < 3) & (np.hypot(X, Y) < 80),
}


def framed(mask: np.ndarray) -> Target:
    colors = np.stack([128 + X, 128 + Y, 0 * X + 90], -1).astype(np.uint8)
    return frame_target(colors, 255 * mask.astype(np.uint8))


@pytest.mark.parametrize("name", MASKS)
def test_the_shape_is_closed_symmetric_and_has_the_outline(name) -> None:
    picture = framed(MASKS[name])
    surface, view = inflate(picture)
    mesh = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)
    assert mesh.is_watertight and mesh.volume > 0, "closed, normals outwards"
    mirrored = surface.vertices * torch.tensor([1, 1, -1])
    assert torch.cdist(mirrored, surface.vertices).min(1).values.max() < 1 / DEFAULTS.smooth.grid
    wanted = {"line": 0.2, "dots": 0.2}.get(name, 0.9)
    assert float(view.ious(surface.vertices, surface.faces, picture.outline())) > wanted


def test_a_disc_becomes_an_ellipsoid_with_the_picture_on_both_sides() -> None:
    picture = framed(MASKS["disc"])
    surface, _ = inflate(picture)
    low, high = surface.vertices.amin(0), surface.vertices.amax(0)
    wide, _, deep = (high - low).tolist()
    assert deep / wide == pytest.approx(DEFAULTS.smooth.depth, rel=0.05)
    front, back = (image.astype(int) for image in draw_around(surface, [0, 180], image_size=64))
    assert front[32, 44, 0] > front[32, 20, 0] + 20, "red grows to the right"
    assert back[32, 44, 0] < back[32, 20, 0] - 20, "and to the left from behind"
    assert 0.1 < surface.colors.min() and surface.colors[:, 2].max() < 0.4, "no white background"


def test_thin_parts_are_whole_and_move_nothing() -> None:
    car = (np.abs(X) < 70) & (Y > 20) & (Y < 60)
    alone, _ = inflate(framed(car))
    surface, view = inflate(framed(car | ((np.abs(X - 40) < 2) & (Y < 30) & (Y > -60))))
    mesh = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)
    assert mesh.body_count == 1 and float(surface.vertices[:, 1].max()) > 0.3, "an antenna"
    wide, high = (np.ptp(each.vertices[:, :2].numpy(), axis=0) for each in (alone, surface))
    assert high[0] == pytest.approx(wide[0], rel=0.05)
    place = view.cameras().transform(surface.vertices)[0, :, :2]
    seen = 2 * surface.vertices[:, :2]
    flat = surface.vertices[:, 2].abs() < 0.01
    torch.testing.assert_close(place[flat], seen[flat], atol=0.01, rtol=0.01)


def test_drawings_of_black_lines_are_filled() -> None:
    ring = np.abs(np.hypot(X, Y) - 60) < 2
    gap = ring & ~((np.abs(Y) < 1) & (X > 0))
    ink = np.zeros((SIZE, SIZE, 3), np.uint8)
    for lines in (ring, gap):
        mask = 255 * lines.astype(np.uint8)
        colors, filled = fill_drawing(ink, mask)
        assert (filled > 0).sum() == pytest.approx(np.pi * 62**2, rel=0.02)
        assert colors[100, 100].tolist() == [255, 255, 255] and colors[lines].max() == 0
        assert fill_drawing(ink + 90, mask)[1] is mask, "a ring that is not of ink"
    half = 255 * (ring & (X < 0)).astype(np.uint8)
    filled = fill_drawing(ink, half)[1]
    assert (filled > 0).sum() == pytest.approx((half > 0).sum(), rel=0.02), "an open line"


def test_gaps_of_a_silhouette_become_white_lines_and_holes_stay() -> None:
    distance = np.hypot(X, Y)
    whole = (distance < 60) & (distance > 20)
    mask = 255 * (whole & (np.abs(Y) > 3)).astype(np.uint8)
    colors, filled = fill_drawing(np.zeros((SIZE, SIZE, 3), np.uint8), mask)
    assert np.mean((filled > 0) == whole) > 0.99
    assert (colors[whole & (np.abs(Y) < 3)] == 255).all()


def test_a_lamp_of_black_parts_keeps_its_shade() -> None:
    mask = 255 * ((np.abs(X) < 30) & ((Y < -10) & (Y > -50) | (Y > 0) & (Y < 60))).astype(np.uint8)
    ink = np.zeros((SIZE, SIZE, 3), np.uint8)
    assert keep_parts(ink, mask) == (mask, None)
    assert keep_parts(ink + 90, mask)[1].startswith("several objects"), "not a drawing"


def test_a_smooth_shape_is_made_if_it_is_asked_for() -> None:
    mask = 255 * MASKS["mug"].astype(np.uint8)
    picture = np.full((SIZE, SIZE, 3), 180, np.uint8), mask
    made = reconstruct_picture(load_model(None), *picture, smooth=True)
    assert made.kind is made.warning is None and made.silhouette_iou > 0.9
    assert made.azimuth_deg == 0 and made.view is not None


def test_an_empty_shape_of_a_file_is_said(tmp_path, capsys) -> None:
    pixels = np.zeros((512, 512, 4), np.uint8)
    pixels[20:490, 250] = 255  # a line of one pixel
    Image.fromarray(pixels).save(tmp_path / "line.png")
    list(reconstruct_files(None, tmp_path / "meshes", [tmp_path / "line.png"], smooth=True))
    assert "line: the shape is empty" in capsys.readouterr().err
