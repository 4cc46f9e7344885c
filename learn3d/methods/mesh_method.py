"""Base classes of the methods that learn meshes from silhouettes."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

import nmr
from learn3d.data.dataset import MASK_SIZE, DatasetInfo
from learn3d.data.poses import LookAtPoses, Poses
from learn3d.data.view_bins import AngleBins
from learn3d.losses import pose_classification_loss
from learn3d.methods.method import Losses, Meshes, Method, MethodSettings
from learn3d.methods.optimization import adam
from learn3d.networks.encoders import ENCODERS, EncoderName, ViewClassifier, network_input
from learn3d.networks.generators import GENERATORS, GeneratorName, MeshGenerator, SymmetryOption
from learn3d.networks.resnet import load_pretrained
from learn3d.settings import FilePath, Positive, Weight, checked

# classes of the view classifier: the azimuth cells of `fitting.fit`
AZIMUTH_BINS = AngleBins(15.0, 180.0, -90.0, 90.0)
MIN_COMPACT_SOLIDITY = 0.8  # objects count as compact if the data's solidity is at least this
CLAMP_LIMIT = 0.499  # clamped coordinates, in sides of the cube; kato18 counts a face on the border (0.5) as outside


@checked
class MeshSettings(MethodSettings):
    """Networks from images to meshes."""

    # weight of the loss of a network that classifies the azimuth of an image; a subclass may make it a field
    lambda_view: ClassVar[float] = 0.0

    encoder: EncoderName = "conv"
    """Network from images to codes. conv: three convolutions on 64-pixel RGB and mask.
    conv-light: half the channels, and a fourth convolution (1x1) to 32 channels. conv-small: a
    fifteenth of the weights. conv-centred: a tenth of the weights, for objects that are all
    scaled to one size (cameras at unknown distances). resnet18: on 224-pixel RGB."""
    generator: GeneratorName = "sphere"
    """Network from codes to vertices. sphere: 642 free vertices. sphere-smooth: the same;
    neighbours learn to move together first. auto: sphere-smooth if the training masks are
    compact, else sphere. sphere-small: sphere with half the weights."""
    symmetry: SymmetryOption = None
    """Vertical mirror plane of all shapes: x (x = 0), z (z = 0), or the azimuth in degrees of a
    camera that looks along it (0 is x = 0). auto: found from the training masks, if they have
    one. Shapes are not mirrored if it is None."""
    learning_rate: Positive = 1e-4
    """Adam's learning rate, the same for all networks."""
    clamp_to_cube: bool = False
    """Clamp vertices to the cube of the data set, if it has one, in evaluation and
    reconstruction. The voxelizers find no inside in a shape that exceeds their grid."""
    pretrained: FilePath | None = None
    """File of ImageNet weights for the encoder resnet18: a state dict of torchvision's resnet18.
    If not given: random weights."""
    lambda_smooth: Weight = 0.001
    """Weight of the smoothness loss (lambda_1 in Peng et al. 2020)."""

    def __post_init__(self) -> None:
        if self.pretrained is not None and self.encoder != "resnet18":
            raise ValueError(
                f"pretrained weights are for the encoder 'resnet18', got encoder {self.encoder!r}; choose that encoder "
                "(it takes images of 224 pixels), or leave pretrained out"
            )

    @property
    def image_size(self) -> int:
        return ENCODERS[self.encoder].image_size

    @property
    def wants_mirror_plane(self) -> bool:
        return self.symmetry == "auto"

    @property
    def wants_solidity(self) -> bool:
        return self.generator == "auto"

    def for_data(self, info: DatasetInfo) -> MeshSettings:
        super().for_data(info)
        if self.lambda_view > 0 and info.pose_features != LookAtPoses.num_features:
            raise ValueError(
                "--lambda-view needs azimuths, and the poses of these data are rotations; leave it out"
            )
        plane = info.mirror_plane_deg if self.symmetry == "auto" else self.symmetry
        sphere = "sphere-smooth" if is_compact(info) else "sphere"
        generator = sphere if self.generator == "auto" else self.generator
        return dataclasses.replace(self, symmetry=plane, generator=generator)


def is_compact(info: DatasetInfo) -> bool:
    """Whether the training masks nearly fill their convex hulls; False if that is not known."""
    return info.solidity is not None and info.solidity >= MIN_COMPACT_SOLIDITY


