"""Templates: generated shapes. The one that fits a picture best is stretched and bent until its outline matches.

A template has the thin legs, gaps and straight edges that a deformed sphere cannot have. A model
knows the codes of its templates; the shapes themselves are made again from their numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
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
from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.methods.mesh_method import MeshMethod
from learn3d.networks.encoders import CODE_SIZE
from learn3d.studio.picture_to_mesh.fit import (
    Fit,
    Prediction,
    Progress,
    View,
    belief,
    minimize,
)
from learn3d.studio.shapes import CATEGORIES, numbered_shape

SEED = 0  # seed of the data set with the templates; shapes of other seeds are no templates
COUNT = 1000  # templates of each category
AXES = 24  # principal axes of the codes that are kept
CANDIDATES = 128  # templates with the nearest codes, which are made and compared with the picture
KEPT = 16  # best of them, which are stretched
DIFFERENT = 0.5  # voxel IoU below which two shapes are different guesses
VOXELS = 0.5  # weight of the IoU with the predicted shape; that of the outline is 1
NEARNESS = 0.5  # weight of the codes' cosine
EDGES = 0.15  # weight of the distance of two outlines in pixels
FARTHEST = 6.0  # largest distance of outlines that counts
LINES = 0.15  # weight of the distance of two pictures' lines in pixels of 64
LINE_SIZE = 128  # side in pixels of the pictures whose lines are compared
LINE_CONTRAST = 0.03  # change of a colour from pixel to pixel that makes a line
LINE_BEND = 0.5  # sum of the normal's changes from pixel to pixel that makes one
STRETCHING = 1.0  # weight of unequal factors along the axes
STRETCH_STEPS = 30
LATTICE = 4  # points of the lattice along each axis
BENDING = 1.5  # weight of their moves
BENDING_STEPS = 40
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
        self, code: Tensor, categories: Sequence[str], category: str | None = None
    ) -> tuple[list[tuple[str, int]], Tensor]:
        """The `CANDIDATES` shapes with codes nearest to a code [C]: category and number of each, and the cosines.

        category: only its shapes are taken; None for those of all categories.
        """
        mean, *axes = self.axes.float()
        place = torch.stack(axes) @ (F.normalize(code, dim=0) - mean)
        cosines = 1 - (self.codes.float() - place).square().sum(2) / 2
        if category is not None:
            others = torch.tensor([name != category for name in categories])
            cosines[others] = -math.inf
        cosines = cosines.flatten()
        best = cosines.topk(min(CANDIDATES, int(cosines.isfinite().sum())))
        count = self.numbers.shape[1]
        names = [
            (categories[row // count], int(self.numbers.flatten()[row]))
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
        vertices, faces = template(category, int(number))
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


def template(category: str, number: int) -> tuple[Tensor, Tensor]:
    """Vertices float32 [V, 3] and faces int64 [F, 3] of a generated shape, in the object frame."""
    shape = numbered_shape(category, SEED, number)
    vertices = np.asarray(shape.vertices) @ mesh_to_object("y", "z").T
    faces = np.asarray(shape.faces)[
        :, ::-1
    ].copy()  # the reflection of the frame turns them inside out
    return torch.tensor(vertices, dtype=torch.float32), torch.from_numpy(faces.astype(np.int64))


class Candidates(NamedTuple):
    """Shapes that a picture may show, and how likely they are."""

    shapes: list[Tensor]  # N tensors float32 [V_n, 3]
    faces: list[Tensor]  # N tensors int64 [F_n, 3]
    kinds: list[str]  # their categories
    prior: Tensor  # float32 [N]: likeness to the predicted shape and of the codes

    def select(self, rows: Sequence[int]) -> Candidates:
        """The candidates `rows`."""
        lists = ([values[row] for row in rows] for values in self[:3])
        return Candidates(*lists, self.prior[list(rows)])


def find_candidates(
    templates: Templates,
    categories: Sequence[str],
    predicted: Prediction,
    category: str | None = None,
) -> Candidates:
    """The templates with codes nearest to the predicted one.

    category: the only one whose templates are taken, None if unknown.
    """
    names, nearness = templates.nearest(predicted.code[0], categories, category)
    shapes, faces = map(list, zip(*(template(*name) for name in names), strict=True))
    voxels = torch.cat([_voxels(*mesh) for mesh in zip(shapes, faces, strict=True)])
    alike = nmr.metrics.voxel_iou(voxels, _voxels(*predicted.shape[:2]).expand_as(voxels))
    prior = VOXELS * alike.float() + NEARNESS * nearness
    return Candidates(shapes, faces, [name for name, _ in names], prior)


@torch.no_grad()
def fit_template(
    templates: Templates,
    categories: Sequence[str],
    predicted: Prediction,
    picture: np.ndarray,
    mask: Tensor,
    progress: Progress = lambda *_: None,
    *,
    category: str | None = None,
    guesses: int = 1,
) -> Iterator[tuple[Fit, str]]:
    """Fit templates to a framed picture: up to `guesses` different ones, the best first, with categories.

    picture: R, G, B and mask, uint8 [4, 256, 256]. mask: the same mask, float32 [64, 64].
    Three numbers rank a candidate: the likeness of its outline in the predicted view, its voxel
    IoU with the predicted shape, and the cosine of the two codes. The best are stretched along
    the axes, and the lines inside of their outlines count, too. Of these the best is bent, and
    those whose voxel IoU with a better one is below `DIFFERENT`. category: see `find_candidates`.
    """
    progress("shape", 0.3)
    found = find_candidates(templates, categories, predicted, category)
    views = predicted.shape.view.select(torch.zeros(len(found.shapes), dtype=torch.int64))
    scores = likeness(views, found.shapes, found.faces, mask) + found.prior
    best = scores.topk(min(KEPT, len(scores))).indices
    found = found.select(best.tolist())
    progress("stretch", 0.5)
    views, shapes, cost = stretch(views.select(best), found.shapes, found.faces, mask)
    scores = likeness(views, shapes, found.faces, mask) + belief(
        views.azimuth_deg, predicted.azimuths
    )
    scores -= LINES * compare_lines(views, shapes, found.faces, picture)
    order = (scores + found.prior - cost).argsort(descending=True).tolist()
    progress("surface", 0.8)
    for row in _choose_different(
        [_voxels(shapes[row], found.faces[row]) for row in order], guesses
    ):
        row = order[row]
        view, vertices = bend(
            views.select(torch.tensor([row])), shapes[row], found.faces[row], mask
        )
        size = 1 / float(np.ptp(vertices.numpy(), axis=0).max())  # the longest side becomes 1 again
        view = view._replace(
            log_distance=view.log_distance + math.log(size), shift=size * view.shift
        )
        vertices = size * vertices
        iou = float(view.ious(vertices[None], found.faces[row], mask))
        yield Fit(vertices, found.faces[row], view, iou), found.kinds[row]


def _choose_different(voxels: list[Tensor], count: int) -> list[int]:
    """Up to `count` of N shapes. Each differs from all before it."""
    chosen = [0]
    for row in range(1, len(voxels)):
        alike = [float(nmr.metrics.voxel_iou(voxels[row], voxels[other])) for other in chosen]
        if len(chosen) < count and max(alike) < DIFFERENT:
            chosen.append(row)
    return chosen


def _voxels(vertices: Tensor, faces: Tensor) -> Tensor:
    return nmr.voxelize(0.998 * vertices[None].clamp(-0.5, 0.5) + 0.5, faces)


def likeness(views: View, shapes: list[Tensor], faces: list[Tensor], mask: Tensor) -> Tensor:
    """How alike the outlines of N shapes and of a mask [64, 64] are: their IoU less the distance of their edges, [N].

    By the IoU alone a solid back is better than slats beside the true ones.
    """
    outline, near_wanted = _edges(mask)
    drawn = map(_edges, views.silhouettes(shapes, faces))
    apart = [(near_wanted[edge].mean() + near[outline].mean()) / 2 for edge, near in drawn]
    return views.ious(shapes, faces, mask) - EDGES * torch.tensor(apart).float()


def _edges(silhouette: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """The pixels on the edge of a silhouette [64, 64], and the distance of each pixel to them, at most `FARTHEST`."""
    inside = np.pad(silhouette.numpy() > 0.35, 1)
    inside[0, 0] = True  # in the margin: there is always an edge
    edge = inside & ~binary_erosion(inside)
    return edge, _near(edge)


def compare_lines(
    views: View, shapes: list[Tensor], faces: list[Tensor], picture: np.ndarray
) -> Tensor:
    """The mean distance of the lines of N shapes and of a picture uint8 [4, 256, 256], [N], in pixels of 64.

    They show arms, slats, drawers and corners within an outline. A shape's lines are its
    silhouette and its creases, a picture's are thin lines along which its colours change.
    """
    lines = _lines_of(picture)
    near_lines = _near(lines)
    normals = nmr.render_normals(
        views.place(shapes), faces, views.cameras(), image_size=LINE_SIZE
    ).numpy()
    down, across = (np.abs(np.diff(normals, axis=axis, append=0)).sum(3) for axis in (1, 2))
    apart = [
        _mean(near_lines[crease]) + _mean(_near(crease)[lines])
        for crease in np.maximum(down, across) > LINE_BEND
    ]
    return torch.tensor(apart) * (MASK_SIZE / LINE_SIZE)


def _lines_of(picture: np.ndarray) -> np.ndarray:
    """The pixels on the lines of a picture uint8 [4, S, S], bool [LINE_SIZE, LINE_SIZE]."""
    colors = gaussian_filter(picture[:3] / np.float32(255), (0, 1.5, 1.5))
    change = np.sqrt(sum(sobel(colors, axis) ** 2 for axis in (1, 2)).sum(0)) / 8
    change = change.reshape(LINE_SIZE, len(change) // LINE_SIZE, LINE_SIZE, -1).max((1, 3))
    return (change > LINE_CONTRAST) & (change >= 0.8 * maximum_filter(change, 3))


def _near(lines: np.ndarray) -> np.ndarray:
    """The distance of each pixel to lines, at most `FARTHEST`."""
    return np.minimum(distance_transform_edt(~lines), FARTHEST)


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else FARTHEST


def stretch(
    views: View, shapes: list[Tensor], faces: list[Tensor], mask: Tensor
) -> tuple[View, list[Tensor], Tensor]:
    """Stretch N shapes along the three axes until they have the outline of a mask [64, 64] in N views.

    Returns the fitted views, the shapes, and how unequal the factors are, [N].
    """
    logs = torch.zeros(len(shapes), 3).requires_grad_()

    def stretched() -> list[Tensor]:
        return [shape * factor for shape, factor in zip(shapes, logs.exp(), strict=True)]

    def costs() -> Tensor:
        return STRETCHING * (logs - logs.mean(1, keepdim=True)).square().sum(1)

    def loss(views: View) -> Tensor:
        size = 0.1 * logs.square().sum(1)
        return (costs() + size - views.ious(stretched(), faces, mask)).sum()

    views = minimize(loss, views, STRETCH_STEPS, (0.02, 0.02), logs)
    return views, stretched(), costs()


def bend(view: View, vertices: Tensor, faces: Tensor, mask: Tensor) -> tuple[View, Tensor]:
    """Free-form deformation (Sederberg and Parry 1986): the points of a lattice move, and the shape with them."""
    low, high = vertices.amin(0), vertices.amax(0)
    place = (vertices - low) / (high - low).clamp(min=1e-3)
    x, y, z = (
        torch.stack(
            [
                math.comb(LATTICE - 1, k) * t**k * (1 - t) ** (LATTICE - 1 - k)
                for k in range(LATTICE)
            ],
            1,
        )
        for t in place.unbind(1)
    )
    weights = torch.einsum("va,vb,vc->vabc", x, y, z)
    lattice = torch.zeros(LATTICE, LATTICE, LATTICE, 3).requires_grad_()

    def moves() -> Tensor:
        return (lattice + lattice.flip(0) @ MIRROR) / 2

    def bent() -> Tensor:
        return vertices + torch.einsum("vabc,abcd->vd", weights, moves())

    def loss(view: View) -> Tensor:
        rough = (
            sum(moves().diff(dim=axis).square().sum() for axis in range(3))
            + 0.1 * moves().square().sum()
        )
        return BENDING * rough - view.ious(bent()[None], faces, mask).sum()

    return minimize(loss, view, BENDING_STEPS, (0.005, 0.01), lattice), bent()
