"""Reconstruction: from images with masks to mesh files and pictures of them."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from scipy import ndimage
from torch import Tensor

from learn3d.config import TrainConfig
from learn3d.data.crops import Crops
from learn3d.data.dataset import MASK_SIZE
from learn3d.data.framing import MEAN_OBJECT_SIZE, frame, read_photo
from learn3d.data.layouts import LAYOUTS, Layout, require_folder
from learn3d.data.masks import check_mask, keep_object, mask_box
from learn3d.data.poses import Poses
from learn3d.files.images import resample
from learn3d.files.reading import DamagedFile
from learn3d.methods.mesh_method import MeshMethod
from learn3d.methods.method import Method
from learn3d.networks.encoders import CENTRED_SIZE, centre
from learn3d.pictures import (
    Surface,
    azimuths_deg,
)
from learn3d.runs import checkpoint
from learn3d.settings import split_names
from learn3d.studio.picture_to_mesh.coloring import color_mesh
from learn3d.studio.picture_to_mesh.cutting import Box, find_outline
from learn3d.studio.picture_to_mesh.familiarity import KNOWN_CODES, KnownCodes
from learn3d.studio.picture_to_mesh.fit import Progress, find_view, fit, predict
from learn3d.studio.picture_to_mesh.inflation import inflate
from learn3d.studio.picture_to_mesh.refinement import refine
from learn3d.studio.picture_to_mesh.smoothing import outer_surface
from learn3d.studio.picture_to_mesh.templates import MIRROR, TEMPLATES, Templates, fit_template
from learn3d.studio.picture_to_mesh.write import MeshFormat, Reconstruction, save
from learn3d.terminal import note

SMALL_MODEL = Path(__file__).with_name("small.safetensors")  # the model in the package
# side in pixels to which a photograph is reduced before its object is searched
_SEARCHED_SIDE = 1024
_COLORED = 256  # side in pixels of the picture that gives the colours
_INK = 16  # brightness up to which a pixel is black
_BLACK = 0.7  # share of a drawing's pixels that are black
_GAP = 0.015  # half of the widest gap in a line, as a share of the drawing
_LINES = 0.75  # share of a drawing up to which it consists of lines
_MIN_OBJECT_SIZE = 0.05  # smallest possible object size


class Model(NamedTuple):
    """A trained model, ready to turn pictures into meshes."""

    method: Method
    config: TrainConfig
    object_size: float  # `ViewDataset.mean_object_size` of its training images
    known_codes: KnownCodes | None = None  # None if its file has none
    templates: Templates | None = None  # None if its file has none

    @property
    def categories(self) -> tuple[str, ...]:
        """The categories that it was trained on."""
        return split_names(self.config.category)

    def prepare(self, colors: np.ndarray, mask: np.ndarray, *, crop: bool = True) -> np.ndarray:
        """Call `prepare_image` with the image size, object size and layout of these networks."""
        size, layout = self.method.image_size, self.config.layout
        return prepare_image(
            colors, mask, crop=crop, object_size=self.object_size, size=size, layout=layout
        )


def load_model(run: Path | None, which: str = "last") -> Model:
    """The model of a run folder or checkpoint file, or the model in the package if `run` is None."""
    path = checkpoint.find(run or SMALL_MODEL, which)
    method, config, metadata = checkpoint.load_method(path)
    tensors = checkpoint.load(path)[0]
    stored = ((KnownCodes, KNOWN_CODES), (Templates, TEMPLATES))
    parts = [
        kind(*map(tensors.get, names)) if names[0] in tensors else None for kind, names in stored
    ]
    categories = len(split_names(config.category))
    if not all(part is None or part.fits(categories) for part in parts):
        raise DamagedFile(path, "has known codes or templates of other shapes than its categories")
    return Model(method, config, metadata.progress.object_share or MEAN_OBJECT_SIZE, *parts)


def cut_out_pictures(model: Model, folder: Path) -> Tensor:
    """All PNG files with transparency in a folder as stored images uint8 [M, 4, S, S]. ValueError if there are none."""
    files = sorted(folder.rglob("*.png"))
    if not files:
        raise ValueError(f"there is no PNG file in {folder}; give a folder of cut-out pictures")
    photos = ((colors, keep_object(mask)[0]) for colors, mask in map(read_photo, files))
    return torch.from_numpy(np.stack([model.prepare(*photo) for photo in photos]))


def reconstruct_files(
    run: Path | None,
    folder: Path,
    images: Sequence[Path],
    masks: Sequence[Path] = (),
    *,
    crop: bool = True,
    box: Box | None = None,
    refined: bool = True,
    category: str | None = None,
    guesses: int = 1,
    which: str = "last",
    mesh_format: MeshFormat = "glb",
) -> list[Path]:
    """Reconstruct image files with the networks of a run (see `load_model`) and save the results in `folder`.

    masks: a file for each image. Without them the object is searched in images without
    transparency, and in all of them with a `box` (see `cutting`). refined, category, guesses: see
    `reconstruct_guesses`. Returns the files, named after the images, with "-2" and so on for
    further guesses (see `save`). Raises ValueError if a mask is empty, or if a result would
    replace an input file. A file that cannot be used is an error after all others are done.
    """
    names = check_files(folder, images, masks)
    model = load_model(run, which)
    if category is not None:
        check_category(model, category)
    paths, faults = [], []
    for name, image, mask in zip(names, images, masks or [None] * len(images), strict=True):
        try:
            photo = _read(image, mask, box)
        except (ValueError, OSError) as error:
            faults.append(error)
            continue
        options = {"crop": crop, "refined": refined, "category": category, "guesses": guesses}
        made = list(reconstruct_guesses(model, *photo, **options))
        if made[0].warning:
            note(f"warning: {name}: {made[0].warning}")
        elif made[0].kind:
            note(f"{name}: category {', '.join(each.kind for each in made)}")
        names = [name, *(f"{name}-{k}" for k in range(2, len(made) + 1))]
        paths += save(folder, names, made, model.config.layout, mesh_format)
    for error in faults[1:]:
        note(f"error: {error}")
    if faults:
        raise faults[0]
    return paths


def check_files(folder: Path, images: Sequence[Path], masks: Sequence[Path]) -> list[str]:
    """Names of the results of images. ValueError if a result would replace a file, or if a mask is missing."""
    if masks and len(masks) != len(images):
        raise ValueError(
            f"there are {len(images)} images but {len(masks)} masks; give one mask per image, or none"
        )
    names = [Path(image).stem for image in images]
    if len(set(names)) < len(names):
        names = [f"{number:03}_{name}" for number, name in enumerate(names)]
    given = {Path(path).resolve() for path in (*images, *masks)}
    if taken := [name for name in names if Path(folder, f"{name}.png").resolve() in given]:
        raise ValueError(
            f"{taken[0]}.png would replace an image that was given; give another --output"
        )
    return names


def reconstruct_dataset(
    run: Path | None,
    folder: Path,
    data: Path,
    indices: Sequence[int],
    *,
    category: str | None = None,
    split: str = "test",
    which: str = "last",
    refined: bool = False,
    mesh_format: MeshFormat = "glb",
) -> list[Path]:
    """Reconstruct images of a data set (indices object * views + view) and save the results in `folder`.

    refined: fit the shapes to the masks at the data set's poses; ValueError if it has none.
    Returns the files, named after category, split and index (see `save`).
    """
    require_folder(data)
    model = load_model(run, which)
    dataset = checkpoint.load_data(model.config, split, data=data, category=category)
    batch = dataset.batch(torch.tensor(indices, dtype=torch.int64))
    if refined and batch.poses is None:
        raise ValueError(
            f"the data of {dataset.category} have no poses, which fitting needs; leave out --refine"
        )
    surfaces = reconstruct(
        model.method, batch.images, *((batch.masks, batch.poses) if refined else ())
    )
    stored = batch.images.numpy()
    if batch.poses is None:
        azimuths = [
            input_azimuth_deg(surface, image[3])
            for surface, image in zip(surfaces, stored, strict=True)
        ]
    else:
        azimuths = azimuths_deg(batch.poses).tolist()
    names = [f"{dataset.category}_{split}_{index:06}" for index in indices]
    made = list(map(Reconstruction, surfaces, stored, azimuths))
    return save(folder, names, made, model.config.layout, mesh_format)


@torch.no_grad()
def reconstruct(
    method: Method,
    images: np.ndarray | Tensor,
    masks: Tensor | None = None,
    poses: Poses | None = None,
) -> list[Surface]:
    """Shapes, in the object frame, of stored images uint8 [B,4,S,S], for example from `prepare_image`.

    With masks float32 [B,64,64] and poses, the shapes are fitted to them; ValueError if the
    method predicts voxels.
    """
    images = torch.as_tensor(images)
    if poses is not None:
        return refine(method, images, masks, poses).surfaces()
    return method.decode(method.encode(images)).surfaces()


def _read(
    path: Path, mask_path: Path | None = None, box: Box | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Colours uint8 [H,W,3] and a checked mask uint8 [H,W]: from the file, from `mask_path`, or found in the image."""
    colors, mask = read_photo(path, mask_path, optional=True)
    if max(colors.shape[:2]) < MASK_SIZE:
        size = f"{colors.shape[1]}x{colors.shape[0]} pixels"
        note(
            f"note: {path} has {size}, fewer than the {MASK_SIZE} of training; expect a rough shape"
        )
    searched = mask is None or box is not None  # a box counts even if the file has transparency
    doubt = None
    if searched:
        if box is None:
            photo = Image.fromarray(colors)
            photo.thumbnail((_SEARCHED_SIDE, _SEARCHED_SIDE))
            colors = np.asarray(photo)
        mask, how, doubt = find_outline(colors, box)
        if box is None:
            wrong = "if the outline in the strip of views is wrong, give --box or --masks"
            note(f"note: {path} has no transparency, so the object was searched, {how}; {wrong}")
    advice = "Give --box or --masks, or cut the object out (transparency)"
    try:
        check_mask(mask, cropped=not searched)
    except ValueError as error:
        missed = f"no object was found in this photograph. {advice}"
        raise ValueError(f"{mask_path or path}: {missed if searched else error}") from None
    if doubt:
        raise ValueError(f"{path}: no object was found for certain: {doubt}. {advice}")
    mask, left_out = keep_object(mask)
    if left_out:
        note(f"note: {path}: {left_out}")
    return colors, mask


