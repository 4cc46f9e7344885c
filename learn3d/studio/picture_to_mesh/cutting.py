"""Outlines of objects in photographs: by a plain background, by rembg, or by a network and GrabCut (OpenCV)."""

import functools
import importlib.util
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from scipy import ndimage
from scipy.special import expit

from learn3d.data.masks import border_lines, keep_object
from learn3d.studio.picture_to_mesh.options import DEFAULTS, CutOptions
from learn3d.studio.picture_to_mesh.outline_network import Part, find_object, place_view
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

    Thin frames around the picture are left out. With a box, or if the background is not plain,
    rembg finds the object if it is installed, or else `cut_out` does. On a plain background the
    object is everything that differs from the border's colour. Raises ValueError as `check_box`
    and `cut_out` do.
    """
    if box is not None:
        check_box(box, *colors.shape[1::-1])
        mask, how, doubt = _cut_out(colors, box, options)
        return Outline(mask, f"{how} in the box", doubt or _box_doubt(mask, box, options))
    inner = peel_frames(colors, options)
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


def peel_frames(colors: np.ndarray, options: CutOptions = DEFAULTS.cut) -> tuple[slice, slice]:
    """Rows and columns within frames, one in the other, around a plain background; all if there is none.

    A line at some distance from the border is two frames: the margin and the line.
    """
    top, left = 0, 0
    height, width = colors.shape[:2]
    for _ in range(options.frames):
        rows, columns = _peel_frame(colors[top : top + height, left : left + width], options)
        top, left = top + rows.start, left + columns.start
        height, width = rows.stop - rows.start, columns.stop - columns.start
    return slice(top, top + height), slice(left, left + width)


def _peel_frame(colors: np.ndarray, options: CutOptions) -> tuple[slice, slice]:
    """Rows and columns within a frame of one colour, or all."""
    whole = slice(0, colors.shape[0]), slice(0, colors.shape[1])
    frame = np.median(np.concatenate(border_lines(colors)), axis=0)
    different = np.abs(colors - frame).max(2) > 255 * options.even
    # JPEG leaves spots in a frame
    rows, columns = (np.flatnonzero(different.mean(axis) > 0.5) for axis in (1, 0))
    if not (len(rows) and len(columns)):
        return whole
    inner = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    part = colors[inner]
    height, width = different.shape
    widest = max(rows[0], height - inner[0].stop, columns[0], width - inner[1].stop)
    if not 0 < widest <= options.frame * min(height, width) or not is_plain(part, options):
        return whole
    background = np.median(part[[0, -1]].reshape(-1, 3), axis=0)
    is_frame = np.abs(background - frame).max() > 255 * options.tolerance
    object_there = 0 < threshold_mask(part, options).mean() < 255
    return inner if is_frame and object_there else whole


def _cut_out(
    colors: np.ndarray, box: Box | None, options: CutOptions
) -> tuple[np.ndarray, str, str | None]:
    """The mask of the main object, or of the one in a box; how it was found, and a doubt."""
    failed = ""
    if importlib.util.find_spec("rembg") is not None:
        try:
            mask = _ask_rembg(colors, box)
            return mask, f"by rembg ({REMBG})", _disagreement(colors, mask, box, options)
        # weights that cannot be loaded, a version without this network, no onnxruntime
        except (Exception, SystemExit) as error:
            failed = f", as rembg fails ({error})"
    mask, sureness = cut_out(colors, box, options)
    doubt = "the network is not sure of its outline" if sureness < options.sure else None
    return mask, f"by a network and GrabCut{failed}", doubt


def _disagreement(
    colors: np.ndarray, mask: np.ndarray, box: Box | None, options: CutOptions
) -> str | None:
    """A doubt if the package's network sees another object than rembg."""
    view, logits = find_object(colors, box and _corners(box))
    found = Image.fromarray(mask).resize(logits.shape, Image.Resampling.BILINEAR, view)
    seen, found = logits > 0, np.asarray(found) > 127
    both, either = np.count_nonzero(seen & found), np.count_nonzero(seen | found)
    return "two networks see different outlines" if both < options.agreed * either else None


def _box_doubt(mask: np.ndarray, box: Box, options: CutOptions) -> str | None:
    """A doubt if the object is much smaller than its box."""
    small = _extent(mask > 127) < options.fills * box[2] * box[3]
    return "its outline fills little of the box" if small else None


def _extent(inside: np.ndarray) -> int:
    """The number of rows that a mask, bool [H, W], touches, times that of columns."""
    return np.count_nonzero(inside.any(axis=0)) * np.count_nonzero(inside.any(axis=1))


def _corners(box: Box) -> Box:
    x, y, width, height = box
    return x, y, x + width, y + height


def find_doubt(mask: np.ndarray, most: int = 1, options: CutOptions = DEFAULTS.cut) -> str | None:
    """A reason why a mask uint8 [H, W] is probably no object, None if there is none.

    most: sides of the picture that an object may touch.
    """
    small = Image.fromarray(mask)
    small.thumbnail((options.side, options.side), Image.Resampling.BOX)
    inside = np.asarray(small) > 127
    if sum(line.mean() > options.touched for line in border_lines(inside)) > most:
        return "its outline touches the border of the picture"
    area, extent = np.count_nonzero(inside), _extent(inside)
    if area > options.rectangle * extent and extent > options.framed * inside.size:
        return "its outline is an upright rectangle, perhaps a frame"
    length = np.count_nonzero(inside & ~ndimage.binary_erosion(inside))
    return "its outline is ragged" if length**2 > options.ragged * area else None


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
    view = place_view(_corners(box or (0, 0, width, height)), width, height)
    part = Image.fromarray(colors).crop(view)
    found = rembg.remove(part, session=_rembg_session(), only_mask=True)
    return _in_picture(found, view, colors, box)


