"""Outlines of objects in photographs: by a plain background, by rembg, or by a network and GrabCut (OpenCV)."""

import functools
import importlib.util
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from scipy import ndimage
from scipy.special import expit

from learn3d.data.masks import keep_object
from learn3d.studio.picture_to_mesh.options import DEFAULTS, CutOptions
from learn3d.studio.picture_to_mesh.outline_network import find_object, place_view
from learn3d.terminal import note

KEEP, OBJECT, BACKGROUND, OPEN = range(4)  # labels of pixels in strokes
REMBG = "isnet-general-use"  # a free network of rembg; its own default may only be used for a fee

Box = tuple[int, int, int, int]  # x and y of the upper left corner, width, height, in pixels


class Outline(NamedTuple):
    """An object that was searched in a picture."""

    mask: np.ndarray  # uint8 [H, W], 0 or 255
    how: str  # how it was found: "by ..."
    doubt: str | None = None  # a reason to doubt it, None if there is none


def find_outline(
    colors: np.ndarray, box: Box | None = None, options: CutOptions = DEFAULTS.cut
) -> Outline:
    """Find the object in a picture uint8 [H, W, 3], and other things beside it.

    A thin frame around the picture is left out. With a box, or if the background is not plain,
    rembg finds the object if it is installed, or else `cut_out` does. On a plain background the
    object is everything that differs from the border's colour. Raises ValueError as `cut_out`
    does.
    """
    if box is not None:
        check_box(box, *colors.shape[1::-1])
        mask, how, doubt = _cut_out(colors, box, options)
        return Outline(mask, f"{how} in the box", doubt or _box_doubt(mask, box, options))
    inner = peel_frame(colors, options)
    part, doubt, most = colors[inner], None, 1
    if is_plain(part, options):
        whole = threshold_mask(part, options)
        found = _without_frame(part, whole, options)
        how = "as all that differs from the plain background"
        if found is not whole:
            how = f"{how} but for an upright rectangle, probably a picture on the wall"
    else:
        found, how, doubt = _cut_out(part, None, options)
        most = 0  # only with a plain background do people crop a picture at the object
    mask = np.zeros(colors.shape[:2], np.uint8)
    mask[inner] = found
    return Outline(mask, how, find_doubt(keep_object(mask)[0], most, options) or doubt)


def peel_frame(colors: np.ndarray, options: CutOptions = DEFAULTS.cut) -> tuple[slice, slice]:
    """Rows and columns within a frame of one colour around a plain background; all if there is no such frame."""
    different = np.abs(colors.astype(int) - colors[0, 0]).max(2) > 255 * options.even
    inner = []
    for axis in (1, 0):
        lines = np.flatnonzero(different.mean(axis) > 0.5)  # JPEG leaves spots in a frame
        inner.append(slice(lines[0], lines[-1] + 1) if len(lines) else slice(None))
    part = colors[tuple(inner)]
    widest = options.frame * min(different.shape)
    missing = max(
        max(each.start or 0, side - (each.stop or side))
        for each, side in zip(inner, different.shape, strict=True)
    )
    if part.shape == colors.shape or missing > widest or not is_plain(part, options):
        return slice(None), slice(None)
    background = np.median(part[[0, -1]].reshape(-1, 3), axis=0)
    is_frame = np.abs(background - colors[0, 0]).max() > 255 * options.tolerance
    object_there = (
        0 < np.count_nonzero(threshold_mask(part, options)) < part.shape[0] * part.shape[1]
    )
    return tuple(inner) if is_frame and object_there else (slice(None), slice(None))


def _cut_out(
    colors: np.ndarray, box: Box | None, options: CutOptions
) -> tuple[np.ndarray, str, str | None]:
    """The mask of the main object, or of the one in a box; how it was found, and a doubt."""
    failed = ""
    if importlib.util.find_spec("rembg") is not None:
        try:
            mask = _ask_rembg(colors, box)
            return mask, f"by rembg ({REMBG})", _disagreement(colors, mask, box, options)
        except Exception as error:  # weights that cannot be loaded, a version without this network
            failed = f", as rembg fails ({error})"
    mask, sureness = cut_out(colors, box, options)
    doubt = "the network is not sure of its outline" if sureness < options.sure else None
    return mask, f"by a network and GrabCut{failed}", doubt


def _disagreement(
    colors: np.ndarray, mask: np.ndarray, box: Box | None, options: CutOptions
) -> str | None:
    """A doubt if the package's network sees another object than rembg."""
    (left, top, right, bottom), logits = find_object(colors, box and _corners(box))
    size = right - left, bottom - top
    seen = np.asarray(Image.fromarray(logits).resize(size, Image.Resampling.BILINEAR)) > 0
    found = mask[top:bottom, left:right] > 127
    both, either = np.count_nonzero(seen & found), np.count_nonzero(seen | found)
    return "two networks see different outlines" if both < options.agreed * either else None