class MeshMethod(Method):
    """A method with an encoder of images and a generator of meshes, which learns from rendered
    silhouettes.

    A subclass may add a network that classifies the azimuth of an image
    (`create_view_classifier`, `view_loss`).
    """

    # whether a code is the mean over an image and its mirror image
    averages_mirror_images: ClassVar[bool] = False
    settings: MeshSettings
    encoder: nn.Module
    generator: MeshGenerator
    view_classifier: nn.Module

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        # for the renderer
        self.faces = self.generator.faces.cpu()
        self.edges = self.generator.edges.cpu()

    def create_networks(self) -> dict[str, nn.Module]:
        encoder = ENCODERS[self.settings.encoder](self.info.inverted)
        generator = GENERATORS[self.settings.generator](symmetry=self.settings.symmetry)
        return {"encoder": encoder.to(memory_format=self.memory_format), "generator": generator}

    def create_view_classifier(self) -> dict[str, nn.Module]:
        """The network "view_classifier", if `lambda_view` is above 0."""
        if self.settings.lambda_view == 0:
            return {}
        classifier = ViewClassifier(math.prod(AZIMUTH_BINS.shape), self.info.inverted)
        return {"view_classifier": classifier.to(memory_format=self.memory_format)}

    def create_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Adam for each network that has weights."""
        trained = {
            name: network for name, network in self.networks.items() if list(network.parameters())
        }
        rate = self.settings.learning_rate
        return {name: adam(network, rate) for name, network in trained.items()}

    def start_from_pretrained(self) -> None:
        if self.settings.pretrained is not None:
            load_pretrained(self.encoder, self.settings.pretrained)

    def encode(self, images: Tensor) -> Tensor:
        codes = self._apply(self.encoder, images)
        if self.averages_mirror_images and self.generator.mirror is not None:
            codes = (codes + self._apply(self.encoder, images.flip(3))) / 2
        return codes

    def decode(self, codes: Tensor) -> Meshes:
        with self.autocast():
            vertices = self.generator(codes).cpu()
        if self.settings.clamp_to_cube and self.info.cube_side is not None:
            limit = CLAMP_LIMIT * self.info.cube_side
            return Meshes(vertices.clamp(-limit, limit), self.faces, unclamped=vertices)
        return Meshes(vertices, self.faces)

    def predict(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Codes float32 [B, C] and vertices float32 [B, V, 3] of stored images."""
        with self.autocast():
            codes = self.encoder(self._pixels(images))
            vertices = self.generator(codes)
        return codes.float(), vertices

    @torch.no_grad()
    def view_probabilities(self, images: Tensor) -> Tensor | None:
        return (
            self._apply(self.view_classifier, images).softmax(1).cpu()
            if self.settings.lambda_view > 0
            else None
        )

    def view_loss(self, images: Tensor, poses: LookAtPoses) -> Tensor:
        """The loss of the network "view_classifier" on stored images of these poses."""
        logits = self._apply(self.view_classifier, images)
        return pose_classification_loss(
            logits, AZIMUTH_BINS.ids(poses).to(self.device, non_blocking=True)
        )

    @property
    def memory_format(self) -> torch.memory_format:
        """Layout of the convolutions: channels last is faster in bf16 and with AVX-512, slower in fp32 with AVX2."""
        avx512 = self.device.type == "cpu" and torch.backends.cpu.get_cpu_capability() == "AVX512"
        faster = avx512 or self.precision == "bf16"
        return torch.channels_last if faster else torch.contiguous_format

    def _pixels(self, images: Tensor) -> Tensor:
        """Stored images as the input of the convolutions."""
        return network_input(images, self.device, self.image_size, self.memory_format)

    def _apply(self, network: nn.Module, images: Tensor) -> Tensor:
        with self.autocast():
            return network(self._pixels(images)).float()

    def flip_every_second(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Flip every second image if shapes are symmetric. Returns images, and bool [B].

        A flipped image of a symmetric object shows the same shape, so mask and pose stay the same.
        """
        flipped = (torch.arange(len(images)) % 2 == 1) & (self.generator.mirror is not None)
        return torch.where(flipped[:, None, None, None], images.flip(3), images), flipped

    def render(self, vertices: Tensor, poses: Poses) -> Tensor:
        """Silhouettes float32 [B, 64, 64] of vertices [B, V, 3]. Rendering runs on the CPU."""
        return nmr.render_silhouette(vertices, self.faces, poses.cameras(), image_size=MASK_SIZE)

    def surface_losses(self, vertices: Tensor, step: int) -> Losses:
        """The losses on vertices [B, V, 3] in step `step`; one whose weight is 0 is left out."""
        if self.settings.lambda_smooth == 0:
            return {}
        return {
            "smoothness": (
                self.settings.lambda_smooth,
                nmr.losses.smoothness_loss(vertices, self.edges),
            )
        }
