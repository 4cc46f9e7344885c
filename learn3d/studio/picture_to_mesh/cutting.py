"""Masks of photographs without one: by the colour of a plain background, or by GrabCut (OpenCV)."""

import numpy as np
from PIL import Image
from scipy import ndimage

SIDE = 384  # longer side in pixels of the picture for GrabCut
INSET = 0.03  # width of the background border without a box, as a share of the picture's sides
PLAIN = 0.9  # least share of the border with one colour in pictures with a plain background
TOLERANCE = 0.12  # largest difference from the background's colour, in 0 .. 1
JPEG_NOISE = 6  # levels by which compression changes the background near an object
PLAIN_HOLE = 0.5  # a hole of the mask shows the background if more than this share of it has the background's colour,
HOLES = 0.001, 0.4  # and its size, as a share of the object, lies between these; larger ones are often white table tops
KEEP, OBJECT, BACKGROUND, OPEN = range(4)  # labels of pixels in strokes
_ROUNDS, _ROUNDS_IN_STROKES = 5, 2
_AROUND = 16  # width in pixels of the region around the strokes that GrabCut sees

Box = tuple[int, int, int, int]  # x and y of the upper left corner, width, height, in pixels


def find_mask(colors: np.ndarray, box: Box | None = None) -> np.ndarray:
    """Mask uint8 [H, W], 0 or 255, of the object in a photograph uint8 [H, W, 3], and of other things beside it.

    GrabCut finds the object in the box or, without one, in the middle. If there is no box and the background is plain,
    the object is everything that differs from the border's colour. Raises ValueError as `cut_out` does.
    """
    if box is None and is_plain(colors):
        return threshold_mask(colors)
    return cut_out(colors, box)


def is_plain(colors: np.ndarray) -> bool:
    """Whether the border of a picture uint8 [H, W, 3] has one colour, except for a tenth of its pixels."""
    _, of_border = _differences(colors)
    return bool((of_border < 255 * TOLERANCE).mean() > PLAIN)


def _differences(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Largest difference of a channel from the border's median, 0 .. 255: of all pixels [H, W], of the border [N]."""
    border = np.concatenate([colors[0], colors[-1], colors[:, 0], colors[:, -1]])
    background = np.median(border, axis=0)
    return np.abs(colors - background).max(axis=-1), np.abs(border - background).max(axis=-1)


def threshold_mask(colors: np.ndarray, tolerance: float = TOLERANCE) -> np.ndarray:
    """Mask an object on a plain background: uint8 [H, W], 0 or 255.

    colors: uint8 [H, W, 3]. The background colour is the median of the border. A pixel belongs to the object if a
    channel differs from it by more than `tolerance` (0 .. 1). Holes are filled, but for some with the colour of the
    background, such as the gaps between the rungs of a chair.
    """
    difference, noise = _differences(colors)
    found = difference > 255 * tolerance
    inside = ndimage.binary_fill_holes(found)
    holes, count = ndimage.label(inside & ~found)
    numbers = np.arange(1, count + 1)
    plain = ndimage.mean(difference <= max(JPEG_NOISE, np.percentile(noise, 90)), holes, numbers) > PLAIN_HOLE
    share = ndimage.sum(holes > 0, holes, numbers) / max(1, inside.sum())
    seen_through = plain & (share > HOLES[0]) & (share < HOLES[1])
    return 255 * (inside & ~np.isin(holes, numbers[seen_through])).astype(np.uint8)


def cut_out(colors: np.ndarray, box: Box | None = None) -> np.ndarray:
    """The mask uint8 [H, W], 0 or 255, of the object within a box of a photograph, by GrabCut.

    colors: uint8 [H, W, 3]. Pixels outside the box are background (default box: all but a narrow border). Holes
    are filled. Raises ValueError without OpenCV, or if the box exceeds or fills the picture.
    """
    height, width = colors.shape[:2]
    scale = min(1.0, SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = np.asarray(Image.fromarray(colors).resize(size, Image.Resampling.BOX))
    x, y, w, h = box or (INSET * width, INSET * height, (1 - 2 * INSET) * width, (1 - 2 * INSET) * height)
    if w < 2 or h < 2 or x < 0 or y < 0 or x + w > width or y + h > height:
        raise ValueError(f"the box {box} (x, y, width, height) must lie within the {width}x{height} pixels")
    inside = np.zeros(small.shape[:2], bool)
    inside[round(y * scale) : round((y + h) * scale), round(x * scale) : round((x + w) * scale)] = True
    if inside.all():
        raise ValueError("the box covers the whole picture; leave some background around the object")
    inside = ndimage.binary_fill_holes(_grab_cut(small, inside, inside, _ROUNDS))
    mask = Image.fromarray(255 * inside.astype(np.uint8)).resize((width, height), Image.Resampling.BILINEAR)
    return 255 * (np.asarray(mask) > 127).astype(np.uint8)


def correct(colors: np.ndarray, mask: np.ndarray, strokes: np.ndarray) -> np.ndarray:
    """A mask uint8 [H, W], 0 or 255, corrected by strokes uint8 [H, W].

    Each pixel of the strokes is KEEP (as in the mask), OBJECT, BACKGROUND or OPEN (GrabCut decides). colors: uint8
    [H, W, 3]. Raises ValueError without OpenCV.
    """
    inside, unsure = np.where(strokes == OBJECT, True, (mask > 127) & (strokes != BACKGROUND)), strokes == OPEN
    if unsure.any():
        rows, columns = (np.flatnonzero(unsure.any(axis=axis)) for axis in (1, 0))
        part = tuple(slice(max(0, line[0] - _AROUND), line[-1] + 1 + _AROUND) for line in (rows, columns))
        inside[part] = _grab_cut(colors[part], inside[part], unsure[part], _ROUNDS_IN_STROKES)
    return 255 * inside.astype(np.uint8)


def _grab_cut(colors: np.ndarray, inside: np.ndarray, unsure: np.ndarray, rounds: int) -> np.ndarray:
    """GrabCut (Rother et al. 2004): decide again which of the pixels `unsure` are inside of an object, bool [H, W]."""
    try:
        import cv2
    except ImportError:
        raise ValueError(
            "photographs are cut out with OpenCV, which is not installed: pip install 'nmr-learn3d[photos]', or give "
            "a picture with transparency or a mask"
        ) from None
    if inside.all() or not inside.any():
        return inside
    labels = inside + np.uint8(2) * unsure  # GC_BGD, GC_FGD, GC_PR_BGD, GC_PR_FGD
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(colors[..., ::-1]), labels, None, *models, rounds, cv2.GC_INIT_WITH_MASK)
    return labels % 2 == 1
