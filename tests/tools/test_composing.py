"""Composed photographs, the training on them, and the measure of outlines."""

from pathlib import Path
from typing import get_args

import measure_cutouts
import numpy as np
import pytest
import safetensors.torch
import torch
from composing import Composer, Surroundings
from train_outlines import draw_objects, make_view, train

from learn3d.studio.picture_to_mesh.outline_network import OutlineNetwork


def compose(mess: float = 0.0) -> Composer:
    rng = np.random.default_rng(0)
    pictures = [rng.integers(256, size=(90, 120, 3), dtype=np.uint8) for _ in range(2)]
    return Composer(pictures, draw_objects(1, None), mess=mess)


@pytest.mark.parametrize("around", get_args(Surroundings))
def test_a_cut_out_stands_in_its_box(around: Surroundings) -> None:
    sprite = np.full((20, 10, 4), 255, np.uint8)
    sprite[..., :2] = 0  # blue
    for seed in range(5):
        rng = np.random.default_rng(seed)
        colors, alpha = compose()(rng, sprite, (60, 30, 40, 80), (160, 100), around)
        inside = np.zeros((100, 160), bool)
        inside[30:, 60:100] = True  # it reaches out of the photograph
        np.testing.assert_array_equal(alpha, inside)
        blue = colors[40:, 70:90].mean((0, 1)) @ [-0.5, -0.5, 1]
        assert colors.dtype == np.uint8 and (blue > 50 or np.ptp(colors, axis=2).max() < 30)


def test_two_steps_of_training_store_weights(tmp_path: Path) -> None:
    objects, composer = draw_objects(2, None), compose(mess=1.0)
    file = tmp_path / "weights.safetensors"
    network = OutlineNetwork()
    before = network.state_dict()["last.3.weight"].clone()
    train(lambda rng, side: make_view(composer, objects, rng, side), network, file, steps=2)
    stored = safetensors.torch.load_file(file)
    OutlineNetwork().load_state_dict(stored)
    assert all(value.isfinite().all() for value in stored.values())
    assert not torch.allclose(stored["last.3.weight"].float(), before, atol=1e-4)


def test_a_plain_room_has_plain_walls() -> None:
    sprite = np.full((20, 10, 4), 255, np.uint8)
    changes = {}
    for around in ("room", "plain room"):
        rooms = [
            compose()(np.random.default_rng(seed), sprite, (70, 60, 20, 30), (160, 100), around)[0]
            for seed in range(8)
        ]
        changes[around] = np.median(np.abs(np.diff(np.float32(rooms), axis=2)))
    assert changes["plain room"] < 0.5 * changes["room"]


def test_scenes_of_each_kind() -> None:
    for scene in measure_cutouts.scenes(6, 3, "usual"):
        assert scene.around in ("room", "photograph") and not touches(scene.mask)
    for scene in measure_cutouts.scenes(3, 3, "plain-room"):
        assert scene.around == "plain room" and not touches(scene.mask)
    for scene in measure_cutouts.scenes(6, 3, "cut-off"):
        assert touches(scene.mask)


def touches(mask: np.ndarray) -> bool:
    return any(side.any() for side in (mask[0], mask[-1], mask[:, 0], mask[:, -1]))


@pytest.mark.parametrize("kind", get_args(measure_cutouts.Kind))
def test_outlines_are_measured(kind, capsys: pytest.CaptureFixture, tmp_path: Path) -> None:
    measure_cutouts.main(images=2, seed=2, kind=kind, sheet=tmp_path / "sheet.png")
    *_, line, legend = capsys.readouterr().out.splitlines()
    name, count, *shares = line.split()
    assert (name, count) == ("all", "2") and set(shares) <= {"0%", "50%", "100%"}
    assert legend.startswith("silent: wrong or cut off without a doubt")
    assert (tmp_path / "sheet.png").exists()
