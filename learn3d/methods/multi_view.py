"""Vanilla-AE as Kato et al. 2018 published it: two views of an object must be explained by the shape of either."""

from __future__ import annotations

import torch

import nmr
from learn3d.data.batch import Batch
from learn3d.device import Download
from learn3d.methods.adam import SparseGradientAdam
from learn3d.methods.method import MeshMethod
from learn3d.networks import ENCODERS, EncoderName, GeneratorName, SymmetryOption
from learn3d.settings import Positive, Weight, checked

CENTROID_LEARNING_RATE = 0.1  # of the centroid's layer, relative to all others


@checked
class MultiViewSettings:
    """Networks and weight of Kato et al. 2018; the defaults are the published code's for one category."""

    encoder: EncoderName = "conv-relu"
    """conv-relu: three convolutions, on 64-pixel RGB and mask, with a ReLU on the code, as in Kato et al. conv: without
    the ReLU. conv-small: conv with a fifteenth of the weights. resnet18: on 224-pixel RGB."""
    generator: GeneratorName = "bounded"
    """bounded: that of Kato et al. sphere: 642 free vertices. The others: see PoseInvariantSettings."""
    symmetry: SymmetryOption = None
    """Mirror shapes at a vertical plane: x (x = 0), z (z = 0), or the azimuth in degrees of a camera that looks along
    it (0 is x = 0). auto: the plane that the training masks show, or none. None: shapes are free."""
    learning_rate: Positive = 1e-4
    """Adam's full step size. The preset's schedule "step" takes a tenth of it in the last 5 % of all iterations."""
    lambda_smooth: Weight = 0.001
    """Weight of the smoothness loss (published: 0.001 for one category, 0 for all together)."""

    @property
    def image_size(self) -> int:
        """Side of the images that the encoder takes, in pixels."""
        return ENCODERS[self.encoder].image_size


class MultiView(MeshMethod):
    """Encoder and mesh generator, trained on pairs of views: batches [a_1 .. a_n, b_1 .. b_n], sampling "pairs"."""

    settings: MultiViewSettings

    def create_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        rate = self.settings.learning_rate
        slow = list(self.generator.centroid.parameters()) if hasattr(self.generator, "centroid") else []
        others = [p for p in self.generator.parameters() if not any(p is q for q in slow)]
        optimizers = {
            "encoder": SparseGradientAdam(self.encoder.parameters(), lr=rate),
            "generator": SparseGradientAdam(others, lr=rate),
        }
        if slow:
            optimizers["centroid"] = SparseGradientAdam(slow, lr=CENTROID_LEARNING_RATE * rate)
        return optimizers

    def check_batch(self, batch: Batch) -> None:
        check_pairs(batch)

    @property
    def weights(self) -> dict[str, float]:
        return {"projection": 1.0, "smoothness": self.settings.lambda_smooth}

    def training_step(self, batch: Batch, step: int) -> dict[str, float]:
        """Render the shapes of both views, {a, b}, in both views: the mean of four IoU losses, and lambda_s times the
        mean smoothness of the shapes. Raises ValueError where the batch is not made of pairs.
        """
        pairs = check_pairs(batch)
        _, vertices = self.predict(batch.images)
        vertices = Download(vertices).wait()
        # Shapes a, b, a, b in the views a, a, b, b.
        seen = torch.arange(2 * pairs).reshape(2, pairs)[[0, 0, 1, 1]].flatten()
        silhouettes = self.render(torch.cat([vertices, vertices]), batch.poses[seen])
        losses = {"projection": nmr.losses.soft_iou_loss(silhouettes, batch.masks[seen])}
        losses |= self.surface_losses(vertices)
        return self.backward_and_step(losses, step, *self.optimizers)


def check_pairs(batch: Batch) -> int:
    """The number n of pairs in a batch [a_1 .. a_n, b_1 .. b_n], or a ValueError where it is made of something else."""
    half = len(batch) // 2
    if len(batch) % 2 or not torch.equal(batch.object_ids[:half], batch.object_ids[half:]):
        raise ValueError(
            "the method multi-view learns from pairs of views of one object, [a_1 .. a_n, b_1 .. b_n], but this batch "
            f"of {len(batch)} views is not made of such pairs; choose sampling 'pairs'"
        )
    return half
