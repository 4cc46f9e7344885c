"""Masks of photographs without one: by the colour of a plain background, or by GrabCut (OpenCV)."""

import importlib.util

import numpy as np
from PIL import Image
from scipy import ndimage

from learn3d.data.framing import TOLERANCE, threshold_mask

SIDE = 384  # longer side in pixels of the picture for GrabCut
INSET = 0.03  # width of the background border without a box, as a share of the picture's sides
PLAIN = 0.9  # least share of the border with one colour in pictures with a plain background
KEEP, OBJECT, BACKGROUND, OPEN = range(4)  # labels of pixels in strokes
_ROUNDS, _ROUNDS_IN_STROKES = 5, 2
_AROUND = 16  # width in pixels of the region around the strokes that GrabCut sees

Box = tuple[int, int, int, int]  # x and y of the upper left corner, width, height, in pixels


def find_mask(colors: np.ndarray) -> np.ndarray:
    """Guess the mask uint8 [H, W], 0 or 255, of the object in a photograph uint8 [H, W, 3].

    If the background is plain, or without OpenCV, the object is everything that differs from the border's colour.
    Otherwise GrabCut separates it from the picture's border.
    """
    plain = is_plain(colors) or importlib.util.find_spec("cv2") is None
    return threshold_mask(colors) if plain else cut_out(colors)


def is_plain(colors: np.ndarray) -> bool:
    """Whether the border of a picture uint8 [H, W, 3] has one colour, except for a tenth of its pixels."""
    border = np.concatenate([colors[0], colors[-1], colors[:, 0], colors[:, -1]]).astype(np.float64)
    difference = np.abs(border - np.median(border, axis=0)).max(axis=1)
    return bool((difference < 255 * TOLERANCE).mean() > PLAIN)


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