def _box_doubt(mask: np.ndarray, box: Box, options: CutOptions) -> str | None:
    """A doubt if the object is much smaller than its box."""
    rows, columns = (np.count_nonzero((mask > 127).any(axis)) for axis in (1, 0))
    small = rows * columns < options.fills * box[2] * box[3]
    return "its outline fills little of the box" if small else None


def _corners(box: Box) -> Box:
    x, y, width, height = box
    return x, y, x + width, y + height


def find_doubt(mask: np.ndarray, most: int = 1, options: CutOptions = DEFAULTS.cut) -> str | None:
    """A reason why a mask uint8 [H, W] is probably no object, None if there is none.

    most: sides of the picture that an object may touch.
    """
    height, width = mask.shape
    scale = min(1.0, options.side / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    inside = np.asarray(Image.fromarray(mask).resize(size, Image.Resampling.BOX)) > 127
    sides = sum(
        line.mean() > options.touched
        for line in (inside[0], inside[-1], inside[:, 0], inside[:, -1])
    )
    if sides > most:
        return "its outline touches the border of the picture"
    length = np.count_nonzero(inside & ~ndimage.binary_erosion(inside))
    return (
        "its outline is ragged" if length**2 > options.ragged * np.count_nonzero(inside) else None
    )


@functools.lru_cache(1)
def _rembg_session() -> Any:
    import rembg

    note(
        f"rembg cuts out photographs with {REMBG}: 180 MB, loaded from the internet if not there yet"
    )
    return rembg.new_session(REMBG)


def _ask_rembg(colors: np.ndarray, box: Box | None) -> np.ndarray:
    import rembg

    height, width = colors.shape[:2]
    left, top, right, bottom = place_view(_corners(box or (0, 0, width, height)), width, height)
    part = Image.fromarray(colors[top:bottom, left:right])
    found = rembg.remove(part, session=_rembg_session(), only_mask=True)
    mask = np.zeros((height, width), np.uint8)
    mask[top:bottom, left:right] = 255 * (np.asarray(found) > 127)
    return mask if box is None else _within(mask, box)


def _within(mask: np.ndarray, box: Box) -> np.ndarray:
    """The mask, 0 outside the box."""
    left, top, right, bottom = _corners(box)
    kept = np.zeros_like(mask)
    kept[top:bottom, left:right] = mask[top:bottom, left:right]
    return kept


def is_plain(colors: np.ndarray, options: CutOptions = DEFAULTS.cut) -> bool:
    """Whether a share `options.plain` of the border of a picture uint8 [H, W, 3] has one colour."""
    _, of_border = _differences(colors)
    return bool((of_border < 255 * options.even).mean() > options.plain)


def _differences(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Largest difference of a channel from the border's median, 0 .. 255: of all pixels [H, W], of the border [N]."""
    border = np.concatenate([colors[0], colors[-1], colors[:, 0], colors[:, -1]])
    background = np.median(border, axis=0)
    return np.abs(colors - background).max(axis=-1), np.abs(border - background).max(axis=-1)


def threshold_mask(colors: np.ndarray, options: CutOptions = DEFAULTS.cut) -> np.ndarray:
    """Mask an object on a plain background: uint8 [H, W], 0 or 255.

    colors: uint8 [H, W, 3]. The background colour is the median of the border. A pixel belongs to
    the object if a channel differs from it by more than the tolerance. Holes are filled,
    but for some with the colour of the background, such as the gaps between the rungs of a chair.
    """
    difference, noise = _differences(colors)
    found = difference > 255 * options.tolerance
    inside = ndimage.binary_fill_holes(found)
    holes, count = ndimage.label(inside & ~found)
    numbers = np.arange(1, count + 1)
    plain = (
        ndimage.mean(
            difference <= max(options.jpeg_noise, np.percentile(noise, 90)), holes, numbers
        )
        > options.plain_hole
    )
    share = ndimage.sum(holes > 0, holes, numbers) / max(1, inside.sum())
    seen_through = plain & (share > options.holes[0]) & (share < options.holes[1])
    return 255 * (inside & ~np.isin(holes, numbers[seen_through])).astype(np.uint8)


def check_box(box: Box, width: int, height: int) -> None:
    """Raise ValueError if a box exceeds or fills a picture."""
    x, y, w, h = box
    if w < 2 or h < 2 or x < 0 or y < 0 or x + w > width or y + h > height:
        raise ValueError(
            f"the box {box} (x, y, width, height) must lie within the {width}x{height} pixels"
        )
    if w == width and h == height:
        raise ValueError(
            "the box covers the whole picture; leave some background around the object"
        )


def cut_out(
    colors: np.ndarray, box: Box | None = None, options: CutOptions = DEFAULTS.cut
) -> tuple[np.ndarray, float]:
    """The mask uint8 [H, W], 0 or 255, of the main object of a photograph or of a box, and its sureness.

    colors: uint8 [H, W, 3]. Pixels outside the box are background. A network finds the object
    (`find_object`), and GrabCut decides where it is not certain. The sureness, in 0 .. 1, is the
    soft IoU of the mask and the network's probabilities; without a box it is smaller if the mask
    may be a part of a larger thing. Raises ValueError without OpenCV, or if the box exceeds or
    fills the picture.
    """
    height, width = colors.shape[:2]
    if box is not None:
        check_box(box, width, height)
    view, logits = find_object(colors, box and _corners(box))
    if box is not None and logits.max() < 0:  # the box says that something is there
        logits = logits - np.quantile(logits, 1 - options.boxed)
    left, top, right, bottom = view
    part = Image.fromarray(colors).crop(view)
    part.thumbnail((options.side, options.side), Image.Resampling.BOX)
    finer = Image.fromarray(logits).resize(part.size, Image.Resampling.BILINEAR)
    chance = expit(np.asarray(finer))
    unsure = np.abs(chance - 0.5) < options.certain - 0.5
    inside = _only_object(_grab_cut(np.asarray(part), chance > 0.5, unsure, options), options)
    sureness = np.minimum(chance, inside).sum() / np.maximum(chance, inside).sum()
    if box is None and inside.any():
        sureness /= _growth(inside, inside | (chance > options.possible))
    larger = Image.fromarray(255 * inside.astype(np.uint8)).resize(
        (right - left, bottom - top), Image.Resampling.BILINEAR
    )
    mask = np.zeros((height, width), np.uint8)
    mask[top:bottom, left:right] = 255 * (np.asarray(larger) > 127)
    return mask if box is None else _within(mask, box), float(sureness)


def _growth(inside: np.ndarray, possible: np.ndarray) -> float:
    """How many times as wide or high as a mask, bool [H, W], the possible pixels are that touch it."""
    regions, _ = ndimage.label(possible)
    larger = np.isin(regions, np.unique(regions[inside]))
    sides = [[1 + np.ptp(np.flatnonzero(each.any(k))) for k in (0, 1)] for each in (larger, inside)]
    return float(np.divide(*sides).max())


def _parts(inside: np.ndarray, options: CutOptions) -> list[np.ndarray]:
    """The largest connected regions of a mask, bool [H, W]: the object may be smaller than a picture on the wall."""
    regions, _ = ndimage.label(inside, np.ones((3, 3)))
    areas = np.bincount(regions.ravel())
    areas[0] = 0
    largest = np.argsort(-areas)[: options.parts]
    return [regions == number for number in largest if areas[number] > options.part * areas.max()]


def _only_object(inside: np.ndarray, options: CutOptions) -> np.ndarray:
    """A mask, bool [H, W], without specks and without small holes."""
    filled = ndimage.binary_fill_holes(inside)
    holes, _ = ndimage.label(filled & ~inside)
    small = np.bincount(holes.ravel()) < options.small_hole * max(1, np.count_nonzero(filled))
    small[0] = False
    return keep_object(255 * (inside | small[holes]).astype(np.uint8))[0] > 127


def _without_frame(colors: np.ndarray, mask: np.ndarray, options: CutOptions) -> np.ndarray:
    """The mask uint8 [H, W], or another part of it if the largest is an upright rectangle and less probable."""
    parts = _parts(mask > 127, options)
    if len(parts) < 2 or not _is_rectangle(parts[0], options):
        return mask
    (left, top, right, bottom), _ = find_object(colors)
    best = max(parts, key=lambda part: np.count_nonzero(part[top:bottom, left:right]))
    return mask if best is parts[0] else 255 * best.astype(np.uint8)


def _is_rectangle(inside: np.ndarray, options: CutOptions) -> bool:
    """Whether a mask, bool [H, W], fills its box."""
    extent = np.count_nonzero(inside.any(axis=0)) * np.count_nonzero(inside.any(axis=1))
    return np.count_nonzero(inside) > options.rectangle * extent


def correct(
    colors: np.ndarray,
    mask: np.ndarray,
    strokes: np.ndarray,
    options: CutOptions = DEFAULTS.cut,
) -> np.ndarray:
    """A mask uint8 [H, W], 0 or 255, corrected by strokes uint8 [H, W].

    Each pixel of the strokes is KEEP (as in the mask), OBJECT, BACKGROUND or OPEN (GrabCut
    decides). colors: uint8 [H, W, 3]. Raises ValueError without OpenCV.
    """
    inside = np.where(strokes == OBJECT, True, (mask > 127) & (strokes != BACKGROUND))
    unsure = strokes == OPEN
    if unsure.any():
        rows, columns = (np.flatnonzero(unsure.any(axis=axis)) for axis in (1, 0))
        part = tuple(
            slice(max(0, line[0] - options.around), line[-1] + 1 + options.around)
            for line in (rows, columns)
        )
        inside[part] = _grab_cut(colors[part], inside[part], unsure[part], options)
    return 255 * inside.astype(np.uint8)


def _grab_cut(
    colors: np.ndarray, inside: np.ndarray, unsure: np.ndarray, options: CutOptions
) -> np.ndarray:
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
        options.rounds,
        cv2.GC_INIT_WITH_MASK,
    )
    return labels % 2 == 1
