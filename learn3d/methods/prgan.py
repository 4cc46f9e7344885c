"""PrGAN (Gadelha et al. 2017): a GAN of voxel grids, then an encoder."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import Annotated

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

from learn3d.data.dataset import Batch
from learn3d.data.poses import LookAtPoses, Poses, wrap_deg
from learn3d.methods.method import Grids, Losses, Method, MethodSettings
from learn3d.methods.optimization import adam, frozen
from learn3d.networks.encoders import network_input
from learn3d.networks.voxel_gan import (
    DISCRIMINATOR_CHANNELS,
    GENERATOR_CHANNELS,
    SHAPE_CODE,
    SILHOUETTE_SIZE,
    TAU,
    InverseEncoder,
    SilhouetteDiscriminator,
    ViewCircle,
    VoxelGenerator,
    project,
)
from learn3d.settings import Items, LayerChannels, Positive, Share, Step, checked

BETAS = (0.5, 0.999)  # Adam's decays for the two networks of the GAN
FourLayers = Annotated[tuple[LayerChannels, LayerChannels, LayerChannels, LayerChannels], Items]


@checked
class PrGANSettings(MethodSettings):
    """Learning rates, widths, phases and cameras, as in the published code for airplanes."""

    encoder_from_step: Step = 53_051
    """First step that trains the encoder instead of the GAN (published: after 50 epochs)."""
    generator_learning_rate: Positive = 2.5e-3
    """Adam's learning rate for both losses of the generator."""
    discriminator_learning_rate: Positive = 1e-4
    """Adam's learning rate for the discriminator."""
    encoder_learning_rate: Positive = 1e-5
    """Adam's learning rate for the inverse encoder."""
    accuracy_margin: Share = 0.8
    """The discriminator is not trained in steps that begin with a higher accuracy."""
    generator_channels: FourLayers = GENERATOR_CHANNELS
    """Channels at 4^3, 8^3, 16^3 and 32^3; fewer on a small machine."""
    discriminator_channels: FourLayers = DISCRIMINATOR_CHANNELS
    """Channels at 32^2, 16^2, 8^2 and 4^2; fewer on a small machine."""
    occupancy_threshold: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """Predicted voxels with a higher mean are occupied. Not published; Kato's grids hold every
    cell that a shape touches, so true airplanes reach an IoU of about 0.46 at 0.5, and 0.95 at
    0.1."""
    elevation_deg: Annotated[float, Field(ge=-90, le=90)] = 30.0
    """Elevation of the K views, whose azimuths are equally spaced."""
    distance: Positive = 2.732
    """Distance of the data set's cameras; with the field of view it gives the size of objects in
    the images."""
    half_fov_deg: Annotated[float, Field(gt=0, lt=90)] = 15.0
    """Half of the field of view of the data set's cameras."""

    @property
    def image_size(self) -> int:
        return SILHOUETTE_SIZE

    @property
    def reads_view_ids(self) -> bool:
        return True

    def check_run(self, *, iterations: int, batch_size: int) -> None:
        if self.encoder_from_step > iterations:
            raise ValueError(
                f"encoder_from_step={self.encoder_from_step} is after the last of {iterations} iterations: "
                f"the encoder would never be trained; give a step such as {iterations // 2 + 1}"
            )

    def for_iterations(self, iterations: int) -> PrGANSettings:
        return dataclasses.replace(self, encoder_from_step=iterations // 2 + 1)


class PrGAN(Method):
    """Generator of voxels from z ~ U(-1, 1)^201, discriminator of silhouettes, inverse encoder.

    The first 200 entries of z decide the shape; the last one, v, decides the view: floor((v + 1)
    K / 2). Views of training images are not used, but all K views must be equally frequent.
    """

    settings: PrGANSettings

    def create_networks(self) -> dict[str, nn.Module]:
        settings = self.settings
        return {
            "generator": VoxelGenerator(settings.generator_channels),
            "discriminator": SilhouetteDiscriminator(settings.discriminator_channels),
            "encoder": InverseEncoder(),
        }

    def create_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        settings = self.settings
        return {
            "generator": adam(self.generator, settings.generator_learning_rate, BETAS),
            "generator_statistics": adam(self.generator, settings.generator_learning_rate, BETAS),
            "discriminator": adam(self.discriminator, settings.discriminator_learning_rate, BETAS),
            "encoder": adam(self.encoder, settings.encoder_learning_rate),
        }

    @functools.cached_property
    def views(self) -> ViewCircle:
        """The K views of the projected silhouettes."""
        settings = self.settings
        return ViewCircle(
            self.info.num_views, settings.elevation_deg, settings.distance, settings.half_fov_deg
        )

    def check_batch(self, batch: Batch) -> None:
        check_views(batch.poses, batch.view_ids, self.views)

    def encode(self, images: Tensor) -> Tensor:
        """Shape codes [B, 200] from the mask channel alone."""
        masks = network_input(images, self.device, self.image_size)[:, 3]
        with self.autocast():
            return self.encoder(masks).float()[:, :SHAPE_CODE]

    def decode(self, codes: Tensor) -> Grids:
        return Grids((self.generator(codes) * TAU).cpu(), self.settings.occupancy_threshold)

    def sample_z(self, count: int) -> Tensor:
        """z ~ U(-1, 1), float32 [count, 201] on the CPU, from torch's global random state."""
        return 2 * torch.rand(count, SHAPE_CODE + 1) - 1

    def view_ids(self, z: Tensor) -> Tensor:
        """View of each z by its last entry v: floor((v + 1) K / 2), int64 [B] in 0 .. K-1."""
        return ((z[:, -1] + 1) * (self.views.count / 2)).long().clamp(0, self.views.count - 1)

    def generate(self, z: Tensor) -> Tensor:
        """Silhouettes [B, 64, 64] of generated shapes, for z [B, 201] on the CPU.

        In float32: bf16 is slow here.
        """
        codes = z[:, :SHAPE_CODE].to(self.device, non_blocking=True)
        with torch.autocast(self.device.type, enabled=False):
            return project(self.generator(codes), self.view_ids(z), self.views, TAU)

    def phases(self, batch: Batch, step: int) -> Iterator[tuple[Losses, tuple[str, ...]]]:
        """One phase for the encoder from step `encoder_from_step` on, before it those of the GAN.

        The discriminator learns if its accuracy is at most `accuracy_margin`; then the generator
        learns from the discriminator's logits, and then from statistics of the discriminator's
        first layer. All three use the same z, as in the published code.
        """
        z = self.sample_z(len(batch))
        if step >= self.settings.encoder_from_step:
            yield {"encoder": (1.0, self.encoder_loss(z))}, ("encoder",)
            return
        real = batch.masks.to(self.device, non_blocking=True)
        accuracy = self.accuracy(real, z)
        self.networks.train()
        fake = self.generate(z)
        losses: Losses = {
            "accuracy": (0.0, accuracy)
        }  # it is logged with the first phase, and has no gradient
        if accuracy <= self.settings.accuracy_margin:
            with self.autocast():
                of_real = self.discriminator(real).float()
                of_fake = self.discriminator(fake.detach()).float()
            losses["discriminator"] = (1.0, _bce(of_real, 1.0) + _bce(of_fake, 0.0))
            yield losses, ("discriminator",)
            losses = {}

        with self.autocast():
            logits = frozen(self.discriminator, fake).float()
        losses["generator"] = (1.0, _bce(logits, 1.0))
        yield losses, ("generator",)

        with self.autocast():
            first = self.discriminator.first
            of_real = frozen(first, real[:, None]).float()
            of_fake = frozen(first, self.generate(z)[:, None]).float()
        yield (
            {"generator_statistics": (1.0, statistics_loss(of_real, of_fake))},
            ("generator_statistics",),
        )

    def encoder_loss(self, z: Tensor) -> Tensor:
        """Summed squared error of the z that the encoder predicts from samples of the generator,
        which is in evaluation mode.
        """
        self.networks.eval()
        with torch.no_grad():
            images = self.generate(z)
        with self.autocast():
            estimate = self.encoder(images)
        difference = estimate.float() - z.to(self.device, non_blocking=True)
        return difference.square().sum()

    @torch.no_grad()
    def accuracy(self, real: Tensor, z: Tensor) -> Tensor:
        """Mean probability that the discriminator, in evaluation mode, gives right answers."""
        self.networks.eval()
        with self.autocast():
            of_real, of_fake = self.discriminator(real), self.discriminator(self.generate(z))
        return (of_real.float().sigmoid().mean() + 1 - of_fake.float().sigmoid().mean()) / 2


def statistics_loss(of_real: Tensor, of_fake: Tensor) -> Tensor:
    """Sum over features [B, ...] of squared differences of batch means and variances."""
    means, variances = [], []  # torch.var takes ten times as long over the first axis
    for features in (of_real, of_fake):
        mean = features.mean(0)
        means.append(mean)
        variances.append((features - mean).square().mean(0))
    return torch.sub(*means).square().sum() + torch.sub(*variances).square().sum()


def check_views(poses: Poses, view_ids: Tensor, views: ViewCircle) -> None:
    """Raise a ValueError unless every camera is that of its view class.

    Tolerances: half a degree for angles, half a percent for the distance, 0.1 degrees for half
    the field of view.
    """
    wanted = (
        f"PrGAN needs images from {views.count} fixed views, view k at azimuth {-360 / views.count:g} k and elevation "
        f"{views.elevation_deg:g}, distance {views.distance:g}, half field of view {views.half_fov_deg:g}"
    )
    if not isinstance(poses, LookAtPoses):
        raise ValueError(f"{wanted}; this data set gives rotations. Take data in Kato's layout")
    found = (poses.azimuth_deg, poses.elevation_deg, poses.distance, poses.half_fov_deg)
    found = torch.stack([torch.as_tensor(values).expand(len(poses)) for values in found], dim=1)
    off = found - torch.tensor([0.0, views.elevation_deg, views.distance, views.half_fov_deg])
    off[:, 0] = wrap_deg(off[:, 0] - views.azimuth_deg(view_ids))
    wrong = (off.abs() > torch.tensor([0.5, 0.5, 0.005 * views.distance, 0.1])).any(1)
    if bool(wrong.any()):
        first = int(wrong.nonzero()[0])
        numbers = "azimuth {:g}, elevation {:g}, distance {:g}, half field of view {:g}".format(
            *found[first].tolist()
        )
        raise ValueError(
            f"{wanted}; a camera of view {int(view_ids[first])} has {numbers}. Take data in Kato's layout, or give "
            "the data set's own elevation_deg, distance and half_fov_deg"
        )


def _bce(logits: Tensor, target: float) -> Tensor:
    return F.binary_cross_entropy_with_logits(logits, torch.full_like(logits, target))
