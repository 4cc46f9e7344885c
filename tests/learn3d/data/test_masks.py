"""The object of a mask among specks and other things, and masks that are refused."""

from __future__ import annotations

import time

import numpy as np
import pytest

from learn3d.data.masks import check_mask, keep_object, mask_box


def disc(factor: int = 1) -> np.ndarray:
    """A disc of radius 60 with a faint rim in a picture of 300 x 400 pixels, times a factor."""
    rows, columns = np.ogrid[: 300 * factor, : 400 * factor]
    distance = np.hypot(rows / factor - 150, columns / factor - 120)
    return np.where(distance < 60, 255, np.where(distance < 63, 60, 0)).astype(np.uint8)


def rectangle(mask: np.ndarray, x: int, y: int, width: int, height: int, factor: int = 1) -> None:
    mask[factor * y : factor * (y + height), factor * x : factor * (x + width)] = 255


@pytest.mark.parametrize("factor", [1, 7])
@pytest.mark.parametrize(
    ("parts", "kept", "said"),
    [
        ([], 0, None),
        ([(390, 290, 1, 1)], 0, None),
        ([(390, 290, 1, 1), (0, 0, 3, 3), (190, 150, 1, 1)], 0, None),
        ([(330, 20, 20, 20)], 0, "one part away from the object, 4% of its size, was left out"),
        (
            [(330, 20, 8, 8), (5, 5, 10, 9)],
            0,
            "2 parts away from the object, 1% of its size, were left out",
        ),
        (
            [(260, 90, 100, 100)],
            0,
            "several objects of similar size were found, and only the largest is used",
        ),
        ([(183, 150, 20, 4), (206, 150, 20, 4)], 2, None),
        ([(192, 100, 80, 90)], 1, None),
    ],
    ids=[
        "alone",
        "a pixel",
        "specks",
        "a thing",
        "two",
        "a twin",
        "broken leg",
        "a large part is near",
    ],
)
def test_the_object_is_the_largest_region_and_its_parts(
    parts, kept: int, said: str | None, factor: int
) -> None:
    mask = disc(factor)
    for part in parts[:kept]:
        rectangle(mask, *part, factor)
    wanted = mask.copy()
    for part in parts[kept:]:
        rectangle(mask, *part, factor)
    found, told = keep_object(mask)
    assert np.array_equal(found, wanted), "with its faint rim"
    assert told == said


def test_a_slanted_line_of_single_pixels_is_one_part() -> None:
    mask = disc()
    steps = np.arange(100)
    mask[150 + steps, 170 + steps] = 255
    found, told = keep_object(mask)
    assert np.array_equal(found, mask) and told is None


@pytest.mark.parametrize("kind", ["checkerboard", "dots", "noise", "full", "empty"])
def test_masks_full_of_holes_take_no_longer_than_others(kind: str) -> None:
    rows, columns = np.indices((1024, 1024))
    mask = {
        "checkerboard": (rows + columns) % 2,
        "dots": (rows % 4 == 0) & (columns % 4 == 0),
        "noise": np.random.default_rng(0).random((1024, 1024)) < 0.2,
        "full": rows >= 0,
        "empty": rows < 0,
    }[kind]
    begun = time.thread_time()
    keep_object(255 * mask.astype(np.uint8))
    assert time.thread_time() - begun < 2


@pytest.mark.parametrize(
    ("outside", "message"), [(100, "its mask is empty"), (255, "its mask is all white")]
)
def test_empty_and_full_masks_are_told_apart(outside: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_mask(np.full((5, 5), outside, np.uint8))


def test_inverted_masks_are_refused_but_not_tight_ones() -> None:
    inverted = np.full((50, 50), 255, np.uint8)
    inverted[10:40, 10:40] = 0
    check_mask(255 - inverted)
    assert mask_box(255 - inverted) == (10, 10, 40, 40)
    for cropped in (False, True):
        with pytest.raises(
            ValueError, match=r"its mask covers 100% of the border; is the object black"
        ):
            check_mask(inverted, cropped=cropped)
    tight = np.full((50, 50), 255, np.uint8)
    tight[:8, :8] = 0  # a cabinet, cut out at its edges
    check_mask(tight, cropped=True)
    with pytest.raises(ValueError, match="of the border"):
        check_mask(tight)
