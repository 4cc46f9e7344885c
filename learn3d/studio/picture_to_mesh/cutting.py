"""Outlines of objects in photographs: by the colour of a plain background, by rembg, or by GrabCut (OpenCV)."""

import functools
import importlib.util
import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.color import rgb2lab
from skimage.filters import threshold_otsu
from skimage.segmentation import felzenszwalb

from learn3d.data.masks import keep_object, mask_box

SIDE = 384  # longer side in pixels of the picture for GrabCut
INSET = 0.03  # width of the background border without a box, as a share of the picture's sides
PLAIN = 0.9  # least share of the border with one colour in pictures with a plain background
TOLERANCE = 0.12  # largest difference from the background's colour, in 0 .. 1
JPEG_NOISE = 6  # levels by which compression changes the background near an object
# A hole of the mask shows the background if more than this share of it has the background's colour.
PLAIN_HOLE = 0.5
# Its least and largest size, as a share of the object; larger holes are often white table tops.
HOLES = 0.001, 0.4
KEEP, OBJECT, BACKGROUND, OPEN = range(4)  # labels of pixels in strokes
_ROUNDS, _ROUNDS_FROM_GUESS, _ROUNDS_IN_STROKES = 5, 3, 2
_AROUND = 16  # width in pixels of the region around the strokes that GrabCut sees

# bands of rows; a pixel is compared with the background of its own band and its neighbours
_BANDS = 12
_SAMPLES = 600  # pixels of the background in a band
_SHADES = 0.88, 0.76, 0.65, 0.55, 0.46  # brightness of the background in shadows of different depth
_SHADED_FROM = 0.4  # height in the picture, from the top, below which there are shadows
_SHADE_COST = 1.5  # differences are in units of CIELAB, here that of a shadow
_LEAST, _CLEAR, _MOST = 4, 25, 60  # of an object; that is certainly one; beyond which all are alike
_AWAY = 0.04  # gap between an object and its box, as a share of the object's sides
_SMALL_HOLE = 0.002  # smaller holes are filled, as a share of the object
_TOUCHED = 0.03  # share of a side of the picture, from which the object touches it
_PREFERRED = 0.05  # by which GrabCut from the whole region must be judged better
_EXTENT = 2  # weight of the share of its box that an object spans, against that of its own pixels
_PROBABLE = -0.6  # mark of an object that is probably the right one
_RECTANGLE = 0.9  # share of its box that an upright rectangle fills
_UNLIKELY = 0.3  # by which the mark of such a rectangle is worse
_FRAME = 0.05  # least area of a picture on the wall, over that of the mask
_FRAME_FILL = 0.7  # and over that of its own box
_FRAME_WIDTH = 5  # pixels
_OFF_CENTRE = 0.6  # weight of the distance from the centre against the judgement
_PARTS = 3  # parts that may be the object
_PART = 0.1  # their least area, over that of the largest
_RAGGED = 600  # squared length of an outline over its area, in pixels; a thin-legged chair has 200

Box = tuple[int, int, int, int]  # x and y of the upper left corner, width, height, in pixels
#: How well a mask uint8 [H, W] of a picture uint8 [H, W, 3] shows something known; larger is better.
Judge = Callable[[np.ndarray, np.ndarray], float]


class Outline(NamedTuple):
    """An object that was searched in a photograph."""

    mask: np.ndarray  # uint8 [H, W], 0 or 255
    how: str  # how it was found: "by ..."
    doubt: str | None = None  # a reason to ask for a box, None if there is none


def find_outline(colors: np.ndarray, box: Box | None = None, judge: Judge | None = None) -> Outline:
    """Find the object in a photograph uint8 [H, W, 3], and other things beside it.

    With a box: see `cut_out`. If there is no box and the background is plain, the object is
    everything that differs from the border's colour. Otherwise rembg finds it if it is installed,
    and if not, see `cut_out`. Raises ValueError as `cut_out` does, or if rembg fails.
    """
    if box is not None:
        return Outline(cut_out(colors, box), "by GrabCut in the box")
    if is_plain(colors):
        whole = threshold_mask(colors)
        mask = _without_frame(colors, whole, judge)
        how = "as all that differs from the plain background"
        if mask is not whole:
            how = f"{how} but for an upright rectangle, probably a picture on the wall"
    elif importlib.util.find_spec("rembg") is not None:
        mask = _ask_rembg(colors)
        how = "by rembg, which loads its weights from the internet at its first use"
    else:
        mask = cut_out(colors, judge=judge)
        how = "by its difference from the background at the border"
    return Outline(mask, how, find_doubt(keep_object(mask)[0]))


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
    return bool((of_border < 255 * TOLERANCE).mean() > PLAIN)


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


