"""The network of kinds: its drawings, its icons, and what the tool writes."""

import re
import shutil
from pathlib import Path

import draw_strangers
import learn_kinds
import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

from learn3d.runs import checkpoint
from learn3d.studio.picture_to_mesh.make import SMALL_MODEL, load_model
from learn3d.studio.shapes import CATEGORIES

ICONS = (
    "car car-side taxi-fill oncoming-automobile chair office-chair-line desk-lamp couch desk airplane "
    "cat mug toy-truck flag-car person-in-chair table-cell user-circle"
).split()


@pytest.fixture
def drawn_icons(monkeypatch: pytest.MonkeyPatch) -> None:
    """Icon sets that are there already, and drawings without a program for SVG files."""

    def draw(svg: bytes, width: int) -> Image.Image:
        image = Image.new("RGBA", (width, width))
        corner = 10 + len(svg)
        ImageDraw.Draw(image).ellipse((corner, 30, width - 10, 90), fill=(200, 30, 10, 255))
        return image

    sets = [(name, {icon: icon.encode() for icon in ICONS}) for name in ("noto", "maki")]
    monkeypatch.setattr(learn_kinds, "read_sets", lambda: iter(sets))
    monkeypatch.setattr(learn_kinds, "draw_svg", draw)


def test_names_tell_kinds_and_things_that_are_nearly_of_one_are_left_out(drawn_icons) -> None:
    kinds = [kind for kind, _ in learn_kinds.choose_icons(dict.fromkeys(ICONS, b"svg"), 10)]
    assert {kind: kinds.count(kind) for kind in kinds} == {
        "airplane": 1, "car": 4, "chair": 2, "lamp": 1, "sofa": 1, "table": 1, "other": 2,
    }  # fmt: skip


@pytest.mark.parametrize("category", CATEGORIES)
def test_drawings_of_a_shape_have_an_outline(category: str) -> None:
    colors, mask = learn_kinds.draw_styled(category, np.random.default_rng(3), plain=False)
    assert colors.shape == (192, 192, 3) and mask.shape == (192, 192)
    assert 0.02 < (mask > 127).mean() < 0.9


def test_varied_pictures_are_white_outside_of_their_masks() -> None:
    rng = np.random.default_rng(0)
    images = torch.zeros(16, 4, 96, 96, dtype=torch.uint8)
    images[:, :, 30:60, 20:70] = 200
    varied = learn_kinds.vary(images, torch.arange(16) % 7, rng)
    masks = varied[:, 3]
    assert varied.shape == (16, 4, 64, 64) and 0 <= varied.min() and varied.max() <= 1
    assert (masks.mean((1, 2)) > 0.02).all()
    assert (varied[:, :3] * (masks[:, None] == 0)).max() == 0  # stored inverted: 0 is white
    assert not torch.equal(varied, learn_kinds.vary(images, torch.arange(16) % 7, rng))


def test_the_tool_changes_nothing_but_the_network_of_kinds(
    drawn_icons, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    path = tmp_path / "model.safetensors"
    shutil.copy(SMALL_MODEL, path)
    learn_kinds.main(path, objects=1, icons=1, others=4)
    before, after = (checkpoint.load(file)[0] for file in (SMALL_MODEL, path))
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert before.keys() == after.keys()
    assert changed == {name for name in before if name.startswith("kind_network.")}
    assert load_model(path).chances(torch.zeros(4, 64, 64, dtype=torch.uint8)).isfinite().all()
    assert re.search(r"car: \d+ icons", capsys.readouterr().out)


def test_an_icon_becomes_an_svg_file_with_its_size() -> None:
    svg = draw_strangers.icon_svg({"body": "<path/>", "width": 24}).decode()
    assert 'viewBox="0 0 24 16"' in svg and svg.endswith("<path/></svg>")
