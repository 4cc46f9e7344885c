"""The network that finds the object in a photograph."""

import numpy as np
import pytest
import torch

from learn3d.studio.picture_to_mesh import outline_network
from learn3d.studio.picture_to_mesh.outline_network import (
    VIEW,
    WEIGHTS,
    find_object,
    load_outline_network,
    place_view,
)


def test_the_package_has_small_weights() -> None:
    assert WEIGHTS.stat().st_size < 2_000_000
    network = load_outline_network()
    assert not network.training
    assert all(value.isfinite().all() for value in network.state_dict().values())
    assert network(torch.zeros(2, 4, 64, 96)).shape == (2, 64, 96)


@pytest.mark.parametrize(
    "place, view",
    [
        ((100, 100, 200, 200), (80, 80, 220, 220)),  # a fifth of its sides more
        ((100, 100, 200, 120), (80, 68, 220, 152)),  # but no narrow strip
        ((0, 0, 390, 100), (0, 0, 400, 214)),  # within the picture
        ((50.5, 50.5, 50.5, 50.5), (49, 49, 52, 52)),  # and never empty
    ],
)
def test_a_view_has_a_margin(place, view) -> None:
    assert place_view(place, 400, 300) == view


@pytest.fixture
def disc() -> np.ndarray:
    """A red disc before a green wall, uint8 [240, 320, 3]."""
    y, x = np.mgrid[:240, :320]
    inside = np.hypot(x - 210, y - 150) < 36
    return np.where(inside[..., None], (170, 40, 40), (150, 190, 150)).astype(np.uint8)


def test_the_second_look_is_nearer(disc, monkeypatch) -> None:
    looks = []
    look = outline_network._look

    def watch(picture, view, box=None):
        looks.append(view)
        return look(picture, view, box)

    monkeypatch.setattr(outline_network, "_look", watch)
    (left, top, right, bottom), logits = find_object(disc)
    assert looks == [(0, 0, 320, 240), (left, top, right, bottom)]
    assert left <= 174 and right >= 246 and top <= 114 and bottom >= 186
    assert right - left < 200 and bottom - top < 200
    assert logits.shape == (VIEW, VIEW) and logits[VIEW // 2, VIEW // 2] > 0 > logits[0, 0]


def test_a_mirrored_picture_has_the_mirrored_object(disc) -> None:
    box = 170, 110, 250, 190
    view, logits = find_object(disc, box)
    mirrored, other = find_object(disc[:, ::-1], (320 - 250, 110, 320 - 170, 190))
    assert mirrored == (320 - view[2], view[1], 320 - view[0], view[3])
    found, again = logits > 0, other[:, ::-1] > 0
    assert found.any() and (found != again).mean() < 0.01
