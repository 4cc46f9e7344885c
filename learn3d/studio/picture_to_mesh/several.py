"""One shape from several pictures of an object whose cameras are unknown.

The cameras are those from which generated shapes look like the pictures, and whose outlines
contradict each other least. Then the object is carved out of a grid: a cell is kept if all
outlines contain it, and likely shapes contain it or an outline needs it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from torch import Tensor

import nmr
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
CELLS, BOX = 80, 1.1  # cells along each side of the grid, and its side in the object frame
ROOM = 0.2  # distance from the box of the bent template up to which the object reaches
LIKELY = 0.4  # probability above which a cell is kept if all outlines contain it
NEEDED = 0.9  # share of the largest probability on a line of sight from which a cell is kept, too
REACH = 2.0  # cells around a needed one that are kept, so that thin legs are whole
BLURS = (1.0, 5.0)  # cells by which probabilities are blurred, for likely and for needed cells
FAR = 0.1  # weight of the second ones
LOSS = 0.03  # share of the outlines that an object mirrored in x may leave uncovered
SHARPNESS = 0.1  # differences of two shapes' scores that make one e times as likely
# cells by which the outlines are widened while the cameras are fitted, in two tries
SLACKS = ((1.0,), (2.0, 1.0))
LAST_SLACKS = (0.3, 0.7)  # and afterwards; the most alike of all shapes is taken
CAMERA_STEPS = 15  # steps of the cameras between two rounds
# mean outline IoU from which the bent template is taken, which has straighter parts
STRAIGHT = 0.85
COLORS = 5.0  # weight of the distance of two pictures' colours; that of their codes is 1
SAMPLES = 500  # pixels of a picture whose colours are compared
# a picture shows something else if its distance to the nearest one exceeds that of the others by this
STRANGE = 0.6
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
    beliefs = [each.azimuths for each in predicted]
    looks = [
        _look_around(shape, faces, masks, beliefs, known)
        for shape, faces in zip(found.shapes, found.faces, strict=True)
    ]
    scores, views = zip(*looks, strict=True)
    if known is None:
        scores = _agree(torch.stack(scores), views, found.prior, distances, masks)
    rows, values = zip(*map(_choose_views, scores), strict=True)
    seen = torch.stack(values) + found.prior
    best = seen.topk(min(STRETCHED, len(seen))).indices.tolist()
    progress("stretch", 0.5)
    chosen = [views[row].select(rows[row]) for row in best]
    found = found.select(best)
    stretched, shapes, cost = stretch(_join(chosen), found.shapes, found.faces, masks, free)
    alike = likeness(
        stretched, _repeat(shapes, len(masks)), _repeat(found.faces, len(masks)), masks
    )
    total = (alike + _believe(stretched, beliefs)).view(len(best), -1).mean(1) + found.prior - cost
    one = int(total.argmax())
    found = found._replace(shapes=shapes)
    progress("surface", 0.7)
    likely = _average(found, ((total - total[one]) / SHARPNESS).softmax(0))
    rows = one * len(masks) + torch.arange(len(masks))
    view = stretched.select(rows)
    faces = found.faces[one]
    view, bent = bend(view, shapes[one], faces, masks, free)
    ious = view.ious(bent[None], faces, masks)
    is_template = float(ious.mean()) > STRAIGHT
    if not is_template:
        likely = (likely + _fill(bent, faces)) / 2
        carved = _carve_out(view, masks, distances, likely, bent, free)
        if carved is not None:
            view, bent, faces = carved
            ious = view.ious(bent[None], faces, masks)
        is_template = carved is None
    centre = (bent.amin(0) + bent.amax(0)) / 2
    size = 1 / float((bent.amax(0) - bent.amin(0)).max())  # the longest side becomes 1
    moved = view.shift + (view.axes()[:, :2] @ centre)
    view = view._replace(log_distance=view.log_distance + math.log(size), shift=size * moved)
    return SeveralFit(size * (bent - centre), faces, view, ious, found.kinds[one], is_template)


def _look_around(
    vertices: Tensor,
    faces: Tensor,
    masks: Tensor,
    beliefs: Sequence[Tensor | None],
    known: View | None,
) -> tuple[Tensor, View]:
    """Scores [M, N] of a shape in M views as explanations of N masks, and the views."""
    if known is not None:
        scores = _all_ious(known, vertices, faces, masks)
        return torch.where(torch.eye(len(masks), dtype=torch.bool), scores, -1.0), known
    azimuths = -180 + (torch.arange(AZIMUTHS) + 0.5) * (360 / AZIMUTHS)
    grid = torch.cartesian_prod(azimuths, torch.tensor(ELEVATIONS_DEG))
    views = frame_view(vertices, grid[:, 0], grid[:, 1])
    bonus = torch.stack([belief(views.azimuth_deg, each) for each in beliefs], 1)
    return _all_ious(views, vertices, faces, masks) + bonus, views


def _agree(
    scores: Tensor, views: Sequence[View], prior: Tensor, distances: Tensor, masks: Tensor
) -> Tensor:
    """Scores [K, M, N] without azimuths at which the outlines of the N pictures contradict each other.

    The scores of K candidates give each picture its likeliest azimuths. Of the likeliest layouts
    of all cameras, that one is taken whose outlines, together with the mirrored ones, carve away
    least of each other.
    """
    levels = len(ELEVATIONS_DEG)
    chances = (torch.stack([_choose_views(each)[1] for each in scores]) + prior) / AGREEMENT
    mean = torch.einsum("k,kmn->mn", chances.softmax(0), scores)
    best, level = mean.view(AZIMUTHS, levels, -1).max(1)
    is_mode = (best >= best.roll(1, 0)) & (best >= best.roll(-1, 0))
    values, modes = torch.where(is_mode, best, best - 1).topk(MODES, 0)
    rows = (modes * levels + level.gather(0, modes)).T.flatten()
    view = views[int(chances.argmax())].select(rows)
    small = F.interpolate(masks[:, None], COARSE, mode="area")[:, 0]
    sight = _Sight.of(
        view,
        distances.repeat_interleave(MODES, 0) * (COARSE / CELLS),
        small.repeat_interleave(MODES, 0),
        COARSE,
    )
    choices = torch.cartesian_prod(*[torch.arange(MODES)] * len(masks))
    score = values.gather(0, choices).mean(1)
    likely = score.topk(min(LAYOUTS, len(score))).indices.tolist()
    first = MODES * torch.arange(len(masks))

    def agreement(layout: int) -> float:
        chosen = sight.select(first + choices[layout])
        hull = chosen.inside.amin(0) + WIDENED
        return float(score[layout]) + chosen.covered(torch.minimum(hull, hull.flip(0)) > 0)

    layout = max(likely, key=agreement)
    azimuth = modes.gather(0, choices[layout][None])[0]
    apart = (torch.arange(AZIMUTHS)[:, None] - azimuth).abs()
    near = torch.minimum(apart, AZIMUTHS - apart) <= 1
    return torch.where(near.repeat_interleave(levels, 0), scores, scores - 1)


def _choose_views(scores: Tensor) -> tuple[Tensor, Tensor]:
    """The best view of each of N pictures by scores [M, N], int64 [N], and the mean of their scores.

    Who walks around an object holds the camera about equally high, so elevations that differ cost
    something.
    """
    levels = len(ELEVATIONS_DEG)
    if len(scores) != AZIMUTHS * levels:  # the views are known
        return scores.argmax(0), scores.amax(0).mean()
    apart = (torch.arange(levels)[:, None] - torch.arange(levels)).abs()
    costs = scores.view(AZIMUTHS, levels, 1, -1) - APART * apart[:, :, None]
    best, rows = costs.flatten(0, 1).max(0)
    common = int(best.mean(1).argmax())
    return rows[common], best[common].mean()


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


def _believe(views: View, beliefs: Sequence[Tensor | None]) -> Tensor:
    """The bonus [K N] of each view, where view k N + n belongs to picture n."""
    azimuths = views.azimuth_deg.view(-1, len(beliefs)).unbind(1)
    return torch.stack([belief(*each) for each in zip(azimuths, beliefs, strict=True)], 1).flatten()


def _join(views: Sequence[View]) -> View:
    return View(*(torch.cat(parts) for parts in zip(*views, strict=True)))


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

    def covered(self, cells: Tensor) -> float:
        """The mean share of the masks that cells [s, s, s], bool, cover."""
        both = (self.project(cells.float()) * self.wanted).sum(1)
        return float((both / self.wanted.sum(1)).mean())


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
    view: View, masks: Tensor, distances: Tensor, likely: Tensor, bent: Tensor, free: int
) -> tuple[View, Tensor, Tensor] | None:
    """Carve shapes, and fit the cameras to them. Returns the one most like the masks.

    None if no cell is left. free: see `minimize`.
    """
    best, found = -math.inf, None
    for slacks in SLACKS if free else ((),):
        fitted = view
        for slack in slacks:
            mesh = _carve(_Sight.of(fitted, distances, masks), likely, bent, slack)
            if mesh is not None:
                misfit = _misfit(*mesh, masks)
                fitted = minimize(misfit, fitted, CAMERA_STEPS, (0.01,), free=free)
        sight = _Sight.of(fitted, distances, masks)
        for slack in LAST_SLACKS:
            mesh = _carve(sight, likely, bent, slack)
            if mesh is not None:
                vertices, faces = smooth(*mesh, rounds=3), mesh[1]
                shapes = ([each] * len(masks) for each in (vertices, faces))
                alike = float(likeness(fitted, *shapes, masks).mean())
                if alike > best:
                    best, found = alike, (fitted, vertices, faces)
    return found


def _misfit(vertices: Tensor, faces: Tensor, masks: Tensor) -> Callable[[View], Tensor]:
    return lambda view: -view.ious(vertices[None], faces, masks).sum()


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
    is_symmetric = sight.covered(mirrored > -0.5) > sight.covered(hull > -0.5) - LOSS
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
