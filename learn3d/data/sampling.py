"""The batches of a training: functions of (data set, seed, step) alone, so that resuming needs no memory of them."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from learn3d.data.augment import Augmentation, augment
from learn3d.data.batch import Batch
from learn3d.data.dataset import ViewDataset

Sampling = Literal["views", "pairs", "groups", "classes"]
GROUP_SIZE = 5  # views of an object in sampling "groups"
#: Views of one object that stand in a batch, [a_1 .. a_n, b_1 .. b_n, ...]; 1 if views are drawn on their own.
VIEWS_OF_OBJECT: dict[Sampling, int] = {"views": 1, "pairs": 2, "groups": GROUP_SIZE, "classes": 1}


class BatchOptions(Protocol):
    """The options of a run that its batches depend on; a `TrainConfig` has them."""

    sampling: Sampling
    batch_size: int
    augment: Sequence[Augmentation]
    seed: int
    iterations: int


def batches(dataset: ViewDataset, options: BatchOptions, start: int = 1) -> Iterator[Batch]:
    """The batches of the training steps `start` .. `options.iterations`, sampled and augmented, without voxels.

    While a step uses a batch, a thread reads the next one from the disk, if the data set is there.
    """
    indices = sample_indices(dataset, options.sampling, options.batch_size, options.seed, start)
    for step in range(start, options.iterations + 1):
        batch = dataset.batch(indices, voxels=False)
        if dataset.candidates is not None:
            batch = dataset.candidates.draw(batch, indices, options.seed, step)
        if step < options.iterations:
            indices = sample_indices(dataset, options.sampling, options.batch_size, options.seed, step + 1)
            dataset.prepare(indices)
        yield augment(batch, options.augment, options.seed, step, inverted=dataset.inverted)


def sample_indices(dataset: ViewDataset, sampling: Sampling, batch_size: int, seed: int, step: int) -> Tensor:
    """Samples of step `step` (from 1), int64 [batch_size].

    "views": every view on its own, epochs of shuffled samples. "pairs": two different views of each of batch_size / 2
    objects drawn at random, [a_1 .. a_n, b_1 .. b_n] (Kato et al. 2018). "groups": likewise GROUP_SIZE views of each,
    different ones if the object has so many. "classes": categories drawn uniformly, then a
    view of each (Kato and Harada 2019).
    """
    if sampling == "views":
        return shuffled_epochs(len(dataset), batch_size, seed, step)
    rng = np.random.default_rng([seed, step])
    if sampling in ("pairs", "groups"):
        starts, order = _views_by_object(dataset)
        sizes = np.diff(starts)
        able = np.flatnonzero(sizes >= 2)
        if len(able) == 0:
            raise ValueError("no object has two views; a multi-view method needs at least two views of an object")
        if sampling == "groups":
            objects = able[rng.integers(len(able), size=batch_size // GROUP_SIZE)]
            views = [rng.permutation(max(size, GROUP_SIZE))[:GROUP_SIZE] % size for size in sizes[objects]]
            return torch.from_numpy(order[starts[objects, None] + np.array(views)].T.reshape(-1))
        objects = able[rng.integers(len(able), size=batch_size // 2)]
        first = rng.integers(sizes[objects])
        second = (first + rng.integers(1, sizes[objects])) % sizes[objects]
        return torch.from_numpy(np.concatenate([order[starts[objects] + first], order[starts[objects] + second]]))
    if sampling == "classes":
        members = _views_by_class(dataset)
        drawn = rng.integers(dataset.num_classes, size=batch_size)
        return torch.from_numpy(np.array([members[c][rng.integers(len(members[c]))] for c in drawn]))
    raise ValueError(f"sampling must be views, pairs or classes, got {sampling!r}")


def shuffled_epochs(num_samples: int, batch_size: int, seed: int, step: int) -> Tensor:
    """The next ones of an endless row of shuffled epochs."""
    positions = range((step - 1) * batch_size, step * batch_size)
    pieces = []
    for epoch in range(positions.start // num_samples, (positions.stop - 1) // num_samples + 1):
        first = max(positions.start - epoch * num_samples, 0)
        end = min(positions.stop - epoch * num_samples, num_samples)
        pieces.append(_epoch_order(num_samples, seed, epoch)[first:end])
    return torch.cat(pieces)


@functools.lru_cache(maxsize=2)
def _epoch_order(num_samples: int, seed: int, epoch: int) -> Tensor:
    generator = torch.Generator().manual_seed((seed * 1_000_003 + epoch) % 2**63)
    return torch.randperm(num_samples, generator=generator)


@functools.lru_cache(maxsize=2)
def _views_by_object(dataset: ViewDataset) -> tuple[np.ndarray, np.ndarray]:
    """(starts [N+1], samples ordered by object [M])."""
    order = np.argsort(dataset.object_ids, kind="stable")
    return np.searchsorted(dataset.object_ids[order], np.arange(dataset.num_objects + 1)), order


@functools.lru_cache(maxsize=2)
def _views_by_class(dataset: ViewDataset) -> list[np.ndarray]:
    """The samples of each category."""
    if dataset.class_ids is None:
        return [np.arange(len(dataset))]
    of_sample = dataset.class_ids[dataset.object_ids]
    return [np.flatnonzero(of_sample == c) for c in range(dataset.num_classes)]
