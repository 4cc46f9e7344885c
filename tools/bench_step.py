"""A training step of the proposed method by part, measured inside the step itself."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from statistics import median
from typing import Literal
from unittest import mock

import numpy as np
import torch
from bench_work import Result, Row, deformed_spheres, settings
from torch import Tensor

import nmr
from learn3d.data import kato
from learn3d.data.sampling import shuffled_epochs
from learn3d.data.views import ViewDataset
from learn3d.memory import keep_freed_memory
from learn3d.methods import DataShape, Method, create_method, pose_invariant
from learn3d.networks import resolve_precision
from learn3d.presets import PRESETS

BATCH = 128
NETWORKS = "networks and optimizers (what is left)"


class _Gate(torch.autograd.Function):
    """The identity, which tells when the gradient comes by."""

    @staticmethod
    def forward(ctx, x: Tensor, passed: Callable[[], None]) -> Tensor:
        ctx.passed = passed
        return x.view_as(x)

    @staticmethod
    def backward(ctx, grad: Tensor):
        ctx.passed()
        return grad, None


class Stopwatch:
    """Seconds of named parts, forward and backward, summed since the last reset.

    Autograd goes back in the opposite order of the calls, and one part is one stretch of them: its backward pass is the
    time between the gates at its end and at its start.
    """

    def __init__(self) -> None:
        self.seconds: dict[tuple[str, str], float] = defaultdict(float)
        self._started = 0.0

    def timed(self, part: str, function: Callable) -> Callable:
        """``function``, timed; both ways if the first argument and the result have a gradient."""

        def end_backward() -> None:
            self.seconds[part, "backward"] += time.perf_counter() - self._started

        def start_backward() -> None:
            self._started = time.perf_counter()

        def call(*args, **kwargs):
            start = time.perf_counter()
            if args and isinstance(args[0], Tensor) and args[0].requires_grad:
                args = (_Gate.apply(args[0], end_backward), *args[1:])
            result = function(*args, **kwargs)
            if isinstance(result, Tensor) and result.requires_grad:
                result = _Gate.apply(result, start_backward)
            self.seconds[part, "forward"] += time.perf_counter() - start
            return result

        return call

    def watch_step(self, stack: ExitStack) -> None:
        """Until the stack closes, the parts of ``PoseInvariant.train_step`` are timed."""

        def render(vertices: Tensor, faces: Tensor, camera: nmr.Camera, **options) -> Tensor:
            return draw(transform(camera, vertices), faces, **options)

        draw = self.timed("render", nmr.render_silhouette)
        transform = lambda camera, vertices: self.timed("camera", camera.transform)(vertices)  # noqa: E731
        stack.enter_context(mock.patch.object(nmr, "render_silhouette", render))
        for owner, name, part in (
            (nmr.losses, "soft_iou_loss", "soft IoU"),
            (nmr.losses, "smoothness_loss", "smoothness"),
            (pose_invariant, "network_input", "images to floats"),
            (pose_invariant, "gaussian_prior_loss", "losses on codes and logits"),
            (pose_invariant, "pose_classification_loss", "losses on codes and logits"),
            (pose_invariant, "domain_confusion_loss", "losses on codes and logits"),
        ):
            stack.enter_context(mock.patch.object(owner, name, self.timed(part, getattr(owner, name))))


def sphere_dataset(num_objects: int = 48) -> ViewDataset:
    """Silhouettes of deformed spheres as images: the cost of a step hardly depends on what is in them."""
    spheres = deformed_spheres(num_objects, 3, 64, True)
    vertices = spheres.vertices.repeat_interleave(kato.NUM_VIEWS, 0)
    cameras = kato.view_cameras(torch.arange(kato.NUM_VIEWS).repeat(num_objects))
    masks = (255 * nmr.render_silhouette(vertices, spheres.faces, cameras, image_size=64)).round().to(torch.uint8)
    images = masks.view(num_objects, kato.NUM_VIEWS, 1, 64, 64).expand(-1, -1, 4, -1, -1).contiguous().numpy()
    return kato.from_arrays(images, np.zeros((num_objects, 32, 32, 32), dtype=bool), "spheres", "train")


WAYS = ("forward", "backward")
Parts = dict[tuple[str, str], float]  # seconds by (part, "forward" or "backward"), and of ("step", "forward")


def run_step(watch: Stopwatch, dataset: ViewDataset, method: Method, iteration: int) -> Parts:
    watch.seconds.clear()
    start = time.perf_counter()
    batch = watch.timed("data", lambda: dataset.batch(shuffled_epochs(len(dataset), BATCH, 0, iteration)))()
    method.train_step(batch, iteration)
    return {("step", "forward"): time.perf_counter() - start, **watch.seconds}


def show(precision: str, steps: list[Parts]) -> float:
    """Print the parts of the median step; return the share in percent of what is not a network."""
    whole = 1e3 * median(step["step", "forward"] for step in steps)
    print(f"\n{precision}: {whole:.1f} ms a step\n{'part':<42}{'forward ms':>12}{'backward ms':>12}{'% of step':>12}")
    rest = 0.0
    for part in dict.fromkeys(part for step in steps for part, _ in step if part != "step"):
        forward, backward = (1e3 * median(step.get((part, way), 0.0) for step in steps) for way in WAYS)
        rest += forward + backward
        print(f"{part:<42}{forward:>12.2f}{backward:>12.2f}{100 * (forward + backward) / whole:>12.2f}")
    for name, value in (("all of these", rest), (NETWORKS, whole - rest)):
        print(f"{name:<42}{value:>24.2f}{100 * value / whole:>12.2f}")
    return 100 * rest / whole


def bench_step(threads: int, repeats: int) -> Result:
    """Steps in bf16 and in fp32, in turns; the first row is the precision that training would choose here."""
    keep_freed_memory()
    about = settings(threads, repeats, batch=BATCH)
    dataset, watch = sphere_dataset(), Stopwatch()
    best = resolve_precision("auto", "cpu")
    precisions: list[Literal["bf16", "fp32"]] = ["bf16", "fp32"] if best == "bf16" else ["fp32", "bf16"]
    proposed, shape = PRESETS["peng2020-kato"].settings, DataShape(kato.NUM_VIEWS)
    programs = {
        precision: create_method(proposed, shape, device="cpu", precision=precision, seed=0) for precision in precisions
    }
    steps: dict[str, list[Parts]] = {precision: [] for precision in programs}
    with ExitStack() as stack:
        watch.watch_step(stack)
        for iteration in range(1, repeats + 3):  # the first two, one of each kind, are not counted
            for precision, method in programs.items():
                parts = run_step(watch, dataset, method, iteration)
                if iteration > 2:
                    steps[precision].append(parts)
    print(f"\nTraining step of the proposed method\n{', '.join(f'{k} {v}' for k, v in about.items())}")
    rows = []
    for precision, measured in steps.items():
        share = show(precision, measured)
        whole = [1e3 * parts["step", "forward"] for parts in measured]
        name = f"nmr, all but the networks in a step of {median(whole):.0f} ms, {precision}"
        rows.append(Row(name, None, share, share))
    return Result("step", f"Training step, B = {BATCH}: what is not a network", rows, about, unit="% of the step")
