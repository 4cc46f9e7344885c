"""Outlines of objects in photographs: by a plain background, by rembg, or by a network and GrabCut (OpenCV)."""

import functools
import importlib.util
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from scipy import ndimage
from scipy.special import expit

from learn3d.data.masks import keep_object
from learn3d.studio.picture_to_mesh.outline_network import find_object

SIDE = 384  # longer side in pixels of the picture for GrabCut
PLAIN = 0.9  # least share of the border with one colour in pictures with a plain background
EVEN = 0.06  # largest difference from this colour, in 0 .. 1; walls and floors differ by more
TOLERANCE = 0.12  # largest difference from the background's colour, in 0 .. 1
JPEG_NOISE = 6  # levels by which compression changes the background near an object
# A hole of the mask shows the background if more than this share of it has the background's colour.
PLAIN_HOLE = 0.5
# Its least and largest size, as a share of the object; larger holes are often white table tops.
HOLES = 0.001, 0.4
KEEP, OBJECT, BACKGROUND, OPEN = range(4)  # labels of pixels in strokes
_ROUNDS = 3  # of GrabCut
_AROUND = 16  # width in pixels of the region around the strokes that GrabCut sees
_CERTAIN = 0.995  # probability from which GrabCut does not decide
_BOXED = 0.2  # share of a box's view with which GrabCut starts if the network finds nothing there
_SMALL_HOLE = 0.002  # smaller holes are filled, as a share of the object
_TOUCHED = 0.03  # share of a side of the picture, from which the object touches it
_RECTANGLE = 0.9  # share of its box that an upright rectangle fills
_PARTS = 3  # parts that may be the object
_PART = 0.1  # their least area, over that of the largest
_RAGGED = 600  # squared length of an outline over its area, in pixels; a thin-legged chair has 200
_SURE = 0.6  # least soft IoU of a mask and its probabilities

Box = tuple[int, int, int, int]  # x and y of the upper left corner, width, height, in pixels


class Outline(NamedTuple):
    """An object that was searched in a photograph."""

    mask: np.ndarray  # uint8 [H, W], 0 or 255
    how: str  # how it was found: "by ..."
    doubt: str | None = None  # a reason to ask for a box, None if there is none


def find_outline(colors: np.ndarray, box: Box | None = None) -> Outline:
    """Find the object in a photograph uint8 [H, W, 3], and other things beside it.

    With a box: see `cut_out`. If there is no box and the background is plain, the object is
    everything that differs from the border's colour. Otherwise rembg finds it if it is installed,
    and if not, see `cut_out`. Raises ValueError as `cut_out` does, or if rembg fails.
    """
    if box is not None:
        return Outline(cut_out(colors, box)[0], "by a network and GrabCut in the box")
    doubt = None
    if is_plain(colors):
        whole = threshold_mask(colors)
        mask = _without_frame(colors, whole)
        how = "as all that differs from the plain background"
        if mask is not whole:
            how = f"{how} but for an upright rectangle, probably a picture on the wall"
    elif importlib.util.find_spec("rembg") is not None:
        mask = _ask_rembg(colors)
        how = "by rembg, which loads its weights from the internet at its first use"
    else:
        mask, sureness = cut_out(colors)
        how = "by a network and GrabCut"
        doubt = "the network is not sure of its outline" if sureness < _SURE else None
    return Outline(mask, how, find_doubt(keep_object(mask)[0]) or doubt)


