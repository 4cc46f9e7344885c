"""Measure the renderer and the voxeliser, beside other programs in the same run (compare within one run only).

    python tools/bench.py w1            64 spheres, 64x64 anti-aliased; also deodr, and the slow definition
    python tools/bench.py w2            one mesh of 81,920 faces, 512x512
    python tools/bench.py w3            one mesh of 1,280 faces, 1024x1024
    python tools/bench.py voxels        voxel IoU of 1000 predictions
    python tools/bench.py step          a whole training step of the proposed method, batch 128, in bf16 and in fp32

Medians over repeats that alternate between the programs. `pip install deodr` for the comparison.
"""

from __future__ import annotations

import importlib.util
import json
import multiprocessing
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal

import numpy as np
import torch
import tyro
from torch import Tensor

import nmr
from learn3d.config import TrainConfig
from learn3d.data.batch import Batch
from learn3d.memory import keep_freed_memory
from learn3d.methods.pose_invariant import create_optimizers, train_step
from learn3d.networks import create_networks
from nmr import reference


@dataclass(frozen=True)
class Workload:
    """Meshes ``[B, V, 3]`` in world space and a camera each; images of ``size``, anti-aliased or not."""

    vertices: Tensor
    faces: Tensor
    camera: nmr.LookAt
    size: int
    anti_aliasing: bool


def deformed_spheres(batch: int, subdivisions: int, size: int, anti_aliasing: bool) -> Workload:
    """Icospheres, axes scaled by 0.4..1.2, noise 0.03, times 0.5; distance 2.732, elevation 30, half fov 15."""
    g = torch.Generator().manual_seed(0)
    sphere, faces = nmr.icosphere(subdivisions)
    scale = 0.4 + 0.8 * torch.rand(batch, 1, 3, generator=g)
    noise = 0.03 * torch.randn(batch, len(sphere), 3, generator=g) * min(1.0, 2.0 ** (3 - subdivisions))
    azimuth = 360 * torch.rand(batch, generator=g, dtype=torch.float64)
    camera = nmr.LookAt.from_angles(2.732, 30.0, azimuth, half_fov_deg=15.0)
    return Workload(0.5 * (sphere * scale + noise), faces, camera, size, anti_aliasing)


def half(workload: Workload, which: int) -> Workload:
    """One half of the batch, for one of two processes."""
    part = slice(which, None, 2)
    camera = nmr.LookAt(workload.camera.eye[part], half_fov_deg=workload.camera.half_fov_deg)
    return Workload(workload.vertices[part], workload.faces, camera, workload.size, workload.anti_aliasing)


def target_images(workload: Workload) -> Tensor:
    """Silhouettes of the neighbour in the batch (of an ellipsoid if there is none)."""
    vertices = workload.vertices
    vertices = vertices.roll(1, 0) if len(vertices) > 1 else vertices * torch.tensor([1.1, 0.7, 0.9])
    return nmr.render_silhouette(
        vertices, workload.faces, workload.camera, image_size=workload.size, anti_aliasing=workload.anti_aliasing
    )


# --- the programs: each takes a workload and its targets, and returns (seconds forward, seconds in all)


def run_ours(workload: Workload, target: Tensor) -> tuple[float, float]:
    leaf = workload.vertices.clone().requires_grad_()
    start = time.perf_counter()
    alpha = nmr.render_silhouette(
        leaf, workload.faces, workload.camera, image_size=workload.size, anti_aliasing=workload.anti_aliasing
    )
    forward = time.perf_counter()
    nmr.losses.soft_iou_loss(alpha, target).backward()
    return forward - start, time.perf_counter() - start


