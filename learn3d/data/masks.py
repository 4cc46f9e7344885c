"""Masks of single objects: their faults, the object among specks and other things, and its box."""

import numpy as np
from scipy import ndimage

_CELLS = 512  # regions are found on a grid of at most so many cells a side
_SPECK = 0.002  # area of a region, over that of the largest, below which it is a speck
NEAR = 0.04  # largest gap between parts of an object, over the length of its largest region,
_REACH = 0.1  # plus this share of the smaller part's own length
_ROUNDS = 8  # parts in a row, each near the one before
_SIMILAR = 0.5  # area of a region, over that of the object, from which it is another object of similar size
_SAID = 0.01  # area that is left out, over that of the object, from which it is said


def keep_object(mask: np.ndarray, near: float = NEAR) -> tuple[np.ndarray, str | None]:
    """The object of a mask uint8 [H, W], without specks and other things; what was left out, None
    if next to nothing.

    Pixels above 127 that touch, also diagonally, form a region. The object is the largest region
    with its other parts: regions near it, and a larger one may be farther away. near: largest gap
    over the length of the largest region. Fainter pixels belong to the nearest region.
    """
    inside = mask > 127
    step = max(1, -(-max(mask.shape) // _CELLS))
    starts = [np.arange(0, side, step) for side in mask.shape]
    pixels = np.add.reduceat(np.add.reduceat(inside, starts[0], 0, np.int32), starts[1], 1)
    regions, count = ndimage.label(pixels, np.ones((3, 3)))
    if count < 2:
        return mask, None
    areas = np.bincount(regions.ravel(), pixels.ravel())[1:]
    kept = _parts_of_object(regions, areas, near)
    if kept.all():
        return mask, None
    cells = ndimage.distance_transform_edt(
        regions == 0, return_distances=False, return_indices=True
    )
    nearest = regions[tuple(cells)]
    of_object = np.r_[False, kept][nearest].repeat(step, 0).repeat(step, 1)
    of_object = of_object[: mask.shape[0], : mask.shape[1]]
    return np.where(of_object, mask, np.uint8(0)), _describe(areas[~kept], areas[kept].sum())


def _parts_of_object(regions: np.ndarray, areas: np.ndarray, near: float) -> np.ndarray:
    """Which of the regions 1 .. N, int [H, W], belong to the object: bool [N]. areas: their pixels
    [N].

    The largest does, then, in rounds, those near the parts so far.
    """
    boxes = ndimage.find_objects(regions)
    lengths = np.array([max(side.stop - side.start for side in box) for box in boxes])
    largest = int(areas.argmax())
    kept = np.arange(len(areas)) == largest
    reach = near * lengths[largest] + _REACH * lengths
    rest = np.flatnonzero(~kept & (areas >= _SPECK * areas[largest]))
    for _ in range(_ROUNDS):
        if not len(rest):
            break
        distances = ndimage.distance_transform_edt(~np.r_[False, kept][regions])
        close = ndimage.minimum(distances, regions, rest + 1) - 1 <= reach[rest]
        if not close.any():
            break
        kept[rest[close]], rest = True, rest[~close]
    return kept


def _describe(left_out: np.ndarray, area: float) -> str | None:
    """A sentence about regions that were left out; None if they are small."""
    if left_out.max() >= _SIMILAR * area:
        return "several objects of similar size were found, and only the largest is used"
    share = left_out.sum() / area
    parts, were = ("one part", "was") if len(left_out) == 1 else (f"{len(left_out)} parts", "were")
    return (
        f"{parts} away from the object, {share:.0%} of its size, {were} left out"
        if share > _SAID
        else None
    )


def check_mask(mask: np.ndarray, *, cropped: bool = False) -> None:
    """Raise ValueError for a mask [H, W] that is empty, full, or probably inverted.

    cropped: the object may touch the border of the picture, and cover much of it.
    """
    inside = mask > 127
    if not inside.any():
        raise ValueError(
            "its mask is empty: no pixel is at least half white, or opaque; white must be the object"
        )
    if inside.all():
        raise ValueError("its mask is all white: white must be the object, black the background")
    border = np.concatenate(border_lines(inside))
    if border.mean() > (max(0.5, inside.mean()) if cropped else 0.5):
        question = "is the object black, or is the background part of the mask?"
        raise ValueError(f"its mask covers {border.mean():.0%} of the border; {question}")


def border_lines(image: np.ndarray) -> tuple[np.ndarray, ...]:
    """The first and the last row, and the first and the last column, of an image [H, W, ...]."""
    return image[0], image[-1], image[:, 0], image[:, -1]


def mask_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Bounding box of the pixels above 127: left, top, right, bottom; right and bottom are
    excluded.

    Raises ValueError if there are none.
    """
    if not (mask > 127).any():
        raise ValueError("the mask has no pixel above half strength; is it the right mask?")
    rows, columns = (np.flatnonzero((mask > 127).any(axis=axis)) for axis in (1, 0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
