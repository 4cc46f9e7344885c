"""A whole training step by part, measured inside the step itself, and what validation costs beside it."""

from __future__ import annotations

import io
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from contextlib import ExitStack, redirect_stderr
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Literal
from unittest import mock

import numpy as np
import torch
from bench_work import Result, Row, deformed_spheres, settings
from torch import Tensor

import nmr
from learn3d import evaluation
from learn3d.config import DEFAULT_PRESET, TrainConfig
from learn3d.data import conventions
from learn3d.data.augment import augment
from learn3d.data.dataset import ViewDataset
from learn3d.data.layouts import load_dataset
from learn3d.data.readers import kato
from learn3d.data.sampling import sample_indices
from learn3d.data.view_bins import AngleBins
from learn3d.device import keep_freed_memory, resolve_precision
from learn3d.methods import DataShape, Method, create_method
from learn3d.runs import checkpoint
from learn3d.runs.log import RunLog

LOG_EVERY = 50  # TrainConfig's default
VALIDATED_IMAGES = 700 * 24  # a tenth of ShapeNet's larger categories in Kato's layout
NETWORKS = "networks"  # parts whose name begins so
REST = "rest: Python, autograd, finite check"
WAYS = ("forward", "backward")

Precision = Literal["bf16", "fp32"]
Parts = dict[tuple[str, str], float]  # seconds by (part, "forward" or "backward")


@dataclass(frozen=True)
class StepOptions:
    """What is trained: a preset on synthetic silhouettes, or a checkpoint on its own data."""

    preset: str = DEFAULT_PRESET
    batch: int | None = None  # None: the preset's
    checkpoint: Path | None = None
    threads: int = 2
    repeats: int = 15
    clock: Literal["wall", "cpu"] = "wall"  # cpu: of all threads of this process, for busy machines, with one thread


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
    """Seconds of named parts, forward and backward, summed since the last reset. A part within another counts once.

    Autograd goes back in the opposite order of the calls, and one part is one stretch of them: its backward pass is the
    time between the gates at its end and at its start.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.seconds: dict[tuple[str, str], float] = defaultdict(float)
        self.clock = clock
        self._started = 0.0
        self._inner = [0.0]  # seconds of parts within the one that runs, innermost last

    def timed(self, part: str, function: Callable, *, gates: bool = True) -> Callable:
        """``function``, timed; both ways if the first argument and the result have a gradient."""

        def end_backward() -> None:
            self.seconds[part, "backward"] += self.clock() - self._started

        def start_backward() -> None:
            self._started = self.clock()

        def call(*args, **kwargs):
            start = self.clock()
            self._inner.append(0.0)
            if gates and args and isinstance(args[0], Tensor) and args[0].requires_grad:
                args = (_Gate.apply(args[0], end_backward), *args[1:])
            result = function(*args, **kwargs)
            if gates and isinstance(result, Tensor) and result.requires_grad:
                result = _Gate.apply(result, start_backward)
            seconds = self.clock() - start
            self.seconds[part, "forward"] += seconds - self._inner.pop()
            self._inner[-1] += seconds
            return result

        return call

    def watch(self, stack: ExitStack, owner: object, name: str, part: str, *, gates: bool = True) -> None:
        """Until the stack closes, ``owner.name`` is timed as ``part``."""
        stack.enter_context(mock.patch.object(owner, name, self.timed(part, getattr(owner, name), gates=gates)))

    def watch_method(self, stack: ExitStack, method: Method) -> None:
        """Until the stack closes, the parts of ``method.train_step`` are timed."""

        def render(vertices: Tensor, faces: Tensor, camera: nmr.cameras.Camera, **options) -> Tensor:
            return draw(transform(camera, vertices), faces, **options)

        draw = self.timed("rendering", nmr.render_silhouette)
        transform = lambda camera, vertices: self.timed("camera", camera.transform)(vertices)  # noqa: E731
        stack.enter_context(mock.patch.object(nmr, "render_silhouette", render))
        module, base = (sys.modules[kind.__module__] for kind in (type(method), Method))
        for owner, name, part in (
            (nmr.losses, "soft_iou_loss", "projection loss"),
            (module, "silhouette_pyramid_loss", "projection loss"),
            (nmr.losses, "smoothness_loss", "smoothness"),
            (nmr.losses, "inflation_loss", "inflation"),
            (module, "network_input", "images to floats"),
            (base, "network_input", "images to floats"),
            (module, "gaussian_prior_loss", "losses on codes and logits"),
            (module, "pose_classification_loss", "losses on codes and logits"),
            (module, "domain_confusion_loss", "losses on codes and logits"),
            (module, "project", "projection of volumes"),
        ):
            if hasattr(owner, name):
                self.watch(stack, owner, name, part)
        # The networks' own backward pass is what the parts above leave of it.
        self.watch(stack, torch.autograd, "backward", f"{NETWORKS}: backward", gates=False)
        for name, network in method.networks.items():
            self.watch(stack, network, "forward", f"{NETWORKS}: {name}", gates=False)
        for name, optimizer in method.optimizers.items():
            kind = type(optimizer).__name__
            self.watch(stack, optimizer, "step", f"{NETWORKS}: {kind} of {name}", gates=False)


class _Terminal(io.StringIO):
    """Somewhere for the progress bar to be drawn."""

    def isatty(self) -> bool:
        return True


def sphere_dataset(num_objects: int = 48, image_size: int = 64, num_classes: int = 1) -> ViewDataset:
    """Silhouettes of deformed spheres as images, in Kato's views."""
    spheres = deformed_spheres(num_objects, 3, 64, True)
    vertices = spheres.vertices.repeat_interleave(conventions.NUM_VIEWS, 0)
    cameras = conventions.view_cameras(torch.arange(conventions.NUM_VIEWS).repeat(num_objects))
    masks = (255 * nmr.render_silhouette(vertices, spheres.faces, cameras, image_size=64)).round().to(torch.uint8)
    images = masks.view(num_objects, conventions.NUM_VIEWS, 1, 64, 64).expand(-1, -1, 4, -1, -1).contiguous().numpy()
    voxels = nmr.voxelize(spheres.vertices + 0.5, spheres.faces).numpy()
    dataset = kato.from_arrays(images, voxels, "spheres", "train")
    if image_size != 64:
        larger = torch.nn.functional.interpolate(torch.from_numpy(dataset.images), size=image_size)
        dataset = replace(dataset, images=larger.numpy(), masks=np.ascontiguousarray(dataset.images[:, 3]))
    if num_classes > 1:
        names = tuple(f"class {n}" for n in range(num_classes))
        dataset = replace(dataset, class_ids=np.arange(num_objects) % num_classes, class_names=names)
    return dataset


