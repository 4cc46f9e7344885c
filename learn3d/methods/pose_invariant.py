"""The pose-invariant method (Peng et al. 2020). Vanilla-AE is it with three weights at 0."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

import nmr
from learn3d.data.batch import Batch
from learn3d.data.dataset import MASK_SIZE
from learn3d.device import Download, upload
from learn3d.losses import domain_confusion_loss, gaussian_prior_loss, pose_classification_loss
from learn3d.methods.method import DataShape, Meshes, Method, adam, descend, frozen
from learn3d.networks import (
    ENCODERS,
    GENERATORS,
    EncoderName,
    GeneratorName,
    PoseDiscriminator,
    create_encoder,
    network_input,
)
from learn3d.networks.resnet import check_pretrained, load_pretrained
from learn3d.settings import FilePath, Positive, Weight, checked


@checked
class PoseInvariantSettings:
    """Networks, weights and forms of the terms of L_tot; a weight of 0 means that the term is not computed."""

    encoder: EncoderName = "conv"
    """conv: three convolutions, 64-pixel RGB and mask. conv-small: a fifteenth of it. resnet18: 224-pixel RGB."""
    generator: GeneratorName = "sphere"
    """sphere: 642 free vertices. symmetric: mirrored at z = 0."""
    pretrained: FilePath | None = None
    """File of ImageNet weights for the encoder resnet18 to start from, a state dict of torchvision's. None: random.
    The encoder gets natural colours, R, G, B, normalised as ImageNet's, however the data set stores them."""
    learning_rate: Positive = 1e-4
    """Adam's step size, the same for the three networks and constant."""
    lambda_smooth: Weight = 0.001
    """Weight of the smoothness loss (lambda_1)."""
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


class PoseInvariant(Method):
    """Encoder, mesh generator and, unless it is Vanilla-AE, a pose discriminator on the shape codes."""

    def __init__(
        self, settings: PoseInvariantSettings, shape: DataShape, device: str, precision: Literal["bf16", "fp32"]
    ) -> None:
        self.settings, self.image_size = settings, settings.image_size
        self.device, self.precision = torch.device(device), precision
        self.encoder = create_encoder(settings.encoder, inverted=shape.inverted)
        self.generator = GENERATORS[settings.generator]()
        self.networks = {"encoder": self.encoder, "generator": self.generator}
        if settings.uses_discriminator:
            self.networks["discriminator"] = self.discriminator = PoseDiscriminator(shape.num_views)
        self.faces, self.edges = self.generator.faces, self.generator.edges  # for the renderer, on the CPU
        self.weights = {
            "smoothness": settings.lambda_smooth,
            "classification": settings.lambda_classification,
            "confusion": settings.lambda_adversarial,
            "prior": settings.lambda_prior,
        }
        for network in self.networks.values():
            network.to(device)
        self.encoder.to(memory_format=torch.channels_last)
        self.optimizers = {name: adam(network, settings.learning_rate) for name, network in self.networks.items()}

    def start_from_pretrained(self) -> None:
        if self.settings.pretrained is not None:
            load_pretrained(self.encoder, self.settings.pretrained)

    def encode(self, images: Tensor) -> Tensor:
        with self.autocast():
            return self.encoder(network_input(images, self.device, self.image_size)).float()

    def decode(self, codes: Tensor) -> Meshes:
        with self.autocast():
            return Meshes(self.generator(codes).cpu(), self.faces)

    def train_step(self, batch: Batch, step: int) -> dict[str, float]:
        """Iterations count from 1. In every one encoder and generator descend projection + lambda_1 smoothness +
        lambda_4 prior. Odd iterations add lambda_2 classification on detached codes and step the discriminator too (the
        loss reaches nobody else); even iterations add lambda_3 confusion, which reaches the encoder through the
        discriminator, while the discriminator itself gets neither gradient nor step.
        """
        settings = self.settings
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(set_to_none=True)

        with self.autocast():
            codes = self.encoder(network_input(batch.images, self.device, self.image_size))
            vertices = self.generator(codes)
        codes = codes.float()

        # Rendering runs on the CPU. The losses on codes come first: a GPU computes them meanwhile.
        download = Download(vertices)
        on_codes = {}
        if settings.lambda_prior > 0:
            on_codes["prior"] = gaussian_prior_loss(codes, settings.prior_form)
        discriminator_turn = step % 2 == 1
        if discriminator_turn and settings.lambda_classification > 0:
            logits, views = self.discriminator(codes.detach()), upload(batch.view_ids, self.device)
            on_codes["classification"] = pose_classification_loss(logits, views)
        if not discriminator_turn and settings.lambda_adversarial > 0:
            logits = frozen(self.discriminator, codes)
            on_codes["confusion"] = domain_confusion_loss(logits, settings.adversarial_form)

        vertices = download.wait()
        silhouettes = nmr.render_silhouette(vertices, self.faces, batch.cameras, image_size=MASK_SIZE)
        losses = {"projection": nmr.losses.soft_iou_loss(silhouettes, batch.masks)}
        if settings.lambda_smooth > 0:
            losses["smoothness"] = nmr.losses.smoothness_loss(vertices, self.edges)

        values = descend(losses | on_codes, self.weights, step, self.ranks)
        self.optimizers["encoder"].step()
        self.optimizers["generator"].step()
        if "classification" in on_codes:
            self.optimizers["discriminator"].step()
        return values
