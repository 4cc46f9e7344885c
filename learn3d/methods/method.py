"""What the training loop, evaluation and figures expect of a method: networks, a training step, a way to shapes."""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learn3d.data.batch import Batch
from learn3d.device import Download, autocast
from learn3d.parallel.ranks import ALONE, Ranks


@dataclass(frozen=True)
class DataShape:
    """What a method must know about its data before it builds its networks. Saved in every checkpoint."""

    num_views: int  # K pose classes
    num_classes: int = 1  # categories in the set
    pose_features: int = 3  # size of `Poses.features()`: 3 for an eye position, 9 for a rotation
    inverted: bool = False  # colours are stored as 255 - colour (not looked at by runs whose checkpoints lack it)


@dataclass(frozen=True, eq=False)
class Meshes:
    """Predicted surfaces, on the CPU."""

    vertices: Tensor  # float32 [B, V, 3], object frame
    faces: Tensor  # int64 [F, 3]


@dataclass(frozen=True, eq=False)
class Grids:
    """Predicted volumes, on the CPU."""

    occupancy: Tensor  # float32 [B, s, s, s] in [0, 1]; axes (x, y, z) of the object frame over the box [-0.5, 0.5]
    threshold: float = 0.5  # occupied above it

    def occupied(self, size: int) -> Tensor:
        """Bool [B, size, size, size]: where the mean over the cell is above the threshold; s is a multiple of size."""
        factor, rest = divmod(self.occupancy.shape[-1], size)
        if rest or factor < 1:
            raise ValueError(f"a grid of {self.occupancy.shape[-1]} cells cannot be pooled to {size}")
        return F.avg_pool3d(self.occupancy[:, None], factor)[:, 0] > self.threshold


class Method(abc.ABC):
    """One method in training or in use. A subclass builds `networks` and `optimizers` and has its own training step.

    Everything that decides the next steps lives in the parameters and buffers of `networks`, in `optimizers` and in
    torch's global random state, so that a checkpoint of these three resumes bit for bit.
    """

    networks: dict[str, nn.Module]
    optimizers: dict[str, torch.optim.Optimizer]
    device: torch.device
    precision: Literal["bf16", "fp32"]
    ranks: Ranks = ALONE  # the processes that train it together; `Ranks.join` sets it
    image_size: int  # side of the images that `encode` takes; also a property of the method's settings

    @abc.abstractmethod
    def train_step(self, batch: Batch, step: int) -> dict[str, float]:
        """Take optimisation step `step` (from 1) and return every loss that was computed, unweighted, and "total".

        Raises FloatingPointError, before stepping, when a loss is not finite (`check_finite`).
        """

    def start_from_pretrained(self) -> None:  # noqa: B027
        """Copy the weights of the file that the settings name, where they name one, into the encoder.

        For the beginning of a run: afterwards they are in its checkpoints, and the file may be gone. Raises as
        `learn3d.networks.resnet.load_pretrained`.
        """

    @abc.abstractmethod
    def encode(self, images: Tensor) -> Tensor:
        """Shape codes float32 [B, C] on the method's device, of stored images uint8 [B, 4, S, S]."""

    @abc.abstractmethod
    def decode(self, codes: Tensor) -> Meshes | Grids:
        """The shapes of codes [B, C], on the CPU."""

    def backward(self, loss: Tensor) -> None:
        """Gradients of this process's share of a loss, whose mean over the processes is that of the whole batch."""
        (loss if self.ranks.alone else self.ranks.share * loss).backward()

    def autocast(self) -> torch.autocast:
        """Context in which the networks run at the method's precision."""
        return autocast(self.device, self.precision)

    @property
    def training(self) -> bool:
        """Whether the networks are in training mode."""
        return any(network.training for network in self.networks.values())

    def set_training(self, training: bool) -> None:
        """Batch norms and the like in training or in evaluation mode."""
        for network in self.networks.values():
            network.train(training)


def adam(network: nn.Module, learning_rate: float, betas: tuple[float, float] = (0.9, 0.999)) -> torch.optim.Adam:
    """Adam for one network, fused (13 ms a step instead of 91 on two cores)."""
    parameters = [parameter for parameter in network.parameters() if parameter.requires_grad]
    return torch.optim.Adam(parameters, lr=learning_rate, betas=betas, fused=True)


def frozen(network: nn.Module, *inputs: Tensor) -> Tensor:
    """Apply a network so that gradients reach its inputs but not its parameters, and its buffers stay as they are."""
    state = {name: parameter.detach() for name, parameter in network.named_parameters()}
    state |= {name: buffer.clone() for name, buffer in network.named_buffers()}
    return torch.func.functional_call(network, state, inputs)


def descend(losses: dict[str, Tensor], weights: dict[str, float], step: int, ranks: Ranks = ALONE) -> dict[str, float]:
    """Backpropagate the sum of the losses, each times its weight (1 where none is given); return them, and "total".

    Losses are those of this process's rows; what is returned is of the whole batch, and so is the sum of the gradients
    over the processes. They may lie on the CPU and on the networks' device: each is added up and goes back where it is,
    and what lies on the device is read with one copy. Raises FloatingPointError, with no gradient computed yet, when
    one is not finite.
    """
    totals: dict[torch.device, Tensor] = {}
    for name, loss in losses.items():
        weight = weights.get(name, 1.0)
        term = loss if weight == 1.0 else weight * loss
        totals[loss.device] = totals[loss.device] + term if loss.device in totals else term
    values = ranks.means(read_back(losses))
    values["total"] = sum(weights.get(name, 1.0) * value for name, value in values.items())
    check_finite(values, step)
    torch.autograd.backward([total if ranks.alone else ranks.share * total for total in totals.values()])
    return values


def read_back(losses: dict[str, Tensor]) -> dict[str, float]:
    """The values of scalar losses; one copy for all that lie on one device."""
    by_device: dict[torch.device, list[str]] = {}
    for name, loss in losses.items():
        by_device.setdefault(loss.device, []).append(name)
    copies = {
        device: Download(torch.stack([losses[name].detach().float() for name in names]))
        for device, names in by_device.items()
    }
    found = {}
    for device, names in by_device.items():
        found |= dict(zip(names, copies[device].finish().tolist(), strict=True))
    return {name: found[name] for name in losses}


def check_finite(losses: dict[str, float], step: int) -> None:
    """Raise FloatingPointError naming the losses when one of them is not finite."""
    if not all(math.isfinite(value) for value in losses.values()):
        listed = ", ".join(f"{name} {value:g}" for name, value in losses.items())
        raise FloatingPointError(f"the loss is not finite at iteration {step} ({listed})")
