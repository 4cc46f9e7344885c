"""The pose-invariant method (Peng et al. 2020), and Vanilla-AE without losses on codes."""

from __future__ import annotations

import dataclasses
from typing import Literal

from torch import Tensor, nn

import nmr
from learn3d.data.dataset import Batch, DatasetInfo
from learn3d.losses import domain_confusion_loss, gaussian_prior_loss, pose_classification_loss
from learn3d.methods.mesh_method import MeshMethod, MeshSettings, is_compact
from learn3d.methods.method import Losses
from learn3d.methods.optimization import frozen
from learn3d.networks.discriminators import pose_discriminator
from learn3d.settings import Positive, Weight, checked

COMPACT_AREA_WEIGHT = 0.03


@checked
class PoseInvariantSettings(MeshSettings):
    """Networks, weights and forms of the losses in L_tot; a loss with weight 0 is not computed."""

    lambda_smooth_end: Positive | None = None
    """Weight of the smoothness loss at the end of the run, reached by exponential decay. Without
    it the weight stays lambda_smooth."""
    lambda_area: Weight | Literal["auto"] = 0.0
    """Weight of the area of the surface. It prevents folds and flattens sides that no camera
    sees. auto: 0.03 if the training masks are compact, else 0."""
    lambda_classification: Weight = 1.0
    """Weight of the discriminator's own loss (lambda_2)."""
    lambda_adversarial: Weight = 1.0
    """Weight of the pose confusion loss (lambda_3)."""
    lambda_prior: Weight = 1.0
    """Weight of the Gaussian prior on the codes (lambda_4)."""
    adversarial_form: Literal["log", "probability"] = "log"
    """Confusion loss: squared differences of log-probabilities (log, published code) or of
    probabilities (eq. 4)."""
    prior_form: Literal["squared", "norm"] = "squared"
    """Prior: squared norm of the codes (squared, published code) or their norm (norm, eq. 5)."""

    @property
    def reads_view_ids(self) -> bool:
        return self.uses_discriminator

    @property
    def wants_solidity(self) -> bool:
        return super().wants_solidity or self.lambda_area == "auto"

    @property
    def varies_over_run(self) -> str | None:
        return (
            "lambda_smooth_end"
            if self.lambda_smooth_end is not None and self.lambda_smooth > 0
            else None
        )

    @property
    def uses_discriminator(self) -> bool:
        """Whether there is a pose discriminator; Vanilla-AE has none."""
        return self.lambda_classification > 0 or self.lambda_adversarial > 0

    def for_data(self, info: DatasetInfo) -> PoseInvariantSettings:
        area = (
            self.lambda_area
            if self.lambda_area != "auto"
            else COMPACT_AREA_WEIGHT * is_compact(info)
        )
        return dataclasses.replace(super().for_data(info), lambda_area=area)


class PoseInvariant(MeshMethod):
    """Encoder, mesh generator and, but for Vanilla-AE, a pose discriminator on the codes."""

    settings: PoseInvariantSettings

    def create_networks(self) -> dict[str, nn.Module]:
        networks = super().create_networks()
        if self.settings.uses_discriminator:
            networks["discriminator"] = pose_discriminator(self.info.num_views)
        return networks

    def losses(self, batch: Batch, step: int) -> Losses:
        """Encoder and generator learn in every step from projection + lambda_1 smoothness +
        lambda_area area + lambda_4 prior; encoder and discriminator learn by turns (see
        `losses_on_codes`).
        """
        codes, vertices = self.predict(batch.images)
        on_codes = self.losses_on_codes(codes, batch.view_ids, step)
        vertices = vertices.cpu()
        projection = nmr.losses.soft_iou_loss(self.render(vertices, batch.poses), batch.masks)
        return {"projection": (1.0, projection), **self.surface_losses(vertices, step), **on_codes}

    def surface_losses(self, vertices: Tensor, step: int) -> Losses:
        losses = super().surface_losses(vertices, step)
        if self.settings.varies_over_run is not None:
            losses["smoothness"] = (self.smoothness_weight(step), losses["smoothness"][1])
        if self.settings.lambda_area > 0:
            losses["area"] = (self.settings.lambda_area, nmr.losses.area_loss(vertices, self.faces))
        return losses

    def smoothness_weight(self, step: int) -> float:
        """The weight of smoothness in a step: it decays exponentially to `lambda_smooth_end`."""
        first, last = self.settings.lambda_smooth, self.settings.lambda_smooth_end
        done = min(1.0, (step - 1) / max(1, self.schedule.iterations - 1))
        return first ** (1 - done) * last**done

    def losses_on_codes(self, codes: Tensor, view_ids: Tensor, step: int) -> Losses:
        """The prior; in odd steps classification on detached codes, which trains the
        discriminator alone; in even steps confusion, which trains the encoder through the
        discriminator, which itself does not learn.
        """
        settings = self.settings
        losses: Losses = {}
        if settings.lambda_prior > 0:
            losses["prior"] = (
                settings.lambda_prior,
                gaussian_prior_loss(codes, settings.prior_form),
            )
        discriminator_turn = step % 2 == 1
        if discriminator_turn and settings.lambda_classification > 0:
            logits = self.discriminator(codes.detach())
            loss = pose_classification_loss(logits, view_ids.to(self.device, non_blocking=True))
            losses["classification"] = (settings.lambda_classification, loss)
        if not discriminator_turn and settings.lambda_adversarial > 0:
            logits = frozen(self.discriminator, codes)
            loss = domain_confusion_loss(logits, settings.adversarial_form)
            losses["confusion"] = (settings.lambda_adversarial, loss)
        return losses
