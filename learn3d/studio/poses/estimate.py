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
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from pydantic import Field
from scipy import ndimage
from torch import Tensor
from tqdm import tqdm

import nmr
from learn3d.data.pose_table import MAX_CANDIDATES
from learn3d.methods.pose_updates import SIZE, TEMPERATURE
from learn3d.networks.encoders import CODE_SIZE
from learn3d.networks.generators import GENERATORS
from learn3d.settings import checked
from learn3d.terminal import progress

MAX_FITTED = 6000  # images that shapes are fitted to and that can be neighbours
MIN_IMAGES = 100  # with fewer images, no pose is trusted
NEAR_DEG = 30.0  # largest error of an azimuth that counts as right
TURNS = 4  # states of a prototype's turn, in steps of 90 degrees
STAGES = 3  # repetitions of the steps 2 to 4
MAX_CONFIDENCE = 0.88  # if the nearest masks all agree; below 1, as they also agree if all are turned by 180 degrees
_BATCH = 256
_NEIGHBOURS, _VOTERS = 8, 5  # nearest masks for smoothing, and for votes on turns
_NEIGHBOUR_SCALE = 0.1  # distance at which the weight of a neighbour has fallen to 1 / e
_FAR = 9.0  # distance of masks that must not be neighbours
_PEAK_WIDTH = 5  # peaks of upper outlines are narrower, in pixels
_PEAK_WEIGHT = 0.002  # weight of their votes; that of nearly equal masks is 1


@checked
class PoseOptions:
    azimuths: Annotated[int, Field(ge=4, le=360, multiple_of=4)] = 24
    """Number of candidate azimuths, equally spaced; a multiple of 4."""
    prototypes: Annotated[int, Field(ge=1, le=64)] = 24
    """Number of fitted shapes, each for one kind of object."""
    restarts: Annotated[int, Field(ge=1, le=100)] = 4
    """Number of initialisations of the mean shape; the best one is kept."""
    repeats: Annotated[int, Field(ge=1, le=100)] = 3
    """Number of independent estimates that are averaged: more are more reliable and take longer."""
    prior: Literal["uniform", "free"] = "uniform"
    """Prior over azimuths. uniform: all azimuths are about equally frequent in the data. free: no
    assumption."""
    steps: Annotated[int, Field(ge=1, le=100_000)] = 300
    """Optimisation steps of each mean shape and of each of the three stages of the prototypes."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of the initial shapes and of the order of the images."""
    candidates: Annotated[int, Field(ge=1, le=MAX_CANDIDATES)] = 4
    """Number of poses of each image with a probability above 0; each training step draws one."""


class CandidatePoses(NamedTuple):
    """A x E candidate poses at one distance and field of view.

    Pose a * E + e has azimuth a and elevation e.
    """

    azimuth_deg: Tensor  # float32 [A]
    elevation_deg: Tensor  # float32 [E]
    distance: float
    half_fov_deg: float


class Masks(NamedTuple):
    """N masks, each with its possible elevations and its object."""

    masks: Tensor  # float32 [N, SIZE^2]
    allowed: Tensor  # bool [N, E]: possible elevations
    objects: Tensor  # int64 [N]: ids

    def select(self, rows: Tensor) -> Masks:
        """The masks `rows`."""
        return Masks(*(part[rows] for part in self))


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
    turns = _solve_turns(torch.einsum("smna,tkna->stmk", stacked, stacked), rng)
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
        turns, front_votes = _turns(values, shapes.data, shapes.rng)
        shapes.turns = (shapes.turns + turns) % TURNS
        own = _posteriors(-_turned(values, turns) / TEMPERATURE, options.prior)
        smoothed = of_fitted.smooth(own.sum(1), options.prior)
        log_prior = (smoothed + 1e-3).log()
    chunks = (
        shapes.all_distances(data.select(rows))
        for rows in torch.arange(len(data.masks)).split(2048)
    )
    alone = torch.cat([_posteriors(-values / TEMPERATURE, "free").sum(1) for values in chunks])
    posterior = _normalize(alone**0.3 * (of_all.message(smoothed) + 1e-3))
    agreement = of_all.message(own.sum(1)).sum(2)
    return posterior, agreement, shapes, own.sum((2, 3)).mean(0), front_votes


