"""From a photograph with a mask to the square image that a network sees, and the camera that sees it so.

Cutting a square out of a photograph somewhere off its centre makes another projection of it: the camera then no longer
looks along the optical axis. Two ways keep the camera model right. "whole" pads the photograph to a square around its
centre: the camera must have been aimed at the middle of the object. "object" turns the camera on the spot until it
looks at the object, and zooms: both change the picture by a homography, which no depth enters. It takes the camera to
have been held level, and the middle of the mask's box for the middle of the object, which is wrong by some 3 % of the
picture from 2.6 lengths of the object away and by 1 % from 8.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from PIL import Image, ImageOps

from learn3d.files import limits, sandbox
from learn3d.files.findings import DamagedFile
from learn3d.files.images import PHOTOGRAPHS, open_image

Framing = Literal["whole", "object"]
OBJECT_SHARE = 0.65  # of the side of the square that the object takes with "object", about what Kato's renderings have
TOLERANCE = 0.12  # of colours, for `threshold_mask`
_MEMORY_PER_PIXEL = 40  # bytes, for masking and framing
_PIXELS_PER_SECOND = 2e7
_SUPERSAMPLE = 4  # pixels, per side, that are averaged to one where the camera is turned


def read_photo(path: Path, mask_path: Path | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Colours uint8 [H, W, 3] and mask uint8 [H, W] of an image file and a mask file, or of an image with transparency.

    Both are turned upright (EXIF). A mask file is its transparency where it has some, else grey: white is the object.
    Raises FileNotFoundError, and ValueError for what cannot be read, no mask at all, and sizes that differ.
    """
    return sandbox.read(_read, Path(path), mask_path, wanted="a photograph")


