"""Samples and augments the batches of a training.

They depend on the data set, the seed, the step and the weights of the candidate poses.
Checkpoints save only these weights.
"""

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from learn3d.data.dataset import Batch, ViewDataset

Sampling = Literal["views", "pairs", "groups"]
ALL_ROWS = slice(None)
GROUP_SIZE = 5  # views per object of sampling "groups"
#: Views of each object in a batch, ordered [a_1 .. a_n, b_1 .. b_n, ...]; 1 if views are drawn independently.
VIEWS_OF_OBJECT: dict[Sampling, int] = {"views": 1, "pairs": 2, "groups": GROUP_SIZE}


def batches(
    dataset: ViewDataset, options: Any, start: int = 1, rows: Tensor | slice = ALL_ROWS
) -> Iterator[Batch]:
    """The batches of the training steps from `start` to `options.iterations`, sampled and
    augmented, without voxels.

    options: `sampling`, `batch_size`, `augment`, `seed` and `iterations`, as in `TrainConfig`.
    rows: int64 [b], the rows that this rank takes of each batch (default: all). Random numbers
    are drawn for all rows. A thread reads the next batch during a step.
    """

    def read(step: int) -> tuple[Tensor, Batch]:
        indices = sample_indices(dataset, options.sampling, options.batch_size, options.seed, step)
        return indices, dataset.batch(indices[rows], voxels=False)

    with ThreadPoolExecutor(1, "read ahead") as reader:
        ahead = reader.submit(read, start)
        for step in range(start, options.iterations + 1):
            indices, batch = ahead.result()
            if step < options.iterations:
                ahead = reader.submit(read, step + 1)
            if dataset.candidates is not None:  # their weights may have changed in the last step
                poses, view_ids = dataset.candidates.draw(indices, options.seed, step)
                batch = dataclasses.replace(batch, poses=poses[rows], view_ids=view_ids[rows])
            whole = {
                "count": len(indices),
                "views": VIEWS_OF_OBJECT[options.sampling],
                "rows": rows,
            }
            yield augment(
                batch, options.augment, options.seed, step, inverted=dataset.inverted, **whole
            )


