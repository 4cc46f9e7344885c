"""Base classes of the methods: settings, networks, training step, and the way from images to shapes."""

from __future__ import annotations

import abc
import contextlib
import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

import nmr
from learn3d.data.dataset import MASK_SIZE, Batch, DatasetInfo
from learn3d.data.poses import LookAtPoses, Poses
from learn3d.data.view_bins import AngleBins
from learn3d.device import autocast
from learn3d.losses import pose_classification_loss
from learn3d.methods.optimization import CONSTANT_LR, EMA, TrainingSchedule, adam, backpropagate
from learn3d.methods.surfaces import Grids, Meshes
from learn3d.networks import (
    ENCODERS,
    GENERATORS,
    EncoderName,
    GeneratorName,
    MeshGenerator,
    SymmetryOption,
    create_encoder,
    network_input,
)
from learn3d.networks.encoders import ViewClassifier
from learn3d.networks.resnet import check_pretrained, load_pretrained
from learn3d.settings import FilePath, Positive, checked

AZIMUTHS = AngleBins(15.0, 180.0, -90.0, 90.0)  # classes of the view classifier: the azimuth cells of `fitting.fit`


@checked
class MethodSettings:
    """Settings of a method, and what a run asks of them. Subclasses override the properties."""

    @property
    def image_size(self) -> int:
        """Side of the encoder's input images in pixels."""
        raise NotImplementedError

    @property
    def reads_view_ids(self) -> bool:
        """Whether training depends on the view classes."""
        return False

    @property
    def wants_mirror_plane(self) -> bool:
        """Whether the networks depend on the mirror plane of the training data."""
        return False

    @property
    def wants_solidity(self) -> bool:
        """Whether the networks depend on the solidity of the training data."""
        return False

    @property
    def varies_over_run(self) -> str | None:
        """Name of a setting that makes losses depend on the number of iterations, or None."""
        return None

    def check_run(self, *, iterations: int, batch_size: int) -> None:
        """Raise ValueError if the settings do not fit a run of this length and batch size."""

    def for_iterations(self, iterations: int) -> MethodSettings:
        """These settings for a run of another length: phases of the training keep their share of it."""
        return self

    def for_data(self, info: DatasetInfo) -> MethodSettings:
        """These settings, with the values that suit the training data in place of "auto"."""
        return self


@checked
class MeshSettings(MethodSettings):
    """Networks from images to meshes."""

    encoder: EncoderName = "conv"
    """Network from images to codes. conv: three convolutions on 64-pixel RGB and mask. conv-light: half the channels,
    and a fourth convolution (1x1) to 32 channels. conv-small: a fifteenth of the weights. conv-centred: a tenth of the
    weights, for objects that are all scaled to one size (cameras at unknown distances). conv-relu: conv with a ReLU on
    the code (Kato et al. 2018). resnet18: on 224-pixel RGB."""
    generator: GeneratorName = "sphere"
    """Network from codes to vertices. sphere: 642 free vertices. sphere-smooth: the same; neighbours learn to move
    together first. auto: sphere-smooth if the training masks are compact, else sphere. sphere-small: sphere with half
    the weights. bounded: the generator of Kato et al. 2018. cube-conv, cube-fc: 1352 vertices of a cube's surface, from
    convolutions or from linear layers (Kato and Harada 2019)."""
    symmetry: SymmetryOption = None
    """Vertical mirror plane of all shapes: x (x = 0), z (z = 0), or the azimuth in degrees of a camera that looks along
    it (0 is x = 0). auto: found from the training masks, if they have one. Shapes are not mirrored if it is None."""
    learning_rate: Positive = 1e-4
    """Adam's learning rate, the same for all networks."""
    clamp_to_cube: bool = False
    """Clamp vertices to the cube of the data set, if it has one, in evaluation and reconstruction. The voxelizers find
    no inside in a shape that exceeds their grid."""
    pretrained: FilePath | None = None
    """File of ImageNet weights for the encoder resnet18: a state dict of torchvision's resnet18 (default: random
    weights). VPL then freezes its batch norms."""

    def __post_init__(self) -> None:
        check_pretrained(self.pretrained, self.encoder)

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
        plane = info.mirror_plane_deg if self.symmetry == "auto" else self.symmetry
        sphere = "sphere-smooth" if is_compact(info) else "sphere"
        generator = sphere if self.generator == "auto" else self.generator
        return dataclasses.replace(self, symmetry=plane, generator=generator)


MIN_COMPACT_SOLIDITY = 0.8  # objects count as compact if the data's solidity is at least this
CLAMP_LIMIT = 0.499  # clamped coordinates, in sides of the cube; kato18 counts a face on the border (0.5) as outside


def is_compact(info: DatasetInfo) -> bool:
    """Whether the training masks nearly fill their convex hulls; False if that is not known."""
    return info.solidity is not None and info.solidity >= MIN_COMPACT_SOLIDITY


