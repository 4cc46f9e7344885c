"""Turns of prototypes against each other by quarters, to tell front from back (step 3 of `estimate`)."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from learn3d.methods.pose_updates import SIZE, TEMPERATURE
from learn3d.studio.poses.neighbours import Masks, Neighbours

TURNS = 4  # states of a prototype's turn, in steps of 90 degrees
_VOTERS = 5  # nearest masks that vote
_PEAK_WIDTH = 5  # peaks of upper outlines are narrower, in pixels
_PEAK_WEIGHT = 0.002  # weight of their votes; that of nearly equal masks is 1


def turn_azimuths(values: Tensor, turns: Tensor) -> Tensor:
    """Values [B, M, A, E] when shape m is turned by `turns[m]` quarter turns, int64 [M]."""
    azimuths = values.shape[2]
    before = (torch.arange(azimuths) - turns[:, None] * (azimuths // TURNS)) % azimuths
    return values.gather(2, before[None, :, :, None].expand_as(values))


def find_turns(values: Tensor, data: Masks, rng: torch.Generator) -> tuple[Tensor, float]:
    """The quarter turns of the prototypes that give similar masks nearly equal azimuths, int64 [M].

    Also `Estimate.front_votes`.
    """
    posterior = torch.softmax(-values.flatten(1) / TEMPERATURE, 1).reshape(values.shape)
    count, azimuths = values.shape[1:3]
    prototype = posterior.sum((2, 3)).argmax(1)
    azimuth = posterior[torch.arange(len(values)), prototype].sum(2).argmax(1)
    of_masks = _mask_votes(data, prototype, azimuth, count, azimuths)
    votes = of_masks + _PEAK_WEIGHT * _peak_votes(data, prototype, azimuth, count, azimuths)
    best = solve_turns(votes, rng)
    every = np.arange(count)
    same = float(of_masks[best[:, None], best, every[:, None], every].sum())
    opposite = float(of_masks[best[:, None], (best + 2) % TURNS, every[:, None], every].sum())
    best = (best + 2 * (best[0] >= 2)) % TURNS  # half a turn of all prototypes changes no vote
    return torch.from_numpy(best), 1 - opposite / max(same + opposite, 1e-9)


def solve_turns(couplings: Tensor, rng: torch.Generator) -> np.ndarray:
    """The turns t, int64 [M], with the largest sum of couplings[t_i, t_j, i, j] over all i, j."""
    count = couplings.shape[-1]
    coupling = ((couplings + couplings.permute(1, 0, 3, 2)) * (1 - torch.eye(count))).numpy()
    draw = np.random.default_rng(int(torch.randint(2**31, (), generator=rng)))
    best = np.zeros(count, np.int64)
    best_score = -np.inf
    every = np.arange(count)
    for _ in range(200):  # coordinate ascent from random turns
        turns = draw.integers(TURNS, size=count)
        for _ in range(50):
            before = turns.copy()
            for i in draw.permutation(count):
                turns[i] = coupling[:, turns, i, every].sum(1).argmax()
            if (turns == before).all():
                break
        score = coupling[turns[:, None], turns, every[:, None], every].sum()
        if score > best_score:
            best = turns
            best_score = score
    return best


def _mask_votes(
    data: Masks, prototype: Tensor, azimuth: Tensor, count: int, azimuths: int
) -> Tensor:
    """Votes float64 [TURNS, TURNS, M, M] of nearest masks of different prototypes: their weight if these turns of the
    two prototypes make the azimuths nearly equal.

    prototype, azimuth: int64 [N].
    """
    votes = torch.zeros(TURNS, TURNS, count, count, dtype=torch.float64)
    neighbours = Neighbours.of(data, data, prototype, _VOTERS)
    quarter = azimuths // TURNS
    for mirrored, (rows, weights) in enumerate(
        zip(neighbours.rows, neighbours.weights, strict=True)
    ):
        pairs = (prototype[:, None].expand_as(rows), prototype[rows])
        for own, other in itertools.product(range(TURNS), repeat=2):
            turned = (azimuth + own * quarter) * (-1 if mirrored else 1)
            error = (azimuth[rows] + other * quarter - turned[:, None]) % azimuths
            near = torch.minimum(error, azimuths - error) <= azimuths / 12
            votes[own, other].index_put_(pairs, near.double() * weights, accumulate=True)
    return votes


def _peak_votes(
    data: Masks, prototype: Tensor, azimuth: Tensor, count: int, azimuths: int
) -> Tensor:
    """Votes float64 [TURNS, TURNS, M, M] of peaks of upper outlines: a fin, a chair's back.

    The vote of two turned prototypes is the inner product of their mean peaks at all azimuths,
    each azimuth weighted by the roots of its numbers of masks. prototype, azimuth: int64 [N].
    """
    cells = prototype * azimuths + azimuth
    total = (
        torch.zeros(count * azimuths, SIZE)
        .index_add_(0, cells, _peaks(data.masks))
        .view(count, azimuths, SIZE)
    )
    number = torch.bincount(cells, minlength=count * azimuths).view(count, azimuths)
    turned = []
    places = torch.arange(azimuths)
    for turn in range(TURNS):
        plain, mirrored = ((p - turn * (azimuths // TURNS)) % azimuths for p in (places, -places))
        masks = (number[:, plain] + number[:, mirrored])[..., None]
        mean = (total[:, plain] + total[:, mirrored].flip(2)) / masks.clamp_min(1)
        mean = (
            mean - (mean * masks).sum(1, keepdim=True) / masks.sum(1, keepdim=True).clamp_min(1)
        ) * masks.sqrt()
        turned.append(mean.flatten(1))
    stacked = torch.stack(turned).double()
    return torch.einsum("smk,tnk->stmn", stacked, stacked)


def _peaks(masks: Tensor) -> Tensor:
    """Parts of each mask's upper outline narrower than _PEAK_WIDTH pixels: float32 [N, SIZE].

    The outline is the height of the topmost pixel of each column above the centre of mass, 0 in
    empty columns.
    """
    shown = masks.reshape(-1, SIZE, SIZE) > 0.5
    rows = torch.arange(SIZE, dtype=torch.float32)[:, None]
    centre = (shown * rows).sum((1, 2)) / shown.sum((1, 2)).clamp_min(1)
    top = shown.float().argmax(1).float()
    outline = torch.where(shown.any(1), centre[:, None] - top, 0.0).numpy()
    size = {"size": (1, _PEAK_WIDTH), "mode": "constant"}
    eroded = ndimage.grey_erosion(outline, **size, cval=0.0)
    return torch.from_numpy(outline - ndimage.grey_dilation(eroded, **size, cval=-SIZE))
