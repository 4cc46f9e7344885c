"""A whole training step beside the part of it that is its networks'."""

from __future__ import annotations

import time
from functools import partial

import torch
from bench_work import Program, Timing, deformed_spheres
from torch import Tensor

import nmr
from learn3d.config import TrainConfig
from learn3d.data import conventions
from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.data.poses import Poses
from learn3d.data.readers import kato
from learn3d.data.sampling import batches
from learn3d.device import resolve_precision
from learn3d.methods import DatasetInfo, Method, create_method


def sphere_set(num_objects: int = 48) -> ViewDataset:
    """Silhouettes of deformed spheres as images in Kato's views."""
    spheres = deformed_spheres(num_objects, 3, 64)
    vertices = spheres.vertices.repeat_interleave(conventions.NUM_VIEWS, 0)
    cameras = conventions.view_poses(torch.arange(conventions.NUM_VIEWS).repeat(num_objects)).cameras()
    masks = (255 * nmr.render_silhouette(vertices, spheres.faces, cameras, image_size=64)).round().to(torch.uint8)
    images = masks.view(num_objects, conventions.NUM_VIEWS, 1, 64, 64).expand(-1, -1, 4, -1, -1).contiguous().numpy()
    voxels = nmr.voxelize(spheres.vertices + 0.5, spheres.faces).numpy()
    return kato.from_arrays(images, voxels, "spheres", "train")


def build(config: TrainConfig, dataset: ViewDataset, precision: str) -> Method:
    return create_method(config.settings, DatasetInfo(dataset.num_views), device="cpu", precision=precision, seed=0)


def stop_rendering(method: Method) -> None:
    """Let a method train on grey images that depend on every vertex: its networks have the same to do."""

    def render(vertices: Tensor, poses: Poses) -> Tensor:
        return vertices.mean((1, 2)).sigmoid()[:, None, None].expand(-1, MASK_SIZE, MASK_SIZE)

    method.render, method.surface_losses = render, lambda vertices: {}


def step_programs(batch_size: int) -> dict[str, Program]:
    """Steps in the precision that training would choose here and in the other one, each with and without rendering."""
    dataset = sphere_set()
    config = TrainConfig(data="-", category="spheres", output="-", batch_size=batch_size)
    best = resolve_precision("auto", "cpu")
    programs = {}
    for precision in (best, "fp32" if best == "bf16" else "bf16"):
        for name in ("whole step", "networks alone"):
            method = build(config, dataset, precision)
            if name == "networks alone":
                stop_rendering(method)
            programs[f"{name}, {precision}"] = partial(_run_step, method, enumerate(batches(dataset, config), 1))
    return programs


def _run_step(method: Method, numbered: enumerate) -> Timing:
    """Seconds until the batch is ready, and of the whole step."""
    start = time.perf_counter()
    step, batch = next(numbered)
    prepared = time.perf_counter()
    method.take_step(batch, step)
    return prepared - start, time.perf_counter() - start