def _in_picture(found: Image.Image, view: Part, colors: np.ndarray, box: Box | None) -> np.ndarray:
    """The mask uint8 [H, W], 0 or 255, of a picture, from one of a view at any scale; 0 outside the box."""
    left, top, right, bottom = view
    found = found.resize((right - left, bottom - top), Image.Resampling.BILINEAR)
    mask = np.zeros(colors.shape[:2], np.uint8)
    mask[top:bottom, left:right] = 255 * (np.asarray(found) > 127)
    if box is not None:
        x, y, width, height = box
        mask[:y] = mask[y + height :] = mask[:, :x] = mask[:, x + width :] = 0
    return mask


def is_plain(colors: np.ndarray, options: CutOptions = DEFAULTS.cut) -> bool:
    """Whether a share `options.plain` of the border of a picture uint8 [H, W, 3] has one colour."""
    _, of_border = _differences(colors)
    return bool((of_border < 255 * options.even).mean() > options.plain)


def _differences(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Largest difference of a channel from the border's median, 0 .. 255: of all pixels [H, W], of the border [N]."""
    border = np.concatenate(border_lines(colors))
    background = np.median(border, axis=0)
    return np.abs(colors - background).max(axis=-1), np.abs(border - background).max(axis=-1)


def threshold_mask(colors: np.ndarray, options: CutOptions = DEFAULTS.cut) -> np.ndarray:
    """Mask an object on a plain background: uint8 [H, W], 0 or 255.

    colors: uint8 [H, W, 3]. The background colour is the median of the border. A pixel belongs to
    the object if a channel differs from it by more than the tolerance. Holes are filled,
    but for some with the colour of the background, such as the gaps between the rungs of a chair.
    """
    difference, noise = _differences(colors)
    filled, holes, share = _holes(difference > 255 * options.tolerance)
    alike = difference <= max(options.jpeg_noise, np.percentile(noise, 90))
    plain = ndimage.mean(alike, holes, np.arange(len(share))) > options.plain_hole
    seen_through = plain & (share > options.holes[0]) & (share < options.holes[1])
    return 255 * (filled & ~seen_through[holes]).astype(np.uint8)


def _holes(inside: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fill the holes of a mask, bool [H, W].

    Returns the filled mask; the number of the hole at each pixel, int [H, W], 0 where there is
    none; and the area of each hole as a share of the filled mask, inf for number 0.
    """
    filled = ndimage.binary_fill_holes(inside)
    holes, _ = ndimage.label(filled & ~inside)
    share = np.bincount(holes.ravel()) / max(1, np.count_nonzero(filled))
    share[0] = np.inf  # no hole
    return filled, holes, share


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
    may be a part of a larger thing. Raises ValueError without OpenCV.
    """
    view, logits = find_object(colors, box and _corners(box))
    if box is not None and logits.max() < 0:  # the box says that something is there
        logits = logits - np.quantile(logits, 1 - options.boxed)
    part = Image.fromarray(colors).crop(view)
    part.thumbnail((options.side, options.side), Image.Resampling.BOX)
    finer = Image.fromarray(logits).resize(part.size, Image.Resampling.BILINEAR)
    chance = expit(np.asarray(finer))
    unsure = np.abs(chance - 0.5) < options.certain - 0.5
    inside = _only_object(_grab_cut(np.asarray(part), chance > 0.5, unsure, options), options)
    sureness = np.minimum(chance, inside).sum() / np.maximum(chance, inside).sum()
    if box is None and inside.any():
        sureness /= _growth(inside, inside | (chance > options.possible))
    found = Image.fromarray(255 * inside.astype(np.uint8))
    return _in_picture(found, view, colors, box), float(sureness)


def _growth(inside: np.ndarray, possible: np.ndarray) -> float:
    """How many times as wide or high as a mask, bool [H, W], the possible pixels are that touch it."""
    regions, _ = ndimage.label(possible)
    larger = np.isin(regions, np.unique(regions[inside]))
    sides = [[1 + np.ptp(line) for line in np.nonzero(each)] for each in (larger, inside)]
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
    _, holes, share = _holes(inside)
    filled = inside | (share < options.small_hole)[holes]
    return keep_object(255 * filled.astype(np.uint8))[0] > 127


def _without_frame(colors: np.ndarray, mask: np.ndarray, options: CutOptions) -> np.ndarray:
    """The mask uint8 [H, W], or another part of it if the largest is an upright rectangle and less probable."""
    parts = _parts(mask > 127, options)
    if len(parts) < 2 or np.count_nonzero(parts[0]) <= options.rectangle * _extent(parts[0]):
        return mask
    (left, top, right, bottom), _ = find_object(colors)
    best = max(parts, key=lambda part: np.count_nonzero(part[top:bottom, left:right]))
    return mask if best is parts[0] else 255 * best.astype(np.uint8)


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
    inside = (strokes == OBJECT) | (mask > 127) & (strokes != BACKGROUND)
    unsure = strokes == OPEN
    if unsure.any():
        part = tuple(
            slice(max(0, line.min() - options.around), line.max() + 1 + options.around)
            for line in np.nonzero(unsure)
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
    cv2.grabCut(colors, labels, None, None, None, options.rounds, cv2.GC_INIT_WITH_MASK)
    return labels % 2 == 1
