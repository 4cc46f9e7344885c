"""One shape from several pictures of an object whose cameras are unknown.

The cameras are those from which a generated shape looks most like the pictures. Then the object
is carved out of a grid: a cell is kept if all outlines contain it, and likely shapes contain it or
an outline needs it.
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
from learn3d.data.dataset import MASK_SIZE
from learn3d.pictures import grid_surface
from learn3d.studio.picture_to_mesh.fit import (
    AZIMUTHS,
    ELEVATIONS_DEG,
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
CELLS, BOX = 64, 1.1  # cells along each side of the grid, and its side in the object frame
LIKELY = 0.2  # probability above which a cell is kept if all outlines contain it
NEEDED = 0.9  # share of the largest probability on a line of sight from which a cell is kept, too
SHARPNESS = 0.1  # differences of two shapes' scores that make one e times as likely
CARVINGS = (1, 0)  # width in pixels by which the outlines are widened in each round
CAMERA_STEPS = 15  # steps of the cameras between two rounds
# mean outline IoU from which the bent template is taken, which has straighter parts
STRAIGHT = 0.85
# cosine of a picture's code and the mean of the others below which it shows something else
ALIKE = 0.5
LEVEL = 0.03  # cost of a camera that stands a level of `ELEVATIONS_DEG` above or below the others
WORSE = 0.15  # a picture is left out if its outline IoU is so much below the median of all


class SeveralFit(NamedTuple):
    """A shape that explains the outlines of N pictures."""

    vertices: Tensor  # float32 [V, 3], object frame
    faces: Tensor  # int64 [F, 3]
    views: View  # N views
    ious: Tensor  # float32 [N]: IoU of mask and silhouette in each view
    kind: str  # category of the template
    is_template: bool  # whether it is a bent template, not a carved shape


def find_strangers(predicted: Sequence[Prediction]) -> list[int]:
    """The pictures whose codes are unlike the others', the most unlike first. Two pictures cannot tell."""
    left, strangers = list(range(len(predicted))), []
    codes = torch.stack([F.normalize(each.code[0], dim=0) for each in predicted])
    while len(left) > 2:
        kept = codes[left]
        others = F.normalize(kept.sum(0) - kept, dim=1)
        cosines = (kept * others).sum(1)
        if cosines.min() > ALIKE:
            break
        strangers.append(left.pop(int(cosines.argmin())))
    return strangers


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
    progress: Progress = lambda *_: None,
    *,
    category: str | None = None,
    known: View | None = None,
) -> SeveralFit:
    """One shape and N cameras for the framed masks float32 [N, 64, 64] of N pictures of the same object.

    category: see `find_candidates`. known: the N cameras if they are known.
    """

    def held(views: View) -> View:
        if known is None:
            return views
        copies = len(views.azimuth_deg) // len(masks)
        return View(
            *(
                torch.cat([part] * copies) + 0 * free
                for part, free in zip(known, views, strict=True)
            )
        )

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
    rows, values = zip(*map(_choose_views, scores), strict=True)
    seen = torch.stack(values) + found.prior
    best = seen.topk(min(STRETCHED, len(seen))).indices.tolist()
    progress("stretch", 0.5)
    chosen = [views[row].select(rows[row]) for row in best]
    found = found.select(best)
    stretched, shapes, cost = stretch(_join(chosen), found.shapes, found.faces, masks, held)
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
    view, bent = bend(view, shapes[one], faces, masks, held)
    ious = view.ious(bent[None], faces, masks)
    is_template = float(ious.mean()) > STRAIGHT
    if not is_template:
        likely = (likely + _fill(bent, faces)) / 2
        carved = _carve_out(view, masks, likely, held)
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


def _choose_views(scores: Tensor) -> tuple[Tensor, Tensor]:
    """The best view of each of N pictures by scores [M, N], int64 [N], and the mean of their scores.

    Who walks around an object holds the camera about equally high, so elevations that differ cost
    something.
    """
    levels = len(ELEVATIONS_DEG)
    if len(scores) != AZIMUTHS * levels:  # the views are known
        return scores.argmax(0), scores.amax(0).mean()
    apart = (torch.arange(levels)[:, None] - torch.arange(levels)).abs()
    costs = scores.view(AZIMUTHS, levels, 1, -1) - LEVEL * apart[:, :, None]
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


