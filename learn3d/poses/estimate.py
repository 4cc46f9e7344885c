"""Azimuths of cameras from masks alone.

1. A mean shape is fitted to all masks: it is rendered at every candidate pose, and each mask weighs the candidates by
   its IoU with them. It starts anew several times; the start with the smallest silhouette loss is kept.
2. Prototypes grow from it in the same way (EM over prototype and pose), which tells kinds of objects apart.
3. Silhouettes hardly tell front from back, so a prototype may be turned by 180 degrees against the others. Nearly equal
   masks of different prototypes vote for or against a turn, and so do upper outlines, which show what stands up at one
   end only: an airplane's fin, a chair's back. It is an Ising problem with a spin for each prototype.
4. The posteriors over poses are smoothed over the nearest masks and the nearest mirror images. Then the prototypes are
   trained again with the smoothed posteriors as a prior. Steps 3 and 4 are repeated.

Objects are taken for mirror images of themselves at x = 0: one looks from azimuth -a as its mirror image does from a.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

import nmr
from learn3d.networks import CODE_SIZE, GENERATORS
from learn3d.settings import Rare, checked

SIZE = 32  # side of the masks and renderings that are compared, in pixels
MOST = 6000  # images that shapes are fitted to and that neighbours are looked for in
FEWEST = 100  # images below which no pose is trusted
NEAR_DEG = 30.0  # azimuths that are closer count as the same
ROUNDS = 3  # stages of the prototypes
#: Confidence of an image whose nearest masks all agree: objects that are turned by 180 degrees as a whole agree, too.
SUREST = 0.88
_BATCH = 256
_TEMPERATURE = 0.02  # of 1 - IoU
_NEIGHBOURS, _VOTERS = 8, 5  # nearest masks that smooth, and that vote on turns
_NEIGHBOUR_SCALE = 0.1  # distance at which the weight of a neighbour has fallen to 1 / e
_FAR = 9.0  # distance of masks that must not be neighbours
_OUTLINES = 0.5  # weight of the votes of upper outlines, those of nearly equal masks having 1


@checked
class PoseOptions:
    """Options of the estimate."""

    azimuths: Annotated[int, Field(ge=4, le=360, multiple_of=2)] = 24
    """Number of candidate azimuths, equally spaced."""
    prototypes: Annotated[int, Field(ge=1, le=64)] = 24
    """Number of shapes that stand for the kinds of objects."""
    restarts: Annotated[int, Field(ge=1, le=100)] = 4
    """Number of mean shapes to try."""
    prior: Literal["uniform", "free"] = "uniform"
    """Azimuths in the data as a whole. uniform: all are about equally frequent. free: nothing is assumed."""
    steps: Rare[Annotated[int, Field(ge=1, le=100_000)]] = 300
    """Optimisation steps of each mean shape and of each of the three stages of the prototypes."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of the first shapes and of the order of the images."""

    @property
    def all_steps(self) -> int:
        """Number of optimisation steps of the whole estimate."""
        return self.steps * (self.restarts + ROUNDS)


@dataclass(frozen=True, eq=False)
class Candidates:
    """The A x E poses that are rendered, seen by one camera; pose a * E + e has azimuth a and elevation e."""

    azimuth_deg: Tensor  # float32 [A]
    elevation_deg: Tensor  # float32 [E]
    distance: float
    half_fov_deg: float

    def cameras(self, copies: int, elevations: slice = slice(None)) -> nmr.LookAt:
        """The cameras of these elevations, for each of several shapes."""
        azimuth, elevation = torch.meshgrid(self.azimuth_deg, self.elevation_deg[elevations], indexing="ij")
        angles = (elevation.flatten().repeat(copies), azimuth.flatten().repeat(copies))
        return nmr.LookAt.from_angles(self.distance, *angles, half_fov_deg=self.half_fov_deg)


