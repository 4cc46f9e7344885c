"""One training step of the pose-invariant method (Peng et al. 2020); Vanilla-AE is it with three weights at 0."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

import nmr
from learn3d.config import LossSettings
from learn3d.data.batch import Batch
from learn3d.losses import domain_confusion_loss, gaussian_prior_loss, pose_classification_loss
from learn3d.networks import IMAGE_SIZE, Networks, autocast, network_input


@dataclass
class Optimizers:
    """One Adam per network, so that the discriminator can rest while the others step."""

    encoder: torch.optim.Adam
    generator: torch.optim.Adam
    discriminator: torch.optim.Adam | None

    def items(self) -> list[tuple[str, torch.optim.Adam]]:
        """(name, optimizer) for those that exist."""
        named = [("encoder", self.encoder), ("generator", self.generator), ("discriminator", self.discriminator)]
        return [(name, optimizer) for name, optimizer in named if optimizer is not None]


def create_optimizers(networks: Networks, learning_rate: float) -> Optimizers:
    """Adam with default betas for each network, fused where possible (13 ms a step instead of 91 on two cores)."""

    def adam(network: nn.Module | None) -> torch.optim.Adam | None:
        if network is None:
            return None
        try:
            return torch.optim.Adam(network.parameters(), lr=learning_rate, fused=True)
        except RuntimeError:  # no fused kernel on this device
            return torch.optim.Adam(network.parameters(), lr=learning_rate)

    return Optimizers(adam(networks.encoder), adam(networks.generator), adam(networks.discriminator))


def uses_discriminator(settings: LossSettings) -> bool:
    """Whether the pose discriminator takes part at all (for Vanilla-AE it is not even created)."""
    return settings.classification > 0 or settings.adversarial > 0


def train_step(
    networks: Networks,
    optimizers: Optimizers,
    batch: Batch,
    iteration: int,
    settings: LossSettings,
    precision: Literal["bf16", "fp32"],
) -> dict[str, float]:
    """Take one optimisation step and return the value of every loss that was computed (unweighted) and of their sum.

    Iterations count from 1. In every iteration encoder and generator descend projection + lambda_1 smoothness +
    lambda_4 prior. Odd iterations add lambda_2 classification on detached codes and step the discriminator too (the
    loss reaches nobody else); even iterations add lambda_3 confusion, which reaches the encoder through the
    discriminator, while the discriminator itself gets neither gradient nor step. Raises FloatingPointError, before
    stepping, when a loss is not finite.
    """
    encoder, generator, discriminator = networks.encoder, networks.generator, networks.discriminator
    device = networks.device
    for _, optimizer in optimizers.items():
        optimizer.zero_grad(set_to_none=True)

    with autocast(device, precision):
        codes = encoder(network_input(batch.images, device))
        vertices = generator(codes)
    codes = codes.float()

    # Rendering runs on the CPU: the vertices move there, and their gradient comes back, explicitly.
    vertices = vertices.cpu()
    faces, edges = generator.faces.cpu(), generator.edges.cpu()
    silhouettes = nmr.render_silhouette(vertices, faces, batch.cameras, image_size=IMAGE_SIZE)
    losses = {"projection": nmr.losses.soft_iou_loss(silhouettes, batch.masks)}
    total = losses["projection"]
    if settings.smoothness > 0:
        losses["smoothness"] = nmr.losses.smoothness_loss(vertices, edges)
        total = total + settings.smoothness * losses["smoothness"]
    if settings.prior > 0:
        losses["prior"] = gaussian_prior_loss(codes, settings.forms.prior)
        total = total + settings.prior * losses["prior"].cpu()

    discriminator_turn = iteration % 2 == 1
    if discriminator_turn and settings.classification > 0:
        losses["classification"] = pose_classification_loss(discriminator(codes.detach()), batch.view_ids.to(device))
        total = total + settings.classification * losses["classification"].cpu()
    if not discriminator_turn and settings.adversarial > 0:
        logits = _frozen(discriminator, codes)
        losses["confusion"] = domain_confusion_loss(logits, settings.forms.adversarial)
        total = total + settings.adversarial * losses["confusion"].cpu()

    losses["total"] = total
    values = {name: float(loss.detach()) for name, loss in losses.items()}
    _check_finite(values, iteration)
    total.backward()
    optimizers.encoder.step()
    optimizers.generator.step()
    if "classification" in losses:
        optimizers.discriminator.step()
    return values


def _frozen(network: nn.Module, inputs: Tensor) -> Tensor:
    """Apply a network so that gradients reach its inputs but not its parameters."""
    parameters = {name: parameter.detach() for name, parameter in network.named_parameters()}
    return torch.func.functional_call(network, parameters, (inputs,))


def _check_finite(values: dict[str, float], iteration: int) -> None:
    if not all(math.isfinite(value) for value in values.values()):
        listed = ", ".join(f"{name} {value:g}" for name, value in values.items())
        raise FloatingPointError(f"the loss is not finite at iteration {iteration} ({listed})")
