"""Random changes of a training batch: functions of (batch, seed, step) alone, so that resuming needs no memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
import torch

from learn3d.data.batch import Batch

Augmentation = Literal["flip", "flip-image", "channels", "colors", "crop"]

COLOR_GAIN = 0.3  # "colors" multiplies each colour by 1 - this .. 1 + this
WITHOUT_COLOR = 0.3  # share of the images that it leaves without colours


def augment(batch: Batch, names: Sequence[Augmentation], seed: int, step: int, *, inverted: bool = True) -> Batch:
    """The batch with the named changes, each drawn for every sample on its own, in the order of the names.

    "flip": image, mask and pose (if known) mirrored left-right with probability 1/2 (Kato and Harada 2019).
    "flip-image": the colours alone (published code of both papers on Pascal3D+, whose meshes are symmetric).
    "channels": a random permutation of the three colours.
    "colors": a random permutation, each colour times a random factor of 0.7 .. 1.3, and 30 % of the images without
    colours (0). It changes 255 - colour, so that a white background stays white; `inverted` says that images are stored
    so. It is not for encoders that ignore the mask.
    "crop": the colours cut anew from the original image, each side of the padded box moved by up to 15 % of the box,
    uniformly (Pascal3D+, both papers). It must come first.

    Raises ValueError for an unknown name, and for "crop" if it is not first or there are no original images.
    """
    rng = np.random.default_rng([seed, step, 1])
    count = len(batch)
    for position, name in enumerate(names):
        if name not in get_args(Augmentation):
            raise ValueError(f"augmentation must be {', '.join(get_args(Augmentation))}, got {name!r}")
        images, colors = batch.images, batch.images[:, :3]
        if name == "crop":
            if position > 0:
                raise ValueError(f"crop must be the first augmentation, got {', '.join(names)}")
            if batch.crops is None:
                where = "only the layout pascal3d has, and not in shards"
                raise ValueError(f"the augmentation crop needs the original images, which {where}; leave it out")
            colors = torch.from_numpy(batch.crops.cut(rng.uniform(-1, 1, (count, 4))))
        elif name in ("channels", "colors"):
            order = torch.from_numpy(np.argsort(rng.random((count, 3)), axis=1))
            colors = torch.gather(colors, 1, order[:, :, None, None].expand_as(colors))
            if name == "colors":
                gain = rng.uniform(1 - COLOR_GAIN, 1 + COLOR_GAIN, (count, 3))
                gain[rng.random(count) < WITHOUT_COLOR] = 0
                gain = torch.from_numpy(gain.astype(np.float32))[:, :, None, None]
                darkness = colors if inverted else 255 - colors
                darkness = (darkness * gain).round_().clamp_(max=255).to(torch.uint8)
                colors = darkness if inverted else 255 - darkness
        else:
            mirrored = torch.from_numpy(rng.random(count) < 0.5)
            chosen = mirrored[:, None, None, None]
            colors = torch.where(chosen, colors.flip(3), colors)
            if name == "flip":
                images = torch.where(chosen, images.flip(3), images)
                masks = torch.where(chosen[:, 0], batch.masks.flip(2), batch.masks)
                depth = None if batch.depth is None else torch.where(chosen[:, 0], batch.depth.flip(2), batch.depth)
                batch = dataclasses.replace(batch, masks=masks, depth=depth)
                if batch.poses is not None:
                    batch = dataclasses.replace(batch, poses=batch.poses.mirrored(mirrored))
        batch = dataclasses.replace(batch, images=torch.cat([colors, images[:, 3:]], dim=1))
    return batch
