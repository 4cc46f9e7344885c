"""The pose-invariant method (Peng et al. 2020). With three of its weights at 0 it is Vanilla-AE."""

from __future__ import annotations

import dataclasses
from typing import Literal

from torch import Tensor, nn

import nmr
from learn3d.data.batch import Batch
from learn3d.device import Download, upload
from learn3d.losses import domain_confusion_loss, gaussian_prior_loss, pose_classification_loss
from learn3d.methods.method import MeshMethod
from learn3d.methods.optimization import frozen
from learn3d.methods.surfaces import Meshes
from learn3d.networks import ENCODERS, EncoderName, GeneratorName, PoseDiscriminator, SymmetryOption
from learn3d.networks.resnet import check_pretrained, load_pretrained
from learn3d.settings import FilePath, Positive, Weight, checked

INSIDE = 0.499  # of a box's side: a face exactly on the border of the grid is outside to the voxelizer kato18


@checked
class PoseInvariantSettings:
    """Networks, weights and forms of the terms of L_tot; a weight of 0 means that the term is not computed."""

    encoder: EncoderName = "conv"
    """conv: three convolutions, on 64-pixel RGB and mask. conv-light: with half the channels, and a fourth (1x1) to
    32 channels. conv-small: with a fifteenth of the weights. conv-centred: about as small, on images in which every
    object is scaled to one size, for pictures from cameras at unknown distances. conv-relu: conv with a ReLU on the
    code, as in Kato et al. 2018. resnet18: on 224-pixel RGB."""
    generator: GeneratorName = "sphere"
    """sphere: 642 free vertices. sphere-small: from fewer weights. bounded: that of Kato et al. 2018. cube-conv,
    cube-fc: those of Kato and Harada 2019."""
    symmetry: SymmetryOption = None
    """Mirror shapes at a vertical plane: x (x = 0), z (z = 0), or the azimuth in degrees of a camera that looks along
    it (0 is x = 0). auto: the plane at which the training masks mirror each other, or none where they do not. None:
    shapes are free."""
    clamp_to_cube: bool = False
    """Whether what reaches out of the cube in which all objects of a data set lie, where it has one, is moved onto its
    sides, in evaluation and reconstruction. The voxelizers count a shape that reaches out of their grid as hollow."""
    pretrained: FilePath | None = None
    """File of ImageNet weights for the encoder resnet18 to start from, a state dict of torchvision's. None: random.
    The encoder gets natural colours, R, G, B, normalised as ImageNet's, however the data set stores them."""
    learning_rate: Positive = 1e-4
    """Adam's step size, the same for the three networks."""
    lambda_smooth: Weight = 0.001
    """Weight of the smoothness loss (lambda_1)."""
    lambda_smooth_end: Positive | None = None
    """This weight at the end of the run, approached by a constant factor a step. None: lambda_smooth throughout."""
    lambda_volume: Weight = 0.0
    """Weight of the volume that shapes enclose."""
    lambda_classification: Weight = 1.0
    """Weight of the discriminator's own loss (lambda_2)."""
    lambda_adversarial: Weight = 1.0
    """Weight of the pose confusion loss (lambda_3)."""
    lambda_prior: Weight = 1.0
    """Weight of the Gaussian prior on the codes (lambda_4)."""
    adversarial_form: Literal["log", "probability"] = "log"
    """Confusion loss on squares of log-probability (published code) or of probability differences (eq. 4)."""
    prior_form: Literal["squared", "norm"] = "squared"
    """Prior on the squared length of the codes (published code) or on their length (eq. 5)."""

    def __post_init__(self) -> None:
        check_pretrained(self.pretrained, self.encoder)

    @property
    def image_size(self) -> int:
        """Side of the images that the encoder takes, in pixels."""
        return ENCODERS[self.encoder].image_size

    @property
    def reads_view_ids(self) -> bool:
        """Whether training depends on the view classes."""
        return self.uses_discriminator

    @property
    def uses_discriminator(self) -> bool:
        """Whether the pose discriminator takes part at all (for Vanilla-AE it is not even created)."""
        return self.lambda_classification > 0 or self.lambda_adversarial > 0


class PoseInvariant(MeshMethod):
    """Encoder, mesh generator and, unless it is Vanilla-AE, a pose discriminator on the shape codes."""

    settings: PoseInvariantSettings

    def create_networks(self) -> dict[str, nn.Module]:
        networks = super().create_networks()
        if self.settings.uses_discriminator:
            networks["discriminator"] = PoseDiscriminator(self.info.num_views)
        return networks

    @property
    def weights(self) -> dict[str, float]:
        settings = self.settings
        return {
            "projection": 1.0,
            "smoothness": settings.lambda_smooth,
            "volume": settings.lambda_volume,
            "classification": settings.lambda_classification,
            "confusion": settings.lambda_adversarial,
            "prior": settings.lambda_prior,
        }

    def weights_at(self, step: int) -> dict[str, float]:
        first, last = self.settings.lambda_smooth, self.settings.lambda_smooth_end
        if last is None or first == 0:
            return self.weights
        done = min(1.0, (step - 1) / max(1, self.plan.iterations - 1))
        return self.weights | {"smoothness": first ** (1 - done) * last**done}

    def decode(self, codes: Tensor) -> Meshes:
        shapes = super().decode(codes)
        if not self.settings.clamp_to_cube or self.info.cube_side is None:
            return shapes
        limit = INSIDE * self.info.cube_side
        return dataclasses.replace(shapes, vertices=shapes.vertices.clamp(-limit, limit))

    def start_from_pretrained(self) -> None:
        if self.settings.pretrained is not None:
            load_pretrained(self.encoder, self.settings.pretrained)

    def training_step(self, batch: Batch, step: int) -> dict[str, float]:
        """In every step encoder and generator descend projection + lambda_1 smoothness + lambda_4 prior. Odd steps add
        lambda_2 classification on detached codes, which trains the discriminator and nothing else. Even steps add
        lambda_3 confusion, which reaches the encoder through the discriminator, while the discriminator itself gets
        neither gradient nor step.
        """
        codes, vertices = self.predict(batch.images)
        download = Download(vertices)  # a GPU computes the losses on codes while the CPU waits and renders
        on_codes = self._losses_on_codes(codes, batch.view_ids, step)
        vertices = download.wait()
        silhouettes = self.render(vertices, batch.poses)
        losses = {"projection": nmr.losses.soft_iou_loss(silhouettes, batch.masks)}
        losses |= self.surface_losses(vertices) | on_codes
        trained = ["encoder", "generator"] + ["discriminator"] * ("classification" in losses)
        return self.backward_and_step(losses, step, *trained)

    def _losses_on_codes(self, codes: Tensor, view_ids: Tensor, step: int) -> dict[str, Tensor]:
        settings, losses = self.settings, {}
        if settings.lambda_prior > 0:
            losses["prior"] = gaussian_prior_loss(codes, settings.prior_form)
        discriminator_turn = step % 2 == 1
        if discriminator_turn and settings.lambda_classification > 0:
            logits, views = self.discriminator(codes.detach()), upload(view_ids, self.device)
            losses["classification"] = pose_classification_loss(logits, views)
        if not discriminator_turn and settings.lambda_adversarial > 0:
            logits = frozen(self.discriminator, codes)
            losses["confusion"] = domain_confusion_loss(logits, settings.adversarial_form)
        return losses
