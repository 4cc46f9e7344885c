"""From pixels that a browser sends to a mask and meshes, one message for each step, and the example pictures."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

import nmr
from learn3d.data.conventions import DISTANCE, HALF_FOV_DEG, mesh_to_object
from learn3d.data.framing import check_mask, largest_region, mask_box
from learn3d.fitting.cutting import Box, correct, cut_out, find_mask
from learn3d.make_data.shapes import make_shape
from learn3d.make_data.writers.around import natural_look
from learn3d.pictures.studio import photograph
from learn3d.reconstruction import Model, mesh_bytes, reconstruct_picture

SIDE = 512  # pixels that a picture has at most a side; the networks see 64 to 224
EXAMPLES = {"airplane": 1, "car": 2, "chair": 6, "lamp": 0, "sofa": 3, "table": 7}  # seeds
_MARGIN = 24  # pixels around the object of an example

Tell = Callable[[dict[str, Any]], None]


class Picture(NamedTuple):
    """A picture, and what is known of its object."""

    colors: np.ndarray  # uint8 [H, W, 3]
    mask: np.ndarray  # uint8 [H, W], above 127: object; 255 everywhere: not known
    strokes: np.ndarray | None = None  # uint8 [H, W] as `cutting.correct` has them; None: no corrections
    box: Box | None = None  # around the object


def unpack(content: bytes, width: int, height: int, box: Box | None = None) -> Picture:
    """The picture that a browser sends: R, G, B, mask for each pixel, then possibly a byte of strokes for each.

    Raises ValueError unless it has as many bytes as that.
    """
    pixels = width * height
    if not (0 < width <= SIDE and 0 < height <= SIDE) or len(content) not in (4 * pixels, 5 * pixels):
        raise ValueError(f"a picture of {width} x {height} pixels came in {len(content)} bytes; at most {SIDE} a side")
    given = np.frombuffer(content, np.uint8)
    planes = given[: 4 * pixels].reshape(height, width, 4)
    strokes = given[4 * pixels :].reshape(height, width) if len(given) > 4 * pixels else None
    return Picture(np.ascontiguousarray(planes[..., :3]), planes[..., 3].copy(), strokes, box)


def find_object(picture: Picture) -> tuple[np.ndarray, bool]:
    """The object's mask uint8 [H, W]: by the strokes, as given, or the largest part of what is found in box or picture;
    whether there were other large parts.
    """
    if picture.box is not None:
        return largest_region(cut_out(picture.colors, picture.box))
    if picture.strokes is not None:
        return correct(picture.colors, picture.mask, picture.strokes), False
    return largest_region(find_mask(picture.colors)) if picture.mask.min() == 255 else (picture.mask, False)


def make_meshes(models: Mapping[str, Model], picture: Picture, tell: Tell) -> None:
    """Tell the mask, the progress, and in the end the meshes of all models, or an error as a sentence."""
    try:
        mask, more = find_object(picture)
        tell({"mask": _base64(np.packbits(mask > 127).tobytes()), "more": more})
        try:
            check_mask(mask, cropped=True)
        except ValueError:
            raise ValueError("No object was found. Draw a box around it, or paint it with Add.") from None
        tell({"meshes": [_mesh(label, model, picture.colors, mask, tell) for label, model in models.items()]})
    except ValueError as error:
        tell({"error": str(error)})


def _mesh(label: str, model: Model, colors: np.ndarray, mask: np.ndarray, tell: Tell) -> dict[str, Any]:
    made = reconstruct_picture(model, colors, mask, progress=lambda text, part: tell({"progress": text, "part": part}))
    if not len(made.surface.faces):
        raise ValueError(f"The model {label} makes an empty shape of this picture. Try another picture.")
    angle = np.radians(made.azimuth_deg)
    x, _, z = np.array([np.sin(angle), 0.0, -np.cos(angle)]) @ mesh_to_object()
    glb = mesh_bytes(made.surface, "glb", "object")
    return {
        "label": label,
        "glb": _base64(glb),
        "yaw": float(np.arctan2(x, z)),
        "kind": made.kind,
        "warning": made.warning,
    }


def example(category: str) -> bytes:
    """A PNG of a generated object, cut out, in natural colours, seen half from the front."""
    rng = np.random.default_rng(EXAMPLES[category])
    mesh = make_shape(category, rng)
    vertices = np.float32(mesh.vertices @ mesh_to_object("y", "z").T)
    colors, lights = natural_look(vertices, mesh.faces, rng)
    azimuth = rng.choice([-1, 1]) * rng.uniform(20, 70)
    camera = nmr.LookAt.from_angles(DISTANCE, 22.0, [azimuth], half_fov_deg=HALF_FOV_DEG)
    rgb, alpha = photograph(vertices, mesh.faces, colors, camera, image_size=SIDE, lights=lights)
    left, top, right, bottom = mask_box(alpha[0])
    image = Image.fromarray(np.dstack([rgb[0], alpha[0]]))
    image.crop((left - _MARGIN, top - _MARGIN, right + _MARGIN, bottom + _MARGIN)).save(png := io.BytesIO(), "png")
    return png.getvalue()


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()
