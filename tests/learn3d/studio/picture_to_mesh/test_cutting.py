"""Masks of photographs that have none."""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from learn3d.studio.picture_to_mesh import cutting
from learn3d.studio.picture_to_mesh.cutting import cut_out, find_doubt, find_outline, is_plain

needs_opencv = pytest.mark.skipif(find_spec("cv2") is None, reason="needs the extra photos")


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


@needs_opencv
@pytest.mark.parametrize("box", [None, (80, 50, 220, 220)])
def test_an_object_is_cut_out_of_a_busy_background(scene, box) -> None:
    colors, inside = scene
    assert not is_plain(colors)
    mask, sureness = cut_out(colors, box)
    assert mask.dtype == np.uint8 and set(np.unique(mask)) == {0, 255}
    assert overlap(mask, inside) > 0.93 and 0.8 < sureness <= 1
    assert box is None or not mask[:, :80].any(), "what is outside of the box is background"
    again, _ = cut_out(colors, box)
    assert np.array_equal(mask, again), "the same mask every time"


@pytest.mark.parametrize(
    "box", [(-1, 0, 50, 50), (0, 0, 401, 300), (10, 10, 0, 5), (0, 0, 400, 300)]
)
def test_a_box_must_leave_some_background(scene, box) -> None:
    with pytest.raises(
        ValueError, match=r"box .*(must lie within the 400x300 pixels|covers the whole picture)"
    ):
        find_outline(scene[0], box)


@needs_opencv
@pytest.mark.parametrize("change", ["odd", "small", "grey", "large"])
def test_pictures_of_all_sizes_are_cut_out(room, change) -> None:
    colors, inside = room
    if change == "grey":
        colors = np.repeat(colors.mean(axis=2, keepdims=True).astype(np.uint8), 3, axis=2)
    sizes = {"odd": (397, 301), "small": (120, 90), "large": (1600, 1200)}
    size = sizes.get(change, inside.shape[::-1])
    colors = np.asarray(Image.fromarray(colors).resize(size))
    inside = np.asarray(Image.fromarray(inside).resize(size))
    mask, _ = cut_out(colors)
    assert mask.shape == inside.shape and overlap(mask, inside) > 0.75


@needs_opencv
@pytest.mark.parametrize("shape", [(2, 2), (3, 40), (40, 3), (9, 7)])
def test_tiny_pictures_have_a_mask_of_their_size(shape) -> None:
    colors = np.random.default_rng(0).integers(0, 256, (*shape, 3)).astype(np.uint8)
    mask, sureness = cut_out(colors)
    assert mask.shape == shape and 0 <= sureness <= 1
    assert cut_out(colors, (0, 0, 2, 2) if shape != (2, 2) else None)[0].shape == shape


def test_a_picture_on_a_plain_wall_is_left_out() -> None:
    y, x = np.mgrid[:300, :400]
    disc = np.hypot(x - 230, y - 180) < 50
    colors = np.full((300, 400, 3), 230, np.uint8)
    colors[30:120, 40:170] = (60, 110, 70)
    colors[disc] = (140, 40, 45)
    found = find_outline(colors)
    assert is_plain(colors) and overlap(found.mask, disc) > 0.98
    assert "picture on the wall" in found.how
    colors[disc] = 230
    alone = find_outline(colors).mask > 127
    assert alone[30:120, 40:170].all() and alone.sum() == 90 * 130, "a rectangle may be the object"


def test_plain_backgrounds_need_no_opencv(scene, monkeypatch) -> None:
    colors, inside = scene
    plain = np.where(inside[..., None], colors, np.uint8(230))
    assert is_plain(plain)
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert overlap(find_outline(plain).mask, inside) > 0.99
    with pytest.raises(ValueError, match=r"nmr-learn3d\[photos\]"):
        find_outline(colors)


