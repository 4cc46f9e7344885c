"""A whole training step, and the part of it that is not the networks'."""

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
from learn3d.device import resolve_precision
from learn3d.methods import DatasetInfo, Method, create_method


def proposed(batch: int | None, num_objects: int = 48) -> tuple[TrainConfig, ViewDataset]:
    """The paper's method, and silhouettes of deformed spheres as images in Kato's views to train it on."""
    spheres = deformed_spheres(num_objects, 3, 64)
    vertices = spheres.vertices.repeat_interleave(conventions.NUM_VIEWS, 0)
    cameras = conventions.view_poses(torch.arange(conventions.NUM_VIEWS).repeat(num_objects)).cameras()
    masks = (255 * nmr.render_silhouette(vertices, spheres.faces, cameras, image_size=64)).round().to(torch.uint8)
    images = masks.view(num_objects, conventions.NUM_VIEWS, 1, 64, 64).expand(-1, -1, 4, -1, -1).contiguous().numpy()
    voxels = nmr.voxelize(spheres.vertices + 0.5, spheres.faces).numpy()
    config = TrainConfig(data="-", category="spheres", output="-", batch_size=batch)
    return config, kato.from_arrays(images, voxels, "spheres", "train")


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
        return vertices.mean((1, 2)).sigmoid()[:, None, None].expand(-1, MASK_SIZE, MASK_SIZE)

    method.render, method.surface_losses = render, lambda vertices: {}


def bench_step(batch: int | None, threads: int, repeats: int) -> Result:
    """Steps in bf16 and in fp32, in turns with those of networks whose shapes are not rendered.

    The first row is the precision that training would choose here. The rest of a step is a small difference of two
    large times, so it is taken pair by pair: the median of the differences. Distrust it if two calls disagree.
    """
    config, dataset = proposed(batch)
    best = resolve_precision("auto", "cpu")
    rows = []
    for precision in (best, "fp32" if best == "bf16" else "bf16"):
        method, bare = (build(config, dataset, precision) for _ in range(2))
        stop_rendering(bare)
        pairs = [
            (run_step(config, dataset, method, step)[0], run_step(config, dataset, bare, step)[1])
            for step in range(1, repeats + 3)
        ][2:]
        step, rest = 1e3 * median(a for a, _ in pairs), 1e3 * median(a - b for a, b in pairs)
        share = 100 * rest / (step - rest)
        rows.append(Row(f"nmr, {rest:.1f} ms of a step of {step:.1f} ms, {precision}", None, share, share))
    about = settings(threads, repeats, batch=config.batch_size)
    title = f"Training step of {config.preset}, B = {config.batch_size}: the part that is not a network"
    return Result("step", title, rows, about, unit="% of the networks")
