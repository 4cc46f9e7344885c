"""Makes a mesh of a picture with an outline: finds the camera, bends templates, ranks them, colours the best."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from learn3d.config import TrainConfig
from learn3d.data.dataset import MASK_SIZE
from learn3d.data.framing import MEAN_OBJECT_SIZE
from learn3d.data.poses import Poses
from learn3d.files.reading import DamagedFile
from learn3d.methods.mesh_method import MeshMethod
from learn3d.methods.method import Method
from learn3d.networks.encoders import centre
from learn3d.pictures import Surface
from learn3d.runs import checkpoint
from learn3d.settings import split_names
from learn3d.studio.picture_to_mesh.coloring import color_mesh
from learn3d.studio.picture_to_mesh.familiarity import KnownCodes
from learn3d.studio.picture_to_mesh.fit import (
    Fit,
    Prediction,
    Report,
    Target,
    find_view,
    fit,
    frame_target,
    predict,
)
from learn3d.studio.picture_to_mesh.inflation import inflate
from learn3d.studio.picture_to_mesh.options import DEFAULTS, MatchOptions, Options
from learn3d.studio.picture_to_mesh.read import fill_drawing, is_uncoloured, prepare_image
from learn3d.studio.picture_to_mesh.refinement import refine
from learn3d.studio.picture_to_mesh.smoothing import outer_surface
from learn3d.studio.picture_to_mesh.templates import (
    MIRROR,
    TEMPLATES,
    Candidates,
    Templates,
    bend_best,
    find_candidates,
    join,
)
from learn3d.studio.picture_to_mesh.write import Reconstruction
from learn3d.terminal import note

SMALL_MODEL = Path(__file__).with_name("small.safetensors")  # the model in the package


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

    def chances(self, image: Tensor, category: str | None = None) -> Tensor:
        """How probably a stored image uint8 [4, S, S] shows each category, and another thing, float32 [N + 1].

        category: the object's, None if unknown.
        """
        if category is not None or self.known_codes is None:
            right = [category in (None, name) for name in self.categories]
            return torch.tensor([*right, False]) / sum(right)
        return self.known_codes.probabilities(image, self.method.encode(image[None])[0])

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
    if any(name.startswith(("output_layer", "judge.")) for name in tensors):
        note(f"{path} is of an earlier version; export it again with --others to warn of these")
    categories = len(split_names(config.category))
    try:
        known = KnownCodes.from_tensors(tensors, categories, method.info.inverted)
        templates = Templates(*map(tensors.get, TEMPLATES)) if TEMPLATES[0] in tensors else None
        if templates is not None and not templates.fits(categories):
            raise ValueError
    except ValueError:
        wrong = "has known codes or templates of other shapes than its categories"
        raise DamagedFile(path, wrong) from None
    size = metadata.progress.object_share or MEAN_OBJECT_SIZE
    return Model(method, config, size, known, templates)


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


def reconstruct_picture(
    model: Model, colors: np.ndarray, mask: np.ndarray, **options: object
) -> Reconstruction:
    """The first of `reconstruct_guesses`, with its options."""
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
    progress: Report = lambda *_: None,
    options: Options = DEFAULTS,
) -> Iterator[Reconstruction]:
    """Reconstruct a picture uint8 [H, W, 3] with its mask uint8 [H, W]; its camera is unknown.

    refined: fit camera, shape and colours to the picture; methods with voxels only predict.
    category: the object's, None if unknown. With a known one there is no warning. smooth: inflate
    the outline instead, for objects of other kinds. guesses: largest number of different shapes,
    the best first; a model without templates makes one.
    progress: called with the name of each stage and the share that is done.

    Raises ValueError if the model was not trained on the category, or if guesses is below 1.
    """
    if guesses < 1:
        raise ValueError(f"guesses must be at least 1, got {guesses}")
    if category is not None:
        check_category(model, category)
    black = is_uncoloured(colors, mask, options.cut)
    colors, mask = fill_drawing(colors, mask, options.cut)
    method, stored = model.method, model.prepare(colors, mask, crop=crop)
    image, target = torch.from_numpy(stored), frame_target(colors, mask)
    outline = target.outline()
    if smooth:
        surface, view = inflate(target, options.smooth)
        iou = float(view.ious(surface.vertices, surface.faces, outline))
        yield Reconstruction(surface, stored, 0.0, iou, view=view)
        return
    if not refined or not isinstance(method, MeshMethod):
        (surface,) = reconstruct(method, image[None])
        found = method.view_probabilities(image[None])
        azimuth_deg = input_azimuth_deg(surface, stored[3], None if found is None else found[0])
        yield Reconstruction(surface, stored, azimuth_deg)
        return
    progress("camera", 0.0)
    predicted = predict(method, image, outline, options=options.fit)
    if model.templates is None:
        mirror = method.generator.reflection
        kind, warning = recognize(model, model.chances(image, category), options.match)
        fitted = fit(method, predicted, outline, progress, options.fit)
        vertices, faces = outer_surface(fitted.vertices, fitted.faces)
        fitted = fitted._replace(vertices=vertices, faces=faces)
        made = [(fitted, category or kind, warning)]
    else:
        mirror, photo = MIRROR, (colors, mask)
        made = match_templates(model, predicted, photo, category, guesses, progress, options)
    for (vertices, faces, view, iou), kind, warning in made:
        progress("colours", 0.9)
        surface = color_mesh((vertices, faces), view, target, mirror, options.color)
        if black:  # grey, as black shows no shape
            surface = surface._replace(colors=(surface.colors + 1) / 2)
        yield Reconstruction(surface, stored, float(view.azimuth_deg), iou, kind, warning, view)


@torch.no_grad()
def match_templates(
    model: Model,
    predicted: Prediction,
    photo: tuple[np.ndarray, np.ndarray],
    category: str | None = None,
    guesses: int = 1,
    progress: Report = lambda *_: None,
    options: Options = DEFAULTS,
) -> list[tuple[Fit, str, str | None]]:
    """Up to `guesses` bent templates, the best first, each with its category and a warning or None.

    photo: colours uint8 [H, W, 3] and mask uint8 [H, W], for which the model has `predicted` code
    and view. Templates of all categories are also tried from level cameras. If the best stretched
    template fits badly, or the picture is like none that the model knows, predictions count less,
    and cameras that are turned about their axes are tried.
    """
    progress("shape", 0.3)
    target = frame_target(*photo)
    outline = target.outline()
    chances = model.chances(torch.from_numpy(model.prepare(*photo)), category)
    match = options.match
    likely, warning = recognize(model, chances, match)

    def find(
        predicted: Prediction, chances: Tensor, options: Options, level: bool = False
    ) -> Candidates:
        known = model.templates, model.categories
        bonus = chances[:-1] / chances[:-1].sum().clamp(min=1e-6)
        if category is None:
            bonus = bonus.clamp(min=match.least)
        bonus = match.kind * bonus.log()  # -inf for all others than a known category
        return find_candidates(*known, predicted, outline, bonus, level, options)

    found = find(predicted, chances, options)
    best = float(found.views.ious(found.shapes, found.faces, outline).max())
    few = dataclasses.replace(match, candidates=match.candidates // 3, kept=match.kept // 2)
    few = dataclasses.replace(options, match=few)
    level = find(predicted, chances, few, level=True)
    if warning or best < match.poor:
        progress("camera", 0.5)
        more = [found, level]
        for roll_deg, turned in _familiar_rolls(model, predicted, target, category, match):
            rolled = predict(model.method, turned, outline, roll_deg, options.fit)
            tried = find(rolled, model.chances(turned, category), few)
            more.append(tried._replace(prior=tried.prior - match.rolled))
        found = join(more)
        found = found._replace(prior=match.doubted * found.prior)
    else:
        found = join([found, level.believing(predicted, options.fit)])
    progress("surface", 0.7)
    bent = bend_best(found, target, guesses, options)
    also = f"this may also be of the kind {likely}: tell its kind" if likely else None
    return [(fitted, kind, warning or (also if kind != likely else None)) for fitted, kind in bent]


def _familiar_rolls(
    model: Model,
    predicted: Prediction,
    target: Target,
    category: str | None,
    options: MatchOptions,
) -> list[tuple[float, Tensor]]:
    """Angles of the camera about its axis at which a picture is more like something that flies, the best first.

    Each comes with the stored image uint8 [4, S, S] of the picture, turned back by it.
    """
    flies = torch.tensor([name in options.flying for name in model.categories])
    if model.known_codes is None or not flies.any():
        return []

    def distance(code: Tensor) -> float:
        return float(model.known_codes.distances(code)[flies].min())

    order, image = [], Image.fromarray((255 * target.pixels).byte().movedim(0, -1).numpy())
    for roll_deg in options.rolls_deg:
        turned = np.asarray(image.rotate(-roll_deg, Image.Resampling.BILINEAR, expand=True))
        stored = torch.from_numpy(model.prepare(turned[..., :3], turned[..., 3]))
        if model.chances(stored, category)[:-1][flies].sum() > options.flies:
            order.append((distance(model.method.encode(stored[None])[0]), roll_deg, stored))
    upright = distance(predicted.code[0])
    familiar = [(roll_deg, stored) for apart, roll_deg, stored in sorted(order) if apart < upright]
    return familiar[: options.retries]


def check_category(model: Model, category: str) -> None:
    """Raise ValueError if the model was not trained on a category."""
    if category not in model.categories:
        known = ", ".join(model.categories)
        raise ValueError(
            f"the model was trained on {known}, not on {category!r}; give one of its categories, or none"
        )


def recognize(
    model: Model, chances: Tensor, options: MatchOptions = DEFAULTS.match
) -> tuple[str | None, str | None]:
    """Category with the best of `Model.chances`, and a warning if the picture may show another thing.

    The category is None if the model has only one.
    """
    if model.known_codes is None:
        return None, None
    kinds = model.categories
    kind = kinds[int(chances[:-1].argmax())] if len(kinds) > 1 else None
    if chances[-1] < options.other:
        return kind, None
    known = ", ".join(kinds)
    return kind, f"this may be none of {known}: tell its kind, or ask for a smooth shape instead"


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
    share = F.adaptive_avg_pool2d(torch.from_numpy(mask)[None, None].float() / 255, MASK_SIZE)
    target = centre(share)[0, 0]
    return float(find_view(surface.vertices, surface.faces, target, probabilities)[0].azimuth_deg)