def _grid_points(cells: int) -> Tensor:
    """The centres [cells^3, 3] of the cells of the grid."""
    along = ((torch.arange(cells) + 0.5) / cells - 0.5) * BOX
    return torch.cartesian_prod(along, along, along)


class _Seen(NamedTuple):
    """The cells of the grid as N cameras see them."""

    inside: Tensor  # float32 [N, C]: the mask at each cell
    pixel: Tensor  # int64 [N, C]: the pixel that shows it; the last one is outside the picture
    mask: Tensor  # float32 [N, 64 * 64]: 1 at the pixels of the mask

    @classmethod
    def of(cls, views: View, masks: Tensor, points: Tensor, wider: int) -> _Seen:
        """The cells [C, 3] in N views of masks [N, 64, 64], which are widened by some pixels for `inside`."""
        x, y, _ = (
            views.cameras().transform(views.place(points.expand(len(masks), -1, -1))).unbind(2)
        )
        grid = torch.stack([x, -y], 2)[:, None]
        widened = F.max_pool2d(masks[:, None], 2 * wider + 1, 1, wider)
        inside = F.grid_sample(widened, grid, align_corners=False)[:, 0, 0]
        column, row = (((value + 1) / 2 * MASK_SIZE).floor().long() for value in (x, -y))
        shown = (column >= 0) & (column < MASK_SIZE) & (row >= 0) & (row < MASK_SIZE)
        pixel = torch.where(shown, row * MASK_SIZE + column, MASK_SIZE**2)
        return cls(inside, pixel, (masks.flatten(1) > 0.5).float())

    def project(self, values: Tensor) -> Tensor:
        """The largest of the values [C] on the line of sight of each pixel, [N, 64 * 64]."""
        largest = torch.zeros(len(self.pixel), MASK_SIZE**2 + 1)
        return largest.scatter_reduce(1, self.pixel, values.expand_as(self.pixel), "amax")[:, :-1]


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
    view: View, masks: Tensor, likely: Tensor, held
) -> tuple[View, Tensor, Tensor] | None:
    """Carve a shape, and fit the cameras to it, in turn. None if no cell is left."""
    for wider in CARVINGS:
        kept = _largest_piece(_carve(view, masks, likely, wider))
        vertices, faces, *_ = grid_surface(kept, box=BOX)
        if not len(faces):
            return None
        if wider:
            view = held(
                minimize(_misfit(vertices, faces, masks, held), view, CAMERA_STEPS, (0.01,))
            )
    return view, smooth(vertices, faces, rounds=3), faces


def _largest_piece(cells: Tensor) -> Tensor:
    """The cells [s, s, s], 0 or 1, without those that hang in the air."""
    pieces, _ = ndimage.label(cells.numpy(), np.ones((3, 3, 3)))
    sizes = np.bincount(pieces.ravel())[1:]  # 0 is empty space
    return cells * torch.from_numpy(pieces == 1 + sizes.argmax()) if len(sizes) else cells


def _misfit(vertices: Tensor, faces: Tensor, masks: Tensor, held):
    return lambda view: -held(view).ious(vertices[None], faces, masks).sum()


def _carve(view: View, masks: Tensor, likely: Tensor, wider: int) -> Tensor:
    """The kept cells [s, s, s], 0 or 1, for probabilities [s, s, s]: likely ones, and the likeliest of each pixel."""
    seen = _Seen.of(view, masks, _grid_points(CELLS), wider)
    common = seen.inside.amin(0) > 0.5
    values = common * (F.avg_pool3d(likely[None], 3, 1, 1).flatten() + 1e-3)
    largest = F.pad(seen.project(values) * seen.mask, (0, 1)).gather(1, seen.pixel)
    needed = (values >= NEEDED * largest) & (largest > 0)
    kept = (likely.flatten() > LIKELY) | needed.any(0)
    return (kept & common).float().view_as(likely)