def run_definition(workload: Workload, target: Tensor) -> tuple[float, float]:
    """The slow pure-torch definition on the first image, times the batch."""
    vertices = workload.camera.transform(workload.vertices)[0]
    size, aa = workload.size, workload.anti_aliasing
    start = time.perf_counter()
    index = reference.face_index(vertices, workload.faces, size * (1 + aa))
    alpha = reference.silhouette(index, aa).requires_grad_()
    forward = time.perf_counter()
    nmr.losses.soft_iou_loss(alpha[None], target[:1]).backward()
    reference.silhouette_gradient(vertices, workload.faces, index, alpha.grad, aa)
    total = time.perf_counter() - start
    batch = len(workload.vertices)
    return batch * (forward - start), batch * total


class DeodrSilhouette(torch.autograd.Function):
    """deodr's 2.5-D renderer, mesh by mesh: vertices in renderer space to images ``[B, S, S]``."""

    @staticmethod
    def forward(ctx, vertices: Tensor, size: int, mesh) -> Tensor:
        from deodr.differentiable_renderer import Scene2D

        points, ctx.size, ctx.scenes, images = vertices.detach().double().numpy(), size, [], []
        num_vertices, num_faces = points.shape[1], mesh.faces.shape[0]
        zeros, no_faces = np.zeros((num_vertices, 2)), np.zeros(num_faces, dtype=bool)
        for xyz in points:
            ij = np.stack([(xyz[:, 0] + 1) * size / 2 - 0.5, (1 - xyz[:, 1]) * size / 2 - 0.5], axis=1)
            scene = Scene2D(
                faces=mesh.faces,
                faces_uv=mesh.faces,
                ij=ij,
                depths=xyz[:, 2].copy(),
                textured=no_faces,
                uv=zeros,
                shade=np.zeros(num_vertices),
                colors=np.ones((num_vertices, 1)),
                shaded=no_faces,
                edgeflags=mesh.edge_on_silhouette(ij),
                height=size,
                width=size,
                nb_colors=1,
                texture=np.zeros((0, 0, 1)),
                background_color=np.zeros(1),
                clockwise=mesh.clockwise,
                backface_culling=True,
            )
            images.append(scene.render()[0][..., 0])
            ctx.scenes.append(scene)
        return torch.from_numpy(np.stack(images)).to(vertices)

    @staticmethod
    def backward(ctx, grad: Tensor):
        result = np.zeros((len(ctx.scenes), ctx.scenes[0].ij.shape[0], 3))
        for b, scene in enumerate(ctx.scenes):
            scene.clear_gradients()
            scene.render_backward(grad[b].double().numpy()[..., None].copy())
            result[b, :, 0] = scene.ij_b[:, 0] * ctx.size / 2
            result[b, :, 1] = -scene.ij_b[:, 1] * ctx.size / 2
        return torch.from_numpy(result).to(grad), None, None


def deodr_mesh(faces: Tensor):
    from deodr.triangulated_mesh import TriMeshAdjacencies

    return TriMeshAdjacencies(faces.numpy().astype(np.uint32), clockwise=False)


def run_deodr(workload: Workload, target: Tensor, mesh) -> tuple[float, float]:
    leaf = workload.vertices.clone().requires_grad_()
    inner = workload.size * (1 + workload.anti_aliasing)
    start = time.perf_counter()
    image = DeodrSilhouette.apply(workload.camera.transform(leaf), inner, mesh)
    if workload.anti_aliasing:
        image = torch.nn.functional.avg_pool2d(image[:, None], 2)[:, 0]
    forward = time.perf_counter()
    nmr.losses.soft_iou_loss(image, target).backward()
    return forward - start, time.perf_counter() - start


def deodr_process(connection, workload: Workload, target: Tensor) -> None:
    """Serves one half of the batch: renders whenever it is asked to."""
    torch.set_num_threads(1)
    mesh = deodr_mesh(workload.faces)
    while connection.recv():
        connection.send(run_deodr(workload, target, mesh))


