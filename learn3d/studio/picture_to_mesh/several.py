"""One shape from several pictures of an object whose cameras are unknown.

The cameras are those from which generated shapes look like the pictures, and whose outlines
contradict each other least. Then the object is carved out of a grid: a cell is kept if all
outlines contain it, and likely shapes contain it or an outline needs it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from torch import Tensor

import nmr
from learn3d.data.poses import wrap_deg
from learn3d.networks.encoders import CENTRED_SIZE
from learn3d.pictures import grid_surface
from learn3d.studio.picture_to_mesh.fit import (
    AZIMUTHS,
    ELEVATIONS_DEG,
    LEVEL,
    Prediction,
    Progress,
    View,
    belief,
    frame_view,
    minimize,
)
from learn3d.studio.picture_to_mesh.smoothing import smooth
from learn3d.studio.picture_to_mesh.templates import (
    Candidates,
    Templates,
    bend,
    find_candidates,
    likeness,
    stretch,
)

MOST_PICTURES = 8
SEEN = 16  # candidates whose outlines are compared with all pictures from all sides
STRETCHED = 6  # best of them, which are stretched
AGREEMENT = 0.05  # differences of two candidates' scores that make one e times as likely
MODES = 4  # azimuths that are tried for each picture
LAYOUTS = 64  # likeliest layouts of all cameras whose outlines are compared
COARSE = 32  # cells along each side of the grid for that, and pixels of its masks
WIDENED = 0.4  # cells of that grid by which the outlines are widened
CELLS, BOX = 88, 1.2  # cells along each side of the grid, and its side in the object frame
ROOM = 0.2  # distance from the box of the bent template up to which the object reaches
LIKELY = 0.4  # probability above which a cell is kept if all outlines contain it
NEEDED = 0.9  # share of the largest probability on a line of sight from which a cell is kept, too
REACH = 2.0  # cells around a needed one that are kept, so that thin legs are whole
BLURS = (1.0, 5.0)  # cells by which probabilities are blurred, for likely and for needed cells
FAR = 0.1  # weight of the second ones
LOSS = 0.03  # share of the outlines that an object mirrored in x may leave uncovered
SHARPNESS = 0.1  # differences of two shapes' scores that make one e times as likely
SLACKS = (0.3, 0.7)  # cells by which the outlines are widened; the shape most like them is taken
FITTED = 4  # best layouts, whose cameras are fitted
COARSE_FIT = (
    COARSE,
    16,
    0.03,
)  # cells along each side of the grid, steps and learning rate for that
FINE_FIT = (64, 20, 0.01)  # and for the cameras of the layout that agrees best
SOFTNESS = 0.35  # cells of the grid over which the edge of a hull is blurred, for gradients
CROWDED = 0.25  # cost of a layout whose cameras all stand at the same side
EQUALLY_HIGH = 0.03  # cost of elevations with a standard deviation of ten degrees
# cost of cameras ten degrees above or below those of a person before furniture
USUALLY_HIGH, USUAL_DEG = 0.02, 25.0
# mean outline IoU from which the bent template is taken, which has straighter parts
STRAIGHT = 0.85
COLORS = 5.0  # weight of the distance of two pictures' colours; that of their codes is 1
SAMPLES = 500  # pixels of a picture whose colours are compared
# a picture shows something else if its distance to the nearest one exceeds that of the others by this
STRANGE = 0.5
APART = 0.03  # cost of a camera that stands a level of `ELEVATIONS_DEG` above or below the others
WORSE = 0.15  # a picture is left out if its outline IoU is so much below the median of all


class SeveralFit(NamedTuple):
    """A shape that explains the outlines of N pictures."""

    vertices: Tensor  # float32 [V, 3], object frame
    faces: Tensor  # int64 [F, 3]
    views: View  # N views
    ious: Tensor  # float32 [N]: IoU of mask and silhouette in each view
    kind: str  # category of the template
    is_template: bool  # whether it is a bent template, not a carved shape


def find_strangers(predicted: Sequence[Prediction], pictures: Sequence[np.ndarray]) -> list[int]:
    """The pictures whose codes and colours are like no other's, the most unlike first. Two pictures cannot tell.

    pictures: N of R, G, B and mask, uint8 [4, S, S].
    """
    codes = torch.stack([F.normalize(each.code[0], dim=0) for each in predicted])
    colors = [_color_samples(picture) for picture in pictures]
    apart = torch.stack([torch.stack([_apart(a, b) for b in colors]) for a in colors])
    apart = 1 - codes @ codes.T + COLORS * (apart + apart.T) / 2
    left, strangers = list(range(len(codes))), []
    while len(left) > 2:
        nearest = apart[left][:, left].fill_diagonal_(math.inf).amin(1)
        most = int(nearest.argmax())
        others = torch.cat([nearest[:most], nearest[most + 1 :]])
        if nearest[most] < others.quantile(0.5) + STRANGE:
            break
        strangers.append(left.pop(most))
    return strangers


def _color_samples(picture: np.ndarray) -> Tensor:
    """Hues and half of the brightness [P, 4] of pixels within the outline of a picture uint8 [4, S, S]."""
    inside = picture[3] > 127
    inner = ndimage.binary_erosion(inside, iterations=2)
    colors = torch.from_numpy(picture[:3, inner if inner.any() else inside].T / np.float32(255))
    grey = colors.mean(1, keepdim=True)
    samples = torch.cat([colors - grey, grey / 2], 1)
    return samples[:: math.ceil(len(samples) / SAMPLES)]


def _apart(colors: Tensor, others: Tensor) -> Tensor:
    """The mean distance of colours [P, 4] to the nearest of other ones [Q, 4]."""
    return torch.cdist(colors, others).amin(1).mean()


def find_outliers(ious: Tensor) -> list[int]:
    """The pictures whose outlines [N] fit much worse than the others' do. Two pictures cannot tell."""
    if len(ious) < 3:
        return []
    return torch.nonzero(ious < ious.median() - WORSE)[:, 0].tolist()


