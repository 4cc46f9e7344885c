"""Shapes that are fitted to masks of unknown pose (steps 1 and 2 of `estimate`)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import nmr
from learn3d.methods.optimization import adam
from learn3d.methods.pose_updates import SIZE, TEMPERATURE
from learn3d.networks.encoders import CODE_SIZE
from learn3d.networks.generators import GENERATORS
from learn3d.studio.poses.neighbours import Masks, distances
from learn3d.studio.poses.options import PoseOptions
from learn3d.studio.poses.turns import TURNS, turn_azimuths

_BATCH = 256


class CandidatePoses(NamedTuple):
    """A x E candidate poses at one distance and field of view.

    Pose a * E + e has azimuth a and elevation e.
    """

    azimuth_deg: Tensor  # float32 [A]
    elevation_deg: Tensor  # float32 [E]
    distance: float
    half_fov_deg: float


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
        return turn_azimuths(values, self.turns)

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
        optimizer = adam(self.network, 4e-4)
        if len(self.codes) > 1:
            optimizer.add_param_group({"params": [self.codes], "lr": 1e-2})
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
            loss = (compute_posteriors(logits, self.options.prior) * values).sum((1, 2, 3)).mean()
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
        posterior = compute_posteriors(-values / TEMPERATURE, self.options.prior)
        return float((posterior * values.nan_to_num(posinf=0.0)).sum((1, 2, 3)).mean())

    @torch.no_grad()
    def align(self) -> Tensor:
        """Vertices [M, V, 3] in the common frame, each shape turned by its `turns`."""
        angle = self.turns * (2 * math.pi / TURNS)
        cos = angle.cos().round()[:, None]
        sin = angle.sin().round()[:, None]
        x, y, z = self.vertices().unbind(2)
        return torch.stack([cos * x - sin * z, y, sin * x + cos * z], 2)


def compute_posteriors(logits: Tensor, prior: str) -> Tensor:
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