def sample_indices(
    dataset: ViewDataset, sampling: Sampling, batch_size: int, seed: int, step: int
) -> Tensor:
    """Samples of step `step` (from 1): int64 [batch_size], or the largest multiple of the group
    size below it.

    "views": epochs of shuffled views. "pairs": two different views of each of batch_size / 2
    random objects, [a_1 .. a_n, b_1 .. b_n] (Kato et al. 2018). "groups": GROUP_SIZE views of
    each of batch_size / GROUP_SIZE random objects; views repeat if the object has fewer.
    Raises ValueError if "pairs" or "groups" finds no object with two views.
    """
    if sampling == "views":
        return shuffled_epochs(len(dataset), batch_size, seed, step)
    rng = np.random.default_rng([seed, step])
    starts, order = _views_of_objects(dataset)
    sizes = np.diff(starts)
    able = np.flatnonzero(sizes >= 2)
    if len(able) == 0:
        raise ValueError(
            "no object has two views; a multi-view method needs at least two views of an object"
        )
    objects = able[rng.integers(len(able), size=batch_size // VIEWS_OF_OBJECT[sampling])]
    if sampling == "groups":
        views = [
            rng.permutation(max(size, GROUP_SIZE))[:GROUP_SIZE] % size for size in sizes[objects]
        ]
        return torch.from_numpy(order[starts[objects, None] + np.array(views)].T.reshape(-1))
    first = rng.integers(sizes[objects])
    second = (first + rng.integers(1, sizes[objects])) % sizes[objects]
    return torch.from_numpy(order[starts[objects] + np.stack([first, second])].reshape(-1))


def shuffled_epochs(num_samples: int, batch_size: int, seed: int, step: int) -> Tensor:
    """Samples of step `step` (from 1) from a sequence of shuffled epochs, int64 [batch_size]."""
    epochs, places = np.divmod(np.arange((step - 1) * batch_size, step * batch_size), num_samples)
    return torch.cat(
        [
            _epoch_order(num_samples, seed, e)[places[epochs == e]]
            for e in np.unique(epochs).tolist()
        ]
    )


@functools.lru_cache(maxsize=2)
def _epoch_order(num_samples: int, seed: int, epoch: int) -> Tensor:
    generator = torch.Generator().manual_seed((seed * 1_000_003 + epoch) % 2**63)
    return torch.randperm(num_samples, generator=generator)


@functools.lru_cache(maxsize=2)
def _views_of_objects(dataset: ViewDataset) -> tuple[np.ndarray, np.ndarray]:
    """Samples int64 [M] sorted by object, after the positions int64 at which each starts, and M."""
    ids = dataset.object_ids
    order = np.argsort(ids, kind="stable")
    return np.searchsorted(ids[order], np.arange(dataset.num_objects + 1)), order


Augmentation = Literal["flip", "flip-image", "channels", "colors", "crop"]

COLOR_GAIN = 0.3  # "colors" multiplies each colour by a factor in 1 - COLOR_GAIN .. 1 + COLOR_GAIN
WITHOUT_COLOR = 0.3  # share of the images that "colors" makes white


def augment(
    batch: Batch,
    names: Sequence[Augmentation],
    seed: int,
    step: int,
    *,
    inverted: bool,
    count: int | None = None,
    views: int = 1,
    rows: Tensor | slice = ALL_ROWS,
) -> Batch:
    """The batch with the named augmentations, in this order, each drawn independently for every
    sample.

    "flip": image, mask, depth and pose (if known) mirrored left-right with probability 1/2 (Kato
    and Harada 2019); all `views` of an object in the batch (`VIEWS_OF_OBJECT`), or none.
    "flip-image": only the colours mirrored (published code of both papers on Pascal3D+, whose
    meshes are symmetric).
    "channels": a random permutation of the three colour channels.
    "colors": a random permutation, each channel times a random factor in 0.7 .. 1.3, and in 30 %
    of the images times 0. It acts on 255 - colour, so that white stays white; `inverted`: images
    are stored as 255 - colour. It is not meant for encoders that ignore the mask.
    "crop": the colours cropped anew from the original image, each side of the padded box moved by
    up to 15 % of the box (Pascal3D+, both papers). It must come first.

    count, rows: the batch has these rows of a batch of `count`, for which all random numbers are
    drawn.

    Raises ValueError for "crop" if it is not first or there are no original images.
    """
    rng = np.random.default_rng([seed, step, 1])
    count = len(batch) if count is None else count
    for position, name in enumerate(names):
        images = batch.images
        colors = batch.images[:, :3]
        if name == "crop":
            if position > 0 or batch.crops is None:
                wanted = "the original images, which only the layout pascal3d without shards has"
                raise ValueError(
                    f"crop must be the first augmentation, and needs {wanted}; got {', '.join(names)}"
                )
            colors = torch.from_numpy(batch.crops.cut(rng.uniform(-1, 1, (count, 4))[rows]))
        elif name in ("channels", "colors"):
            order = torch.from_numpy(np.argsort(rng.random((count, 3)), axis=1)[rows])
            colors = torch.gather(colors, 1, order[:, :, None, None].expand_as(colors))
            if name == "colors":
                gain = rng.uniform(1 - COLOR_GAIN, 1 + COLOR_GAIN, (count, 3))
                gain[rng.random(count) < WITHOUT_COLOR] = 0
                gain = torch.from_numpy(gain.astype(np.float32)[rows])[:, :, None, None]
                darkness = colors if inverted else 255 - colors
                darkness = (darkness * gain).round_().clamp_(max=255).to(torch.uint8)
                colors = darkness if inverted else 255 - darkness
        else:
            together = views if name == "flip" else 1
            coins = np.tile(rng.random(count // together) < 0.5, together)
            mirrored = torch.from_numpy(coins[rows])
            colors = _flip(colors, mirrored)
            if name == "flip":
                images = _flip(images, mirrored)
                depth = None if batch.depth is None else _flip(batch.depth, mirrored)
                poses = None if batch.poses is None else batch.poses.mirrored(mirrored)
                batch = dataclasses.replace(
                    batch, masks=_flip(batch.masks, mirrored), depth=depth, poses=poses
                )
        batch = dataclasses.replace(batch, images=torch.cat([colors, images[:, 3:]], dim=1))
    return batch


def _flip(images: Tensor, chosen: Tensor) -> Tensor:
    """Flip the images [B, ..., H, W] with `chosen`, bool [B], left-right."""
    return torch.where(chosen.view(-1, *[1] * (images.ndim - 1)), images.flip(-1), images)