@dataclass(frozen=True, eq=False)
class Masks:
    """N masks and the elevations that each may have been seen from."""

    masks: Tensor  # float32 [N, SIZE^2]
    allowed: Tensor  # bool [N, E]
    objects: Tensor  # int64 [N]

    def __getitem__(self, rows: Tensor) -> Masks:
        return Masks(self.masks[rows], self.allowed[rows], self.objects[rows])

    def __len__(self) -> int:
        return len(self.masks)

    def batches(self, rng: torch.Generator, steps: int) -> Iterator[tuple[Tensor, slice]]:
        """Rows of a batch and the elevations to render it at: if they are known, those of one elevation at a time."""
        known = bool((self.allowed.sum(1) == 1).all())
        counts = self.allowed.sum(0).double()
        for _ in range(steps):
            rows, elevations = torch.arange(len(self)), slice(None)
            if known:
                e = int(torch.multinomial(counts, 1, generator=rng))
                rows, elevations = torch.nonzero(self.allowed[:, e])[:, 0], slice(e, e + 1)
            yield rows[torch.randint(len(rows), (_BATCH,), generator=rng)], elevations


@dataclass(frozen=True, eq=False)
class Estimate:
    """Posteriors over the candidates, and the prototypes."""

    posterior: Tensor  # float32 [N, A, E]
    confidence: Tensor  # float32 [N]: probability that the best azimuth is right to NEAR_DEG
    prototypes: Tensor  # float32 [M, V, 3], in the frame of the azimuths
    faces: Tensor  # int64 [F, 3]
    weights: Tensor  # float32 [M]: share of the images that each prototype explains


def estimate(
    data: Masks, fitted: Tensor, candidates: Candidates, options: PoseOptions, tick: Callable[[], object] = lambda: None
) -> Estimate:
    """Poses of N masks, none of them empty. The same data, options and number of threads give the same bits.

    fitted: int64, rows of the masks that shapes are fitted to (of more than MOST, some). tick: called after each of the
    `options.all_steps` steps.
    """
    rng = torch.Generator().manual_seed(options.seed)
    fitted = fitted[torch.randperm(len(fitted), generator=rng)[:MOST].sort().values]
    some = data[fitted]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        shapes = _mean_shape(some, candidates, options, rng, tick)
    shapes.codes = 0.3 * torch.randn(options.prototypes, CODE_SIZE, generator=rng)
    shapes.turned = torch.zeros(options.prototypes, dtype=torch.bool)
    neighbours, log_prior = Neighbours.of(some, some), None
    for stage in range(ROUNDS):
        start = 0.03 if stage else 0.05
        _train(shapes, some, options, rng, start=start, smooth=3e-4, log_prior=log_prior, tick=tick)
        shapes.turned = shapes.turned ^ _turns(shapes.all_distances(some), some, rng)
        own = _posteriors(-shapes.all_distances(some) / _TEMPERATURE, options.prior)
        smooth = neighbours.smooth(own.sum(1), options.prior)
        log_prior = (smooth + 1e-3).log()
    posterior, confidence = torch.empty(len(data), *smooth.shape[1:]), torch.empty(len(data))
    for rows in torch.arange(len(data)).split(2048):
        part = data[rows]
        near = Neighbours.of(part, some)
        alone = _posteriors(-shapes.all_distances(part) / _TEMPERATURE, "free").sum(1)
        found = _normalized(alone**0.3 * (near.message(smooth) + 1e-3))
        posterior[rows] = found
        confidence[rows] = SUREST * near_mass(near.message(own.sum(1)).sum(2), found.sum(2).argmax(1))
    if len(some) < FEWEST or _views_coincide(posterior.sum(2).argmax(1), data.objects, options.azimuths):
        confidence = confidence.clamp(max=2 * NEAR_DEG / 360)
    return Estimate(posterior, confidence, *shapes.placed(), own.sum((2, 3)).mean(0))


def near_mass(mass: Tensor, azimuth: Tensor) -> Tensor:
    """The share of masses [N, A] within NEAR_DEG of each azimuth, int64 [N]: float [N]."""
    reach = math.floor(NEAR_DEG * mass.shape[1] / 360)
    near = (azimuth[:, None] + torch.arange(-reach, reach + 1)) % mass.shape[1]
    return mass.gather(1, near).sum(1) / mass.sum(1).clamp_min(1e-9)


