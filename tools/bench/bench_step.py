"""A whole training step, what of it is not the networks', and what validation costs beside it."""

from __future__ import annotations

import time
from statistics import median

import torch
from bench_work import Result, Row, deformed_spheres, settings
from torch import Tensor

import nmr
from learn3d.config import TrainConfig
from learn3d.data import conventions
from learn3d.data.augment import augment
from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.data.poses import Poses
from learn3d.data.readers import kato
from learn3d.data.sampling import sample_indices
from learn3d.device import keep_freed_memory, resolve_precision
from learn3d.evaluation import evaluate
from learn3d.methods import DatasetInfo, Method, create_method

VALIDATED_IMAGES = 700 * 24  # a tenth of ShapeNet's larger categories in Kato's layout


def sphere_dataset(num_objects: int = 48) -> ViewDataset:
    """Silhouettes of deformed spheres as images, in Kato's views."""
    spheres = deformed_spheres(num_objects, 3, 64, True)
    vertices = spheres.vertices.repeat_interleave(conventions.NUM_VIEWS, 0)
    cameras = conventions.view_cameras(torch.arange(conventions.NUM_VIEWS).repeat(num_objects))
    masks = (255 * nmr.render_silhouette(vertices, spheres.faces, cameras, image_size=64)).round().to(torch.uint8)
    images = masks.view(num_objects, conventions.NUM_VIEWS, 1, 64, 64).expand(-1, -1, 4, -1, -1).contiguous().numpy()
    voxels = nmr.voxelize(spheres.vertices + 0.5, spheres.faces).numpy()
    return kato.from_arrays(images, voxels, "spheres", "train")


def proposed(batch: int | None) -> tuple[TrainConfig, ViewDataset]:
    """The paper's method, and spheres to train it on."""
    return TrainConfig(data="-", category="spheres", output="-", batch_size=batch), sphere_dataset()


def build(config: TrainConfig, dataset: ViewDataset, precision: str) -> Method:
    return create_method(config.settings, DatasetInfo(dataset.num_views), device="cpu", precision=precision, seed=0)


def run_step(config: TrainConfig, dataset: ViewDataset, method: Method, step: int) -> tuple[float, float]:
    """Seconds of one step as in learn3d/training.py, and of its take_step alone."""
    start = time.perf_counter()
    indices = sample_indices(dataset, config.sampling, config.batch_size, config.seed, step)
    batch = augment(dataset.batch(indices, voxels=False), config.augment, config.seed, step)
    prepared = time.perf_counter()
    method.take_step(batch, step)
    end = time.perf_counter()
    return end - start, end - prepared


def stop_rendering(method: Method) -> None:
    """Let a method train on grey images of which every vertex has a gradient: its networks have the same to do."""

    def render(vertices: Tensor, poses: Poses) -> Tensor:
        grey = vertices.mean((1, 2)).sigmoid()
        return grey[:, None, None].expand(-1, MASK_SIZE, MASK_SIZE)

    method.render, method.surface_losses = render, lambda vertices: {}


def bench_step(batch: int | None, threads: int, repeats: int) -> Result:
    """Steps in bf16 and in fp32, in turns with those of networks whose shapes are not rendered.

    The first row is the precision that training would choose here. What is not a network is a small difference of two
    large times, so it is taken pair by pair: the median of the differences. Distrust it where two calls disagree.
    """
    keep_freed_memory()
    config, dataset = proposed(batch)
    best = resolve_precision("auto", "cpu")
    precisions = (best, "fp32" if best == "bf16" else "bf16")
    methods, bare = ({name: build(config, dataset, name) for name in precisions} for _ in range(2))
    for method in bare.values():
        stop_rendering(method)
    whole, networks = ({name: [] for name in precisions} for _ in range(2))
    for step in range(1, repeats + 3):  # the first two do not count
        for name in precisions:
            whole[name].append(run_step(config, dataset, methods[name], step)[0])
            networks[name].append(run_step(config, dataset, bare[name], step)[1])
    rows = []
    for name in precisions:
        pairs = list(zip(whole[name], networks[name], strict=True))[2:]
        step, rest = 1e3 * median(a for a, _ in pairs), 1e3 * median(a - b for a, b in pairs)
        title = f"nmr, {rest:.1f} ms of a step of {step:.1f} ms, {name}"
        rows.append(Row(title, None, 100 * rest / (step - rest), 100 * rest / (step - rest)))
    about = settings(threads, repeats, batch=config.batch_size)
    title = f"Training step of {config.preset}, B = {config.batch_size}: what is not a network"
    return Result("step", title, rows, about, unit="% of the networks")


def bench_evaluation(batch: int | None, threads: int, repeats: int) -> Result:
    """What validating costs, in percent of a run that trains between two validations."""
    keep_freed_memory()
    config, dataset = proposed(batch)
    method, steps, validations = build(config, dataset, resolve_precision("auto", "cpu")), [], []
    for step in range(1, repeats + 3):
        steps.append(run_step(config, dataset, method, step)[0])
    for _ in range(max(2, repeats // 5) + 1):  # the first one is not counted
        start = time.perf_counter()
        evaluate(method, dataset)
        validations.append(time.perf_counter() - start)
    training = config.validate_every * median(steps[2:])
    validation = VALIDATED_IMAGES * median(validations[1:]) / len(dataset)
    share = 100 * validation / (training + validation)
    name = f"nmr, {validation:.1f} s for {VALIDATED_IMAGES} images every {config.validate_every} steps"
    about = settings(threads, repeats, batch=config.batch_size)
    return Result("evaluation", "Validation during training", [Row(name, None, share, share)], about, "% of the run")