@torch.no_grad()
def fit_several(
    templates: Templates,
    categories: Sequence[str],
    predicted: Sequence[Prediction],
    masks: Tensor,
    outlines: Tensor,
    progress: Progress = lambda *_: None,
    *,
    category: str | None = None,
    known: View | None = None,
) -> SeveralFit:
    """One shape and N cameras for the framed masks float32 [N, 64, 64] of N pictures of the same object.

    outlines: the masks uint8 [N, S, S]. category: see `find_candidates`. known: the N cameras if
    they are known.
    """
    free = LEVEL if known is None else 0
    distances = _distances(outlines)
    progress("shape", 0.3)
    found = find_candidates(templates, categories, predicted, category)
    each = [each.shape.view for each in predicted]
    alike = torch.stack([_guess(found, *pair) for pair in zip(each, masks, strict=True)])
    found = found.select(
        (alike.mean(0) + found.prior).topk(min(SEEN, len(found.prior))).indices.tolist()
    )
    if known is None:
        beliefs = [each.azimuths for each in predicted]
        looks = [
            _look_around(shape, faces, masks, beliefs)
            for shape, faces in zip(found.shapes, found.faces, strict=True)
        ]
        scores, views = zip(*looks, strict=True)
        known = _find_cameras(torch.stack(scores), views, found.prior, distances, masks)
    seen = found.prior + torch.stack(
        [
            known.ious(shape[None], faces, masks).mean()
            for shape, faces in zip(found.shapes, found.faces, strict=True)
        ]
    )
    best = seen.topk(min(STRETCHED, len(seen))).indices.tolist()
    progress("stretch", 0.5)
    found = found.select(best)
    fitted = _fit_template(found, known, masks, free)
    view, bent = fitted.view, fitted.bent
    faces, kind = found.faces[fitted.best], found.kinds[fitted.best]
    progress("surface", 0.7)
    ious = view.ious(bent[None], faces, masks)
    is_template = float(ious.mean()) > STRAIGHT
    if not is_template:
        if free:  # a shape is carved by the cameras whose outlines agree
            fitted = _fit_template(found, known, masks, 0)
            view, bent, faces = fitted.view, fitted.bent, found.faces[fitted.best]
        move = _Centring.of(bent)
        view, bent = move.view(view), move(bent)
        found = found._replace(shapes=[move(shape) for shape in fitted.shapes])
        likely = _average(found, (fitted.scores / SHARPNESS).softmax(0))
        likely = (likely + _fill(bent, faces)) / 2
        carved = _carve_out(view, masks, distances, likely, bent)
        if carved is not None:
            bent, faces = carved
        is_template = carved is None
        ious = view.ious(bent[None], faces, masks)
    move = _Centring.of(bent)
    view, bent = move.view(view), move(bent)
    return SeveralFit(bent, faces, view, ious, kind, is_template)