class Method(abc.ABC):
    """One method in training or in use. A subclass creates networks and optimizers and defines a training step.

    Training steps depend only on the parameters and buffers of `networks`, on `optimizers`, `ema` and torch's global
    random state. A run that is resumed from these is bit-identical.
    """

    needs_poses: ClassVar[bool] = True  # whether every training image must have a known pose
    networks: dict[str, nn.Module]  # networks["encoder"] is self.encoder, and so on
    optimizers: dict[str, torch.optim.Optimizer]
    ema: EMA | None = None  # None if the run keeps no average of the weights
    image_size: int  # side of the stored images that `encode` takes

    def __init__(
        self,
        settings: MethodSettings,
        info: DatasetInfo,
        device: str,
        precision: Literal["bf16", "fp32"],
        schedule: TrainingSchedule = CONSTANT_LR,
    ) -> None:
        self.settings, self.info, self.schedule = settings.for_data(info), info, schedule
        self.image_size = settings.image_size
        self.device, self.precision = torch.device(device), precision
        self.networks = self.create_networks()
        for name, network in self.networks.items():
            setattr(self, name, network.to(device))
        self.optimizers = self.create_optimizers()
        self._learning_rates = {name: [g["lr"] for g in o.param_groups] for name, o in self.optimizers.items()}
        if schedule.ema_decay > 0:
            self.ema = EMA(self.networks, schedule.ema_decay)

    @abc.abstractmethod
    def create_networks(self) -> dict[str, nn.Module]:
        """The networks by name, for `settings` and `info`. Raises ValueError if these contradict each other."""

    @abc.abstractmethod
    def create_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Optimizers by name, with the learning rates of the settings; `take_step` applies the schedule."""

    @abc.abstractmethod
    def training_step(self, batch: Batch, step: int) -> dict[str, float]:
        """The method's part of `take_step`: compute losses, call `backward_and_step` and return its values."""

    @abc.abstractmethod
    def encode(self, images: Tensor) -> Tensor:
        """Shape codes float32 [B, C], on the method's device, of stored images uint8 [B, 4, S, S]."""

    @abc.abstractmethod
    def decode(self, codes: Tensor) -> Meshes | Grids:
        """The shapes of codes [B, C], on the CPU."""

    def view_probabilities(self, images: Tensor) -> Tensor | None:
        """Probability of each cell of `AZIMUTHS`, float32 [B, K], for stored images; None if they were not learnt."""
        return None

    @property
    def weights(self) -> Mapping[str, float]:
        """Weights of the losses of `backward_and_step`, by name."""
        return {}

    def weights_at(self, step: int) -> Mapping[str, float]:
        """The weights of the losses in step `step` (from 1), if they change during a run."""
        return self.weights

    def start_from_pretrained(self) -> None:  # noqa: B027
        """Load the file of pretrained weights that the settings name, if any; called at the start of a run.

        Raises the errors of `learn3d.networks.resnet.load_pretrained`.
        """

    def check_batch(self, batch: Batch) -> None:  # noqa: B027
        """Raise ValueError if the method cannot learn from batches like this one; called at the start of a run."""

    def take_step(self, batch: Batch, step: int) -> dict[str, float]:
        """Take training step `step` (from 1); return all computed losses, unweighted, and "total".

        Raises FloatingPointError if a loss is not finite, before any gradient of that loss is computed.
        """
        factor = self.schedule.lr_factor(step)
        for name, optimizer in self.optimizers.items():
            for group, learning_rate in zip(optimizer.param_groups, self._learning_rates[name], strict=True):
                group["lr"] = factor * learning_rate
        self._clear_gradients()  # frees their memory for the forward pass
        values = self.training_step(batch, step)
        if self.ema is not None:
            self.ema.update(step)
        return values

    def backward_and_step(self, losses: Mapping[str, Tensor], step: int, *names: str) -> dict[str, float]:
        """Backpropagate the weighted sum of the losses and let the optimizers `names` step; see `backpropagate`."""
        self._clear_gradients()
        values = backpropagate(losses, self.weights_at(step), step)
        for name in names:
            self.optimizers[name].step()
        return values

    def _clear_gradients(self) -> None:
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(set_to_none=True)

    def ema_weights(self) -> contextlib.AbstractContextManager[None]:
        """Context in which the networks have their EMA weights, if the run keeps an EMA."""
        return contextlib.nullcontext() if self.ema is None else self.ema.in_place()

    @contextlib.contextmanager
    def in_use(self) -> Iterator[None]:
        """Context for evaluation during a training: `ema_weights`, and networks in evaluation mode. Do not nest it."""
        was_training = self.training
        self.set_training(False)
        try:
            with self.ema_weights():
                yield
        finally:
            self.set_training(was_training)

    def autocast(self) -> torch.autocast:
        """Context in which the networks run at the method's precision."""
        return autocast(self.device, self.precision)

    @property
    def training(self) -> bool:
        """Whether the networks are in training mode."""
        return any(network.training for network in self.networks.values())

    def set_training(self, training: bool) -> None:
        """Put the networks into training or evaluation mode."""
        for network in self.networks.values():
            network.train(training)