def prepare_image(
    colors: np.ndarray,
    mask: np.ndarray,
    *,
    crop: bool = True,
    object_size: float = MEAN_OBJECT_SIZE,
    size: int = 64,
    layout: Layout = "kato",
) -> np.ndarray:
    """Turn colours uint8 [H,W,3] and a mask uint8 [H,W] into a stored image uint8 [4,size,size] of a layout.

    The background becomes white. crop: centre the object in a square, so that its larger side
    takes `object_size` of it; without, the picture must be framed like that already and is only
    padded to a square and scaled. Colours are inverted if the layout inverts them. Layouts with
    stretched images (Pascal3D+) keep the background, and `crop` cuts out the mask's box as their
    reader does (`learn3d.data.crops`).

    Raises ValueError if the mask has no pixel above half.
    """
    if LAYOUTS[layout].stretched:
        height, width = mask.shape
        left, top, right, bottom = mask_box(mask) if crop else (0, 0, width, height)
        box = np.array([[left, top, right - left, bottom - top]])
        planes = (colors, np.repeat(mask[..., None], 3, axis=2))
        cut, cut_mask = (
            Crops.from_images([np.ascontiguousarray(p)], box, size).cut()[0] for p in planes
        )
        return np.concatenate([cut, cut_mask[:1]])
    object_size = max(object_size, _MIN_OBJECT_SIZE) if crop else None
    return frame(colors, mask, size, object_size=object_size, inverted=LAYOUTS[layout].inverted)