class _FittedTemplate(NamedTuple):
    """K candidates, stretched to the outlines of N pictures, and the best of them, bent."""

    shapes: list[Tensor]  # K tensors float32 [V_k, 3], stretched
    scores: Tensor  # float32 [K]
    best: int  # row of the best one
    view: View  # N views
    bent: Tensor  # float32 [V, 3], the best one


def _fit_template(found: Candidates, view: View, masks: Tensor, free: int) -> _FittedTemplate:
    """Stretch candidates to masks [N, 64, 64], and bend the best. free: see `minimize`."""
    shapes, faces, count = found.shapes, found.faces, len(masks)
    views = view.select(torch.arange(count).repeat(len(shapes)))
    views, shapes, cost = stretch(views, shapes, faces, masks, free)
    alike = likeness(views, _repeat(shapes, count), _repeat(faces, count), masks)
    scores = alike.view(-1, count).mean(1) + found.prior - cost
    best = int(scores.argmax())
    view = views.select(best * count + torch.arange(count))
    return _FittedTemplate(
        shapes, scores, best, *bend(view, shapes[best], faces[best], masks, free)
    )


class _Centring(NamedTuple):
    """The move of a shape's box to the origin, and the scale at which its longest side becomes 1."""

    centre: Tensor
    scale: float

    @classmethod
    def of(cls, vertices: Tensor) -> _Centring:
        low, high = vertices.amin(0), vertices.amax(0)
        return cls((low + high) / 2, 1 / float((high - low).max()))

    def __call__(self, vertices: Tensor) -> Tensor:
        return self.scale * (vertices - self.centre)

    def view(self, view: View) -> View:
        """The cameras from which the moved shape looks as before."""
        shift = self.scale * (view.shift + view.axes()[:, :2] @ self.centre)
        return view._replace(log_distance=view.log_distance + math.log(self.scale), shift=shift)


def _look_around(
    vertices: Tensor, faces: Tensor, masks: Tensor, beliefs: Sequence[Tensor | None]
) -> tuple[Tensor, View]:
    """Scores [M, N] of a shape in M views as explanations of N masks, and the views."""
    azimuths = -180 + (torch.arange(AZIMUTHS) + 0.5) * (360 / AZIMUTHS)
    grid = torch.cartesian_prod(azimuths, torch.tensor(ELEVATIONS_DEG))
    views = frame_view(vertices, grid[:, 0], grid[:, 1])
    bonus = torch.stack([belief(views.azimuth_deg, each) for each in beliefs], 1)
    return _all_ious(views, vertices, faces, masks) + bonus, views