class DeodrTwoProcesses:
    """deodr with the batch shared between two processes; the slower one counts."""

    def __init__(self, workload: Workload, target: Tensor) -> None:
        context = multiprocessing.get_context("spawn")
        self.connections, self.processes = [], []
        for which in (0, 1):
            ours, theirs = context.Pipe()
            arguments = (theirs, half(workload, which), target[which::2])
            self.processes.append(context.Process(target=deodr_process, args=arguments, daemon=True))
            self.processes[-1].start()
            self.connections.append(ours)

    def __call__(self) -> tuple[float, float]:
        for connection in self.connections:
            connection.send(True)
        results = [connection.recv() for connection in self.connections]
        return max(r[0] for r in results), max(r[1] for r in results)

    def close(self) -> None:
        for connection, process in zip(self.connections, self.processes, strict=True):
            connection.send(False)
            process.join()


# --- running and reporting


def measure(programs: dict[str, Callable[[], tuple[float, float]]], repeats: int) -> list[dict]:
    """Median forward and total milliseconds of each program; the repeats alternate between them."""
    for program in programs.values():
        program()
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in programs}
    for _ in range(repeats):
        for name, program in programs.items():
            times[name].append(program())
    return [
        {
            "program": name,
            "forward_ms": 1e3 * median(t[0] for t in seconds),
            "total_ms": 1e3 * median(t[1] for t in seconds),
            "fastest_ms": 1e3 * min(t[1] for t in seconds),
        }
        for name, seconds in times.items()
    ]


def report(title: str, rows: list[dict], settings: dict, json_path: Path | None) -> None:
    print(f"{title}\n" + ", ".join(f"{k} {v}" for k, v in settings.items()))
    ours = rows[0]["total_ms"]
    print(f"{'program':<44}{'forward ms':>12}{'total ms':>12}{'fastest ms':>12}{'x ours':>10}")
    for row in rows:
        print(
            f"{row['program']:<44}{row['forward_ms']:>12.2f}{row['total_ms']:>12.2f}{row['fastest_ms']:>12.2f}"
            f"{row['total_ms'] / ours:>10.2f}"
        )
    if json_path:
        temporary = json_path.with_name(f".{json_path.name}.{os.getpid()}")
        temporary.write_text(json.dumps({"title": title, "settings": settings, "rows": rows}, indent=2) + "\n")
        temporary.replace(json_path)


@dataclass(frozen=True)
class Options:
    workload: tyro.conf.Positional[Literal["w1", "w2", "w3", "voxels", "step"]] = "w1"
    """What to measure."""
    batch: int = 64
    """Meshes of w1."""
    threads: int = 2
    """Threads of ours (deodr has none: it gets one process, and two)."""
    repeats: int = 15
    """Timed runs of each program."""
    definition: bool = True
    """w1: also time the slow definition (nmr/reference.py) on one image, once, scaled to the batch."""
    json: Path | None = None
    """Also write the figures here."""


def bench_render(options: Options) -> None:
    title, workload = {
        "w1": lambda: (
            f"W1: {options.batch} meshes, 1280 faces, 64x64 anti-aliased",
            deformed_spheres(options.batch, 3, 64, True),
        ),
        "w2": lambda: ("W2: one mesh, 81,920 faces, 512x512", deformed_spheres(1, 6, 512, False)),
        "w3": lambda: ("W3: one mesh, 1280 faces, 1024x1024", deformed_spheres(1, 3, 1024, False)),
    }[options.workload]()
    target = target_images(workload)
    programs = {f"nmr, {options.threads} threads": lambda: run_ours(workload, target)}
    two = None
    if importlib.util.find_spec("deodr"):
        mesh = deodr_mesh(workload.faces)
        plain = Workload(workload.vertices, workload.faces, workload.camera, workload.size, False)
        programs["deodr, 1 process"] = lambda: run_deodr(plain, target, mesh)
        if workload.anti_aliasing:
            two = DeodrTwoProcesses(plain, target)
            programs["deodr, 2 processes"] = two
            programs["deodr, 1 process, our inner resolution"] = lambda: run_deodr(workload, target, mesh)
        overlap = check_same_image(workload, mesh)
        print(f"images of nmr and deodr agree to a soft IoU of {overlap:.4f}")
    else:
        print("deodr is not installed (pip install deodr): no comparison with it")
    rows = measure(programs, options.repeats)
    if two:
        two.close()
    if options.workload == "w1" and options.definition:
        forward, total = run_definition(workload, target)
        rows.append(
            {
                "program": "slow definition (1 image x batch)",
                "forward_ms": 1e3 * forward,
                "total_ms": 1e3 * total,
                "fastest_ms": 1e3 * total,
            }
        )
    settings = {
        "threads": options.threads,
        "repeats": options.repeats,
        "torch": torch.__version__,
        "machine": platform.machine(),
    }
    report(title + ", forward + backward of 1 - soft IoU", rows, settings, options.json)