def cut_out(colors: np.ndarray, box: Box | None = None, judge: Judge | None = None) -> np.ndarray:
    """The mask uint8 [H, W], 0 or 255, of the object within a box of a photograph.

    colors: uint8 [H, W, 3]. Pixels outside the box are background (default box: all but a narrow
    border). GrabCut starts with the pixels that are unlike the background at their height
    (`_separate`), and in a given box once more with all pixels (`_cut_in`). Without a box the
    largest parts are tried, each in a box of its own, and the `judge` decides. Raises ValueError
    without OpenCV, or if the box exceeds or fills the picture.
    """
    height, width = colors.shape[:2]
    scale = min(1.0, SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = np.asarray(Image.fromarray(colors).resize(size, Image.Resampling.BOX))
    x, y, w, h = box or (
        INSET * width,
        INSET * height,
        (1 - 2 * INSET) * width,
        (1 - 2 * INSET) * height,
    )
    if w < 2 or h < 2 or x < 0 or y < 0 or x + w > width or y + h > height:
        raise ValueError(
            f"the box {box} (x, y, width, height) must lie within the {width}x{height} pixels"
        )
    region = np.zeros(small.shape[:2], bool)
    region[round(y * scale) : round((y + h) * scale), round(x * scale) : round((x + w) * scale)] = (
        True
    )
    if region.all():
        raise ValueError(
            "the box covers the whole picture; leave some background around the object"
        )
    inside = _choose(small, region, judge) if box is None else _cut_in(small, region)
    mask = Image.fromarray(255 * inside.astype(np.uint8)).resize(
        (width, height), Image.Resampling.BILINEAR
    )
    return 255 * (np.asarray(mask) > 127).astype(np.uint8)


def _separate(colors: np.ndarray, region: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Objects in a region, all bool [H, W]: GrabCut from the pixels that are unlike the background.

    The second mask is that of all pixels that may be unlike the background.
    """
    difference = _difference(colors, ~region)
    least = max(1.5 * np.percentile(difference[~region], 90), _LEAST)
    limit = max(min(threshold_otsu(difference[region].clip(max=_MOST)), _CLEAR), least)
    inside = _grab_cut(colors, region & (difference > limit), region, _ROUNDS_FROM_GUESS)
    unlike = difference > least
    return inside | (ndimage.binary_fill_holes(inside) & unlike), unlike


def _cut_in(colors: np.ndarray, region: np.ndarray) -> np.ndarray:
    """The object that spans a region, both bool [H, W]: the better of two results of GrabCut.

    The first GrabCut starts from the pixels that are unlike the background. The second starts from
    the whole region, and its colours are CIELAB with twice the chroma. The better result spans more
    of the region and has fewer pixels that are like the background.
    """
    started, unlike = _separate(colors, region)
    chromatic = (128 + (rgb2lab(colors) - [50, 0, 0]) * [1, 2, 2]).clip(0, 255).astype(np.uint8)

    def mark(inside: np.ndarray) -> float:
        share = unlike[inside].mean() if inside.any() else 0
        return _EXTENT * _extent(inside) / np.count_nonzero(region) + share

    results = started, _grab_cut(chromatic, region, region, _ROUNDS)
    return max(map(_only_object, results), key=mark)


def _parts(inside: np.ndarray) -> list[np.ndarray]:
    """The largest connected regions of a mask, bool [H, W]: the object may be smaller than a picture on the wall."""
    regions, _ = ndimage.label(inside, np.ones((3, 3)))
    areas = np.bincount(regions.ravel())
    areas[0] = 0
    largest = np.argsort(-areas)[:_PARTS]
    return [regions == number for number in largest if areas[number] > _PART * areas.max()]


def _offset(inside: np.ndarray) -> float:
    """Distance of the centre of a mask, bool [H, W], from that of the picture, in sides of the picture."""
    return float(
        np.hypot(
            *(np.nonzero(inside)[k].mean() / side - 0.5 for k, side in enumerate(inside.shape))
        )
    )


def _difference(colors: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Difference of each pixel, float [H, W], from the colours of the background, bool [H, W], at its height.

    So wall, skirting board and floor are each compared with themselves. Below, the background may
    also be darker: a shadow on the floor.
    """
    height, width = background.shape
    blurred = ndimage.gaussian_filter(colors.astype(np.float32) / 255, (0.8, 0.8, 0))
    lab, rng = rgb2lab(blurred), np.random.default_rng(0)
    edges = np.linspace(0, height, _BANDS + 1).round().astype(int)
    rows, difference = height // _BANDS + 1, np.empty((height, width))
    for low, high in itertools.pairwise(edges):
        near = slice(max(0, low - rows), high + rows)
        samples = blurred[near][background[near]]
        samples = samples[rng.permutation(len(samples))[:_SAMPLES]]
        pixels = lab[low:high].reshape(-1, 3)
        found = _distance(pixels, samples)
        if high > _SHADED_FROM * height:
            shaded = np.concatenate([shade * samples for shade in _SHADES])
            found = np.minimum(found, _distance(pixels, shaded) + _SHADE_COST)
        difference[low:high] = found.reshape(high - low, width)
    return difference


def _distance(pixels: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Mean distance [N] of pixels [N, 3], in CIELAB, to the three nearest samples [M, 3], in RGB."""
    tree, nearest = cKDTree(rgb2lab(samples[None])[0]), np.arange(1, min(3, len(samples)) + 1)
    distance, _ = tree.query(pixels, k=nearest, distance_upper_bound=_MOST)
    return distance.clip(max=_MOST).mean(1)


def _only_object(inside: np.ndarray) -> np.ndarray:
    """A mask, bool [H, W], without specks and without small holes."""
    filled = ndimage.binary_fill_holes(inside)
    holes, _ = ndimage.label(filled & ~inside)
    small = np.bincount(holes.ravel()) < _SMALL_HOLE * max(1, np.count_nonzero(filled))
    small[0] = False
    return keep_object(255 * (inside | small[holes]).astype(np.uint8))[0] > 127


def _around(inside: np.ndarray) -> np.ndarray:
    """The box of a mask, bool [H, W], and a little more, but never the border of the picture."""
    region = np.zeros_like(inside)
    height, width = inside.shape
    left, top, right, bottom = (
        mask_box(255 * inside.astype(np.uint8)) if inside.any() else (0, 0, width, height)
    )
    x, y = (round(_AWAY * side) + 2 for side in (right - left, bottom - top))
    region[
        max(2, top - y) : min(height - 2, bottom + y), max(2, left - x) : min(width - 2, right + x)
    ] = True
    return region


def _extent(inside: np.ndarray) -> int:
    """Area of the box of a mask, bool [H, W], in pixels."""
    return np.count_nonzero(inside.any(axis=0)) * np.count_nonzero(inside.any(axis=1))


def _without_frames(patches: np.ndarray, inside: np.ndarray) -> Iterator[np.ndarray]:
    """A mask, bool [H, W], without each upright rectangle among the numbered patches of one colour [H, W].

    It may be a picture or a window that the object touches or covers in part.
    """
    for number, box in enumerate(ndimage.find_objects(patches), 1):
        part = (patches[box] == number) & inside[box]
        if np.count_nonzero(part) > max(_FRAME * np.count_nonzero(inside), _FRAME_FILL * part.size):
            rest = inside & ~ndimage.binary_dilation(patches == number, iterations=_FRAME_WIDTH)
            yield _only_object(rest)


def _choose(colors: np.ndarray, region: np.ndarray, judge: Judge | None) -> np.ndarray:
    """The most probable object, bool [H, W], in a region: all of it, or a part that is unlike the background.

    If none is probable, it is looked for once more beside these parts.
    """
    whole = _only_object(_grab_cut(colors, region, region, _ROUNDS))
    patches = felzenszwalb(colors, scale=100, min_size=50) + 1
    masks, marks = [whole], [_mark(colors, whole, judge) - _PREFERRED]
    for _ in range(2):
        for part in _parts(_separate(colors, region)[0]):
            mask = _only_object(_separate(colors, _around(part))[0])
            for candidate in (mask, *_without_frames(patches, mask)):
                masks.append(candidate)
                marks.append(_mark(colors, candidate, judge))
            region = region & ~_around(part)
        if max(marks) > _PROBABLE or not region.any():
            break
    return masks[int(np.argmax(marks))]


def _without_frame(colors: np.ndarray, mask: np.ndarray, judge: Judge | None) -> np.ndarray:
    """The mask uint8 [H, W], or another part of it if the largest is an upright rectangle and less probable."""
    parts = _parts(mask > 127)
    if len(parts) < 2 or not _is_rectangle(parts[0]):
        return mask
    best = max(parts, key=lambda part: _mark(colors, part, judge))
    return mask if best is parts[0] else 255 * best.astype(np.uint8)


def _is_rectangle(inside: np.ndarray) -> bool:
    """Whether a mask, bool [H, W], fills its box."""
    return np.count_nonzero(inside) > _RECTANGLE * _extent(inside)


def _mark(colors: np.ndarray, inside: np.ndarray, judge: Judge | None) -> float:
    """How probably a mask, bool [H, W], is the object's: near the centre and known to the judge, or else large."""
    if not inside.any():
        return -math.inf
    mark = judge(colors, 255 * inside.astype(np.uint8)) if judge else float(inside.mean())
    return mark - _OFF_CENTRE * _offset(inside) - _UNLIKELY * _is_rectangle(inside)


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
        inside[part] = _grab_cut(colors[part], inside[part], unsure[part], _ROUNDS_IN_STROKES)
    return 255 * inside.astype(np.uint8)


def _grab_cut(
    colors: np.ndarray, inside: np.ndarray, unsure: np.ndarray, rounds: int
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
        rounds,
        cv2.GC_INIT_WITH_MASK,
    )
    return labels % 2 == 1