class MeshMethod(Method):
    """A method with an encoder of images and a generator of meshes, which learns from rendered silhouettes."""

    settings: MeshSettings
    encoder: nn.Module
    generator: MeshGenerator

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.faces, self.edges = self.generator.faces.cpu(), self.generator.edges.cpu()  # for the renderer

    def create_networks(self) -> dict[str, nn.Module]:
        encoder = create_encoder(self.settings.encoder, inverted=self.info.inverted)
        generator = GENERATORS[self.settings.generator](symmetry=self.settings.symmetry)
        return {"encoder": encoder.to(memory_format=torch.channels_last), "generator": generator}

    def create_view_classifier(self) -> dict[str, nn.Module]:
        """The network "view_classifier", which predicts the azimuth of an image."""
        classifier = ViewClassifier(AZIMUTHS.count, inverted=self.info.inverted)
        return {"view_classifier": classifier.to(memory_format=torch.channels_last)}

    def create_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return {name: adam(network, self.settings.learning_rate) for name, network in self.networks.items()}

    def start_from_pretrained(self) -> None:
        if self.settings.pretrained is not None:
            load_pretrained(getattr(self.encoder, "resnet", self.encoder), self.settings.pretrained)

    def check_batch(self, batch: Batch) -> None:
        if "view_classifier" in self.networks and not isinstance(batch.poses, LookAtPoses):
            raise ValueError("--lambda-view needs azimuths, and the poses of these data are rotations; leave it out")

    def encode(self, images: Tensor) -> Tensor:
        with self.autocast():
            return self.encoder(network_input(images, self.device, self.image_size)).float()

    def decode(self, codes: Tensor) -> Meshes:
        with self.autocast():
            vertices = self.generator(codes).cpu()
        if self.settings.clamp_to_cube and self.info.cube_side is not None:
            limit = CLAMP_LIMIT * self.info.cube_side
            vertices = vertices.clamp(-limit, limit)
        return Meshes(vertices, self.faces)

    def encode_symmetric(self, images: Tensor) -> Tensor:
        """Shape codes; for symmetric shapes the mean of the codes of an image and its mirror image."""
        codes = MeshMethod.encode(self, images)
        return codes if self.generator.mirror is None else (codes + MeshMethod.encode(self, images.flip(3))) / 2

    def predict(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Codes float32 [B, C] and vertices float32 [B, V, 3] of stored images, on the method's device."""
        with self.autocast():
            codes = self.encoder(network_input(images, self.device, self.image_size))
            vertices = self.generator(codes)
        return codes.float(), vertices

    @torch.no_grad()
    def view_probabilities(self, images: Tensor) -> Tensor | None:
        return self._view_logits(images).softmax(1).cpu() if "view_classifier" in self.networks else None

    def view_loss(self, images: Tensor, poses: LookAtPoses) -> Tensor:
        """The loss of the network "view_classifier" on stored images of these poses."""
        return pose_classification_loss(
            self._view_logits(images), AZIMUTHS.ids(poses).to(self.device, non_blocking=True)
        )

    def _view_logits(self, images: Tensor) -> Tensor:
        with self.autocast():
            return self.networks["view_classifier"](network_input(images, self.device, self.image_size)).float()

    def render(self, vertices: Tensor, poses: Poses) -> Tensor:
        """Silhouettes float32 [B, 64, 64] of vertices [B, V, 3]. Rendering runs on the CPU."""
        return nmr.render_silhouette(vertices, self.faces, poses.cameras(), image_size=MASK_SIZE)

    def surface_losses(self, vertices: Tensor) -> dict[str, Tensor]:
        """The losses smoothness, inflation and area, each only if its weight is above 0."""
        losses = {}
        if self.weights.get("smoothness", 0.0) > 0:
            losses["smoothness"] = nmr.losses.smoothness_loss(vertices, self.edges)
        if self.weights.get("inflation", 0.0) > 0:
            losses["inflation"] = nmr.losses.inflation_loss(vertices, self.faces)
        if self.weights.get("area", 0.0) > 0:
            losses["area"] = nmr.losses.area_loss(vertices, self.faces)
        return losses


def check_groups(batch: Batch, size: int, sampling: Literal["pairs", "groups"]) -> None:
    """Raise ValueError unless a batch is [a_1 .. a_n, b_1 .. b_n, ...], `size` views of each of n objects."""
    count, rest = divmod(len(batch), size)
    if rest or not torch.equal(batch.object_ids, batch.object_ids[:count].repeat(size)):
        raise ValueError(
            f"the method learns from batches of {size} views of each object, [a_1 .. a_n, b_1 .. b_n, ...], but this "
            f"batch of {len(batch)} views has another form; choose sampling {sampling!r}"
        )