def _views_coincide(azimuth: Tensor, objects: Tensor, count: int) -> bool:
    """Whether most pairs of views of an object have nearly equal azimuths, as if it looked alike from all sides."""
    _, which = objects.unique(return_inverse=True)
    views = torch.zeros(int(which.max()) + 1, count).index_put_(
        (which, azimuth), torch.ones(len(which)), accumulate=True
    )
    number = views.sum(1, keepdim=True)
    pairs = views * (number - 1)
    close = views * (
        near_mass(views.repeat_interleave(count, 0), torch.arange(count).repeat(len(views))).view_as(views) * number - 1
    )
    return bool(pairs.sum() > 0 and close.sum() > 0.5 * pairs.sum())


class Shapes:
    """M shapes that are mirror images of themselves at x = 0: a generator, a code for each, and an offset for all."""

    def __init__(self, candidates: Candidates, rng: torch.Generator) -> None:
        self.candidates, self.network = candidates, GENERATORS["sphere-small"](symmetry="x")
        scale = torch.exp(torch.empty(3).uniform_(np.log(0.3), 0.0, generator=rng))
        self.base = 0.5 * self.network.place(self.network.sphere) * (scale - 1)
        self.codes = torch.zeros(1, CODE_SIZE)
        self.turned = torch.zeros(1, dtype=torch.bool)  # whether a prototype's azimuths are counted from its back

    def vertices(self) -> Tensor:
        """Float32 [M, V, 3]."""
        return self.network(self.codes) + self.base

    def distances(self, masks: Tensor, vertices: Tensor, elevations: slice = slice(None)) -> Tensor:
        """1 - soft IoU of masks [B, SIZE^2] with all shapes in all poses of these elevations: [B, M, A, E]."""
        count, azimuths = len(vertices), len(self.candidates.azimuth_deg)
        cameras = self.candidates.cameras(count, elevations)
        repeated = vertices.repeat_interleave(len(cameras.eye) // count, 0)
        prints = nmr.render_silhouette(repeated, self.network.faces, cameras, image_size=SIZE).flatten(1)
        values = distances(masks, prints).reshape(len(masks), count, azimuths, -1)
        return torch.where(self.turned[:, None, None], values.roll(azimuths // 2, 2), values)

    @torch.no_grad()
    def placed(self) -> tuple[Tensor, Tensor]:
        """Vertices [M, V, 3], turned to the common frame, and faces [F, 3]."""
        front = torch.where(self.turned, -1.0, 1.0)[:, None, None] * torch.tensor([1.0, 0.0, 1.0])
        return self.vertices() * (front + torch.tensor([0.0, 1.0, 0.0])), self.network.faces

    @torch.no_grad()
    def all_distances(self, data: Masks) -> Tensor:
        """`distances` of all masks, infinite at elevations that an image does not have."""
        vertices = self.vertices()
        values = torch.cat([self.distances(part, vertices) for part in data.masks.split(1024)])
        return values.masked_fill(~data.allowed[:, None, None], float("inf"))


def distances(masks: Tensor, others: Tensor) -> Tensor:
    """1 - soft IoU of each of B masks with each of C: float [B, C]."""
    common = masks @ others.T
    return 1 - common / (masks.sum(1)[:, None] + others.sum(1) - common).clamp_min(1e-6)


def _train(
    shapes: Shapes,
    data: Masks,
    options: PoseOptions,
    rng: torch.Generator,
    *,
    start: float,
    smooth: float,
    log_prior: Tensor | None = None,
    tick: Callable[[], object] = lambda: None,
) -> None:
    """EM: posteriors over prototypes and poses by the IoU, then a step of the shapes towards the masks.

    The temperature falls from `start` to 0.02. log_prior: float [N, A, E], of the poses of each image.
    """
    shapes.codes.requires_grad_()
    groups = [{"params": shapes.network.parameters()}]
    if len(shapes.codes) > 1:
        groups.append({"params": [shapes.codes], "lr": 1e-2})
    optimizer = torch.optim.Adam(groups, 4e-4)
    for step, (rows, elevations) in enumerate(data.batches(rng, options.steps)):
        done = step / options.steps
        temperature = start ** (1 - done) * _TEMPERATURE**done
        vertices = shapes.vertices()
        values = shapes.distances(data.masks[rows], vertices, elevations)
        logits = -values.detach() / temperature
        if log_prior is not None:
            logits = logits + log_prior[rows][:, None, :, elevations]
        posterior = _posteriors(logits, options.prior)
        loss = (posterior * values).sum((1, 2, 3)).mean()
        total = loss + smooth * nmr.losses.smoothness_loss(vertices, shapes.network.edges)
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        tick()
    shapes.codes.requires_grad_(False)


def _posteriors(logits: Tensor, prior: str) -> Tensor:
    """Posterior [B, M, A, E] over prototypes and poses; with "uniform" all azimuths have about the same mass."""
    bias = torch.zeros(logits.shape[2], dtype=torch.float64)
    if prior == "uniform":
        of_azimuth = logits.logsumexp((1, 3)).double()
        for _ in range(20):
            marginal = torch.softmax(of_azimuth + bias, 1).mean(0)
            bias = bias - (marginal.clamp_min(1e-12) * len(bias)).log()
    biased = logits + bias.float()[:, None]
    return torch.softmax(biased.flatten(1), 1).reshape(logits.shape)


def _mean_shape(
    data: Masks, candidates: Candidates, options: PoseOptions, rng: torch.Generator, tick: Callable[[], object]
) -> Shapes:
    """The mean shape with the smallest silhouette loss of several."""
    found = []
    for _ in range(options.restarts):
        shapes = Shapes(candidates, rng)
        _train(shapes, data, options, rng, start=0.1, smooth=5e-4, tick=tick)
        values = shapes.all_distances(data)
        posterior = _posteriors(-values / _TEMPERATURE, options.prior)
        loss = float((posterior * values.nan_to_num(posinf=0.0)).sum((1, 2, 3)).mean())
        found.append((loss, shapes))
    return min(found, key=lambda pair: pair[0])[1]


@dataclass(frozen=True, eq=False)
class Neighbours:
    """The nearest masks of other objects: of each mask and of its mirror image."""

    rows: Tensor  # int64 [2, N, n]
    weights: Tensor  # float32 [2, N, n]

    @classmethod
    def of(cls, data: Masks, known: Masks, apart: tuple[Tensor, ...] = (), count: int = _NEIGHBOURS) -> Neighbours:
        """Neighbours of `data` among `known`, whose objects are others. apart: int64 [N] each, ids that must differ."""
        rows, weights = [], []
        size = len(data.masks)
        for mirrored in (False, True):
            source = data.masks.reshape(-1, SIZE, SIZE).flip(2).flatten(1) if mirrored else data.masks
            parts = []
            for part in torch.arange(size).split(512):
                values = distances(source[part], known.masks)
                values[data.objects[part][:, None] == known.objects] = _FAR
                shared = data.allowed[part].float() @ known.allowed.float().T
                values[shared == 0] = _FAR
                for ids in apart:
                    values[ids[part][:, None] == ids] = _FAR
                parts.append(values.topk(min(count, values.shape[1]), 1, largest=False))
            rows.append(torch.cat([p.indices for p in parts]))
            weights.append(torch.exp(-torch.cat([p.values for p in parts]) / _NEIGHBOUR_SCALE))
        return cls(torch.stack(rows), torch.stack(weights))

    def message(self, posterior: Tensor) -> Tensor:
        """The weighted sum of the neighbours' posteriors [N', A, E], mirrored ones with azimuth -a: [N, A, E]."""
        back = (-torch.arange(posterior.shape[1])) % posterior.shape[1]
        total = 0
        for mirrored, (rows, weights) in enumerate(zip(self.rows, self.weights, strict=True)):
            source = posterior[:, back] if mirrored else posterior
            for n in range(rows.shape[1]):
                total = total + weights[:, n, None, None] * source[rows[:, n]]
        return total

    def smooth(self, posterior: Tensor, prior: str, rounds: int = 10) -> Tensor:
        """Posteriors [N, A, E], each multiplied by its neighbours' again and again."""
        result = posterior
        for _ in range(rounds):
            result = _normalized(posterior**0.3 * (self.message(result) + 1e-3))
            if prior == "uniform":
                result = _normalized(result / result.sum(2).mean(0)[:, None].clamp_min(1e-9))
        return result


def _normalized(posterior: Tensor) -> Tensor:
    return posterior / posterior.sum((1, 2), keepdim=True)


def _turns(values: Tensor, data: Masks, rng: torch.Generator) -> Tensor:
    """Which prototypes must be turned by 180 degrees for similar masks to have nearly equal azimuths: bool [M]."""
    posterior = torch.softmax(-values.flatten(1) / _TEMPERATURE, 1).reshape(values.shape)
    count, azimuths = values.shape[1:3]
    prototype = posterior.sum((2, 3)).argmax(1)
    azimuth = posterior[torch.arange(len(values)), prototype].sum(2).argmax(1)
    coupling = np.zeros((count, count))
    for weight, votes in (
        (1.0, _mask_votes(data, prototype, azimuth, count, azimuths)),
        (_OUTLINES, _outline_votes(data, prototype, azimuth, count, azimuths)),
    ):
        votes = (votes + votes.T).fill_diagonal_(0)
        coupling += weight * (votes / votes.abs().sum().clamp_min(1e-12)).numpy()
    draw = np.random.default_rng(int(torch.randint(2**31, (), generator=rng)))
    best, best_score = np.ones(count), -np.inf
    for _ in range(200):
        spins = draw.choice([-1.0, 1.0], count)
        for _ in range(50):
            before = spins.copy()
            for i in draw.permutation(count):
                spins[i] = 1.0 if coupling[i] @ spins >= 0 else -1.0
            if (spins == before).all():
                break
        if (score := spins @ coupling @ spins) > best_score:
            best, best_score = spins, score
    return torch.from_numpy(best * best[0] < 0)


def _mask_votes(data: Masks, prototype: Tensor, azimuth: Tensor, count: int, azimuths: int) -> Tensor:
    """For each pair of prototypes, the nearest masks with nearly equal azimuths minus those with opposite ones: float64
    [M, M]. prototype, azimuth: int64 [N].
    """
    votes = torch.zeros(count, count, dtype=torch.float64)
    near = azimuths / 12
    neighbours = Neighbours.of(data, data, (prototype,), _VOTERS)
    for mirrored, (rows, weights) in enumerate(zip(neighbours.rows, neighbours.weights, strict=True)):
        own = (-azimuth) % azimuths if mirrored else azimuth
        apart = (azimuth[rows] - own[:, None]) % azimuths
        apart = torch.minimum(apart, azimuths - apart)
        sign = (apart <= near).double() - (apart >= azimuths / 2 - near).double()
        votes.index_put_((prototype[:, None].expand_as(rows), prototype[rows]), sign * weights, accumulate=True)
    return votes


def _outline_votes(data: Masks, prototype: Tensor, azimuth: Tensor, count: int, azimuths: int) -> Tensor:
    """For each mask and prototype, how much farther the nearest upper outline of the opposite azimuth is than that of
    the same azimuth, summed over the masks of each prototype: float64 [M, M]. prototype, azimuth: int64 [N].
    """
    outlines = _upper_outlines(data.masks)
    votes = torch.zeros(count, count, dtype=torch.float64)
    for part in torch.arange(len(data)).split(512):
        nearest = torch.full((len(part), count * azimuths), float("inf"))
        same_object = data.objects[part][:, None] == data.objects
        for others, seen_from in ((outlines, azimuth), (outlines.flip(1), (-azimuth) % azimuths)):
            values = torch.cdist(outlines[part], others).masked_fill(same_object, float("inf"))
            cells = (prototype * azimuths + seen_from).expand_as(values)
            nearest.scatter_reduce_(1, cells, values, "amin")
        nearest = nearest.view(len(part), count, azimuths)
        rows = torch.arange(len(part))
        gain = nearest[rows, :, (azimuth[part] + azimuths // 2) % azimuths] - nearest[rows, :, azimuth[part]]
        votes.index_add_(0, prototype[part], gain.nan_to_num(0.0, posinf=0.0, neginf=0.0).double())
    return votes


def _upper_outlines(masks: Tensor) -> Tensor:
    """The height of the outline above the centre of mass in each column, 0 in empty ones: float32 [N, SIZE]."""
    shown = masks.reshape(-1, SIZE, SIZE) > 0.5
    rows = torch.arange(SIZE, dtype=torch.float32)[:, None]
    centre = (shown * rows).sum((1, 2)) / shown.sum((1, 2)).clamp_min(1)
    top = shown.float().argmax(1).float()
    return torch.where(shown.any(1), centre[:, None] - top, 0.0)