@needs_opencv
def test_reconstruct_takes_a_box(
    scene, finished_run, tmp_path: Path, command, short_turntables
) -> None:
    Image.fromarray(scene[0]).save(tmp_path / "disc.png")
    words = (
        "reconstruct",
        tmp_path / "disc.png",
        "--run",
        finished_run,
        "--output",
        tmp_path / "out",
    )
    status, _, said = command(*words)
    how = "by a network and GrabCut"
    assert (
        status == 0 and f"{how}; if the outline in the strip of views is wrong, give --box" in said
    )
    status, _, said = command(*words, "--box", 80, 50, 220, 220)
    assert status == 0, said
    with Image.open(tmp_path / "out" / "disc.png") as strip:
        shown = np.asarray(strip.convert("L"))[40:, 200:390]  # the mask
    assert 0.15 < (shown > 127).mean() < 0.7
    cut = (tmp_path / "out" / "disc.png").read_bytes()
    Image.fromarray(
        np.dstack([scene[0], np.where(np.arange(400) < 390, 255, 0) + np.zeros((300, 1))]).astype(
            np.uint8
        )
    ).save(tmp_path / "disc.png")
    status, _, said = command(*words, "--box", 80, 50, 220, 220)
    assert status == 0 and (tmp_path / "out" / "disc.png").read_bytes() == cut, (
        "the box goes before transparency"
    )
    status, _, said = command(*words, "--box", 80, 50, 220, 220, "--masks", tmp_path / "disc.png")
    assert status == 1 and "--box is for one photograph" in said
    noise = np.random.default_rng(0).integers(0, 256, (120, 120, 3)).astype(np.uint8)
    Image.fromarray(noise).save(tmp_path / "disc.png")
    status, _, said = command(*words)
    assert status == 1 and "no object was found" in said and "Give --box or --masks" in said
    noise[50:70] = (200, 30, 30)
    Image.fromarray(noise).save(tmp_path / "disc.png")
    status, _, said = command(*words)
    assert status == 0 and "warning: disc: its outline touches the border" in said
    status, _, said = command(*words, "--box", 10, 45, 100, 30)
    assert status == 0, said