class Shapes:
    """M shapes, symmetric about x = 0: a generator, a code for each shape, one offset for all.

    They are fitted to the masks `data`.
    """

    def __init__(
        self,
        data: Masks,
        candidates: CandidatePoses,
        options: PoseOptions,
        rng: torch.Generator,
        bar: tqdm,
    ) -> None:
        self.data = data
        self.candidates = candidates
        self.options = options
        self.rng = rng
        self.bar = bar
        self.network = GENERATORS["sphere-small"](symmetry="x")
        scale = torch.exp(torch.empty(3).uniform_(np.log(0.3), 0.0, generator=rng))
        self.base = 0.5 * self.network.place(self.network.sphere) * (scale - 1)
        self.codes = torch.zeros(1, CODE_SIZE)
        # azimuth 0 of shape m is the common azimuth 90 * turns[m]
        self.turns = torch.zeros(1, dtype=torch.int64)

    def vertices(self) -> Tensor:
        """Vertices float32 [M, V, 3], before any turn."""
        return self.network(self.codes) + self.base

    def distances(self, masks: Tensor, vertices: Tensor, elevations: slice = slice(None)) -> Tensor:
        """1 - soft IoU of masks [B, SIZE^2] with all shapes at these elevations: [B, M, A, E].

        Views from azimuths above 180 degrees are mirror images.
        """
        azimuth_deg, elevation_deg, distance, half_fov_deg = self.candidates
        count = len(vertices)
        half = len(azimuth_deg) // 2 + 1
        azimuth, elevation = torch.meshgrid(
            azimuth_deg[:half], elevation_deg[elevations], indexing="ij"
        )
        angles = (elevation.flatten().repeat(count), azimuth.flatten().repeat(count))
        cameras = nmr.LookAt.from_angles(distance, *angles, half_fov_deg=half_fov_deg)
        repeated = vertices.repeat_interleave(azimuth.numel(), 0)
        right = nmr.render_silhouette(repeated, self.network.faces, cameras, image_size=SIZE)
        right = right.reshape(count, half, -1, SIZE, SIZE)
        rendered = torch.cat([right, right[:, 1:-1].flip(1, 4)], 1)
        values = distances(masks, rendered.flatten(3).flatten(0, 2)).reshape(
            len(masks), *rendered.shape[:3]
        )
        return _turned(values, self.turns)

    @torch.no_grad()
    def all_distances(self, data: Masks) -> Tensor:
        """`distances` of all masks, infinite at elevations that are not allowed."""
        vertices = self.vertices()
        values = torch.cat([self.distances(part, vertices) for part in data.masks.split(1024)])
        return values.masked_fill(~data.allowed[:, None, None], float("inf"))

    def fit(
        self, *, start: float, smoothness_weight: float, log_prior: Tensor | None = None
    ) -> None:
        """EM: the IoU gives posteriors over shapes and poses, then a gradient step fits the shapes.

        The temperature falls from `start` to `TEMPERATURE`. log_prior: [N, A, E].
        """
        self.codes.requires_grad_()
        groups = [{"params": self.network.parameters()}]
        if len(self.codes) > 1:
            groups.append({"params": [self.codes], "lr": 1e-2})
        optimizer = torch.optim.Adam(groups, 4e-4)
        masks, allowed, _ = self.data
        steps = self.options.steps
        rows = torch.arange(len(masks))
        elevations = slice(None)
        known = bool((allowed.sum(1) == 1).all())
        for step in range(steps):
            if known:  # a batch has a single elevation
                e = int(torch.multinomial(allowed.sum(0).double(), 1, generator=self.rng))
                rows = torch.nonzero(allowed[:, e])[:, 0]
                elevations = slice(e, e + 1)
            batch = rows[torch.randint(len(rows), (_BATCH,), generator=self.rng)]
            vertices = self.vertices()
            values = self.distances(masks[batch], vertices, elevations)
            logits = -values.detach() / (
                start ** (1 - step / steps) * TEMPERATURE ** (step / steps)
            )
            if log_prior is not None:
                logits = logits + log_prior[batch][:, None, :, elevations]
            loss = (_posteriors(logits, self.options.prior) * values).sum((1, 2, 3)).mean()
            total = loss + smoothness_weight * nmr.losses.smoothness_loss(
                vertices, self.network.edges
            )
            optimizer.zero_grad()
            total.backward()
            optimizer.step()
            self.bar.update()
        self.codes.requires_grad_(False)

    def loss(self) -> float:
        """The mean silhouette loss over all masks."""
        values = self.all_distances(self.data)
        posterior = _posteriors(-values / TEMPERATURE, self.options.prior)
        return float((posterior * values.nan_to_num(posinf=0.0)).sum((1, 2, 3)).mean())

    @torch.no_grad()
    def align(self) -> Tensor:
        """Vertices [M, V, 3] in the common frame, each shape turned by its `turns`."""
        angle = self.turns * (2 * math.pi / TURNS)
        cos = angle.cos().round()[:, None]
        sin = angle.sin().round()[:, None]
        x, y, z = self.vertices().unbind(2)
        return torch.stack([cos * x - sin * z, y, sin * x + cos * z], 2)


