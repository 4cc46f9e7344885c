"""Templates: generated shapes. The best for a picture are stretched, bent until their outlines match, and ranked.

A template has the thin legs, gaps and straight edges that a deformed sphere cannot have. A model
knows the codes of its templates; the shapes themselves are made again from their numbers.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import (
    binary_erosion,
    distance_transform_edt,
    gaussian_filter,
    maximum_filter,
    sobel,
)
from torch import Tensor

import nmr
from learn3d.data.conventions import mesh_to_object
from learn3d.data.dataset import ViewDataset
from learn3d.methods.mesh_method import MeshMethod
from learn3d.networks.encoders import CODE_SIZE
from learn3d.studio.picture_to_mesh.coloring import clash
from learn3d.studio.picture_to_mesh.fit import (
    Fit,
    Prediction,
    Target,
    View,
    belief,
    frame_view,
    minimize,
    soft_ious,
)
from learn3d.studio.picture_to_mesh.options import DEFAULTS, FitOptions, MatchOptions, Options
from learn3d.studio.shapes import CATEGORIES, numbered_shape

SEED = 0  # seed of the data set with the templates; shapes of other seeds are no templates
COUNT = 1000  # templates of each category
AXES = 24  # principal axes of the codes that are kept
WIDTH = 64  # pixels in which distances of outlines and lines are measured
# maps most generated shapes to themselves, in the object frame
MIRROR = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))
# names of the tensors in a checkpoint
TEMPLATES = (
    "template_numbers",
    "template_codes",
    "template_axes",
)


class Templates(NamedTuple):
    """Codes of generated shapes, reduced to their principal axes."""

    numbers: Tensor  # int32 [N, M]: numbers of M shapes of each of N categories
    codes: Tensor  # float [N, M, K]
    axes: Tensor  # float [K + 1, C]: the mean of all codes, and K axes

    def fits(self, categories: int) -> bool:
        """Whether the shapes are those of so many categories."""
        if self.codes is None or self.axes is None or self.axes.shape[1:] != (CODE_SIZE,):
            return False
        shape = (categories, *self.numbers.shape[1:2], len(self.axes) - 1)
        return self.numbers.shape == shape[:2] and self.codes.shape == shape and 0 not in shape

    def nearest(
        self, code: Tensor, categories: Sequence[str], bonus: Tensor, count: int
    ) -> tuple[list[tuple[str, int]], Tensor]:
        """The `count` shapes with codes nearest to a code [C]: category and number of each, and their scores.

        A score is the cosine of the codes and the bonus [N] of the category, -inf to leave it out.
        """
        mean, *axes = self.axes.float()
        place = torch.stack(axes) @ (F.normalize(code, dim=0) - mean)
        cosines = 1 - (self.codes.float() - place).square().sum(2) / 2
        scores = (cosines + bonus[:, None]).flatten()
        best = scores.topk(min(count, int(scores.isfinite().sum())))
        of_kind = self.numbers.shape[1]
        names = [
            (categories[row // of_kind], int(self.numbers.flatten()[row]))
            for row in best.indices.tolist()
        ]
        return names, best.values


@torch.no_grad()
def learn_templates(method: MeshMethod, dataset: ViewDataset) -> Templates | None:
    """The templates of a training set; None if one of its categories has none.

    They are the objects that `make-dataset --procedural` generates with the seed `SEED`. They are
    recognised by their names, and by their voxels, which must be those of the shape with the
    number in the name.
    """
    found = {
        category: [] for category in dataset.class_names or (dataset.category,)
    }  # numbers and codes
    if dataset.voxels is None or not found.keys() <= set(CATEGORIES):
        return None
    for item, name in enumerate(dataset.object_names):
        category, _, number = name.rpartition("_")
        if category not in found or not number.isdecimal() or len(found[category]) >= COUNT:
            continue
        batch = dataset.batch(torch.from_numpy(np.flatnonzero(dataset.object_ids == item)))
        vertices, faces = template(category, int(number), loads=True)
        if (
            nmr.metrics.voxel_iou(
                dataset.convention.voxelize(vertices[None], faces), batch.voxels[:1]
            )
            > 0.98
        ):
            of_views = F.normalize(method.encode(batch.images), dim=1)
            found[category].append((int(number), F.normalize(of_views.mean(0), dim=0)))
    if not (count := min(map(len, found.values()))):
        return None
    numbers, codes = zip(
        *(each for of_kind in found.values() for each in of_kind[:count]), strict=True
    )
    codes, shape = torch.stack(codes), (len(found), count)
    mean = codes.mean(0)
    axes = torch.linalg.svd(codes - mean, full_matrices=False).Vh[:AXES]
    reduced = ((codes - mean) @ axes.T).view(*shape, -1)
    return Templates(
        torch.tensor(numbers, dtype=torch.int32).view(shape), reduced, torch.cat([mean[None], axes])
    )


@functools.lru_cache(512)
def template(category: str, number: int, loads: bool = False) -> tuple[Tensor, Tensor]:
    """Vertices float32 [V, 3] and faces int64 [F, 3] of a generated shape, in the object frame.

    loads: cars may have boxes on their roofs. Few pictures show them, and a box on a low roof has
    the outline of a high one.
    """
    shape = numbered_shape(category, SEED, number, loads)
    vertices = torch.tensor(shape.vertices @ mesh_to_object("y", "z").T, dtype=torch.float32)
    # the reflection of the frame turns the faces inside out
    return vertices, torch.tensor(shape.faces).flip(1)


class Candidates(NamedTuple):
    """N shapes that a picture may show."""

    shapes: list[Tensor]  # float32 [V_n, 3]
    faces: list[Tensor]  # int64 [F_n, 3]
    kinds: list[str]  # their categories
    views: View  # the picture's cameras, if it shows them
    prior: Tensor  # float32 [N]: how likely they are, whatever their outlines

    def select(self, rows: list[int]) -> Candidates:
        """The candidates `rows`."""
        lists = ([values[row] for row in rows] for values in self[:3])
        return Candidates(*lists, self.views.select(torch.tensor(rows)), self.prior[rows])

    def believing(self, predicted: Prediction, options: FitOptions) -> Candidates:
        """The candidates; the log-probabilities of their azimuths, weighted, are added to `prior`."""
        believed = belief(self.views.azimuth_deg, predicted.azimuths, options.belief)
        return self._replace(prior=self.prior + believed)

    def voxels(self) -> Tensor:
        """Their voxels, bool [N, 32, 32, 32]."""
        return torch.cat([_voxels(*mesh) for mesh in zip(self.shapes, self.faces, strict=True)])


def join(parts: Sequence[Candidates]) -> Candidates:
    """All candidates in one."""
    lists = (list(itertools.chain(*each)) for each in list(zip(*parts, strict=True))[:3])
    views = View(*map(torch.cat, zip(*(part.views for part in parts), strict=True)))
    return Candidates(*lists, views, torch.cat([part.prior for part in parts]))


@torch.no_grad()
def find_candidates(
    templates: Templates,
    categories: Sequence[str],
    predicted: Prediction,
    outline: Tensor,
    bonus: Tensor,
    level: bool = False,
    options: Options = DEFAULTS,
) -> Candidates:
    """The templates with codes nearest to the predicted one that fit an outline [64, 64] best, stretched.

    Three numbers rank a template: the likeness of its outline in the predicted view, its voxel IoU
    with the predicted shape, and the cosine of the two codes with the bonus [N] of its category,
    see `Templates.nearest`. The predicted azimuths count, too, unless level: then as many templates
    of each category are taken, seen at elevation 0 from four sides.
    """
    match, each_alone = options.match, torch.eye(len(bonus)).log() + bonus
    groups = [row for row in each_alone if row.isfinite().any()] if level else [bonus]
    count = match.candidates // len(groups)
    nearest = [templates.nearest(predicted.code[0], categories, row, count) for row in groups]
    names = [name for each, _ in nearest for name in each]
    nearness = torch.cat([cosines for _, cosines in nearest])
    shapes, faces = map(list, zip(*(template(*name) for name in names), strict=True))
    views = predicted.shape.view.select(torch.zeros(len(names), dtype=torch.int64))
    found = Candidates(shapes, faces, [name for name, _ in names], views, nearness)
    voxels = found.voxels()
    alike = nmr.metrics.voxel_iou(voxels, _voxels(*predicted.shape[:2]).expand_as(voxels))
    prior = match.voxels * alike.float() + match.nearness * nearness
    found = found._replace(prior=prior)
    if level:
        found = _seen_level(found)
    scores = likeness(found, outline, match) + found.prior
    best = scores.topk(min(match.kept, len(scores))).indices.tolist()
    found = stretch(found.select(best), outline, match)
    return found if level else found.believing(predicted, options.fit)


def _seen_level(found: Candidates) -> Candidates:
    """Each candidate from the front, from behind and from both sides, at elevation 0."""
    sides = torch.tensor([-90.0, 0.0, 90.0, 180.0])
    views = [frame_view(shape, sides, torch.zeros(4)) for shape in found.shapes]
    rows = [row for row in range(len(views)) for _ in sides]
    return found.select(rows)._replace(views=View(*map(torch.cat, zip(*views, strict=True))))


@torch.no_grad()
def bend_best(
    found: Candidates, target: Target, guesses: int = 1, options: Options = DEFAULTS
) -> list[tuple[Fit, str]]:
    """Bend the best of stretched candidates, and rank them: up to `guesses` different ones, the best first, with kinds.

    They are ranked by outline, inner lines, and colours that differ between parts that are mirror
    images.
    """

    match = options.match

    def scored(found: Candidates, outline: Tensor) -> Tensor:
        lines = match.lines * compare_lines(found, target, match)
        return likeness(found, outline, match) + found.prior - lines

    scores = scored(found, target.outline())
    rows = spread_out(scores, found.voxels(), match.bent, match.alike)
    found = bend(found.select(rows), target.outline(), match)
    scores = scored(found, target.outline(match.ranked_size))
    meshes = list(zip(found.shapes, found.faces, strict=True))
    views = [found.views.select(torch.tensor([row])) for row in range(len(meshes))]
    clashes = [
        clash(*each, target, MIRROR, options.color) for each in zip(meshes, views, strict=True)
    ]
    scores -= match.colors * torch.tensor(clashes)
    made = []
    for row in spread_out(scores, found.voxels(), guesses, match.alike):
        (vertices, faces), view = meshes[row], views[row]
        size = 1 / float(np.ptp(vertices.numpy(), axis=0).max())  # the longest side becomes 1 again
        view = view._replace(
            log_distance=view.log_distance + math.log(size), shift=size * view.shift
        )
        vertices = size * vertices
        iou = float(view.ious(vertices, faces, target.outline()))
        made.append((Fit(vertices, faces, view, iou), found.kinds[row]))
    return made


def spread_out(scores: Tensor, voxels: Tensor, count: int, alike: float) -> list[int]:
    """Up to `count` of N shapes with high scores [N] and different voxels [N, s, s, s], the best first.

    A shape costs `alike` times its largest voxel IoU with those before it.
    """
    left, chosen = scores.clone(), []
    largest = torch.zeros_like(scores)
    for _ in range(min(count, len(scores))):
        row = int((left - alike * largest).argmax())
        chosen.append(row)
        left[row] = -math.inf
        overlap = nmr.metrics.voxel_iou(voxels, voxels[row].expand_as(voxels)).float()
        largest = torch.maximum(largest, overlap)
    return chosen


def _voxels(vertices: Tensor, faces: Tensor) -> Tensor:
    return nmr.voxelize(0.998 * vertices[None].clamp(-0.5, 0.5) + 0.5, faces)


def likeness(found: Candidates, outline: Tensor, options: MatchOptions) -> Tensor:
    """How alike the outlines of N shapes and of a picture [S, S] are: their IoU less the distance of their edges, [N].

    By the IoU alone a solid back is better than slats beside the true ones.
    """
    drawn = found.views.silhouettes(found.shapes, found.faces, len(outline))
    edge, near_wanted = _edges(outline, options)
    apart = [
        (near_wanted[own].mean() + near[edge].mean()) / 2
        for own, near in (_edges(image, options) for image in drawn)
    ]
    return soft_ious(drawn, outline) - options.edges * torch.tensor(apart).float()


def _edges(silhouette: Tensor, options: MatchOptions) -> tuple[np.ndarray, np.ndarray]:
    """The pixels on the edge of a silhouette [S, S], and the distance of each pixel to them."""
    inside = np.pad(silhouette.numpy() > 0.35, 1)
    inside[0, 0] = True  # in the margin: there is always an edge
    edge = inside & ~binary_erosion(inside)
    return edge, _near(edge, options)


def compare_lines(found: Candidates, target: Target, options: MatchOptions) -> Tensor:
    """The mean distance of the lines of N shapes and of a picture, [N].

    They show arms, slats, drawers and corners within an outline. A shape's lines are its
    silhouette and its creases, a picture's are thin lines along which its colours change.
    """
    lines = _lines_of(target, options)
    near_lines = _near(lines, options)
    normals = nmr.render_normals(
        found.shapes, found.faces, found.views.cameras(), image_size=options.ranked_size
    ).numpy()
    down, across = (np.abs(np.diff(normals, axis=axis, append=0)).sum(3) for axis in (1, 2))
    apart = [
        _mean(near_lines[crease], options) + _mean(_near(crease, options)[lines], options)
        for crease in np.maximum(down, across) > options.line_bend
    ]
    return torch.tensor(apart).float()


def _lines_of(target: Target, options: MatchOptions) -> np.ndarray:
    """The pixels on the lines of a picture, bool [S, S]."""
    colors = gaussian_filter(target.pixels[:3].numpy(), (0, 1.5, 1.5))
    change = np.sqrt(sum(sobel(colors, axis) ** 2 for axis in (1, 2)).sum(0)) / 8
    size = options.ranked_size
    change = change.reshape(size, len(change) // size, size, -1).max((1, 3))
    return (change > options.line_contrast) & (change >= 0.8 * maximum_filter(change, 3))


def _near(lines: np.ndarray, options: MatchOptions) -> np.ndarray:
    """The distance of each pixel to lines [S, S], in pixels of 64, at most `farthest`."""
    return np.minimum(WIDTH / len(lines) * distance_transform_edt(~lines), options.farthest)


def _mean(values: np.ndarray, options: MatchOptions) -> float:
    return float(values.mean()) if len(values) else options.farthest


def stretch(found: Candidates, outline: Tensor, options: MatchOptions) -> Candidates:
    """Stretch N shapes along the three axes until they have an outline [64, 64]; unequal factors cost."""
    logs = torch.zeros(len(found.shapes), 3).requires_grad_()

    def stretched() -> list[Tensor]:
        return [shape * factor for shape, factor in zip(found.shapes, logs.exp(), strict=True)]

    def costs() -> Tensor:
        return options.stretching * (logs - logs.mean(1, keepdim=True)).square().sum(1)

    def loss(views: View) -> Tensor:
        size = 0.1 * logs.square().sum(1)
        return (costs() + size - views.ious(stretched(), found.faces, outline)).sum()

    views = minimize(loss, found.views, options.stretch_steps, (0.02, 0.02), logs)
    return found._replace(shapes=stretched(), views=views, prior=found.prior - costs())


def bend(found: Candidates, outline: Tensor, options: MatchOptions) -> Candidates:
    """Free-form deformation (Sederberg and Parry 1986): the points of a lattice move, and N shapes with them.

    Unequal moves cost.
    """
    count = options.lattice
    weights = [_lattice_weights(shape, count) for shape in found.shapes]
    lattice = torch.zeros(len(weights), count, count, count, 3).requires_grad_()

    def moves() -> Tensor:
        return (lattice + lattice.flip(1) @ MIRROR) / 2

    def bent() -> list[Tensor]:
        parts = zip(found.shapes, weights, moves().flatten(1, 3), strict=True)
        return [shape + weight @ move for shape, weight, move in parts]

    def costs() -> Tensor:
        rough = sum(moves().diff(dim=axis).square().flatten(1).sum(1) for axis in (1, 2, 3))
        return options.bending * (rough + 0.1 * moves().square().flatten(1).sum(1))

    def loss(views: View) -> Tensor:
        return (costs() - views.ious(bent(), found.faces, outline)).sum()

    views = minimize(loss, found.views, options.bending_steps, (0.01, 0.02), lattice)
    prior = found.prior - options.bent_cost * costs()
    return found._replace(shapes=bent(), views=views, prior=prior)


def _lattice_weights(vertices: Tensor, count: int) -> Tensor:
    """Bernstein polynomials [V, count^3] of vertices [V, 3] in their box: how far each moves with each point."""
    low, high = vertices.amin(0), vertices.amax(0)
    place = (vertices - low) / (high - low).clamp(min=1e-3)
    powers = torch.arange(count)
    chosen = torch.tensor([math.comb(count - 1, k) for k in range(count)])
    along = chosen * place[..., None] ** powers * (1 - place[..., None]) ** (count - 1 - powers)
    return torch.einsum("va,vb,vc->vabc", *along.unbind(1)).flatten(1)