@pytest.fixture
def room() -> tuple[np.ndarray, np.ndarray]:
    """A table with open legs before a wall with a picture and a floor, its soft shadow on both, and its mask."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:300, :400].astype(float)
    colors = np.where(y[..., None] < 170, (214.0, 208, 190), (150.0, 122, 96))
    colors[164:170] = (235, 235, 230)
    colors[20:70, 30:100] = (70, 90, 60)
    inside = (np.abs(x - 210) < 90) & (np.abs(y - 150) < 9)
    inside |= (np.abs(np.abs(x - 210) - 80) < 7) & (y > 150) & (y < 262)
    colors *= 1 - 0.45 * np.exp(-((((x - 235) / 90) ** 2 + ((y - 258) / 16) ** 2) ** 2))[..., None]
    colors[inside] = (140, 40, 45)
    return (colors + rng.normal(0, 2, colors.shape)).clip(0, 255).astype(np.uint8), inside


@needs_opencv
@pytest.mark.parametrize("box", [None, (114, 136, 192, 130)])
def test_wall_floor_and_shadow_stay_outside(room, box) -> None:
    colors, inside = room
    assert not is_plain(colors)
    outline = find_outline(colors, box)
    assert overlap(outline.mask, inside) > 0.9 and outline.doubt is None


def test_doubtful_outlines(room) -> None:
    y, x = np.indices((400, 400))
    disc = np.hypot(x - 200, y - 200)
    border = "its outline touches the border of the picture"
    noise = np.random.default_rng(0).random((400, 400)) < 0.7
    for mask in (np.abs(y - 200) < 90, disc < 230):
        assert find_doubt(255 * mask.astype(np.uint8)) == border
    assert find_doubt(255 * ((disc < 150) & noise).astype(np.uint8)) == "its outline is ragged"
    cropped = (np.abs(x - 200) < 90) & (y > 200)
    for mask in (disc < 150, cropped, room[1]):
        assert find_doubt(255 * mask.astype(np.uint8)) is None
    assert find_doubt(255 * cropped.astype(np.uint8), most=0) == border


def test_an_object_that_leaves_a_photograph_is_doubted(scene) -> None:
    pytest.importorskip("cv2", reason="needs the extra photos")
    found = find_outline(scene[0][:200])
    assert found.doubt == "its outline touches the border of the picture"


def test_a_part_of_what_may_be_a_larger_thing_is_less_sure(monkeypatch) -> None:
    pytest.importorskip("cv2", reason="needs the extra photos")
    colors = np.full((160, 160, 3), 200, np.uint8)
    colors[60:100, 60:100] = (180, 30, 30)
    logits = np.full((160, 160), -9.0, np.float32)
    logits[60:100, 60:100] = 9
    found = []
    for chance in (-9.0, -1.5):  # of the pixels to the right of it
        logits[60:100, 100:140] = chance
        monkeypatch.setattr(cutting, "find_object", lambda *_: ((0, 0, 160, 160), logits))
        found.append(cut_out(colors)[1])
    assert found[0] > 0.95 and found[1] < 0.5


class Rembg:
    """A stand-in for the package: everything red is the object."""

    failure: BaseException | None = None
    sessions: list[str]

    def __init__(self) -> None:
        self.sessions = []

    def new_session(self, name: str) -> Rembg:
        self.sessions.append(name)
        return self

    def remove(self, photo: Image.Image, session: Rembg, only_mask: bool) -> Image.Image:
        assert session is self and only_mask
        if self.failure is not None:
            raise self.failure
        red, green, _ = photo.split()
        return Image.fromarray(
            np.where(np.asarray(red) > 2.0 * np.asarray(green), 240, 10).astype(np.uint8)
        )


@pytest.fixture
def rembg(monkeypatch) -> Rembg:
    stand_in = Rembg()
    stand_in.__spec__ = ModuleSpec("rembg", None)
    monkeypatch.setitem(sys.modules, "rembg", stand_in)
    cutting._rembg_session.cache_clear()
    yield stand_in
    cutting._rembg_session.cache_clear()


def test_rembg_is_used_if_installed_and_says_so(rembg, room, capsys) -> None:
    colors, inside = room
    outline = find_outline(colors)
    assert overlap(outline.mask, inside) > 0.99 and outline.doubt is None
    assert outline.how == "by rembg (isnet-general-use)"
    assert "isnet-general-use: 180 MB, loaded from the internet" in capsys.readouterr().err
    box = find_outline(colors, (114, 136, 192, 130))
    assert overlap(box.mask, inside) > 0.99 and box.how == "by rembg (isnet-general-use) in the box"
    assert rembg.sessions == ["isnet-general-use"], "loaded once"
    assert not capsys.readouterr().err, "said once"


@needs_opencv
@pytest.mark.parametrize(
    "failure",
    [OSError("no route to host"), RuntimeError("odd weights"), SystemExit("no onnxruntime")],
)
@pytest.mark.parametrize("box", [None, (114, 136, 192, 130)])
def test_the_packages_network_does_what_rembg_cannot(rembg, room, failure, box) -> None:
    colors, inside = room
    rembg.failure = failure
    outline = find_outline(colors, box)
    assert overlap(outline.mask, inside) > 0.9
    assert f"by a network and GrabCut, as rembg fails ({failure})" in outline.how


def test_outlines_on_which_two_networks_disagree_are_doubted(rembg, room) -> None:
    colors, inside = room
    other = colors.copy()
    other[inside] = (60, 60, 60)
    other[20:70, 30:100] = (200, 40, 40)  # rembg takes the picture on the wall
    assert find_outline(other).doubt == "two networks see different outlines"


@needs_opencv
def test_a_box_leaves_out_a_picture_on_the_wall_that_the_object_touches(room) -> None:
    colors, inside = room
    colors = colors.copy()
    colors[80:141, 170:240] = np.where(
        inside[80:141, 170:240, None], colors[80:141, 170:240], (60, 110, 70)
    )
    assert overlap(find_outline(colors, (114, 136, 192, 130)).mask, inside) > 0.9