def reconstruct_picture(
    model: Model,
    colors: np.ndarray,
    mask: np.ndarray,
    *,
    crop: bool = True,
    refined: bool = True,
    category: str | None = None,
    progress: Progress = lambda *_: None,
) -> Reconstruction:
    """The first of `reconstruct_guesses`."""
    options = {"crop": crop, "refined": refined, "category": category, "progress": progress}
    return next(reconstruct_guesses(model, colors, mask, **options))


@torch.no_grad()
def reconstruct_guesses(
    model: Model,
    colors: np.ndarray,
    mask: np.ndarray,
    *,
    crop: bool = True,
    refined: bool = True,
    category: str | None = None,
    smooth: bool = False,
    guesses: int = 1,
    progress: Progress = lambda *_: None,
) -> Iterator[Reconstruction]:
    """Reconstruct a picture uint8 [H, W, 3] with its mask uint8 [H, W]; its camera is unknown.

    refined: fit camera, shape and colours to the picture; methods with voxels only predict.
    category: the object's, None if unknown. With a known one there is no warning.
    smooth: inflate the outline instead of predicting a shape.
    guesses: largest number of different shapes, the best first; a model without templates makes
    one.
    progress: called with the name of each stage and the share that is done.

    Raises ValueError if the model was not trained on the category, or if guesses is below 1.
    """
    if guesses < 1:
        raise ValueError(f"guesses must be at least 1, got {guesses}")
    if category is not None:
        check_category(model, category)
    colors, mask = fill_drawing(colors, mask)
    method, stored = model.method, model.prepare(colors, mask, crop=crop)
    image = torch.from_numpy(stored)
    if not refined or not isinstance(method, MeshMethod):
        (surface,) = reconstruct(method, image[None])
        found = method.view_probabilities(image[None])
        azimuth_deg = input_azimuth_deg(surface, stored[3], None if found is None else found[0])
        yield Reconstruction(surface, stored, azimuth_deg)
        return
    framed = enlarge(colors, mask)
    mask = reduce_mask(framed[3])
    progress("camera", 0.0)
    predicted = predict(method, image, mask)
    kind, warning = (category, None) if category else recognize(model, predicted.code[0])
    if smooth or warning is not None:
        surface, view = inflate(framed)
        iou = float(view.ious(surface.vertices[None], surface.faces, mask))
        yield Reconstruction(surface, stored, 0.0, iou, None, None if smooth else warning, view)
        return
    templates = model.templates
    if templates is None:
        fitted = fit(method, predicted, mask, progress)
        mesh = outer_surface(fitted.vertices, fitted.faces)
        progress("colours", 0.9)
        surface = color_mesh(mesh, fitted.view, framed, method.generator.reflection)
        yield Reconstruction(
            surface,
            stored,
            float(fitted.view.azimuth_deg),
            fitted.iou,
            kind,
            warning,
            fitted.view,
        )
        return
    options = {"category": category, "guesses": guesses}
    for fitted, kind in fit_template(
        templates, model.categories, predicted, framed, mask, progress, **options
    ):
        progress("colours", 0.9)
        mesh = fitted.vertices, fitted.faces
        surface = color_mesh(mesh, fitted.view, framed, MIRROR, fine=True)
        azimuth_deg = float(fitted.view.azimuth_deg)
        yield Reconstruction(
            surface, stored, azimuth_deg, fitted.iou, kind, warning=None, view=fitted.view
        )


