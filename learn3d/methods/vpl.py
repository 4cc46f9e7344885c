"""View prior learning (VPL; Kato and Harada 2019), as published and by Peng et al. 2020.

A discriminator learns to separate silhouettes of predicted shapes at the view of the input image
("real") from those at other views ("fake"); encoder and generator learn to fool it.
docs/methods/vpl.md has the equations.
"""

import functools
from collections.abc import Callable
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

import nmr
from learn3d.data.dataset import MASK_SIZE, Batch, DatasetInfo
from learn3d.data.poses import Poses
from learn3d.distributed import whole_batch
from learn3d.losses import silhouette_pyramid_loss
from learn3d.methods.mesh_method import MeshMethod, MeshSettings
from learn3d.methods.method import Losses
from learn3d.methods.optimization import frozen
from learn3d.networks.discriminators import (
    OneHotViewDiscriminator,
    PatchDiscriminator,
    SpectralPatchDiscriminator,
)
from learn3d.networks.encoders import ENCODERS, PreactResNet18
from learn3d.networks.generators import GENERATORS
from learn3d.networks.layers import reverse_gradient
from learn3d.networks.resnet import ResNet18Encoder
from learn3d.settings import Channels, Pixels, Positive, Weight, checked

MASK_THRESHOLD = 0.1  # published code: a pixel belongs to the object if alpha is at least this


@checked
class VPLSettings(MeshSettings):
    """Networks, losses and their weights; a loss with weight 0 is not computed.

    The defaults are those of the re-implementation that Peng et al. 2020 used on Kato's data.
    """

    encoder: Literal["conv", "preact-resnet18", "resnet18"] = "conv"
    """Network from images to codes. conv: three convolutions, 64-pixel RGB and mask.
    preact-resnet18: RGB on grey. resnet18: RGB, may be pretrained. The last two take any multiple
    of 32 pixels (--image-size)."""
    image_size: Pixels = 64
    """Side of the input images in pixels."""
    vertex_scale: Positive = 0.01
    """Cube generators only: factor s of the last layer's output."""
    object_scale: Positive = 0.5
    """Cube generators only: factor of the vertices; they start on a sphere of half this radius."""
    discriminator: Literal["dcgan", "spectral-patch", "patch"] = "dcgan"
    """dcgan: reads one-hot view planes. spectral-patch, patch: read the camera's pose (ShapeNet,
    Pascal3D+)."""
    discriminator_channels: Channels = 128
    """Channels of the discriminator's first layer; those of later layers are multiples
    (published: dcgan 128, spectral-patch 32, patch 64)."""
    class_conditional: bool = False
    """Give the discriminator the object's category (only with spectral-patch and data of several
    categories)."""
    adversary: Literal["alternating", "reversal"] = "alternating"
    """alternating: odd steps train the discriminator, even ones the shapes against it. reversal:
    both in one step through a gradient reversal layer (as published)."""
    other_views: Literal["random", "reversed", "next"] = "random"
    """Sample of the batch that gives each sample its other view. random: one of another view
    class. reversed: the one at the same place from the batch's end (published, ShapeNet). next:
    the next one of its category (published, Pascal3D+)."""
    silhouette_size: Pixels = 64
    """Side of rendered silhouettes: 64 (compared with the data's masks) or image_size (with the
    input's own mask)."""
    anti_aliasing: bool = True
    """Render silhouettes with 2x2 samples per pixel."""
    renderer_gradient: Literal["nmr", "local"] = "nmr"
    """Gradient of the renderer: Kato et al. 2018's, or the local one of Kato and Harada 2019."""
    silhouette_loss: Literal["iou", "pyramid"] = "iou"
    """iou: 1 - soft IoU. pyramid: squared distance of normalised images at five resolutions."""
    adam_beta1: Annotated[float, Field(ge=0, lt=1)] = 0.9
    """beta_1 of Adam (beta_2 is 0.999)."""
    lambda_inflation: Weight = 0.0
    """Weight of the inflation loss (internal pressure)."""
    lambda_discriminator: Weight = 1.0
    """Weight of the adversarial loss on the shapes (lambda_D); the discriminator's own loss has
    weight 1."""

    @property
    def reads_view_ids(self) -> bool:
        return self.lambda_discriminator > 0 and (
            self.discriminator == "dcgan" or self.other_views == "random"
        )

    def __post_init__(self) -> None:
        size = self.image_size
        if self.encoder == "conv" and size != ENCODERS["conv"].image_size:
            raise ValueError(f"encoder 'conv' takes images of 64 pixels, got image_size {size}")
        if size % 32:
            raise ValueError(
                f"image_size must be a multiple of 32 for encoder {self.encoder!r}, got {size}"
            )
        if self.silhouette_size not in (MASK_SIZE, size):
            raise ValueError(
                f"silhouette_size must be {MASK_SIZE}, the size of the data's masks, or image_size ({size}), got "
                f"{self.silhouette_size}"
            )
        super().__post_init__()
        if self.class_conditional and self.discriminator != "spectral-patch":
            raise ValueError(
                f"class_conditional needs discriminator 'spectral-patch', got {self.discriminator!r}"
            )

    def check_run(self, *, iterations: int, batch_size: int) -> None:
        if self.lambda_discriminator > 0 and batch_size < 2:
            raise ValueError(
                "view prior learning needs another view for each image: batches of at least 2, got 1"
            )

    def for_data(self, info: DatasetInfo) -> "VPLSettings":
        settings = super().for_data(info)
        if self.class_conditional and info.num_classes < 2:
            raise ValueError("class_conditional needs data of several categories, got one")
        if self.lambda_discriminator > 0 and self.discriminator == "dcgan" and info.num_views < 2:
            raise ValueError(
                f"discriminator 'dcgan' tells views by their class and needs at least 2, got {info.num_views}"
            )
        return settings