def _find_cameras(
    scores: Tensor, views: Sequence[View], prior: Tensor, distances: Tensor, masks: Tensor
) -> View:
    """The cameras of N pictures from which their outlines contradict each other least.

    The scores [K, M, N] of K candidates give each picture its likeliest azimuths. The best of the
    likeliest layouts of all cameras are fitted, until their outlines, together with the mirrored
    ones, carve away as little as possible of each other.
    """
    levels, count = len(ELEVATIONS_DEG), len(masks)
    chances = (torch.stack([_explained(each) for each in scores]) + prior) / AGREEMENT
    mean = torch.einsum("k,kmn->mn", chances.softmax(0), scores)
    best, level = mean.view(AZIMUTHS, levels, -1).max(1)
    is_mode = (best >= best.roll(1, 0)) & (best >= best.roll(-1, 0))
    values, modes = torch.where(is_mode, best, best - 1).topk(MODES, 0)
    rows = (modes * levels + level.gather(0, modes)).T.flatten()
    view = views[int(chances.argmax())].select(rows)
    choices = torch.cartesian_prod(*[torch.arange(MODES)] * count)
    score = values.gather(0, choices).mean(1)
    likely = score.topk(min(LAYOUTS, len(score))).indices
    layouts = MODES * torch.arange(count) + choices[likely]
    score = score[likely]
    small = F.interpolate(masks[:, None], COARSE, mode="area")[:, 0].repeat_interleave(MODES, 0)
    scale = COARSE / CELLS
    sight = _Sight.of(view, scale * distances.repeat_interleave(MODES, 0), small, COARSE)
    chosen = [sight.select(layout) for layout in layouts]
    covered = torch.stack([each.covered((each.hull() > 0).float()) for each in chosen])
    promise = score + covered - CROWDED * _crowding(view.azimuth_deg[layouts])
    best, found = -math.inf, view
    for row in promise.topk(min(FITTED, len(score))).indices.tolist():
        fitted = _fit_cameras(view.select(layouts[row]), distances, masks, *COARSE_FIT)
        contradiction = _disagree(fitted, distances, masks, COARSE)
        crowding = _crowding(fitted.azimuth_deg[None])[0]
        agreement = float(score[row] - 2 * contradiction - CROWDED * crowding)
        if agreement > best:
            best, found = agreement, fitted
    return _fit_cameras(found, distances, masks, *FINE_FIT)


def _crowding(azimuths_deg: Tensor) -> Tensor:
    """How much nearer the N cameras of each of L layouts [L, N] are than if they stood all around, [L]."""
    sector = 360 / azimuths_deg.shape[1]
    apart = wrap_deg(azimuths_deg[:, :, None] - azimuths_deg[:, None]).abs()
    nearest = (apart + 360 * torch.eye(azimuths_deg.shape[1])).amin(2)
    return (0.75 - nearest / sector).clamp(min=0).mean(1)


def _fit_cameras(
    view: View, distances: Tensor, masks: Tensor, cells: int, steps: int, rate: float
) -> View:
    """The cameras near `view` whose outlines agree best. They are held about equally high."""

    def loss(view: View) -> Tensor:
        height = view.elevation_deg / 10
        unusual = (height - USUAL_DEG / 10).square().mean()
        return (
            _disagree(view, distances, masks, cells)
            + EQUALLY_HIGH * height.var(correction=0)
            + USUALLY_HIGH * unusual
        )

    return minimize(loss, view, steps, (rate,))


def _disagree(view: View, distances: Tensor, masks: Tensor, cells: int) -> Tensor:
    """The share of the masks that the cells within all outlines, and all mirrored ones, leave uncovered."""
    small = F.interpolate(masks[:, None], cells, mode="area")[:, 0]
    sight = _Sight.of(view, distances * (cells / CELLS), small, cells)
    return 1 - sight.covered((sight.hull() / SOFTNESS).sigmoid())


def _explained(scores: Tensor) -> Tensor:
    """The mean of the best scores of N pictures, from scores [M, N] in views from all sides.

    Who walks around an object holds the camera about equally high, so elevations that differ cost
    something.
    """
    levels = len(ELEVATIONS_DEG)
    apart = (torch.arange(levels)[:, None] - torch.arange(levels)).abs()
    costs = scores.view(AZIMUTHS, levels, 1, -1) - APART * apart[:, :, None]
    return costs.amax((0, 1)).mean(1).max()