def check_category(model: Model, category: str) -> None:
    """Raise ValueError if the model was not trained on a category."""
    if category not in model.categories:
        known = ", ".join(model.categories)
        raise ValueError(
            f"the model was trained on {known}, not on {category!r}; give one of its categories, or none"
        )


def recognize(model: Model, code: Tensor) -> tuple[str | None, str | None]:
    """Predicted category of a picture's code [C], and a warning if it is that of an unknown kind of object.

    The category is None if the model has only one.
    """
    if model.known_codes is None:
        return None, None
    kinds = model.categories
    kind = kinds[model.known_codes.nearest_kind(code)] if len(kinds) > 1 else None
    if not model.known_codes.is_strange(code):
        return kind, None
    known = ", ".join(kinds)
    advice = "so its outline was inflated, and its back is its front; check the outline"
    return kind, f"this looks like nothing that the model was trained on ({known}), {advice}"


def enlarge(colors: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A picture uint8 [H, W, 3] and its mask as uint8 [4, 256, 256] on white, with the object centred and large."""
    return frame(colors, mask, _COLORED, object_size=CENTRED_SIZE, inverted=False)


def fill_drawing(colors: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add the white areas between the black lines of a drawing to its mask.

    colors, mask: uint8 [H, W, 3] and [H, W]. Lines may have small gaps. Pictures other than
    drawings of lines stay as they are. Returns colours on white, and the mask.
    """
    inside = mask > 127
    if not inside.any() or np.quantile(colors[inside].mean(1), _BLACK) > _INK:
        return colors, mask
    left, top, right, bottom = mask_box(mask)
    gap = math.ceil(_GAP * max(right - left, bottom - top))
    padded = np.pad(inside, gap + 1)
    near = ndimage.distance_transform_edt(~padded) <= gap
    closed = padded | (ndimage.distance_transform_edt(near) > gap)
    solid = ndimage.binary_fill_holes(closed)[gap + 1 : -gap - 1, gap + 1 : -gap - 1]
    if inside.sum() > _LINES * solid.sum():
        return colors, mask
    alpha = mask[..., None] / 255
    on_white = (alpha * colors + 255 * (1 - alpha)).round().astype(np.uint8)
    return on_white, np.where(solid, np.uint8(255), mask)


def reduce_mask(mask: np.ndarray) -> Tensor:
    """A mask uint8 [S, S] as float32 [64, 64] in 0 .. 1."""
    return torch.from_numpy(resample(mask[None].astype(np.float32), MASK_SIZE)[0]) / 255


@torch.no_grad()
def input_azimuth_deg(
    surface: Surface, mask: np.ndarray, probabilities: Tensor | None = None
) -> float:
    """Azimuth, in degrees, from which the shape's silhouette fits the mask uint8 [S,S] of its image best.

    A guess, since elevation and distance are unknown; 0 for an empty shape. probabilities: see
    `find_view`.
    """
    if not len(surface.faces):
        return 0.0
    target = centre(reduce_mask(mask)[None, None])[0, 0]
    return float(find_view(surface.vertices, surface.faces, target, probabilities)[0].azimuth_deg)
