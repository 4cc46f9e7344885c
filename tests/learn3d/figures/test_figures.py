"""Picture grids, turntables and the files they go into."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import nmr
from learn3d.data.poses import LookAtPoses, RotationPoses
from learn3d.figures.grids import picture_grid
from learn3d.methods import DatasetInfo, Grids, Meshes, Method, create_method
from learn3d.pictures.sheets import (
    HEADER,
    MARGIN,
    TILE,
    magnify,
    natural_colors,
    save_gif,
    save_png,
    stack,
    tile,
    to_uint8,
    with_suffix,
)
from learn3d.pictures.surfaces import Surface, azimuths_deg, common_zoom, draw_surface, orbit, turntable
from learn3d.presets import PRESETS


def create_vanilla() -> Method:
    settings = PRESETS["peng2020-kato-vanilla"].settings
    return create_method(settings, DatasetInfo(24), device="cpu", precision="fp32", seed=0)


@pytest.fixture(scope="module")
def egg() -> tuple[torch.Tensor, torch.Tensor]:
    """A sphere stretched along x."""
    sphere, faces = nmr.icosphere(3)
    return sphere * torch.tensor([0.5, 0.2, 0.2]), faces


def test_natural_colors_undo_the_inversion() -> None:
    stored = np.zeros((2, 4, 3, 5), np.uint8)  # background: black, no alpha
    stored[1, 0, 2, 4] = 255  # red stored at full strength is cyan
    colors = natural_colors(stored)
    assert colors.shape == (2, 3, 5, 3)
    assert (colors[0] == 255).all()
    assert colors[1, 2, 4].tolist() == [0, 255, 255]
    assert natural_colors(stored, inverted=False)[1, 2, 4].tolist() == [255, 0, 0]


def test_picture_grid_shows_inputs_targets_and_renderings(tiny_set) -> None:
    method = create_vanilla()
    grid = picture_grid(method, tiny_set, torch.tensor([3, 30]))
    step = TILE + MARGIN
    assert grid.shape == (HEADER + 2 * step + MARGIN, 9 * step + MARGIN, 3)
    assert grid.dtype == np.uint8

    def cell(row: int, column: int) -> np.ndarray:
        y, x = HEADER + MARGIN + row * step, MARGIN + column * step
        return grid[y : y + TILE, x : x + TILE]

    def resized(picture: np.ndarray) -> np.ndarray:
        return np.asarray(Image.fromarray(picture).resize((TILE,) * 2, Image.Resampling.BICUBIC))

    unknown = picture_grid(method, dataclasses.replace(tiny_set, poses=None), torch.tensor([3, 30]))
    assert unknown.shape == grid.shape, "drawn from view 0"
    batch = tiny_set.batch(torch.tensor([3, 30]))
    assert np.array_equal(cell(1, 0), resized(natural_colors(batch.images[1].numpy())))
    assert np.array_equal(cell(1, 1), resized(to_uint8(batch.masks[1])))
    rendered = cell(0, 2)[..., 0] > 127
    assert 0.3 < rendered.mean() < 0.45  # the untrained sphere covers a disk of radius 0.34 of the side
    for column in range(3, 9):
        assert ((cell(0, column) < 250).any(axis=2) == rendered).mean() > 0.95


@pytest.mark.parametrize("kind", ["look-at", "rotation"])
def test_shaded_views_agree_with_the_renderings_at_the_poses(egg, kind) -> None:
    vertices, faces = egg[0] + torch.tensor([0.15, 0.1, 0.05]), egg[1]
    poses = LookAtPoses(torch.tensor([-75.0, -40.0, 100.0]), torch.tensor([30.0, 30.0, -10.0]), 2.732, 15.0)
    if kind == "rotation":  # the same cameras without perspective, the last one rolled by 25 degrees
        poses = RotationPoses(torch.stack([rotation(-75, 30), rotation(-40, 30), rotation(100, -10, roll_deg=25)]))
    silhouettes = nmr.render_silhouette(vertices[None].expand(3, -1, -1), faces, poses.cameras(), image_size=256) > 0.5
    first = orbit(poses[torch.tensor([0])], [0, 35, -35])  # the second pose is 35 degrees on
    last = orbit(poses[torch.tensor([2])], [0])
    surface = Surface(vertices, faces)
    shaded = [(draw_surface(surface, c, image_size=256) < 205).any(axis=3) for c in (first, last)]

    def overlap(a: np.ndarray, b: torch.Tensor) -> float:
        return float((a & b.numpy()).sum() / (a | b.numpy()).sum())

    assert overlap(shaded[0][0], silhouettes[0]) > 0.97
    assert overlap(shaded[0][1], silhouettes[1]) > 0.97
    assert overlap(shaded[0][2], silhouettes[1]) < 0.8
    assert overlap(shaded[1][0], silhouettes[2]) > 0.97


def rotation(azimuth_deg: float, elevation_deg: float, *, roll_deg: float = 0.0) -> torch.Tensor:
    """Rows right, up, away of a camera that looks at the origin."""
    away = -nmr.cameras.points_from_angles(1.0, elevation_deg, azimuth_deg).float()
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), away)
    right = right / right.norm()
    up = torch.linalg.cross(away, right)
    cos, sin = math.cos(math.radians(roll_deg)), math.sin(math.radians(roll_deg))
    return torch.stack([cos * right + sin * up, cos * up - sin * right, away])


def test_azimuths_are_read_from_poses_of_either_kind() -> None:
    look_at = LookAtPoses(torch.tensor([-75.0, 190.0]), 30.0, 2.732, 15.0)
    rotations = RotationPoses(torch.stack([rotation(-75, 30), rotation(190, -20, roll_deg=40)]))
    for poses in (look_at, rotations):
        assert azimuths_deg(poses).tolist() == pytest.approx([-75, -170], abs=1e-4)


def test_an_orbit_needs_one_pose() -> None:
    with pytest.raises(ValueError, match="one camera, got 2 poses"):
        orbit(LookAtPoses(torch.zeros(2), 30.0, 2.732, 15.0), [0])


def test_the_light_goes_with_the_camera() -> None:
    sphere = Surface(*nmr.icosphere(4))
    cameras = orbit(LookAtPoses(torch.zeros(1), 30.0, 2.732, 25.0), [0, 60, 180, 300])
    pictures = draw_surface(sphere, cameras, image_size=32).astype(int)
    brightness = [picture[10:22, 10:22].mean() for picture in pictures]
    assert max(brightness) - min(brightness) < 4
    assert pictures[0][10:16].mean() > pictures[0][16:22].mean() + 8  # and it comes from above


def test_shapes_are_drawn_in_their_colours() -> None:
    vertices, faces = nmr.icosphere(3)
    red = torch.tensor([1.0, 0.0, 0.0]).expand_as(vertices)
    cameras = orbit(LookAtPoses(torch.zeros(1), 30.0, 2.732, 25.0), [0])
    (surface,) = Meshes(vertices[None], faces, red[None]).surfaces()
    middle = draw_surface(surface, cameras, image_size=32)[0, 16, 16]
    assert middle[0] > 120 and middle[1:].max() < 10


def test_grids_are_drawn_where_their_cells_are() -> None:
    occupancy = torch.zeros(2, 16, 16, 16)
    occupancy[0, 2:6, 8:14, 15:] = 1.0  # touches the far end of z
    full, empty = Grids(occupancy).surfaces()
    low, high = full.vertices.amin(dim=0), full.vertices.amax(dim=0)
    half = 0.5 / 16  # the surface runs half way between the centres of neighbouring cells: through their border
    assert low.tolist() == pytest.approx([2 / 16 - 0.5, 8 / 16 - 0.5, 15 / 16 - 0.5], abs=half / 8)
    assert high.tolist() == pytest.approx([6 / 16 - 0.5, 14 / 16 - 0.5, 0.5], abs=half / 8)
    assert len(empty.faces) == 0
    cameras = orbit(LookAtPoses(torch.zeros(1), 30.0, 2.732, 15.0), [0, 90])
    pictures = draw_surface(empty, cameras, image_size=8)
    assert pictures.shape == (2, 8, 8, 3)
    assert (pictures == 255).all()
    assert (draw_surface(full, cameras, image_size=32) < 250).any()


def test_common_zoom_fills_the_picture_with_the_largest_shape_or_mask(egg) -> None:
    pose, turns = LookAtPoses(torch.zeros(1), 0.0, 2.732, 15.0), [0, 90]
    surface, small = Surface(*egg), Surface(egg[0] * 0.3, egg[1])
    cameras, no_masks = orbit(pose, turns), torch.zeros(1, 64, 64)
    zoom = common_zoom([(surface, cameras), (small, cameras)], no_masks)
    picture = draw_surface(surface, orbit(pose, turns, zoom=zoom), image_size=100)[0]
    columns = np.flatnonzero((picture < 250).any(axis=(0, 2)))
    assert 1 <= columns[0] <= 4  # 5 % of the half side are left free
    assert columns[-1] == 99 - columns[0]
    masks = no_masks.clone()
    masks[0, 16:48, 20:56] = 1.0  # reaches 24 / 32 of the half side
    assert common_zoom([(small, cameras)], masks) == pytest.approx(0.95 / (23.5 / 32), rel=1e-6)
    assert common_zoom([(small, cameras)], torch.ones(1, 64, 64)) == 1.0


def test_magnified_keeps_the_middle() -> None:
    pictures = np.zeros((1, 40, 40, 3), np.uint8)
    pictures[:, 10:30, 10:30] = 255
    assert magnify(pictures, 2.0).shape == (1, 20, 20, 3)
    assert (magnify(pictures, 2.0) == 255).all()
    assert np.array_equal(magnify(pictures, 1.0), pictures)


def test_a_sheet_has_titles_free_places_and_rules() -> None:
    black = np.zeros((8, 8, 3), np.uint8)
    plain = tile([[black, None], [black, black]], tile_size=20)
    step = 20 + MARGIN
    assert plain.shape == (2 * step + MARGIN, 2 * step + MARGIN, 3)
    assert plain[MARGIN + 5, MARGIN + 5].tolist() == [0, 0, 0]
    assert (plain[: step - 1, step + MARGIN :] == 255).all()  # the free place
    titled = tile([[black, None], [black, black]], ["a", "b"], tile_size=20, row_titles=["one", "two"], rules=[1])
    left = titled.shape[1] - plain.shape[1]
    assert left > 10 and titled.shape[0] == plain.shape[0] + HEADER
    assert (titled[:HEADER] < 128).any() and (titled[HEADER:, :left] < 128).any()
    rule = titled[HEADER + step + MARGIN // 2]
    assert len(np.unique(rule, axis=0)) == 1 and rule[0, 0] not in (0, 255)


def test_pictures_are_put_below_each_other() -> None:
    low, high = np.zeros((10, 30, 3), np.uint8), np.zeros((20, 40, 3), np.uint8)
    both = stack([low, high], gap=4)
    assert both.shape == (34, 40, 3) and (both[10:14] == 255).all() and (both[14:] == 0).all()


def test_endings_are_replaced_only_where_they_are_those_of_pictures() -> None:
    assert with_suffix(Path("a/b.png"), ".svg") == Path("a/b.svg")
    assert with_suffix(Path("a/lambda-0.5"), ".svg") == Path("a/lambda-0.5.svg")


def test_turntable_turns(egg) -> None:
    frames = turntable(Surface(*egg), frames=4, image_size=48)
    assert frames.shape == (4, 48, 48, 3)
    widths = [(frame < 250).any(axis=(0, 2)).sum() for frame in frames]
    assert widths[0] > 1.5 * widths[1]
    assert abs(widths[0] - widths[2]) <= 1
    assert (frames[:, 0, 0] == 255).all()
    assert 42 <= widths[0] <= 48  # fills the picture, and
    assert not (frames[:, :, 0] < 250).any()  # is not cut off


def test_png_and_gif_can_be_read_back(tmp_path, egg) -> None:
    frames = turntable(Surface(*egg), frames=3, image_size=32)
    save_png(tmp_path / "a.png", frames[0])
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), frames[0])
    save_gif(tmp_path / "a.gif", frames, frames_per_second=10)
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.size, image.info["duration"], image.info["loop"]) == (3, (32, 32), 100, 0)
        first = np.asarray(image.convert("RGB")).astype(int)
    assert np.abs(first - frames[0]).max() <= 16
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gif", "a.png"]
