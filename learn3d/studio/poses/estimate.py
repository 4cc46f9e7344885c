"""Estimates the azimuths of cameras from masks alone.

1. A mean shape is fitted to all masks. It is rendered at all candidate poses, and each mask weights the poses by the
   IoU. Of several random initialisations, the one with the smallest silhouette loss is kept.
2. Prototypes, shapes for the different kinds of objects, start as the mean shape and are fitted in the same way: EM
   over prototype and pose.
3. Silhouettes hardly tell front from back, nor the long side of a table from its short side. So a prototype may be
   turned by 90 or 180 degrees against the others. Nearly equal masks of different prototypes vote
   for turns. So do peaks of the upper outline: an airplane's fin or a chair's back is at one end
   of the object. The votes are the couplings of a Potts model whose states are the four turns of
   each prototype.
4. The posteriors over poses are smoothed over the nearest masks and the nearest mirrored masks. Then steps 2 to 4 are
   repeated with the smoothed posteriors as a prior.
5. Steps 1 to 4 are repeated from other random shapes, and the posteriors are averaged: a kind of object that is turned
   in one estimate is outvoted by the others.

Objects are assumed to be symmetric about x = 0: the view from azimuth -a is the mirror image of
the view from a.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from learn3d.methods.pose_updates import TEMPERATURE
from learn3d.networks.encoders import CODE_SIZE
from learn3d.studio.poses.neighbours import Masks, Neighbours, normalize
from learn3d.studio.poses.options import PoseOptions
from learn3d.studio.poses.prototypes import CandidatePoses, Shapes, compute_posteriors
from learn3d.studio.poses.turns import TURNS, find_turns, solve_turns, turn_azimuths
from learn3d.terminal import progress

MAX_FITTED = 6000  # images that shapes are fitted to and that can be neighbours
MIN_IMAGES = 100  # with fewer images, no pose is trusted
NEAR_DEG = 30.0  # largest error of an azimuth that counts as right
STAGES = 3  # repetitions of the steps 2 to 4
MAX_CONFIDENCE = 0.88  # if the nearest masks all agree; below 1, as they also agree if all are turned by 180 degrees


@dataclass(frozen=True, eq=False)
class Estimate:
    """Posteriors over the candidates, and the prototypes."""

    posterior: Tensor  # float32 [N, A, E]
    confidence: Tensor  # float32 [N]: probability that the best azimuth is right to NEAR_DEG
    prototypes: Tensor  # float32 [M, V, 3] of the most typical estimate, y up, z away from the camera at azimuth 0
    faces: Tensor  # int64 [F, 3]
    weights: Tensor  # float32 [M]: mean posterior of each prototype
    front_votes: float  # similar masks with equal azimuths, over those with equal or opposite ones; 1 if there are none


def estimate(
    data: Masks, fitted: Tensor, candidates: CandidatePoses, options: PoseOptions
) -> Estimate:
    """Estimate the poses of N masks, none of them empty.

    The same arguments and number of threads give the same bits.

    fitted: int64, rows of the masks that shapes are fitted to; of more than MAX_FITTED rows, a
    random part is used.
    """
    rng = torch.Generator().manual_seed(options.seed)
    fitted = fitted[torch.randperm(len(fitted), generator=rng)[:MAX_FITTED].sort().values]
    subset = data.select(fitted)
    neighbours = (Neighbours.of(subset, subset), Neighbours.of(data, subset))
    steps = options.steps * (options.restarts + STAGES) * options.repeats
    bar = progress(None, "poses", unit="step", total=steps)
    with torch.random.fork_rng(devices=[]), bar:
        torch.manual_seed(options.seed)
        create = functools.partial(Shapes, subset, candidates, options, rng, bar)
        parts = [_estimate_once(options, create, data, *neighbours) for _ in range(options.repeats)]
    posteriors, agreements, shapes, weights, front_votes = zip(*parts, strict=True)
    shifts = _common_frame([posterior.sum(2) for posterior in posteriors], rng)
    posteriors = [values.roll(shift, 1) for values, shift in zip(posteriors, shifts, strict=True)]
    posterior = sum(posteriors) / len(parts)
    agreement = sum(values.roll(shift, 1) for values, shift in zip(agreements, shifts, strict=True))
    best = posterior.sum(2).argmax(1)
    confidence = MAX_CONFIDENCE * (_near(agreement, best) / agreement.sum(1).clamp_min(1e-9))
    _, which = data.objects.unique(return_inverse=True)
    views = torch.bincount(
        which * options.azimuths + best, minlength=options.azimuths * (int(which.max()) + 1)
    )
    views = views.view(-1, options.azimuths)[which]
    pairs = int(views.sum()) - len(views)  # of views of an object
    alike = pairs > 0 and int(_near(views, best).sum()) - len(views) > 0.5 * pairs  # from all sides
    if len(fitted) < MIN_IMAGES or alike:
        confidence = confidence.clamp(max=2 * NEAR_DEG / 360)
    # the most typical one
    k = max(range(len(parts)), key=lambda k: float((posteriors[k] * posterior).sum()))
    shapes[k].turns = (shapes[k].turns + shifts[k] * TURNS // options.azimuths) % TURNS
    votes = sum(front_votes) / len(parts)
    return Estimate(
        posterior, confidence, shapes[k].align(), shapes[k].network.faces, weights[k], votes
    )


def _common_frame(posteriors: list[Tensor], rng: torch.Generator) -> list[int]:
    """The shifts by quarters, 0 for the first, that make posteriors [N, A] overlap most."""
    quarter = posteriors[0].shape[1] // TURNS
    stacked = torch.stack(
        [torch.stack([p.roll(t * quarter, 1) for p in posteriors]) for t in range(TURNS)]
    )
    turns = solve_turns(torch.einsum("smna,tkna->stmk", stacked, stacked), rng)
    return ((turns - turns[0]) % TURNS * quarter).tolist()


def _near(mass: Tensor, azimuth: Tensor) -> Tensor:
    """The mass [N], of [N, A], within NEAR_DEG of the azimuths of index int64 [N]."""
    reach = math.floor(NEAR_DEG * mass.shape[1] / 360)
    return mass.gather(1, (azimuth[:, None] + torch.arange(-reach, reach + 1)) % mass.shape[1]).sum(
        1
    )


def _estimate_once(
    options: PoseOptions,
    create: Callable[[], Shapes],
    data: Masks,
    of_fitted: Neighbours,
    of_all: Neighbours,
) -> tuple[Tensor, Tensor, Shapes, Tensor, float]:
    """Steps 1 to 4 on the masks of the shapes of `create`, then posteriors of all masks `data`.

    of_fitted, of_all: the neighbours of the shapes' masks and of `data` among the shapes' masks.
    Returns, in a frame of its own, the posteriors [N, A, E] of `data` and the added probabilities
    [N, A] of their nearest masks; the shapes and their mean posteriors [M]; and
    `Estimate.front_votes`.
    """
    starts = []
    for _ in range(options.restarts):
        starts.append(create())
        starts[-1].fit(start=0.1, smoothness_weight=5e-4)
    shapes = min(starts, key=Shapes.loss)
    shapes.codes = 0.3 * torch.randn(options.prototypes, CODE_SIZE, generator=shapes.rng)
    shapes.turns = torch.zeros(options.prototypes, dtype=torch.int64)
    log_prior = None
    for stage in range(STAGES):
        shapes.fit(start=0.03 if stage else 0.05, smoothness_weight=3e-4, log_prior=log_prior)
        values = shapes.all_distances(shapes.data)
        turns, front_votes = find_turns(values, shapes.data, shapes.rng)
        shapes.turns = (shapes.turns + turns) % TURNS
        own = compute_posteriors(-turn_azimuths(values, turns) / TEMPERATURE, options.prior)
        smoothed = of_fitted.smooth(own.sum(1), options.prior)
        log_prior = (smoothed + 1e-3).log()
    chunks = (
        shapes.all_distances(data.select(rows))
        for rows in torch.arange(len(data.masks)).split(2048)
    )
    alone = torch.cat(
        [compute_posteriors(-values / TEMPERATURE, "free").sum(1) for values in chunks]
    )
    posterior = normalize(alone**0.3 * (of_all.message(smoothed) + 1e-3))
    agreement = of_all.message(own.sum(1)).sum(2)
    return posterior, agreement, shapes, own.sum((2, 3)).mean(0), front_votes
