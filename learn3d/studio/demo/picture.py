"""Turns the pixels that a browser sends into a mask and meshes, with a message for each step; example pictures."""

import base64
import io
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

import nmr
from learn3d.data.conventions import DISTANCE, HALF_FOV_DEG, mesh_to_object
from learn3d.data.masks import check_mask, mask_box
from learn3d.networks.encoders import CENTRED_SIZE
from learn3d.pictures import photograph
from learn3d.studio.make_data.looks import PALETTES, natural_look
from learn3d.studio.picture_to_mesh.cutting import Box, Outline, correct, find_outline
from learn3d.studio.picture_to_mesh.fit import LENS_HALF_FOV_DEG
from learn3d.studio.picture_to_mesh.make import Model, reconstruct_guesses
from learn3d.studio.picture_to_mesh.read import keep_parts
from learn3d.studio.picture_to_mesh.write import Reconstruction, mesh_bytes
from learn3d.studio.shapes import make_shape

SIDE = 512  # largest side of a picture in pixels; the networks see 64 to 224
EXAMPLES = {"airplane": 1, "car": 2, "chair": 6, "lamp": 0, "sofa": 3, "table": 7}  # category: seed
GUESSES = 3  # different shapes of one picture among which a visitor can choose
_LEAST = 0.02  # smallest share of a mask that strokes may leave; less is only specks between them
_MARGIN = 24  # pixels around the object of an example

Send = Callable[[dict[str, Any]], None]


class Picture(NamedTuple):
    """A picture, and hints about its object."""

    colors: np.ndarray  # uint8 [H, W, 3]
    mask: np.ndarray  # uint8 [H, W], above 127: object; 255 everywhere if unknown
    # corrections of the mask, uint8 [H, W], see `cutting.correct`
    strokes: np.ndarray | None = None
    box: Box | None = None  # box around the object


def unpack(content: bytes, width: int, height: int, box: Box | None = None) -> Picture:
    """Decode a picture that a browser sends: R, G, B, mask for each pixel, then optionally strokes, a byte per pixel.

    Raises ValueError for a wrong size or number of bytes.
    """
    pixels = width * height
    if not (0 < width <= SIDE and 0 < height <= SIDE) or len(content) not in (
        4 * pixels,
        5 * pixels,
    ):
        raise ValueError(
            f"a picture of {width} x {height} pixels came in {len(content)} bytes; at most {SIDE} a side"
        )
    values = np.frombuffer(content, np.uint8)
    rgba = values[: 4 * pixels].reshape(height, width, 4)
    strokes = values[4 * pixels :].reshape(height, width) if len(values) > 4 * pixels else None
    return Picture(rgba[..., :3], rgba[..., 3], strokes, box)


def outline_object(picture: Picture) -> tuple[Outline, str | None]:
    """The object's outline, and what was left out, see `keep_parts`.

    The mask is the given one, or is found in the box or picture. If it was corrected, nothing is
    left out. Raises ValueError if the correction leaves nearly nothing.
    """
    if picture.box is None and picture.strokes is not None:
        mask = correct(picture.colors, picture.mask, picture.strokes)
        if (mask > 127).sum() < _LEAST * (picture.mask > 127).sum():
            raise ValueError("Almost nothing of the object is left. Paint over a smaller part.")
        return Outline(mask, "by hand"), None
    if picture.box is None and picture.mask.min() < 255:
        outline = Outline(picture.mask, "by the picture's transparency")
    else:
        outline = find_outline(picture.colors, picture.box)
    mask, left_out = keep_parts(picture.colors, outline.mask)
    return outline._replace(mask=mask), left_out


def make_meshes(
    models: Mapping[str, Model],
    picture: Picture,
    send: Send,
    category: str | None = None,
    smooth: bool = False,
) -> None:
    """Send the mask, the progress, the meshes of all models and their further guesses, or an error as a sentence.

    category, smooth: what the visitor says about the object, see `reconstruct_guesses`.
    """
    try:
        outline, left_out = outline_object(picture)
        try:
            check_mask(outline.mask, cropped=True)
        except ValueError:
            send({"error": "No object was found. Drag a box around it.", "tool": "box"})
            return
        mask = _base64(np.packbits(outline.mask > 127).tobytes())
        send({"mask": mask, "how": outline.how, "left_out": left_out})
        if outline.doubt:
            doubt = (
                f"Is this the object? {outline.doubt.capitalize()}. If not, drag a box around it."
            )
            send({"doubt": doubt, "tool": "box"})
        made = {
            label: reconstruct_guesses(
                model,
                picture.colors,
                outline.mask,
                category=category if category in model.categories else None,
                smooth=smooth,
                guesses=GUESSES,
                progress=lambda stage, part: send({"progress": stage, "part": part}),
            )
            for label, model in models.items()
        }
        first = {label: next(guesses) for label, guesses in made.items()}
        if empty := [label for label, each in first.items() if not len(each.surface.faces)]:
            doubt = f"An empty shape was made of this picture by {', '.join(empty)}."
            if len(empty) == len(first):
                raise ValueError(f"{doubt} Try another one.")
            send({"doubt": doubt})
        shown = (each for each in first.items() if each[0] not in empty)
        send({"meshes": [_message(*each) for each in shown]})
        for label, guesses in made.items():
            for guess in guesses:
                send({"guess": _message(label, guess)})
    except ValueError as error:
        send({"error": str(error)})


def _message(label: str, made: Reconstruction) -> dict[str, Any]:
    return {
        "label": label,
        "kind": made.kind,
        "doubt": made.warning,
        "glb": _base64(mesh_bytes(made.surface, "glb", "object")),
        "camera": _camera(made),
    }


def _camera(made: Reconstruction) -> dict[str, Any]:
    """The picture's camera in the mesh's axes: from where it looks, and if it was fitted, all of it."""
    yaw = math.radians(made.azimuth_deg + 90)  # azimuth 0 sees the front, which is at x in the mesh
    if made.view is None:
        return {"yaw": yaw, "pitch": 0.3}
    right, up, forward = made.view.axes()[0].numpy() @ mesh_to_object()
    return {
        "yaw": yaw,
        "pitch": math.radians(float(made.view.elevation_deg)),
        "axes": [right.tolist(), up.tolist(), (-forward).tolist()],
        "distance": float(made.view.log_distance.exp()),
        "shift": made.view.shift[0].tolist(),
        "focus": 0.5 / math.tan(math.radians(LENS_HALF_FOV_DEG)),
        "size": CENTRED_SIZE,
    }


def example(category: str) -> bytes:
    """An example picture as PNG: a generated object in natural colours on transparency, seen obliquely."""
    rng = np.random.default_rng(EXAMPLES[category])
    mesh = make_shape(category, rng)
    vertices = np.float32(mesh.vertices @ mesh_to_object("y", "z").T)
    colors, lights = natural_look(vertices, mesh.faces, rng, PALETTES[category])
    azimuth = rng.choice([-1, 1]) * rng.uniform(20, 70)
    camera = nmr.LookAt.from_angles(DISTANCE, 22.0, [azimuth], half_fov_deg=HALF_FOV_DEG)
    rgb, alpha = photograph(vertices, mesh.faces, colors, camera, image_size=SIDE, lights=lights)
    left, top, right, bottom = mask_box(alpha[0])
    image = Image.fromarray(np.dstack([rgb[0], alpha[0]]))
    image.crop((left - _MARGIN, top - _MARGIN, right + _MARGIN, bottom + _MARGIN)).save(
        png := io.BytesIO(), "png"
    )
    return png.getvalue()


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()