def check_same_image(workload: Workload, mesh) -> float:
    """Both programs must draw the same thing, or the comparison means nothing."""
    with torch.no_grad():
        vertices = workload.camera.transform(workload.vertices)
        theirs = DeodrSilhouette.apply(vertices, workload.size, mesh)
        ours = nmr.render_silhouette(vertices, workload.faces, image_size=workload.size)
        overlap = 1 - float(nmr.losses.soft_iou_loss(ours, theirs))
    if overlap < 0.9:
        raise SystemExit(f"nmr and deodr draw different images (soft IoU {overlap:.3f}): the comparison is invalid")
    return overlap


def bench_voxels(options: Options) -> None:
    spheres = deformed_spheres(1000, 3, 64, True)
    vertices = spheres.vertices * (31 / 32) + 0.5

    def run() -> tuple[float, float]:
        start = time.perf_counter()
        voxels = nmr.voxelize(vertices, spheres.faces)
        forward = time.perf_counter()
        (voxels & voxels.roll(1, 0)).sum((1, 2, 3)) / (voxels | voxels.roll(1, 0)).sum((1, 2, 3))
        return forward - start, time.perf_counter() - start

    rows = measure({f"nmr.voxelize, {options.threads} threads": run}, min(options.repeats, 5))
    report("Voxel IoU of 1000 meshes of 1280 faces at 32^3", rows, {"threads": options.threads}, options.json)


def bench_step(options: Options) -> None:
    """Images are the silhouettes of deformed spheres: the cost of a step hardly depends on what is in them."""
    keep_freed_memory()
    spheres = deformed_spheres(128, 3, 64, True)
    masks = target_images(spheres)
    images = (255 * masks).round().to(torch.uint8)[:, None].expand(-1, 4, -1, -1).contiguous()
    views = torch.arange(128) % 24
    batch = Batch(images, masks, spheres.camera, view_ids=views, object_ids=views, voxels=None)
    settings = TrainConfig(data=Path(), category="spheres", output=Path()).loss_settings()
    programs = {}
    for precision in ("bf16", "fp32"):
        networks = create_networks(24, discriminator=True, device="cpu", seed=0)
        programs[precision] = (networks, create_optimizers(networks, 1e-4))
    seconds: dict[str, list[float]] = {precision: [] for precision in programs}
    for iteration in range(1, options.repeats + 3):
        for precision, (networks, optimizers) in programs.items():
            start = time.perf_counter()
            train_step(networks, optimizers, batch, iteration, settings, precision)
            seconds[precision].append(time.perf_counter() - start)
    print(f"training step, batch 128, {options.threads} threads, median of {options.repeats}")
    for precision, times in seconds.items():
        print(f"{precision}  {1e3 * median(times[2:]):.0f} ms")


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(options.threads)
    if options.workload == "voxels":
        bench_voxels(options)
    elif options.workload == "step":
        bench_step(options)
    else:
        bench_render(options)


if __name__ == "__main__":
    main()
