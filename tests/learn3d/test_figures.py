"""Picture grids, turntables and the files they go into."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

import nmr
from learn3d import figures
from learn3d.methods import DataShape, Method, create_method
from learn3d.presets import PRESETS


def create_vanilla() -> Method:
    settings = PRESETS["peng2020-kato-vanilla"].settings
    return create_method(settings, DataShape(24), device="cpu", precision="fp32", seed=0)


@pytest.fixture(scope="module")
def egg() -> tuple[torch.Tensor, torch.Tensor]:
    """A sphere stretched along x."""
    sphere, faces = nmr.icosphere(3)
    return sphere * torch.tensor([0.5, 0.2, 0.2]), faces


def test_natural_colors_undo_the_inversion() -> None:
    stored = np.zeros((2, 4, 3, 5), np.uint8)  # background: black, no alpha
    stored[1, 0, 2, 4] = 255  # red stored at full strength is cyan
    colors = figures.natural_colors(stored)
    assert colors.shape == (2, 3, 5, 3)
    assert (colors[0] == 255).all()
    assert colors[1, 2, 4].tolist() == [0, 255, 255]


def test_picture_grid_shows_inputs_targets_and_renderings(tiny_set) -> None:
    method = create_vanilla()
    grid = figures.picture_grid(method, tiny_set, torch.tensor([3, 30]))
    step = figures.TILE + figures.MARGIN
    assert grid.shape == (figures.HEADER + 2 * step + figures.MARGIN, 9 * step + figures.MARGIN, 3)
    assert grid.dtype == np.uint8

    def cell(row: int, column: int) -> np.ndarray:
        y, x = figures.HEADER + figures.MARGIN + row * step, figures.MARGIN + column * step
        return grid[y : y + figures.TILE, x : x + figures.TILE]

    def resized(picture: np.ndarray) -> np.ndarray:
        return np.asarray(Image.fromarray(picture).resize((figures.TILE,) * 2, Image.Resampling.BICUBIC))

    batch = tiny_set.batch(torch.tensor([3, 30]))
    assert np.array_equal(cell(1, 0), resized(figures.natural_colors(batch.images[1].numpy())))
    assert np.array_equal(cell(1, 1), resized(figures.to_uint8(batch.masks[1])))
    rendered = cell(0, 2)[..., 0] > 127
    assert 0.3 < rendered.mean() < 0.45  # the untrained sphere covers a disk of radius 0.34 of the side
    for column in range(3, 9):
        assert ((cell(0, column) < 250).any(axis=2) == rendered).mean() > 0.95


def test_shaded_view_agrees_with_the_rendering_at_the_input_view(tiny_set, egg) -> None:
    vertices, faces = egg[0] + torch.tensor([0.15, 0.1, 0.05]), egg[1]
    camera = tiny_set.poses[torch.tensor([5])].cameras()
    silhouette = nmr.render_silhouette(vertices[None], faces, camera, image_size=64)[0] > 0.5
    azimuth = figures.view_angles(tiny_set.poses[torch.tensor([5])])[0]
    assert azimuth == pytest.approx(-75, abs=1e-3)
    shaded = figures.draw_mesh(vertices, faces, [azimuth, -azimuth], elevation_deg=30, image_size=64)
    agreement = [((picture < 220).any(axis=2) == silhouette.numpy()).mean() for picture in shaded]
    assert agreement[0] > 0.99 > 0.95 > agreement[1]


def test_turntable_turns(egg) -> None:
    frames = figures.turntable(*egg, frames=4, image_size=48)
    assert frames.shape == (4, 48, 48, 3)
    widths = [(frame < 250).any(axis=(0, 2)).sum() for frame in frames]
    assert widths[0] > 1.5 * widths[1]
    assert abs(widths[0] - widths[2]) <= 1
    assert (frames[:, 0, 0] == 255).all()
    assert 42 <= widths[0] <= 48  # fills the picture, and
    assert not (frames[:, :, 0] < 250).any()  # is not cut off


def test_png_and_gif_can_be_read_back(tmp_path, egg) -> None:
    frames = figures.turntable(*egg, frames=3, image_size=32)
    figures.save_png(tmp_path / "a.png", frames[0])
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), frames[0])
    figures.save_gif(tmp_path / "a.gif", frames, frames_per_second=10)
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.size, image.info["duration"], image.info["loop"]) == (3, (32, 32), 100, 0)
        first = np.asarray(image.convert("RGB")).astype(int)
    assert np.abs(first - frames[0]).max() <= 16
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gif", "a.png"]