def find_doubt(mask: np.ndarray) -> str | None:
    """A reason why a mask uint8 [H, W] is probably no object, None if there is none."""
    height, width = mask.shape
    scale = min(1.0, SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    inside = np.asarray(Image.fromarray(mask).resize(size, Image.Resampling.BOX)) > 127
    sides = sum(
        line.mean() > _TOUCHED for line in (inside[0], inside[-1], inside[:, 0], inside[:, -1])
    )
    if sides > 1:
        return f"its outline touches {sides} sides of the picture"
    length = np.count_nonzero(inside & ~ndimage.binary_erosion(inside))
    return "its outline is ragged" if length**2 > _RAGGED * np.count_nonzero(inside) else None


@functools.lru_cache(1)
def _rembg_session() -> Any:
    import rembg

    return rembg.new_session()


def _ask_rembg(colors: np.ndarray) -> np.ndarray:
    import rembg

    try:
        mask = rembg.remove(Image.fromarray(colors), session=_rembg_session(), only_mask=True)
    except OSError as error:  # the weights cannot be loaded, for example
        raise ValueError(
            f"rembg does not cut the object out ({error}); give a box or a mask"
        ) from error
    return 255 * (np.asarray(mask) > 127).astype(np.uint8)


def is_plain(colors: np.ndarray) -> bool:
    """Whether the border of a picture uint8 [H, W, 3] has one colour, except for a tenth of its pixels."""
    _, of_border = _differences(colors)
    return bool((of_border < 255 * EVEN).mean() > PLAIN)


def _differences(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Largest difference of a channel from the border's median, 0 .. 255: of all pixels [H, W], of the border [N]."""
    border = np.concatenate([colors[0], colors[-1], colors[:, 0], colors[:, -1]])
    background = np.median(border, axis=0)
    return np.abs(colors - background).max(axis=-1), np.abs(border - background).max(axis=-1)


def threshold_mask(colors: np.ndarray, tolerance: float = TOLERANCE) -> np.ndarray:
    """Mask an object on a plain background: uint8 [H, W], 0 or 255.

    colors: uint8 [H, W, 3]. The background colour is the median of the border. A pixel belongs to
    the object if a channel differs from it by more than `tolerance` (0 .. 1). Holes are filled,
    but for some with the colour of the background, such as the gaps between the rungs of a chair.
    """
    difference, noise = _differences(colors)
    found = difference > 255 * tolerance
    inside = ndimage.binary_fill_holes(found)
    holes, count = ndimage.label(inside & ~found)
    numbers = np.arange(1, count + 1)
    plain = (
        ndimage.mean(difference <= max(JPEG_NOISE, np.percentile(noise, 90)), holes, numbers)
        > PLAIN_HOLE
    )
    share = ndimage.sum(holes > 0, holes, numbers) / max(1, inside.sum())
    seen_through = plain & (share > HOLES[0]) & (share < HOLES[1])
    return 255 * (inside & ~np.isin(holes, numbers[seen_through])).astype(np.uint8)


def cut_out(colors: np.ndarray, box: Box | None = None) -> tuple[np.ndarray, float]:
    """The mask uint8 [H, W], 0 or 255, of the main object of a photograph or of a box, and its sureness.

    colors: uint8 [H, W, 3]. Pixels outside the box are background. A network finds the object
    (`find_object`), and GrabCut decides where it is not certain. The sureness, in 0 .. 1, is the
    soft IoU of the mask and the network's probabilities. Raises ValueError without OpenCV, or if
    the box exceeds or fills the picture.
    """
    height, width = colors.shape[:2]
    x, y, w, h = box or (0, 0, width, height)
    if w < 2 or h < 2 or x < 0 or y < 0 or x + w > width or y + h > height:
        raise ValueError(
            f"the box {box} (x, y, width, height) must lie within the {width}x{height} pixels"
        )
    if box is not None and w == width and h == height:
        raise ValueError(
            "the box covers the whole picture; leave some background around the object"
        )
    view, logits = find_object(colors, None if box is None else (x, y, x + w, y + h))
    if box is not None and logits.max() < 0:  # the box says that something is there
        logits = logits - np.quantile(logits, 1 - _BOXED)
    left, top, right, bottom = view
    part = Image.fromarray(colors).crop(view)
    part.thumbnail((SIDE, SIDE), Image.Resampling.BOX)
    finer = Image.fromarray(logits).resize(part.size, Image.Resampling.BILINEAR)
    chance = expit(np.asarray(finer))
    unsure = np.abs(chance - 0.5) < _CERTAIN - 0.5
    inside = _only_object(_grab_cut(np.asarray(part), chance > 0.5, unsure))
    sureness = np.minimum(chance, inside).sum() / np.maximum(chance, inside).sum()
    larger = Image.fromarray(255 * inside.astype(np.uint8)).resize(
        (right - left, bottom - top), Image.Resampling.BILINEAR
    )
    mask = np.zeros((height, width), np.uint8)
    mask[top:bottom, left:right] = 255 * (np.asarray(larger) > 127)
    if box is not None:
        within = np.zeros_like(mask)
        within[y : y + h, x : x + w] = 255
        mask &= within
    return mask, float(sureness)


def _parts(inside: np.ndarray) -> list[np.ndarray]:
    """The largest connected regions of a mask, bool [H, W]: the object may be smaller than a picture on the wall."""
    regions, _ = ndimage.label(inside, np.ones((3, 3)))
    areas = np.bincount(regions.ravel())
    areas[0] = 0
    largest = np.argsort(-areas)[:_PARTS]
    return [regions == number for number in largest if areas[number] > _PART * areas.max()]


def _only_object(inside: np.ndarray) -> np.ndarray:
    """A mask, bool [H, W], without specks and without small holes."""
    filled = ndimage.binary_fill_holes(inside)
    holes, _ = ndimage.label(filled & ~inside)
    small = np.bincount(holes.ravel()) < _SMALL_HOLE * max(1, np.count_nonzero(filled))
    small[0] = False
    return keep_object(255 * (inside | small[holes]).astype(np.uint8))[0] > 127


def _without_frame(colors: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The mask uint8 [H, W], or another part of it if the largest is an upright rectangle and less probable."""
    parts = _parts(mask > 127)
    if len(parts) < 2 or not _is_rectangle(parts[0]):
        return mask
    (left, top, right, bottom), _ = find_object(colors)
    best = max(parts, key=lambda part: np.count_nonzero(part[top:bottom, left:right]))
    return mask if best is parts[0] else 255 * best.astype(np.uint8)


def _is_rectangle(inside: np.ndarray) -> bool:
    """Whether a mask, bool [H, W], fills its box."""
    extent = np.count_nonzero(inside.any(axis=0)) * np.count_nonzero(inside.any(axis=1))
    return np.count_nonzero(inside) > _RECTANGLE * extent


def correct(colors: np.ndarray, mask: np.ndarray, strokes: np.ndarray) -> np.ndarray:
    """A mask uint8 [H, W], 0 or 255, corrected by strokes uint8 [H, W].

    Each pixel of the strokes is KEEP (as in the mask), OBJECT, BACKGROUND or OPEN (GrabCut
    decides). colors: uint8 [H, W, 3]. Raises ValueError without OpenCV.
    """
    inside = np.where(strokes == OBJECT, True, (mask > 127) & (strokes != BACKGROUND))
    unsure = strokes == OPEN
    if unsure.any():
        rows, columns = (np.flatnonzero(unsure.any(axis=axis)) for axis in (1, 0))
        part = tuple(
            slice(max(0, line[0] - _AROUND), line[-1] + 1 + _AROUND) for line in (rows, columns)
        )
        inside[part] = _grab_cut(colors[part], inside[part], unsure[part])
    return 255 * inside.astype(np.uint8)


def _grab_cut(colors: np.ndarray, inside: np.ndarray, unsure: np.ndarray) -> np.ndarray:
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
    cv2.grabCut(
        np.ascontiguousarray(colors[..., ::-1]),
        labels,
        None,
        *models,
        _ROUNDS,
        cv2.GC_INIT_WITH_MASK,
    )
    return labels % 2 == 1