def _turned(values: Tensor, turns: Tensor) -> Tensor:
    """Values [B, M, A, E] when shape m is turned by `turns[m]` quarter turns, int64 [M]."""
    azimuths = values.shape[2]
    before = (torch.arange(azimuths) - turns[:, None] * (azimuths // TURNS)) % azimuths
    return values.gather(2, before[None, :, :, None].expand_as(values))


def distances(masks: Tensor, others: Tensor) -> Tensor:
    """1 - soft IoU of each of B masks with each of C: float [B, C]."""
    common = masks @ others.T
    return 1 - common / (masks.sum(1)[:, None] + others.sum(1) - common).clamp_min(1e-6)


def _posteriors(logits: Tensor, prior: str) -> Tensor:
    """Posterior [B, M, A, E] over shapes and poses.

    With the prior "uniform", all azimuths get about the same mass.
    """
    bias = torch.zeros(logits.shape[2], dtype=torch.float64)
    if prior == "uniform":
        azimuth_logits = logits.logsumexp((1, 3)).double()
        for _ in range(20):
            marginal = torch.softmax(azimuth_logits + bias, 1).mean(0)
            bias = bias - (marginal.clamp_min(1e-12) * len(bias)).log()
    biased = logits + bias.float()[:, None]
    return torch.softmax(biased.flatten(1), 1).reshape(logits.shape)


class Neighbours(NamedTuple):
    """The n nearest masks of other objects, for each of N masks and for its mirror image."""

    rows: Tensor  # int64 [2, N, n]: of the masks, of their mirror images
    weights: Tensor  # float32 [2, N, n]

    @classmethod
    def of(
        cls, data: Masks, known: Masks, kinds: Tensor | None = None, count: int = _NEIGHBOURS
    ) -> Neighbours:
        """Neighbours of `data` among `known`: other objects, and other `kinds` (int64 [N])."""
        found = []
        for source in (data.masks, data.masks.reshape(-1, SIZE, SIZE).flip(2).flatten(1)):
            for part in torch.arange(len(source)).split(512):
                far = data.objects[part][:, None] == known.objects
                far |= data.allowed[part].float() @ known.allowed.float().T == 0
                if kinds is not None:
                    far |= kinds[part][:, None] == kinds
                values = distances(source[part], known.masks).masked_fill(far, _FAR)
                found.append(values.topk(min(count, values.shape[1]), 1, largest=False))
        values, rows = (
            torch.cat(part).view(2, len(data.masks), -1) for part in zip(*found, strict=True)
        )
        return cls(rows, torch.exp(-values / _NEIGHBOUR_SCALE))

    def message(self, posterior: Tensor) -> Tensor:
        """Weighted sum of the neighbours' posteriors [N', A, E], mirrored ones at -a: [N, A, E]."""
        back = (-torch.arange(posterior.shape[1])) % posterior.shape[1]
        total = 0
        for mirrored, (rows, weights) in enumerate(zip(self.rows, self.weights, strict=True)):
            source = posterior[:, back] if mirrored else posterior
            for n in range(rows.shape[1]):
                total = total + weights[:, n, None, None] * source[rows[:, n]]
        return total

    def smooth(self, posterior: Tensor, prior: str, rounds: int = 10) -> Tensor:
        """Posteriors [N, A, E] after `rounds` of message passing between neighbours."""
        result = posterior
        for _ in range(rounds):
            result = _normalize(posterior**0.3 * (self.message(result) + 1e-3))
            if prior == "uniform":
                result = _normalize(result / result.sum(2).mean(0)[:, None].clamp_min(1e-9))
        return result


def _normalize(posterior: Tensor) -> Tensor:
    return posterior / posterior.sum((1, 2), keepdim=True)


def _turns(values: Tensor, data: Masks, rng: torch.Generator) -> tuple[Tensor, float]:
    """The quarter turns of the prototypes that give similar masks nearly equal azimuths, int64 [M].

    Also `Estimate.front_votes`.
    """
    posterior = torch.softmax(-values.flatten(1) / TEMPERATURE, 1).reshape(values.shape)
    count, azimuths = values.shape[1:3]
    prototype = posterior.sum((2, 3)).argmax(1)
    azimuth = posterior[torch.arange(len(values)), prototype].sum(2).argmax(1)
    of_masks = _mask_votes(data, prototype, azimuth, count, azimuths)
    votes = of_masks + _PEAK_WEIGHT * _peak_votes(data, prototype, azimuth, count, azimuths)
    best = _solve_turns(votes, rng)
    every = np.arange(count)
    same = float(of_masks[best[:, None], best, every[:, None], every].sum())
    opposite = float(of_masks[best[:, None], (best + 2) % TURNS, every[:, None], every].sum())
    best = (best + 2 * (best[0] >= 2)) % TURNS  # half a turn of all prototypes changes no vote
    return torch.from_numpy(best), 1 - opposite / max(same + opposite, 1e-9)


def _solve_turns(couplings: Tensor, rng: torch.Generator) -> np.ndarray:
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