def _guess(found: Candidates, view: View, mask: Tensor) -> Tensor:
    """IoU [K] of the silhouettes of K candidates in the view of the predicted shape and a mask."""
    return view.select(torch.zeros(len(found.shapes), dtype=torch.int64)).ious(
        found.shapes, found.faces, mask
    )


def _all_ious(views: View, vertices: Tensor, faces: Tensor, masks: Tensor) -> Tensor:
    """IoU [M, N] of each of M silhouettes of a shape, one a view, and each of N masks."""
    drawn, wanted = views.silhouettes(vertices[None], faces).flatten(1), masks.flatten(1)
    both = drawn @ wanted.T
    return both / (drawn.sum(1, keepdim=True) + wanted.sum(1) - both).clamp(min=1e-6)


def _repeat(shapes: Sequence[Tensor], count: int) -> list[Tensor]:
    return [shape for shape in shapes for _ in range(count)]


class _Sight(NamedTuple):
    """The cells of the grid as N cameras see them."""

    inside: Tensor  # float32 [N, s, s, s]: distance to the outline in cells, positive inside of it
    # int64 [N, s^3]: the pixel that shows a cell; the last one is outside the picture
    pixel: Tensor
    wanted: Tensor  # float32 [N, S * S]: 1 at the pixels of the mask

    @classmethod
    def of(cls, views: View, distances: Tensor, masks: Tensor, cells: int = CELLS) -> _Sight:
        """A grid in N views of masks [N, S, S]. distances: see `_distances`."""
        along = ((torch.arange(cells) + 0.5) / cells - 0.5) * BOX
        points = torch.cartesian_prod(along, along, along).expand(len(masks), -1, -1)
        x, y, _ = views.cameras().transform(views.place(points)).unbind(2)
        options = {"padding_mode": "border", "align_corners": False}
        place = torch.stack([x, -y], 2)[:, None]
        inside = F.grid_sample(distances[:, None], place, **options)[:, 0, 0]
        size = masks.shape[-1]
        column, row = (((value + 1) / 2 * size).floor().long() for value in (x, -y))
        shown = (column >= 0) & (column < size) & (row >= 0) & (row < size)
        inside = torch.where(shown, inside, inside.clamp(max=-cells)).view(-1, *[cells] * 3)
        pixel = torch.where(shown, row * size + column, size**2)
        return cls(inside, pixel, (masks.flatten(1) > 0.5).float())

    def select(self, rows: Tensor) -> _Sight:
        """The views `rows`."""
        return _Sight(*(part[rows] for part in self))

    def project(self, values: Tensor) -> Tensor:
        """The largest of the values [s, s, s] on the line of sight of each pixel, [N, S * S]."""
        largest = torch.zeros(len(self.pixel), self.wanted.shape[1] + 1)
        values = values.flatten().expand_as(self.pixel)
        return largest.scatter_reduce(1, self.pixel, values, "amax")[:, :-1]

    def covered(self, cells: Tensor) -> Tensor:
        """The mean share of the masks that cells [s, s, s], which count 0 .. 1, cover."""
        both = (self.project(cells) * self.wanted).sum(1)
        return (both / self.wanted.sum(1)).mean()

    def hull(self) -> Tensor:
        """Distance [s, s, s] to the common hull of the widened outlines and the mirrored ones, positive inside."""
        hull = self.inside.amin(0) + WIDENED
        return torch.minimum(hull, hull.flip(0))


def _distances(outlines: Tensor) -> Tensor:
    """Distance [N, S, S] of pixels to the outline of masks uint8 [N, S, S], positive inside.

    Its unit is a cell of the grid at the object's distance.
    """
    found = []
    for inside in outlines.numpy() > 127:
        within, beyond = map(ndimage.distance_transform_edt, (inside, ~inside))
        found.append(np.where(inside, within - 0.5, 0.5 - beyond))
    scale = CELLS / (BOX * CENTRED_SIZE * outlines.shape[-1])
    return scale * torch.from_numpy(np.float32(found))


