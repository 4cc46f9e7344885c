"""Methods that know which views show the same object, from batches [a_1 .. a_n, b_1 .. b_n, ...].

Multi-view is Vanilla-AE with the supervision of Kato et al. 2018: the shape of each of two views
must explain both. Many views: the shape of one image must explain other views of its object,
whose depth is used if it is known.
"""

import torch
from torch import nn

import nmr
from learn3d.data.dataset import MASK_SIZE, Batch
from learn3d.data.sampling import GROUP_SIZE, Sampling
from learn3d.losses import depth_losses, gaussian_prior_loss
from learn3d.methods.mesh_method import MeshMethod, MeshSettings
from learn3d.methods.method import Losses
from learn3d.networks.encoders import EncoderName
from learn3d.networks.generators import SymmetryOption
from learn3d.settings import Positive, Weight, checked


@checked
class MultiViewSettings(MeshSettings):
    """Networks, and the weight of the smoothness loss."""

    @property
    def sampling(self) -> Sampling:
        return "pairs"


class MultiView(MeshMethod):
    """Encoder and mesh generator, trained on pairs of views."""

    settings: MultiViewSettings

    def losses(self, batch: Batch, step: int) -> Losses:
        """Render the shapes of both views, a and b, in both views.

        The loss is the mean of the four IoU losses plus lambda_smooth times the mean smoothness
        of the shapes.
        """
        pairs = len(batch) // 2
        vertices = self.predict(batch.images)[1].cpu()
        # shapes a, b, a, b in the views a, a, b, b
        seen = torch.arange(2 * pairs).reshape(2, pairs)[[0, 0, 1, 1]].flatten()
        silhouettes = self.render(torch.cat([vertices, vertices]), batch.poses[seen])
        projection = nmr.losses.soft_iou_loss(silhouettes, batch.masks[seen])
        return {"projection": (1.0, projection), **self.surface_losses(vertices, step)}


@checked
class ManyViewsSettings(MeshSettings):
    """Networks and weights of the losses; a loss with weight 0 is not computed."""

    encoder: EncoderName = "conv-light"
    symmetry: SymmetryOption = "auto"
    clamp_to_cube: bool = True
    learning_rate: Positive = 4e-4
    lambda_smooth: Weight = 3e-4
    lambda_prior: Weight = 1e-4
    """Weight of the mean squared length of the codes."""
    lambda_depth: Weight = 3.0
    """Weight of the depth loss, in views whose depth is known."""
    lambda_slope: Weight = 3.0
    """Weight of the slope loss: how depth changes from pixel to pixel, which shows how surfaces
    are turned."""
    lambda_view: Weight = 0.0
    """Weight of the loss of a small network that classifies the azimuth of an image;
    reconstruction places the camera of a picture by it. 0: no such network."""

    @property
    def sampling(self) -> Sampling:
        return "groups"


class ManyViews(MeshMethod):
    """Encoder and mesh generator, trained on groups of `GROUP_SIZE` views."""

    averages_mirror_images = True
    settings: ManyViewsSettings

    def create_networks(self) -> dict[str, nn.Module]:
        return super().create_networks() | self.create_view_classifier()

    def losses(self, batch: Batch, step: int) -> Losses:
        """Render the shape of the first view of each object in all its views. The loss is
        projection + lambda_depth depth + lambda_slope slope + lambda_smooth smoothness +
        lambda_prior prior + lambda_view view. Every second image of symmetric objects is flipped
        first, but not for the loss view.
        """
        settings = self.settings
        count = len(batch) // GROUP_SIZE
        images = batch.images[:count]
        codes, vertices = self.predict(self.flip_every_second(images)[0])
        losses: Losses = {}
        if settings.lambda_prior > 0:
            losses["prior"] = (settings.lambda_prior, gaussian_prior_loss(codes, "squared"))
        if settings.lambda_view > 0:
            losses["view"] = (settings.lambda_view, self.view_loss(images, batch.poses[:count]))
        vertices = vertices.cpu()
        uses_depth = batch.depth is not None and settings.lambda_depth + settings.lambda_slope > 0
        rendered = nmr.render(
            vertices.repeat(GROUP_SIZE, 1, 1),
            self.faces,
            batch.cameras,
            outputs=("alpha", "depth") if uses_depth else ("alpha",),
            image_size=MASK_SIZE,
        )
        losses["projection"] = (1.0, nmr.losses.soft_iou_loss(rendered.alpha, batch.masks))
        if uses_depth:
            depth, slope = depth_losses(rendered.depth, batch.depth)
            losses["depth"] = (settings.lambda_depth, depth)
            losses["slope"] = (settings.lambda_slope, slope)
        return losses | self.surface_losses(vertices, step)
