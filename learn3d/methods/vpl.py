"""View prior learning (VPL; Kato and Harada 2019), as Peng et al. 2020 ran it on Kato's data.

A discriminator learns to separate silhouettes of predicted shapes at the view of the input image
("real") from those at other views ("fake"); encoder and generator learn to fool it.
docs/methods/vpl.md has the equations.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

import nmr
from learn3d.data.dataset import Batch, DatasetInfo
from learn3d.methods.mesh_method import MeshMethod, MeshSettings
from learn3d.methods.method import Losses
from learn3d.methods.optimization import frozen
from learn3d.networks.discriminators import OneHotViewDiscriminator
from learn3d.settings import Channels, Weight, checked


@checked
class VPLSettings(MeshSettings):
    """Networks and weights of the losses; a loss with weight 0 is not computed."""

    discriminator_channels: Channels = 128
    """Channels of the discriminator's first layer; those of later layers are multiples
    (published: 128)."""
    lambda_discriminator: Weight = 1.0
    """Weight of the adversarial loss on the shapes (lambda_D); the discriminator's own loss has
    weight 1. 0: no discriminator."""

    @property
    def reads_view_ids(self) -> bool:
        return self.lambda_discriminator > 0

    def check_run(self, *, iterations: int, batch_size: int) -> None:
        if self.lambda_discriminator > 0 and batch_size < 2:
            raise ValueError(
                "view prior learning needs another view for each image: batches of at least 2, got 1"
            )

    def for_data(self, info: DatasetInfo) -> "VPLSettings":
        settings = super().for_data(info)
        if self.lambda_discriminator > 0 and info.num_views < 2:
            raise ValueError(
                f"the discriminator tells views by their class and needs at least 2, got {info.num_views}"
            )
        return settings


class VPL(MeshMethod):
    """Encoder, mesh generator and, but for the baseline, a discriminator of silhouettes."""

    settings: VPLSettings

    def create_networks(self) -> dict[str, nn.Module]:
        networks = super().create_networks()
        if self.settings.lambda_discriminator > 0:
            networks["discriminator"] = OneHotViewDiscriminator(
                self.info.num_views, self.settings.discriminator_channels
            )
        return networks

    def losses(self, batch: Batch, step: int) -> Losses:
        """Encoder and generator learn in every step from projection + smoothness.

        With a discriminator D each shape is also rendered at another view. Odd steps train D on
        softplus(-D(input view)) + softplus(D(other view)) of detached silhouettes. Even steps
        train encoder and generator on lambda_D softplus(-D(other view)); D and its running means
        do not change.
        """
        weight = self.settings.lambda_discriminator
        others = other_views(batch.view_ids) if weight > 0 else torch.arange(0)
        vertices = self.predict(batch.images)[1].cpu()
        # both views of each shape in one call
        seen_at = torch.cat([torch.arange(len(batch)), others])
        silhouettes, elsewhere = self.render(
            torch.cat([vertices, vertices[: len(others)]]), batch.poses[seen_at]
        ).tensor_split([len(batch)])
        projection = nmr.losses.soft_iou_loss(silhouettes, batch.masks)
        losses: Losses = {"projection": (1.0, projection), **self.surface_losses(vertices, step)}
        if weight > 0 and step % 2 == 1:
            of_real = self._discriminate(self.discriminator, silhouettes.detach(), batch.view_ids)
            of_fake = self._discriminate(
                self.discriminator, elsewhere.detach(), batch.view_ids[others]
            )
            loss = F.softplus(-of_real).mean() + F.softplus(of_fake).mean()
            losses["discrimination"] = (1.0, loss)
        elif weight > 0:
            logits = self._discriminate(
                lambda *inputs: frozen(self.discriminator, *inputs),
                elsewhere,
                batch.view_ids[others],
            )
            losses["adversarial"] = (weight, F.softplus(-logits).mean())
        return losses

    def _discriminate(
        self, network: Callable[..., Tensor], silhouettes: Tensor, view_ids: Tensor
    ) -> Tensor:
        """Logits float32 [B] for silhouettes [B, 64, 64] of these view classes."""
        with self.autocast():
            return network(
                silhouettes.to(self.device, non_blocking=True),
                view_ids.to(self.device, non_blocking=True),
            ).float()


def other_views(view_ids: Tensor) -> Tensor:
    """For each view of a batch a random one of another view class, int64 [B].

    Any view if the batch has one view class. It uses torch's global generator.
    """
    different = (view_ids[:, None] != view_ids).float()
    weights = torch.where(different.any(1, keepdim=True), different, 1.0)
    return torch.multinomial(weights, 1).squeeze(1)
