"""Vanilla-AE as Kato et al. 2018 published it: the shape of each of two views must explain both."""

from __future__ import annotations

import torch

import nmr
from learn3d.data.dataset import Batch
from learn3d.methods.method import MeshMethod, MeshSettings, check_groups
from learn3d.methods.optimization import SparseGradientAdam
from learn3d.networks import EncoderName, GeneratorName
from learn3d.settings import Weight, checked

CENTROID_LEARNING_RATE = 0.1  # learning rate of the centroid's layer, relative to the other layers


@checked
class MultiViewSettings(MeshSettings):
    """Networks and loss weight of Kato et al. 2018, with the published code's defaults for one category."""

    encoder: EncoderName = "conv-relu"
    generator: GeneratorName = "bounded"
    lambda_smooth: Weight = 0.001
    """Weight of the smoothness loss (published: 0.001 for one category, 0 for all together)."""


class MultiView(MeshMethod):
    """Encoder and mesh generator, trained on pairs of views: batches [a_1 .. a_n, b_1 .. b_n], sampling "pairs"."""

    settings: MultiViewSettings

    def create_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        rate = self.settings.learning_rate
        of_generator = dict(self.generator.named_parameters())
        slow = [parameter for name, parameter in of_generator.items() if name.startswith("centroid.")]
        others = [parameter for name, parameter in of_generator.items() if not name.startswith("centroid.")]
        optimizers = {
            "encoder": SparseGradientAdam(self.encoder.parameters(), lr=rate),
            "generator": SparseGradientAdam(others, lr=rate),
        }
        if slow:  # only the generator "bounded" has this layer
            optimizers["centroid"] = SparseGradientAdam(slow, lr=CENTROID_LEARNING_RATE * rate)
        return optimizers

    def check_batch(self, batch: Batch) -> None:
        check_groups(batch, 2, "pairs")

    @property
    def weights(self) -> dict[str, float]:
        return {"projection": 1.0, "smoothness": self.settings.lambda_smooth}

    def training_step(self, batch: Batch, step: int) -> dict[str, float]:
        """Render the shapes of both views, a and b, in both views. The loss is the mean of the four IoU losses plus
        lambda_smooth times the mean smoothness of the shapes.
        """
        pairs = len(batch) // 2
        vertices = self.predict(batch.images)[1].cpu()
        # shapes a, b, a, b in the views a, a, b, b
        seen = torch.arange(2 * pairs).reshape(2, pairs)[[0, 0, 1, 1]].flatten()
        silhouettes = self.render(torch.cat([vertices, vertices]), batch.poses[seen])
        losses = {"projection": nmr.losses.soft_iou_loss(silhouettes, batch.masks[seen])}
        return self.backward_and_step(losses | self.surface_losses(vertices), step, *self.optimizers)
