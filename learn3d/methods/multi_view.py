"""Vanilla-AE as Kato et al. 2018 published it: two views of an object must be explained by the shape of either."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Literal

import torch
from torch import Tensor

import nmr
from learn3d.data.batch import Batch
from learn3d.data.dataset import MASK_SIZE
from learn3d.device import Download
from learn3d.methods.method import DataShape, Meshes, Method, descend
from learn3d.networks import ENCODERS, GENERATORS, EncoderName, GeneratorName, create_encoder, network_input
from learn3d.settings import Positive, Step, Weight, checked

CENTROID_LEARNING_RATE = 0.1  # of the centroid's layer, relative to all others
DECAY = 0.1  # of the step size, after `decay_at_step`
CHUNK = 1 << 20  # weights that the optimizer handles at once


@checked
class MultiViewSettings:
    """Networks, weight and schedule of Kato et al. 2018; the defaults are the published code's for one category."""

    encoder: EncoderName = "conv-relu"
    """conv-relu: that of Kato et al. conv: without the ReLU on the code."""
    generator: GeneratorName = "bounded"
    """bounded: that of Kato et al. sphere: 642 free vertices."""
    learning_rate: Positive = 1e-4
    """Adam's step size up to `decay_at_step`, a tenth of it afterwards."""
    decay_at_step: Step = 190_000
    """Last step at the full step size (published: 95 % of all iterations)."""
    lambda_smooth: Weight = 0.001
    """Weight of the smoothness loss (published: 0.001 for one category, 0 for all together)."""

    @property
    def image_size(self) -> int:
        """Side of the images that the encoder takes, in pixels."""
        return ENCODERS[self.encoder].image_size


class MultiView(Method):
    """Encoder and mesh generator, trained on pairs of views: batches [a_1 .. a_n, b_1 .. b_n], sampling "pairs"."""

    def __init__(
        self, settings: MultiViewSettings, shape: DataShape, device: str, precision: Literal["bf16", "fp32"]
    ) -> None:
        self.settings, self.image_size = settings, settings.image_size
        self.device, self.precision = torch.device(device), precision
        self.encoder = create_encoder(settings.encoder, inverted=shape.inverted)
        self.generator = GENERATORS[settings.generator]()
        self.networks = {"encoder": self.encoder, "generator": self.generator}
        self.faces, self.edges = self.generator.faces, self.generator.edges  # for the renderer, on the CPU
        for network in self.networks.values():
            network.to(device)
        self.encoder.to(memory_format=torch.channels_last)
        slow = {id(parameter) for n, parameter in self.generator.named_parameters() if n.startswith("centroid.")}
        parameters = list(self.generator.parameters())
        self.optimizers = {
            "encoder": SparseGradientAdam(self.encoder.parameters(), lr=settings.learning_rate),
            "generator": SparseGradientAdam([p for p in parameters if id(p) not in slow], lr=settings.learning_rate),
        }
        if slow:
            self.optimizers["centroid"] = SparseGradientAdam(
                [p for p in parameters if id(p) in slow], lr=CENTROID_LEARNING_RATE * settings.learning_rate
            )

    def encode(self, images: Tensor) -> Tensor:
        with self.autocast():
            return self.encoder(network_input(images, self.device, self.image_size)).float()

    def decode(self, codes: Tensor) -> Meshes:
        with self.autocast():
            return Meshes(self.generator(codes).cpu(), self.faces)

    def train_step(self, batch: Batch, step: int) -> dict[str, float]:
        """Render the shapes of both views, {a, b}, in both views: the mean of four IoU losses, and lambda_s times the
        mean smoothness of the shapes. Raises ValueError where the batch is not made of pairs.
        """
        pairs = check_pairs(batch)
        settings = self.settings
        for name, optimizer in self.optimizers.items():
            optimizer.zero_grad(set_to_none=True)
            rate = settings.learning_rate * (CENTROID_LEARNING_RATE if name == "centroid" else 1.0)
            for group in optimizer.param_groups:
                group["lr"] = rate * (DECAY if step > settings.decay_at_step else 1.0)

        with self.autocast():
            vertices = self.generator(self.encoder(network_input(batch.images, self.device, self.image_size)))

        # Shapes a, b, a, b in the views a, a, b, b. Rendering runs on the CPU.
        vertices = Download(vertices).wait()
        seen = torch.arange(2 * pairs).reshape(2, pairs)[[0, 0, 1, 1]].flatten()
        silhouettes = nmr.render_silhouette(
            torch.cat([vertices, vertices]), self.faces, batch.poses[seen].cameras(), image_size=MASK_SIZE
        )
        losses = {"projection": nmr.losses.soft_iou_loss(silhouettes, batch.masks[seen])}
        if settings.lambda_smooth > 0:
            losses["smoothness"] = nmr.losses.smoothness_loss(vertices, self.edges)
        values = descend(losses, {"smoothness": settings.lambda_smooth}, step, self.ranks)
        for optimizer in self.optimizers.values():
            optimizer.step()
        return values