def prepare(options: StepOptions) -> tuple[TrainConfig, ViewDataset, dict[str, Tensor] | None]:
    """The run to be measured, its data, and the weights of its checkpoint, if it has one."""
    if options.checkpoint is not None:
        tensors, metadata = checkpoint.load(checkpoint.find(options.checkpoint, "best"))
        config = metadata.config
        size = {"image_size": config.settings.image_size, "view_bins": config.view_bins}
        where = (config.layout, config.data, config.category, "train")
        dataset = load_dataset(*where, views_per_object=config.views_per_object, **size)
    else:
        tensors, config = None, TrainConfig(data="-", category="spheres", output="-", preset=options.preset)
        conditional = getattr(config.settings, "class_conditional", False)
        size = config.settings.image_size
        dataset = sphere_dataset(48 if size == 64 else 8, size, 2 if conditional else 1)
        if config.view_bins is not None:
            dataset = dataset.with_bins(AngleBins.parse(config.view_bins))
        possible = tuple(name for name in config.augment if name != "crop")  # crops need photographs
        config = replace(config, augment=possible)
    return replace(config, batch_size=options.batch or config.batch_size), dataset, tensors


def build(config: TrainConfig, dataset: ViewDataset, tensors: dict[str, Tensor] | None, precision: Precision) -> Method:
    shape = DataShape(dataset.num_views, dataset.num_classes, dataset.pose_features)
    method = create_method(config.settings, shape, device="cpu", precision=precision, seed=0)
    if tensors is not None:
        checkpoint.restore_networks(method, tensors, Path("the checkpoint"))
    return method


def run_step(
    watch: Stopwatch, config: TrainConfig, dataset: ViewDataset, method: Method, log: RunLog, step: int
) -> Parts:
    """One step as in learn3d/training.py; the seconds of its parts, and of all of it as ("step", "forward")."""
    watch.seconds.clear()
    start = watch.clock()
    sample, gather = watch.timed("data: samples", sample_indices), watch.timed("data: batch", dataset.batch)
    indices = sample(dataset, config.sampling, config.batch_size, config.seed, step)
    batch = gather(indices, voxels=False)
    batch = watch.timed("data: augmentation", augment)(batch, config.augment, config.seed, step)
    losses = method.train_step(batch, step)
    watch.timed("logging", log.step)(step, losses)
    whole = watch.clock() - start
    # Every so many steps the losses are written down: a share of that for each.
    start = watch.clock()
    log.metrics(step, "train", losses)
    written = (watch.clock() - start) / LOG_EVERY
    watch.seconds["logging", "forward"] += written
    parts = dict(watch.seconds)
    below = sum(seconds for (part, way), seconds in parts.items() if way == "backward")
    parts[f"{NETWORKS}: backward", "backward"] = parts.pop((f"{NETWORKS}: backward", "forward"), 0.0) - below
    parts[REST, "forward"] = whole + written - sum(parts.values())
    return {**parts, ("step", "forward"): whole + written}