def _fill(vertices: Tensor, faces: Tensor) -> Tensor:
    """The cells [s, s, s] of the grid that a shape contains, as 0 and 1."""
    return nmr.voxelize(vertices[None] / BOX + 0.5, faces, size=CELLS)[0].float()


def _average(found: Candidates, weights: Tensor) -> Tensor:
    """The probability [s, s, s] of each cell for candidates with weights [N]."""
    return sum(
        weight * _fill(*mesh)
        for weight, *mesh in zip(weights, found.shapes, found.faces, strict=True)
    )


def _carve_out(
    view: View, masks: Tensor, distances: Tensor, likely: Tensor, bent: Tensor
) -> tuple[Tensor, Tensor] | None:
    """Vertices and faces of the carved shape that is most like the masks; None if no cell is left."""
    sight = _Sight.of(view, distances, masks)
    best, found = -math.inf, None
    for slack in SLACKS:
        mesh = _carve(sight, likely, bent, slack)
        if mesh is not None:
            vertices, faces = smooth(*mesh, rounds=3), mesh[1]
            shapes = ([each] * len(masks) for each in (vertices, faces))
            alike = float(likeness(view, *shapes, masks).mean())
            if alike > best:
                best, found = alike, (vertices, faces)
    return found


def _carve(
    sight: _Sight, likely: Tensor, bent: Tensor, slack: float
) -> tuple[Tensor, Tensor] | None:
    """Vertices and faces of a carved shape; None if it is empty.

    Cells within all outlines, which are widened by `slack` cells, are kept if they are likely, or
    near the likeliest one on the line of sight of a pixel. If the mirrored outlines leave almost
    no pixel without a cell, they carve, too. likely: the probability [s, s, s] of each cell.
    bent: the template, whose box contains the object.
    """
    along = ((torch.arange(CELLS) + 0.5) / CELLS - 0.5) * BOX
    low, high = bent.amin(0)[:, None] - ROOM, bent.amax(0)[:, None] + ROOM
    x, y, z = torch.minimum(along - low, high - along) * (CELLS / BOX)
    room = torch.minimum(torch.minimum(x[:, None, None], y[:, None]), z)
    hull = torch.minimum(sight.inside.amin(0) + slack, room)
    mirrored = torch.minimum(hull, hull.flip(0))
    symmetric, plain = (sight.covered((each > -0.5).float()) for each in (mirrored, hull))
    is_symmetric = bool(symmetric > plain - LOSS)
    if is_symmetric:
        hull, likely = mirrored, (likely + likely.flip(0)) / 2
    near, far = (torch.from_numpy(ndimage.gaussian_filter(likely.numpy(), each)) for each in BLURS)
    values = (hull > -0.5) * (near + FAR * far + 1e-3)
    largest = F.pad(sight.project(values) * sight.wanted, (0, 1)).gather(1, sight.pixel)
    needed = ((values.flatten() >= NEEDED * largest) & (largest > 0)).any(0).view_as(hull)
    if is_symmetric:
        needed |= needed.flip(0)
    away = ndimage.distance_transform_edt(~needed.numpy())
    kept = np.maximum(3 * (near.numpy() - LIKELY), REACH - away).astype(np.float32)
    kept = torch.from_numpy(ndimage.gaussian_filter(kept, 0.7))
    field = _largest_piece(torch.minimum(hull, kept).clamp(-2, 2))
    vertices, faces, *_ = grid_surface(field, level=0.0, box=BOX)
    return (vertices, faces) if len(faces) else None


def _largest_piece(field: Tensor) -> Tensor:
    """The field [s, s, s] without pieces that hang in the air."""
    pieces, _ = ndimage.label((field > 0).numpy(), np.ones((3, 3, 3)))
    sizes = np.bincount(pieces.ravel())[1:]  # 0 is empty space
    if not len(sizes):
        return field
    others = torch.from_numpy((pieces > 0) & (pieces != 1 + sizes.argmax()))
    return torch.where(others, -field, field)