def read_picture(path: Path, most_side: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Colours uint8 [H, W, 3] and transparency uint8 [H, W] of an image file, upright; None: nothing is transparent.

    Made smaller where a side has more than `most_side` pixels. Raises FileNotFoundError, and ValueError for what cannot
    be read.
    """
    return sandbox.read(_read_picture, Path(path), most_side, wanted="a photograph")


class Framed(NamedTuple):
    """A photograph as a network sees it."""

    image: np.ndarray  # uint8 [4, size, size], in Kato's form
    mask: np.ndarray  # uint8 [64, 64]
    half_fov_deg: float
    box: tuple[int, int, int, int]  # of the mask in the photograph: left, top, right, bottom (excluded)
    shape: tuple[int, int]  # of the photograph: height, width


def read_framed(
    path: Path, mask_path: Path | None, fov_deg: float, elevation_deg: float, framing: Framing, size: int, small: int
) -> Framed:
    """For worker processes: a photograph read, checked and framed (`frame`), and its mask at another size."""
    colors, mask = _read(path, mask_path)
    try:
        check_mask(mask)
    except ValueError as error:
        raise DamagedFile(path, str(error)) from None
    camera = fov_deg, elevation_deg, framing
    image, half_fov = frame(colors, mask, *camera, size)
    small_mask = image[3] if size == small else frame(colors, mask, *camera, small)[0][3]
    return Framed(image, small_mask, half_fov, mask_box(mask), mask.shape)


def _read_picture(path: Path, most_side: int) -> tuple[np.ndarray, np.ndarray | None]:
    image = _open_photo(path)
    alpha = _transparency(image)
    image = image.convert("RGBA")
    image.thumbnail((most_side, most_side))
    pixels = np.asarray(image)
    return pixels[..., :3], None if alpha is None else pixels[..., 3]


def _open_photo(path: Path) -> Image.Image:
    image = _open(path)
    if image.mode.startswith(("I", "F")):  # Pillow would make white of all that is above 255
        raise DamagedFile(path, f"has more than 8 bits a pixel and channel ({image.mode}); save it with 8")
    return image


def _read(path: Path, mask_path: Path | None) -> tuple[np.ndarray, np.ndarray]:
    image = _open_photo(path)
    if mask_path is None:
        mask = _transparency(image)
        if mask is None:
            raise DamagedFile(
                path,
                "has no transparency and no mask: give a mask image, white where the object is "
                "(reconstruct: --masks, or --plain-background)",
            )
    else:
        mask_image = _open(mask_path)
        mask = _transparency(mask_image)
        if mask is None:
            mask = np.asarray(mask_image.convert("L"))
        if mask_image.size != image.size:
            sizes = [f"{i.size[0]}x{i.size[1]}" for i in (mask_image, image)]
            turned = mask_image.size == image.size[::-1]
            raise DamagedFile(
                path,
                f"has {sizes[1]} pixels, its mask {mask_path} has {sizes[0]}"
                + (": it lies on its side; the photo's EXIF data says how it is turned" if turned else ""),
            )
    return np.asarray(image.convert("RGBA"))[..., :3], mask


def check_mask(mask: np.ndarray, *, cropped: bool = False) -> None:
    """Raise ValueError for a mask [H, W] that is empty, full, or probably black where the object is.

    cropped: the picture may end where the object does, so that much of its border is object.
    """
    inside = mask > 127
    if not inside.any():
        raise ValueError("its mask is empty: no pixel is brighter than half; white must be the object")
    if inside.all():
        raise ValueError("its mask is all white: white must be the object, black the background")
    border = np.concatenate([inside[0], inside[-1], inside[:, 0], inside[:, -1]])
    if border.mean() > (max(0.5, inside.mean()) if cropped else 0.5):
        raise ValueError(
            f"its mask covers {border.mean():.0%} of the border; is it black where the object is, or is the background "
            "in it?"
        )


def threshold_mask(colors: np.ndarray, tolerance: float = TOLERANCE) -> np.ndarray:
    """The largest region, without its holes, whose colour is not that of the picture's border: uint8 [H,W], 0 or 255.

    colors: uint8 [H,W,3]. The background's colour is the median of the border; what differs from it by less than
    `tolerance` (0 .. 1, of the largest difference in any channel) is background.
    """
    from scipy import ndimage  # here, as workers import this module

    border = np.concatenate([colors[0], colors[-1], colors[:, 0], colors[:, -1]])
    difference = np.abs(colors - np.median(border, axis=0)).max(axis=2)
    regions, count = ndimage.label(difference > 255 * tolerance)
    if count == 0:
        return np.zeros(colors.shape[:2], np.uint8)
    largest = regions == 1 + np.bincount(regions.ravel())[1:].argmax()
    return 255 * ndimage.binary_fill_holes(largest).astype(np.uint8)


def mask_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Left, top, right, bottom (excluded) of the pixels above half."""
    rows, columns = (np.flatnonzero((mask > 127).any(axis=axis)) for axis in (1, 0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def frame(
    colors: np.ndarray, mask: np.ndarray, fov_deg: float, elevation_deg: float, framing: Framing, size: int
) -> tuple[np.ndarray, float]:
    """The network's image uint8 [4, size, size], in Kato's form, and half of its field of view in degrees.

    Kato's form: 255 - colour over white, so that all but the object is 0; then the mask. fov_deg: full field of view
    across the longer side of the photograph, whose optical axis meets its centre. elevation_deg: of the camera, seen
    from the object; "object" needs it to keep the picture upright, and takes the camera to have been held level.
    """
    alpha = mask[..., None].astype(np.float32) / 255
    stored = np.concatenate([np.rint((255 - colors) * alpha).astype(np.uint8), mask[..., None]], axis=2)
    if framing == "whole":
        return _square(stored, size), fov_deg / 2
    return _turned(stored, fov_deg, elevation_deg, size)


def _square(stored: np.ndarray, size: int) -> np.ndarray:
    """Padded with 0 to a square around the centre, and averaged down."""
    height, width = stored.shape[:2]
    side = max(height, width)
    x, y = (side - width) / 2, (side - height) / 2  # half pixels where the difference is odd
    pad_x, pad_y = math.ceil(x), math.ceil(y)
    padded = np.pad(stored, ((pad_y, pad_y), (pad_x, pad_x), (0, 0)))
    return _shrink(padded, (pad_x - x, pad_y - y, pad_x - x + side, pad_y - y + side), size)


def _shrink(stored: np.ndarray, box: tuple[float, float, float, float], size: int) -> np.ndarray:
    """The box (left, top, right, bottom) as [4, size, size]; each pixel is the mean of what it covers."""
    method = Image.Resampling.BOX if box[2] - box[0] >= size else Image.Resampling.BILINEAR
    bands = (Image.fromarray(np.ascontiguousarray(stored[..., c])) for c in range(stored.shape[2]))
    return np.stack([np.asarray(band.resize((size, size), method, box)) for band in bands])


def _turned(stored: np.ndarray, fov_deg: float, elevation_deg: float, size: int) -> tuple[np.ndarray, float]:
    """Seen by a camera at the same place whose picture has the mask's box in its middle, as large as it is to be.

    Camera axes: x right, y down, z forward; rows of `turn` are the new camera's axes in those of the old.
    """
    height, width = stored.shape[:2]
    focal = max(height, width) / 2 / math.tan(math.radians(fov_deg) / 2)  # pixels
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    outline = _outline(stored[..., 3] > 127)
    rays = np.linalg.inv(intrinsics) @ np.concatenate([outline, np.ones((len(outline), 1))], axis=1).T
    middle = np.array([0.0, 0.0, 1.0])
    for _ in range(6):  # the middle of the box is another one once the camera has turned: it soon comes to rest
        turn = _turn(middle[0] / middle[2], middle[1] / middle[2], elevation_deg)
        points = (turn @ rays)[:2] / (turn @ rays)[2]
        middle = turn.T @ np.append((points.min(axis=1) + points.max(axis=1)) / 2, 1.0)
    tangent = np.abs(points).max() / OBJECT_SHARE

    side = size * _SUPERSAMPLE
    reduction = max(1, int(2 * tangent * focal / side))  # of the photograph, so that no pixel is skipped
    output = np.array([[side / 2 / tangent, 0, side / 2], [0, side / 2 / tangent, side / 2], [0, 0, 1]])
    matrix = np.diag([1 / reduction, 1 / reduction, 1]) @ intrinsics @ turn.T @ np.linalg.inv(output)
    coefficients = (matrix / matrix[2, 2]).reshape(-1)[:8].tolist()
    method = {"method": Image.Transform.PERSPECTIVE, "data": coefficients, "resample": Image.Resampling.BILINEAR}
    bands = (Image.fromarray(np.ascontiguousarray(stored[..., c])).reduce(reduction) for c in range(4))
    seen = np.stack([np.asarray(band.transform((side, side), **method)) for band in bands], axis=2)
    return _shrink(seen, (0, 0, side, side), size), math.degrees(math.atan(tangent))


def _turn(x: float, y: float, elevation_deg: float) -> np.ndarray:
    """Axes [3, 3] of a camera that looks along (x, y, 1) and keeps the world upright.

    The old camera is held level, tilted down by some angle p: up is (0, -cos p, -sin p). The ray to the object falls by
    the elevation e: -up . (x, y, 1) = y cos p + sin p = |(x, y, 1)| sin e, from which p follows.
    """
    forward = np.array([x, y, 1.0])
    length = np.linalg.norm(forward)
    sine = length * math.sin(math.radians(elevation_deg)) / math.hypot(y, 1)
    tilt = math.asin(min(1.0, max(-1.0, sine))) - math.atan(y)
    up = np.array([0.0, -math.cos(tilt), -math.sin(tilt)])
    forward = forward / length
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _outline(inside: np.ndarray) -> np.ndarray:
    """Corners (x, y) [P, 2] of the first and last pixel of every row and column: their hull is the mask's."""
    points = []
    for mask, order in ((inside, (1, 0)), (inside.T, (0, 1))):
        lines = np.flatnonzero(mask.any(axis=1))
        for ends in (mask[lines].argmax(axis=1), mask.shape[1] - 1 - mask[lines, ::-1].argmax(axis=1)):
            points.append(np.stack([lines, ends], axis=1)[:, order])
    pixels = np.concatenate(points)
    return np.concatenate([pixels + corner for corner in ((0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0))])


def _open(path: Path) -> Image.Image:
    """The image, upright: cameras write the pixels as they lie on the sensor, and the turn into the EXIF data."""
    image = open_image(path, PHOTOGRAPHS, limits.IMAGE_SIDE)
    sandbox.allow(_MEMORY_PER_PIXEL * image.width * image.height, image.width * image.height / _PIXELS_PER_SECOND)
    try:
        return ImageOps.exif_transpose(image)
    except Exception:  # its EXIF data are damaged: whatever Pillow's parser raises, the picture itself is sound
        return image


def _transparency(image: Image.Image) -> np.ndarray | None:
    """The alpha channel uint8 [H, W], None where there is none or nothing is transparent."""
    if not image.has_transparency_data:
        return None
    alpha = np.asarray(image.convert("RGBA"))[..., 3]
    return None if alpha.min() == 255 else alpha
