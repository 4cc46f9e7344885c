"""Masks of photographs that have none."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from learn3d.studio.picture_to_mesh.cutting import cut_out, find_mask, is_plain


@pytest.fixture
def scene() -> tuple[np.ndarray, np.ndarray]:
    """A red disc with a blue bar before a background of green noise that grows lighter to the right, and its mask."""
    rng = np.random.default_rng(0)
    rows, columns = np.ogrid[:300, :400]
    colors = np.zeros((300, 400, 3))
    colors[..., 1] = 60 + columns / 4 + rng.normal(0, 25, (300, 400))
    colors[..., 0] = rng.normal(40, 20, (300, 400))
    inside = np.hypot(rows - 160, columns - 190) < 90
    colors[inside] = (200, 40, 50)
    bar = inside & (np.abs(rows - 160) < 20)
    colors[bar] = (40, 40, 190)
    colors[inside] += rng.normal(0, 12, (inside.sum(), 3))
    return colors.clip(0, 255).astype(np.uint8), inside


def overlap(mask: np.ndarray, inside: np.ndarray) -> float:
    return ((mask > 0) & inside).sum() / ((mask > 0) | inside).sum()


@pytest.mark.parametrize("box", [None, (80, 50, 220, 220)])
def test_an_object_is_cut_out_of_a_busy_background(scene, box) -> None:
    pytest.importorskip("cv2", reason="needs the extra photos")
    colors, inside = scene
    assert not is_plain(colors)
    mask = cut_out(colors, box)
    assert mask.dtype == np.uint8 and set(np.unique(mask)) == {0, 255}
    assert overlap(mask, inside) > 0.93
    assert box is None or not mask[:, :76].any(), "what is outside of the box is background"
    assert np.array_equal(mask, cut_out(colors, box)), "the same mask every time"


@pytest.mark.parametrize("box", [(-1, 0, 50, 50), (0, 0, 401, 300), (10, 10, 0, 5), (0, 0, 400, 300)])
def test_a_box_must_leave_some_background(scene, box) -> None:
    pytest.importorskip("cv2", reason="needs the extra photos")
    with pytest.raises(ValueError, match=r"box .*(must lie within the 400x300 pixels|covers the whole picture)"):
        cut_out(scene[0], box)


def test_plain_backgrounds_need_no_opencv(scene, monkeypatch) -> None:
    colors, inside = scene
    plain = np.where(inside[..., None], colors, np.uint8(230))
    assert is_plain(plain)
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert overlap(find_mask(plain), inside) > 0.99
    with pytest.raises(ValueError, match=r"nmr-learn3d\[photos\]"):
        find_mask(colors)


def test_reconstruct_takes_a_box(scene, finished_run, tmp_path: Path, command) -> None:
    pytest.importorskip("cv2", reason="needs the extra photos")
    Image.fromarray(scene[0]).save(tmp_path / "disc.png")
    words = ("reconstruct", tmp_path / "disc.png", "--run", finished_run, "--output", tmp_path / "out")
    status, _, said = command(*words)
    assert status == 0 and "by GrabCut in the middle; if the outline in the strip of views is wrong, give --box" in said
    status, _, said = command(*words, "--box", 80, 50, 220, 220)
    assert status == 0, said
    with Image.open(tmp_path / "out" / "disc.png") as strip:
        shown = np.asarray(strip.convert("L"))[40:, 200:390]  # the mask
    assert 0.15 < (shown > 127).mean() < 0.7
    cut = (tmp_path / "out" / "disc.png").read_bytes()
    Image.fromarray(
        np.dstack([scene[0], np.where(np.arange(400) < 390, 255, 0) + np.zeros((300, 1))]).astype(np.uint8)
    ).save(tmp_path / "disc.png")
    status, _, said = command(*words, "--box", 80, 50, 220, 220)
    assert status == 0 and (tmp_path / "out" / "disc.png").read_bytes() == cut, "the box goes before transparency"
    status, _, said = command(*words, "--box", 80, 50, 220, 220, "--masks", tmp_path / "disc.png")
    assert status == 1 and "--box is for one photograph" in said