class VPL(MeshMethod):
    """Encoder, mesh generator and, but for the baseline, a discriminator of silhouettes."""

    settings: VPLSettings

    def create_networks(self) -> dict[str, nn.Module]:
        settings = self.settings
        info = self.info
        if settings.encoder == "preact-resnet18":
            encoder = PreactResNet18(settings.image_size)
        elif settings.encoder == "resnet18":
            frozen_norms = settings.pretrained is not None
            encoder = ResNet18Encoder(
                info.inverted, flat_size=settings.image_size, frozen_norms=frozen_norms
            )
        else:
            encoder = ENCODERS[settings.encoder](info.inverted)
        scales = {}
        if settings.generator.startswith("cube"):
            scales = {"scale": settings.vertex_scale, "object_scale": settings.object_scale}
        generator = GENERATORS[settings.generator](symmetry=settings.symmetry, **scales)
        networks = {"encoder": encoder.to(memory_format=self.memory_format), "generator": generator}
        if settings.lambda_discriminator == 0:
            return networks
        channels = settings.discriminator_channels
        if settings.discriminator == "patch":
            discriminator = PatchDiscriminator(info.pose_features, channels)
        elif settings.discriminator == "spectral-patch":
            num_classes = info.num_classes if settings.class_conditional else None
            discriminator = SpectralPatchDiscriminator(info.pose_features, channels, num_classes)
        else:
            discriminator = OneHotViewDiscriminator(
                info.num_views, channels, settings.silhouette_size
            )
        return networks | {"discriminator": discriminator}

    def losses(self, batch: Batch, step: int) -> Losses:
        """Encoder and generator learn from projection + smoothness + inflation in every step.

        With a discriminator D each shape is also rendered at another view. Alternating: odd steps
        train D on softplus(-D(input view)) + softplus(D(other view)) of detached silhouettes.
        Even steps train encoder and generator on lambda_D softplus(-D(other view)); D and its
        running means do not change. Reversal: every step trains D on its loss, and encoder and
        generator on -lambda_D times its gradient.
        """
        settings, (whole, own) = self.settings, whole_batch(batch)
        is_baseline = settings.lambda_discriminator == 0
        others = own[:0] if is_baseline else other_views(whole, settings.other_views)[own]
        vertices = self.predict(batch.images)[1].cpu()
        # both views of each shape in one call
        both = torch.cat([vertices, vertices[: len(others)]])
        silhouettes, elsewhere = self.render(
            both, whole.poses[torch.cat([own, others])]
        ).tensor_split([len(batch)])
        projection = self._projection_loss(silhouettes, batch)
        losses: Losses = {"projection": (1.0, projection), **self.surface_losses(vertices, step)}
        if is_baseline:
            return losses
        if settings.adversary == "reversal":
            real, fake = (
                reverse_gradient(s, settings.lambda_discriminator) for s in (silhouettes, elsewhere)
            )
        elif step % 2 == 1:
            real, fake = silhouettes.detach(), elsewhere.detach()
        else:
            logits = self._discriminate(
                functools.partial(frozen, self.discriminator), elsewhere, whole, others, own
            )
            losses["adversarial"] = (settings.lambda_discriminator, F.softplus(-logits).mean())
            return losses
        of_real = self._discriminate(self.discriminator, real, whole, own, own)
        of_fake = self._discriminate(self.discriminator, fake, whole, others, own)
        losses["discrimination"] = (1.0, F.softplus(-of_real).mean() + F.softplus(of_fake).mean())
        return losses

    def surface_losses(self, vertices: Tensor, step: int) -> Losses:
        losses = super().surface_losses(vertices, step)
        if self.settings.lambda_inflation > 0:
            losses["inflation"] = (
                self.settings.lambda_inflation,
                nmr.losses.inflation_loss(vertices, self.faces),
            )
        return losses

    def render(self, vertices: Tensor, poses: Poses) -> Tensor:
        """Silhouettes float32 [B,s,s] with the settings' size, anti-aliasing and gradient."""
        settings = self.settings
        return nmr.render_silhouette(
            vertices,
            self.faces,
            poses.cameras(),
            image_size=settings.silhouette_size,
            anti_aliasing=settings.anti_aliasing,
            gradient=settings.renderer_gradient,
        )

    def _projection_loss(self, silhouettes: Tensor, batch: Batch) -> Tensor:
        masks = batch.masks
        if self.settings.silhouette_size != MASK_SIZE:
            masks = (batch.images[:, 3] >= MASK_THRESHOLD * 255).to(silhouettes)
        pyramid = self.settings.silhouette_loss == "pyramid"
        return (silhouette_pyramid_loss if pyramid else nmr.losses.soft_iou_loss)(
            silhouettes, masks
        )

    def _discriminate(
        self,
        network: Callable[..., Tensor],
        silhouettes: Tensor,
        batch: Batch,
        seen_at: Tensor,
        own: Tensor,
    ) -> Tensor:
        """Logits for silhouettes [b,S,S] of the shapes `own`, seen at the views `seen_at`."""
        silhouettes = silhouettes.to(self.device, non_blocking=True)
        if self.settings.discriminator == "dcgan":
            with self.autocast():
                return network(
                    silhouettes, batch.view_ids[seen_at].to(self.device, non_blocking=True)
                ).float()
        # autocast is off: with it, spectral normalisation mixes dtypes
        conditions = [batch.poses[seen_at].features().to(self.device, non_blocking=True)]
        if self.settings.class_conditional:
            conditions.append(batch.class_ids[own].to(self.device, non_blocking=True))
        return network(silhouettes, *conditions)


def other_views(batch: Batch, choice: Literal["random", "reversed", "next"]) -> Tensor:
    """The sample whose view is the other view of each sample, int64 [B].

    "random" uses torch's global generator, and takes any sample if the batch has one view class.
    As published, "reversed" gives the middle sample of an odd batch its own view, and "next" does
    so for the only sample of a category.
    """
    count = len(batch.view_ids)
    if choice == "reversed":
        return torch.arange(count).flip(0)
    if choice == "next":
        others = torch.arange(count)
        for category in batch.class_ids.unique():
            members = torch.nonzero(batch.class_ids == category).flatten()
            others[members] = members.roll(-1)
        return others
    different = (batch.view_ids[:, None] != batch.view_ids).float()
    weights = torch.where(different.any(1, keepdim=True), different, 1.0)
    return torch.multinomial(weights, 1).squeeze(1)