def check_pairs(batch: Batch) -> int:
    """The number n of pairs in a batch [a_1 .. a_n, b_1 .. b_n], or a ValueError where it is made of something else."""
    half = len(batch) // 2
    if len(batch) % 2 or not torch.equal(batch.object_ids[:half], batch.object_ids[half:]):
        raise ValueError(
            "multi_view learns from pairs of views of one object, [a_1 .. a_n, b_1 .. b_n], but this batch of "
            f"{len(batch)} views is not made of such pairs; choose sampling 'pairs'"
        )
    return half


class SparseGradientAdam(torch.optim.Adam):
    """Adam that leaves alone, moments included, every single weight whose gradient is exactly zero in this step.

    The published code trains with it. It is not the same as Adam: the weights of a ReLU that is off for a whole batch
    have zero gradients in that step, and Adam would carry them on by their momentum and forget their second moment.
    As in Chainer, epsilon is added before the bias correction of the second moment: lr' m / (sqrt(v) + eps), with
    lr' = lr sqrt(1 - beta_2^t) / (1 - beta_1^t), and all weights share the count t. The state is that of torch's Adam.
    """

    def __init__(self, params: Iterable[Tensor], lr: float) -> None:
        super().__init__(params, lr=lr)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        with torch.enable_grad():
            loss = closure() if closure is not None else None
        for group in self.param_groups:
            for parameter in (p for p in group["params"] if p.grad is not None):
                state = self.state[parameter]
                if not state:
                    state["step"] = torch.tensor(0.0)
                    state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
                state["step"] += 1
                self._update(parameter, state, group)
        return loss

    def _update(self, parameter: Tensor, state: dict[str, Tensor], group: dict) -> None:
        """In pieces, and in two pieces of memory: allocating more takes five times as long as computing."""
        (beta1, beta2), count = group["betas"], float(state["step"])
        rate = group["lr"] * math.sqrt(1 - beta2**count) / (1 - beta1**count)
        row = parameter[0].numel()
        rows = max(1, CHUNK // row)
        memory = parameter.new_empty(2, min(rows, len(parameter)) * row)
        tensors = (parameter, parameter.grad, state["exp_avg"], state["exp_avg_sq"])
        for weight, grad, first, second in zip(*(tensor.split(rows) for tensor in tensors), strict=True):
            touched, change = (part[: weight.numel()].view(weight.shape) for part in memory)
            touched.copy_(grad).ne_(0)
            torch.sub(grad, first, out=change)
            first.addcmul_(touched, change, value=1 - beta1)
            torch.mul(grad, grad, out=change).sub_(second)
            second.addcmul_(touched, change, value=1 - beta2)
            torch.sqrt(second, out=change).add_(group["eps"])
            weight.addcdiv_(touched.mul_(first), change, value=-rate)