def measure_steps(
    options: StepOptions, precisions: Iterable[Precision]
) -> tuple[TrainConfig, dict[str, list[Parts]], dict[str, Method]]:
    """Steps at each precision, in turns; the first two of each are not counted."""
    keep_freed_memory()
    clock = {"wall": time.perf_counter, "cpu": time.process_time}[options.clock]
    config, dataset, tensors = prepare(options)
    methods = {precision: build(config, dataset, tensors, precision) for precision in precisions}
    steps: dict[str, list[Parts]] = {precision: [] for precision in methods}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        stack.enter_context(redirect_stderr(_Terminal()))
        log = stack.enter_context(RunLog(Path(folder), start=0, total=options.repeats + 2))
        for step in range(1, options.repeats + 3):
            for precision, method in methods.items():
                watch = Stopwatch(clock)
                with ExitStack() as watched:
                    watch.watch_method(watched, method)
                    parts = run_step(watch, config, dataset, method, log, step)
                if step > 2:
                    steps[precision].append(parts)
    return config, steps, methods


def show_parts(title: str, steps: list[Parts]) -> float:
    """Print the medians of the parts; return all that is not a network in percent of the networks."""
    whole = 1e3 * median(step["step", "forward"] for step in steps)
    print(f"\n{title}: {whole:.1f} ms a step\n{'part':<42}{'forward ms':>12}{'backward ms':>12}{'% of step':>12}")
    names = dict.fromkeys(part for step in steps for part, _ in step if part != "step")
    sums = {True: 0.0, False: 0.0}
    for part in sorted(names, key=lambda part: (part.startswith(NETWORKS), part == REST)):
        times = [1e3 * median(step.get((part, way), 0.0) for step in steps) for way in WAYS]
        sums[part.startswith(NETWORKS)] += sum(times)
        print(f"{part:<42}{times[0]:>12.2f}{times[1]:>12.2f}{100 * sum(times) / whole:>12.2f}")
    totals = {"sum of the parts": sum(sums.values()), "all networks": sums[True], "all else": sums[False]}
    for name, value in totals.items():
        print(f"{name:<42}{value:>24.2f}{100 * value / whole:>12.2f}")
    ratio = 100 * sums[False] / sums[True]
    print(f"all else, in % of the networks: {ratio:.2f}", flush=True)
    return ratio


def bench_step(options: StepOptions) -> Result:
    """Steps in bf16 and in fp32, in turns; the first row is the precision that training would choose here."""
    best = resolve_precision("auto", "cpu")
    config, steps, _ = measure_steps(options, ["bf16", "fp32"] if best == "bf16" else ["fp32", "bf16"])
    what = str(options.checkpoint or config.preset)
    about = settings(options.threads, options.repeats, batch=config.batch_size, clock=options.clock)
    print(f"\nTraining step of {what}\n{', '.join(f'{k} {v}' for k, v in about.items())}")
    rows = []
    for precision, measured in steps.items():
        ratio = show_parts(precision, measured)
        whole = median(1e3 * parts["step", "forward"] for parts in measured)
        rows.append(Row(f"nmr, all but the networks in a step of {whole:.0f} ms, {precision}", None, ratio, ratio))
    title = f"Training step of {what}, B = {config.batch_size}: what is not a network"
    return Result("step", title, rows, about, unit="% of the networks")


def bench_evaluation(options: StepOptions) -> Result:
    """What validating costs, in percent of the training between two validations; per image, by part."""
    config, steps, methods = measure_steps(options, [resolve_precision("auto", "cpu")])
    (precision, measured), method = next(iter(steps.items())), next(iter(methods.values()))
    _, dataset, _ = prepare(options)
    watch = Stopwatch({"wall": time.perf_counter, "cpu": time.process_time}[options.clock])
    runs = []
    for _ in range(max(2, options.repeats // 5) + 1):  # the first one is not counted
        watch.seconds.clear()
        with ExitStack() as stack:
            for owner, name, part in (
                (method, "encode", "encoder"),
                (method, "decode", "generator"),
                (evaluation, "occupancy", "voxels"),
                (nmr.metrics, "voxel_iou", "IoU"),
                (evaluation, "mean_mmd", "MMD"),
            ):
                watch.watch(stack, owner, name, part, gates=False)
            start = watch.clock()
            evaluation.evaluate(method, dataset)
        whole = watch.clock() - start
        runs.append({**{part: s for (part, _), s in watch.seconds.items()}, "all": whole})
    about = settings(options.threads, options.repeats, batch=config.batch_size, clock=options.clock)
    print(f"\nValidation of {options.checkpoint or config.preset}, {precision}: microseconds per image")
    for part in runs[-1]:
        print(f"{part:<42}{1e6 * median(run[part] for run in runs[1:]) / len(dataset):>12.1f}")
    step = median(parts["step", "forward"] for parts in measured)
    validation = VALIDATED_IMAGES * median(run["all"] for run in runs[1:]) / len(dataset)
    share = 100 * validation / (config.validate_every * step + validation)
    print(
        f"{validation:.1f} s for {VALIDATED_IMAGES} images every {config.validate_every} steps of {1e3 * step:.0f} ms: "
        f"{share:.2f} % of the run",
        flush=True,
    )
    name = f"nmr, {VALIDATED_IMAGES} images every {config.validate_every} steps, {precision}"
    rows = [Row(name, None, share, share)]
    return Result("evaluation", "Validation during training", rows, about, unit="% of the run")
