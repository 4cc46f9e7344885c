"""Meshes as pictures, pictures in rows and columns, and the files they go into."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from PIL import Image

import nmr
from learn3d.data.conventions import view_poses
from learn3d.data.poses import LookAtPoses, RotationPoses
from learn3d.methods.method import Grids
from learn3d.pictures import (
    BACK_LIGHT,
    HEADER,
    MARGIN,
    Surface,
    azimuths_deg,
    draw_surface,
    natural_colors,
    orbit,
    photograph,
    save_gif,
    save_png,
    studio_lights,
    tile,
    turntable,
)
from learn3d.studio.make_data.contact_sheet import draw_sheet, make_row
from learn3d.studio.tables.grids import common_zoom, magnify

WHITE = np.ones(3, np.float32)
FRONT = nmr.LookAt.from_angles(2.732, 0.0, 0.0, half_fov_deg=15.0)


@pytest.fixture(scope="module")
def egg() -> Surface:
    """A sphere stretched along x."""
    sphere, faces = nmr.icosphere(3)
    return Surface(sphere * torch.tensor([0.5, 0.2, 0.2]), faces)


@pytest.fixture
def square():
    """A square in the plane z = 0 that the camera of azimuth 0, elevation 0 sees face on."""
    vertices = 0.4 * torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return vertices, torch.tensor([[0, 1, 2], [0, 2, 3]])


def rotation(azimuth_deg: float, elevation_deg: float, *, roll_deg: float = 0.0) -> torch.Tensor:
    """Rows right, up, away of a camera that looks at the origin."""
    away = -nmr.cameras.points_from_angles(1.0, elevation_deg, azimuth_deg).float()
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), away)
    right = right / right.norm()
    up = torch.linalg.cross(away, right)
    cos, sin = math.cos(math.radians(roll_deg)), math.sin(math.radians(roll_deg))
    return torch.stack([cos * right + sin * up, cos * up - sin * right, away])


def test_alpha_equals_the_antialiased_silhouette(egg) -> None:
    cameras = view_poses(torch.arange(24)).cameras()
    _, alpha = photograph(*egg[:2], WHITE, cameras, image_size=64)
    wanted = nmr.render_silhouette(*egg[:2], cameras, image_size=64)
    np.testing.assert_array_equal(alpha, np.rint(255 * wanted.numpy()))
    assert set(np.unique(alpha)) == {0, 64, 128, 191, 255}


@pytest.mark.parametrize("winding", [(0, 1, 2), (2, 1, 0)])
@pytest.mark.parametrize("orthographic", [False, True])
def test_colour_is_lambert_on_either_side(square, winding, orthographic) -> None:
    camera = nmr.LookAt.from_angles(2.732, 0.0, [0.0, 180.0], half_fov_deg=15.0)
    if orthographic:
        both_sides = torch.diag_embed(torch.tensor([[1.0, 1.0, 1.0], [-1.0, 1.0, -1.0]]))
        camera = RotationPoses(both_sides).cameras()
    color = np.array([0.8, 0.4, 0.2], np.float32)
    lights = studio_lights((0.0, 3.0, -4.0))  # 4/5 of it along -z, towards the camera of azimuth 0
    rgb, _ = photograph(
        square[0], square[1][:, list(winding)], color, camera, image_size=32, lights=lights
    )
    for picture, share in zip(rgb, (1, BACK_LIGHT), strict=True):
        lit = np.rint(255 * color * (0.5 + 0.5 * 0.8 * share))
        np.testing.assert_array_equal(picture[16, 16], lit)
    np.testing.assert_array_equal(rgb[:, 0, 0], 255)


def test_edge_pixels_are_the_mean_of_surface_and_paper(square) -> None:
    rgb, alpha = photograph(*square, 0 * WHITE, FRONT, image_size=33, supersample=4)
    np.testing.assert_allclose(rgb[..., 0], 255.0 - alpha, atol=1.0)  # black on white
    assert ((alpha > 0) & (alpha < 255)).any()


def test_each_face_keeps_its_own_colour(square) -> None:
    colors, lights = np.float32([[1, 0, 0], [0, 0, 1]]), studio_lights(ambient=1.0)
    rgb, _ = photograph(*square, colors, FRONT, image_size=32, lights=lights)
    assert rgb[0, 20, 18].tolist() == [255, 0, 0] and rgb[0, 12, 14].tolist() == [0, 0, 255]


@pytest.mark.parametrize("kind", ["look-at", "rotation"])
def test_shaded_views_agree_with_the_renderings_at_the_poses(egg, kind) -> None:
    vertices, faces = egg.vertices + torch.tensor([0.15, 0.1, 0.05]), egg.faces
    azimuths, elevations = torch.tensor([[-75.0, -40.0, 100.0], [30.0, 30.0, -10.0]])
    poses = LookAtPoses(azimuths, elevations, 2.732, 15.0)
    # the same cameras without perspective, the last one rolled by 25 degrees
    if kind == "rotation":
        turned = [rotation(-75, 30), rotation(-40, 30), rotation(100, -10, roll_deg=25)]
        poses = RotationPoses(torch.stack(turned))
    assert azimuths_deg(poses).tolist() == pytest.approx([-75, -40, 100], abs=1e-4)
    silhouettes = nmr.render_silhouette(vertices, faces, poses.cameras(), image_size=256).numpy()
    cameras = [
        *orbit(poses[torch.tensor([0])], [0, 35, -35]),
        *orbit(poses[torch.tensor([2])], [0]),
    ]
    shaded = (draw_surface(Surface(vertices, faces), cameras, image_size=256) < 205).any(axis=3)

    def overlap(drawn: int, pose: int) -> float:
        a, b = shaded[drawn], silhouettes[pose] > 0.5
        return float((a & b).sum() / (a | b).sum())

    # the second pose is 35 degrees on
    assert min(overlap(0, 0), overlap(1, 1), overlap(3, 2)) > 0.97
    assert overlap(2, 1) < 0.8


def test_figures_need_poses() -> None:
    beyond = LookAtPoses(torch.tensor([190.0]), 30.0, 2.7, 15.0)
    assert azimuths_deg(beyond).item() == pytest.approx(-170, abs=1e-4)
    with pytest.raises(ValueError, match="needs camera poses, and these data have none"):
        azimuths_deg(None)


def test_the_light_goes_with_the_camera() -> None:
    cameras = orbit(LookAtPoses(torch.zeros(1), 30.0, 2.732, 25.0), [0, 60, 180, 300])
    pictures = draw_surface(Surface(*nmr.icosphere(4)), cameras, image_size=32).astype(int)
    brightness = [picture[10:22, 10:22].mean() for picture in pictures]
    assert max(brightness) - min(brightness) < 4
    assert pictures[0][10:16].mean() > pictures[0][16:22].mean() + 8  # and it comes from above
    assert pictures[0][:, 10:16].mean() > pictures[0][:, 16:22].mean() + 2  # and from the left


def test_shapes_are_drawn_in_their_colours() -> None:
    vertices, faces = nmr.icosphere(3)
    red = torch.tensor([1.0, 0.0, 0.0]).expand_as(vertices)
    middle = draw_surface(Surface(vertices, faces, red), [FRONT], image_size=32)[0, 16, 16]
    assert middle[0] > 120 and middle[1:].max() < 10


def test_empty_shapes_are_white() -> None:
    (empty,) = Grids(torch.zeros(1, 8, 8, 8)).surfaces()
    cameras = orbit(LookAtPoses(torch.zeros(1), 30.0, 2.732, 15.0), [0, 90])
    pictures = draw_surface(empty, cameras, image_size=8)
    assert pictures.shape == (2, 8, 8, 3) and (pictures == 255).all()
    assert common_zoom([(empty, cameras)], torch.zeros(1, 8, 8)) == 0.95 / 0.05


def test_common_zoom_fills_the_picture_with_the_largest_shape_or_mask(egg) -> None:
    pose, turns = LookAtPoses(torch.zeros(1), 0.0, 2.732, 15.0), [0, 90]
    small = Surface(egg.vertices * 0.3, egg.faces)
    cameras, no_masks = orbit(pose, turns), torch.zeros(1, 64, 64)
    zoom = common_zoom([(egg, cameras), (small, cameras)], no_masks)
    picture = draw_surface(egg, orbit(pose, turns, zoom=zoom), image_size=100)[0]
    columns = np.flatnonzero((picture < 250).any(axis=(0, 2)))
    # 5 % of the half side are left free
    assert 1 <= columns[0] <= 4 and columns[-1] == 99 - columns[0]
    masks = no_masks.clone()
    masks[0, 16:48, 20:56] = 1.0  # reaches 24 / 32 of the half side
    assert common_zoom([(small, cameras)], masks) == pytest.approx(0.95 / (23.5 / 32), rel=1e-6)
    assert common_zoom([(small, cameras)], torch.ones(1, 64, 64)) == 1.0


def test_turntable_turns_and_fills_its_pictures(egg) -> None:
    frames = turntable(egg, frames=4, image_size=48)
    widths = [(frame < 250).any(axis=(0, 2)).sum() for frame in frames]
    assert frames.shape == (4, 48, 48, 3) and 42 <= widths[0] <= 48
    assert widths[0] > 1.5 * widths[1] and abs(widths[0] - widths[2]) <= 1
    assert not (frames[:, :, 0] < 250).any()  # nothing is cut off


def test_natural_colors_undo_the_inversion() -> None:
    stored = np.zeros((2, 4, 3, 5), np.uint8)  # background: black, no alpha
    stored[1, 0, 2, 4] = 255  # red stored at full strength is cyan
    colors = natural_colors(stored)
    assert (colors[0] == 255).all() and colors[1, 2, 4].tolist() == [0, 255, 255]
    assert natural_colors(stored, inverted=False)[1, 2, 4].tolist() == [255, 0, 0]


def test_magnify_keeps_the_middle() -> None:
    pictures = np.zeros((1, 40, 40, 3), np.uint8)
    pictures[:, 10:30, 10:30] = 255
    assert np.array_equal(magnify(pictures, 2.0), np.full((1, 20, 20, 3), 255))
    assert np.array_equal(magnify(pictures, 1.0), pictures)


def test_a_sheet_has_titles_free_places_and_rules() -> None:
    black = np.zeros((8, 8, 3), np.uint8)
    plain = tile([[black, None], [black, black]], tile_size=20)
    step = 20 + MARGIN
    assert plain[MARGIN + 5, MARGIN + 5].tolist() == [0, 0, 0]
    assert (plain[: step - 1, step + MARGIN :] == 255).all()  # the free place
    titles = {"row_titles": ["one", "two"], "rules": [1]}
    titled = tile([[black, None], [black, black]], ["a", "b"], tile_size=20, **titles)
    left = titled.shape[1] - plain.shape[1]
    assert (titled[:HEADER] < 128).any() and (titled[HEADER:, :left] < 128).any()
    assert len(np.unique(titled[HEADER + step + MARGIN // 2], axis=0)) == 1, "the rule"


def test_png_and_gif_can_be_read_back(tmp_path, egg) -> None:
    frames = turntable(egg, frames=3, image_size=32)
    save_png(tmp_path / "a.png", frames[0])
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), frames[0])
    save_gif(tmp_path / "a.gif", frames, frames_per_second=10)
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.size) == (3, (32, 32))
        assert (image.info["duration"], image.info["loop"]) == (100, 0)
        assert np.abs(np.asarray(image.convert("RGB")).astype(int) - frames[0]).max() <= 16


def test_contact_sheets_name_the_first_row_of_each_split() -> None:
    rgb, alpha = np.full((24, 64, 64, 3), 255, np.uint8), np.zeros((24, 64, 64), np.uint8)
    row = make_row(rgb, alpha, np.ones((32, 32, 32), bool))
    sheet = draw_sheet({"train": [row] * 2, "val": [], "test": [row]}, 24)
    left = sheet.shape[1] - len(row) * (64 + MARGIN) - MARGIN
    named = [(part[:, :left] < 100).any() for part in np.split(sheet[HEADER + MARGIN :], 3)]
    assert named == [True, False, True] and (sheet[:HEADER, left:] < 100).any()
    voxels = sheet[HEADER + MARGIN :, -36]
    assert (voxels[:64] == 0).all() and (voxels[64 : 64 + MARGIN] > 0).all(), "rows do not touch"
