"""Plus: the pose-invariant method with mirror symmetry and a loss at novel views.

The supervision is that of Peng et al. 2020: single images, each with its mask and its pose.
"""

from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

import nmr
from learn3d.data.dataset import MASK_SIZE, Batch
from learn3d.distributed import all_gather, whole_batch
from learn3d.losses import silhouette_energy_distance
from learn3d.methods.method import Losses
from learn3d.methods.pose_invariant import PoseInvariant, PoseInvariantSettings
from learn3d.networks.discriminators import pose_discriminator
from learn3d.networks.encoders import EncoderName
from learn3d.networks.generators import GeneratorName, SymmetryOption
from learn3d.settings import Positive, Weight, checked

REDUCED = MASK_SIZE // 2  # side of the masks in the mask bank


@checked
class PlusSettings(PoseInvariantSettings):
    """Networks and weights of the losses; a loss with weight 0 is not computed."""

    encoder: EncoderName = "conv-light"
    generator: GeneratorName = "auto"
    symmetry: SymmetryOption = "auto"
    clamp_to_cube: bool = True
    learning_rate: Positive = 4e-4
    lambda_smooth: Weight = 5e-4
    lambda_smooth_end: Positive | None = 1e-4
    lambda_area: Weight | Literal["auto"] = "auto"
    lambda_novel_view: Weight = 0.5
    """Weight of the loss at novel views."""
    bank_size: Annotated[int, Field(ge=1, le=100_000)] = 2048
    """Number of training masks in the mask bank of the loss at novel views."""
    lambda_view: Weight = 0.0
    """Weight of the loss of a small network that classifies the azimuth of an image;
    reconstruction places the camera of a picture by it. 0: no such network."""

    @property
    def reads_view_ids(self) -> bool:
        return self.uses_discriminator or self.lambda_novel_view > 0

    def check_run(self, *, iterations: int, batch_size: int) -> None:
        if self.lambda_novel_view > 0 and not 2 <= batch_size <= self.bank_size:
            raise ValueError(
                f"the loss at novel views compares a batch with the {self.bank_size} masks of the mask bank "
                f"(--bank-size): batch_size must lie in 2 .. {self.bank_size}, got {batch_size}; "
                "--lambda-novel-view 0 leaves it out"
            )


class MaskBank(nn.Module):
    """The latest masks of the training, at half their resolution, with their view classes.

    It has no weights, and is a module so that checkpoints hold it.
    """

    masks: Tensor  # uint8 [N, REDUCED^2], 255 inside; the oldest first
    view_ids: Tensor  # int64 [N]; -1 for empty places

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("masks", torch.zeros(size, REDUCED**2, dtype=torch.uint8))
        self.register_buffer("view_ids", torch.full((size,), -1))

    @property
    def full(self) -> bool:
        """Whether the bank holds as many masks as it can."""
        return bool(self.view_ids[0] >= 0)

    def add(self, masks: Tensor, view_ids: Tensor) -> None:
        """Add masks float [B, REDUCED^2] of these view classes, and drop the B oldest."""
        size = len(self.masks)
        self.masks.copy_(torch.cat([self.masks, (255 * masks).round().to(self.masks)])[-size:])
        self.view_ids.copy_(torch.cat([self.view_ids, view_ids.to(self.view_ids)])[-size:])

    def of_view(self, view_id: int) -> Tensor:
        """The masks of one view class, float32 [M, REDUCED^2]."""
        return self.masks[self.view_ids == view_id] / 255


class Plus(PoseInvariant):
    """Encoder, mesh generator, pose discriminator and a mask bank."""

    averages_mirror_images = True
    settings: PlusSettings
    mask_bank: MaskBank

    def create_networks(self) -> dict[str, nn.Module]:
        networks = super().create_networks()
        if self.settings.uses_discriminator and networks["generator"].mirror is not None:
            # flipped views are other views
            networks["discriminator"] = pose_discriminator(2 * self.info.num_views)
        if self.settings.lambda_novel_view > 0:
            networks["mask_bank"] = MaskBank(self.settings.bank_size)
        return networks | self.create_view_classifier()

    def losses(self, batch: Batch, step: int) -> Losses:
        """The losses of `PoseInvariant`, lambda_view times that of the azimuths, and
        lambda_novel_view times that at a novel view once the mask bank is full. Every second
        image of symmetric objects is flipped. For the discriminator it has another view class
        then: K + k instead of k.
        """
        images, flipped = self.flip_every_second(batch.images)
        codes, vertices = self.predict(images)
        on_codes = self.losses_on_codes(codes, batch.view_ids + self.info.num_views * flipped, step)
        vertices = vertices.cpu()
        projection = nmr.losses.soft_iou_loss(self.render(vertices, batch.poses), batch.masks)
        losses: Losses = {"projection": (1.0, projection)}
        if self.settings.lambda_view > 0:
            losses["view"] = (self.settings.lambda_view, self.view_loss(batch.images, batch.poses))
        if self.settings.lambda_novel_view > 0:
            losses |= self.novel_view_loss(vertices, batch)
        return losses | self.surface_losses(vertices, step) | on_codes

    def novel_view_loss(self, vertices: Tensor, batch: Batch) -> Losses:
        """Render all shapes of the batch at one of its cameras. The loss is the energy distance
        between these silhouettes and the masks of this view class in the mask bank, mostly of
        other objects.
        """
        whole = whole_batch(batch)
        self.mask_bank.add(all_gather(_reduced(batch.masks)), whole.view_ids)
        seen_by = int(torch.randint(len(whole.view_ids), ()))
        if not self.mask_bank.full:
            return {}
        silhouettes = self.render(vertices, whole.poses[torch.full((len(vertices),), seen_by)])
        silhouettes = all_gather(_reduced(silhouettes))
        masks = self.mask_bank.of_view(int(whole.view_ids[seen_by])).to(silhouettes.device)
        return {
            "novel_view": (
                self.settings.lambda_novel_view,
                silhouette_energy_distance(silhouettes, masks),
            )
        }


def _reduced(silhouettes: Tensor) -> Tensor:
    """Silhouettes [B, MASK_SIZE, MASK_SIZE] at the resolution of the mask bank, [B, REDUCED^2]."""
    return F.avg_pool2d(silhouettes[:, None], MASK_SIZE // REDUCED).flatten(1)
