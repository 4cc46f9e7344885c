"""Many views (multi-view supervision): the shape of one image must explain other views of its object.

It needs several views of every object with known cameras, and uses their depth if it is known.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

import nmr
from learn3d.data.dataset import MASK_SIZE, Batch
from learn3d.data.sampling import GROUP_SIZE
from learn3d.losses import depth_loss, gaussian_prior_loss
from learn3d.methods.method import MeshMethod, MeshSettings, check_groups
from learn3d.networks import EncoderName, SymmetryOption
from learn3d.settings import Positive, Weight, checked


@checked
class ManyViewsSettings(MeshSettings):
    """Networks and weights of the losses; a loss with weight 0 is not computed."""

    encoder: EncoderName = "conv-light"
    symmetry: SymmetryOption = "auto"
    clamp_to_cube: bool = True
    learning_rate: Positive = 4e-4
    lambda_smooth: Weight = 3e-4
    """Weight of the smoothness loss."""
    lambda_prior: Weight = 1e-4
    """Weight of the mean squared length of the codes."""
    lambda_depth: Weight = 3.0
    """Weight of the depth loss, in views whose depth is known."""
    lambda_view: Weight = 0.0
    """Weight of the loss of a small network that classifies the azimuth of an image; reconstruction places the camera
    of a picture by it. 0: no such network."""


class ManyViews(MeshMethod):
    """Encoder and mesh generator, trained on groups of views: batches [a_1 .. a_n, b_1 .. b_n, ...]."""

    settings: ManyViewsSettings

    def create_networks(self) -> dict[str, nn.Module]:
        networks = super().create_networks()
        return networks | self.create_view_classifier() if self.settings.lambda_view > 0 else networks

    @property
    def weights(self) -> dict[str, float]:
        settings = self.settings
        return {
            "projection": 1.0,
            "depth": settings.lambda_depth,
            "smoothness": settings.lambda_smooth,
            "prior": settings.lambda_prior,
            "view": settings.lambda_view,
        }

    def encode(self, images: Tensor) -> Tensor:
        return self.encode_symmetric(images)

    def check_batch(self, batch: Batch) -> None:
        super().check_batch(batch)
        check_groups(batch, GROUP_SIZE, "groups")

    def training_step(self, batch: Batch, step: int) -> dict[str, float]:
        """Render the shape of the first view of each object in all its views. The loss is projection + lambda_depth
        depth + lambda_smooth smoothness + lambda_prior prior + lambda_view view. Every second image of symmetric
        objects is flipped first, but not for the loss view.
        """
        count = len(batch) // GROUP_SIZE
        images = batch.images[:count]
        flipped = (torch.arange(count) % 2 == 1) & (self.generator.mirror is not None)
        codes, vertices = self.predict(torch.where(flipped[:, None, None, None], images.flip(3), images))
        losses = {"prior": gaussian_prior_loss(codes, "squared")} if self.settings.lambda_prior > 0 else {}
        if self.settings.lambda_view > 0:
            losses["view"] = self.view_loss(images, batch.poses[:count])
        vertices = vertices.cpu()
        uses_depth = batch.depth is not None and self.settings.lambda_depth > 0
        rendered = nmr.render(
            vertices.repeat(GROUP_SIZE, 1, 1),
            self.faces,
            batch.cameras,
            outputs=("alpha", "depth") if uses_depth else ("alpha",),
            image_size=MASK_SIZE,
        )
        losses["projection"] = nmr.losses.soft_iou_loss(rendered.alpha, batch.masks)
        if uses_depth:
            losses["depth"] = depth_loss(rendered.depth, batch.depth)
        return self.backward_and_step(losses | self.surface_losses(vertices), step, *self.optimizers)
