"""Base classes of every method: settings, losses of a step, shapes from images."""

from __future__ import annotations

import abc
import contextlib
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learn3d.data.dataset import Batch, DatasetInfo
from learn3d.data.sampling import Sampling
from learn3d.methods.optimization import EMA, TrainingSchedule
from learn3d.pictures import Surface, grid_surface
from learn3d.settings import checked

#: The losses of a batch by name: the weight of each, and its value before weighting, a scalar tensor.
Losses: TypeAlias = dict[str, tuple[float, Tensor]]


@checked
class MethodSettings:
    """Settings of a method: fields are options.

    The properties follow from them; a run reads these, and subclasses override them.
    """

    @property
    def image_size(self) -> int:
        """Side of the encoder's input images in pixels; data sets are read at this size."""
        return 64

    @property
    def sampling(self) -> Sampling | None:
        """The only sampling with which the losses work; None if they take any batch."""
        return None

    @property
    def reads_view_ids(self) -> bool:
        """Whether losses read the view classes, which a flipped image does not keep."""
        return False

    @property
    def wants_mirror_plane(self) -> bool:
        """Whether a run must look for the mirror plane of the training masks."""
        return False

    @property
    def wants_solidity(self) -> bool:
        """Whether a run must measure the solidity of the training masks."""
        return False

    @property
    def varies_over_run(self) -> str | None:
        """Name of a setting that makes losses depend on the number of iterations, which then must
        not change when a run is resumed; None if there is none.
        """
        return None

    def check_run(self, *, iterations: int, batch_size: int) -> None:
        """Raise ValueError if the settings do not fit a run of this length and batch size."""

    def for_iterations(self, iterations: int) -> MethodSettings:
        """These settings for a run of another length; phases keep their share of it."""
        return self

    def for_data(self, info: DatasetInfo) -> MethodSettings:
        """These settings, with the values that suit the training data in place of "auto".

        Raises ValueError if the method cannot learn from such data.
        """
        if info.pose_features == 0:
            raise ValueError(
                f"{type(self).__name__.removesuffix('Settings')} learns from images whose camera poses are known, but "
                "this data set has no poses; take a data set with poses, or estimate them from its masks (learn3d "
                "estimate-poses, then --poses)"
            )
        return self


@dataclass(frozen=True, eq=False)
class Meshes:
    """Predicted surfaces, on the CPU."""

    vertices: Tensor  # float32 [B, V, 3], object frame
    faces: Tensor  # int64 [F, 3]
    unclamped: Tensor | None = None  # the vertices before a clamp to the cube; None without one

    def without_clamp(self) -> Meshes | None:
        """The same surfaces before the clamp; None if there was none."""
        return None if self.unclamped is None else Meshes(self.unclamped, self.faces)

    def surfaces(self) -> list[Surface]:
        """The shapes one by one."""
        return [Surface(vertices, self.faces) for vertices in self.vertices]


@dataclass(frozen=True, eq=False)
class Grids:
    """Predicted volumes, on the CPU."""

    occupancy: Tensor  # float32 [B, s, s, s] in [0, 1]; axes (x, y, z) of the object frame over the box [-0.5, 0.5]
    threshold: float = 0.5  # cells above it are occupied

    def surfaces(self) -> list[Surface]:
        """The shapes one by one, by marching cubes at the threshold."""
        return [grid_surface(grid, level=self.threshold) for grid in self.occupancy]

    def occupied(self, size: int) -> Tensor:
        """Bool [B, size, size, size]: whether the mean of larger cells is above the threshold."""
        return (
            F.avg_pool3d(self.occupancy[:, None], self.occupancy.shape[-1] // size)[:, 0]
            > self.threshold
        )


class Method(abc.ABC):
    """One method in training or in use.

    A subclass creates networks and optimizers and computes losses; `training.take_step` takes the
    steps.

    Losses depend only on the batch, the step, the parameters and buffers of `networks`, and
    torch's global random state. A run that is resumed from these, `optimizers` and `ema` is
    bit-identical.
    """

    networks: nn.ModuleDict  # networks["encoder"] is self.encoder, and so on
    ema: EMA | None = None  # None if the run keeps no average of the weights
    image_size: int  # side of the stored images that `encode` takes

    def __init__(
        self,
        settings: MethodSettings,
        info: DatasetInfo,
        device: str,
        precision: Literal["bf16", "fp32"],
        schedule: TrainingSchedule = TrainingSchedule(),  # noqa: B008 (it is frozen)
    ) -> None:
        self.settings = settings.for_data(info)
        self.info = info
        self.schedule = schedule
        self.image_size = settings.image_size
        self.device = torch.device(device)
        self.precision = precision
        self.networks = nn.ModuleDict(self.create_networks()).to(device)
        vars(self).update(self.networks)
        if schedule.ema_decay > 0:
            self.ema = EMA(self.networks, schedule.ema_decay)

    @functools.cached_property
    def optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Optimizers by name, made when they are first needed: pictures need none."""
        return self.create_optimizers()

    @abc.abstractmethod
    def create_networks(self) -> dict[str, nn.Module]:
        """The networks by name, for `settings` and `info`.

        Raises ValueError if these contradict each other.
        """

    @abc.abstractmethod
    def create_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Optimizers by name, with full learning rates; the loop applies the schedule."""

    def losses(self, batch: Batch, step: int) -> Losses:
        """The losses of step `step` (from 1), whose weighted sum all optimizers minimise.

        Parameters that no loss of the step depends on do not change.
        """
        raise NotImplementedError(
            f"{type(self).__name__} must define losses, or phases for several in a step"
        )

    def phases(self, batch: Batch, step: int) -> Iterator[tuple[Losses, tuple[str, ...]]]:
        """The phases of a step: the losses of each, and the optimizers that minimise them.

        A step has one phase, `losses` with all optimizers, unless a subclass yields others. The
        optimizers of a phase have stepped when the next one is computed.
        """
        yield self.losses(batch, step), tuple(self.optimizers)

    @abc.abstractmethod
    def encode(self, images: Tensor) -> Tensor:
        """Shape codes float32 [B, C] of stored images uint8 [B, 4, S, S]."""

    @abc.abstractmethod
    def decode(self, codes: Tensor) -> Meshes | Grids:
        """The shapes of codes [B, C], on the CPU."""

    def view_probabilities(self, images: Tensor) -> Tensor | None:
        """Probabilities float32 [B, K] of the cells of `mesh_method.AZIMUTH_BINS` for stored images.

        None if they were not learnt.
        """
        return None

    def start_from_pretrained(self) -> None:  # noqa: B027
        """Load the pretrained weights that the settings name; called at the start of a run."""

    def check_batch(self, batch: Batch) -> None:  # noqa: B027
        """Raise ValueError if the method cannot learn from such batches; called at the start."""

    def ema_weights(self) -> contextlib.AbstractContextManager[None]:
        """Context in which the networks have their EMA weights, if the run keeps an EMA."""
        return contextlib.nullcontext() if self.ema is None else self.ema.in_place()

    @contextlib.contextmanager
    def in_use(self) -> Iterator[None]:
        """Context for evaluation during a training: `ema_weights`, and networks in evaluation
        mode. Do not nest it.
        """
        was_training = self.networks.training
        self.networks.eval()
        try:
            with self.ema_weights():
                yield
        finally:
            self.networks.train(was_training)

    def autocast(self) -> torch.autocast:
        """Context for networks at the method's precision; losses and rendering belong outside."""
        return torch.autocast(
            self.device.type, dtype=torch.bfloat16, enabled=self.precision == "bf16"
        )
