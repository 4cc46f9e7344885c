"""Measure the renderer, its losses and its metrics. Compare only numbers of one run.

  w1: 64 spheres, 64x64 anti-aliased
  w2: one mesh of 81,920 faces, 512x512
  w3: one mesh of 1,280 faces, 1024x1024
  w4: w1 with depth instead of silhouettes
  white, vertex, uv, uv-lights: w1 in colour: white, vertex colours, texture images of 128x128, lights
  voxels: voxel IoU of 1000 predictions

Prints the median and the fastest of the repeats in milliseconds; repeats alternate between the programs. Freed memory
is kept, as in training (learn3d/device.py). w1 to w4 are measured with deodr as well, if it is installed.
"""

from __future__ import annotations

import importlib.util
import math
import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from statistics import median
from typing import Literal

import numpy as np
import torch
import tyro
from torch import Tensor

import nmr
from learn3d.device import keep_freed_memory

#: Options of `spheres` for each workload.
WORKLOADS = {
    "w1": {"subdivisions": 3, "size": 64},
    "w2": {"batch": 1, "subdivisions": 6, "size": 512, "anti_aliasing": False},
    "w3": {"batch": 1, "subdivisions": 3, "size": 1024, "anti_aliasing": False},
    "w4": {"subdivisions": 3, "size": 64, "output": "depth"},
}
COLORS = ("white", "vertex", "uv", "uv-lights")
WORKLOADS |= {
    kind: {"subdivisions": 3, "size": 64, "output": "rgb", "colors": kind} for kind in COLORS
}
TEXELS = 128  # along each side of a texture image
FAR = 100.0  # depth of the background, the default of nmr.render
Timing = tuple[float, float]  # seconds: forward pass, total
Program = Callable[[], Timing]


@dataclass(frozen=True)
class Options:
    workload: tyro.conf.Positional[Literal[("all", *WORKLOADS, "voxels")]] = "w1"
    """Name of the workload, from the list above."""
    batch: int = 64
    """Meshes, but for w2, w3 and voxels."""
    threads: int = 2
    """Threads of nmr and torch. deodr has no threads: it gets one process, and as many as these."""
    repeats: int = 15
    """Timed runs of each program."""


@dataclass(frozen=True)
class Work:
    """Meshes [B, V, 3] in world space with a camera each, and the images to be drawn of them."""

    vertices: Tensor
    faces: Tensor
    camera: nmr.LookAt
    size: int
    output: str = "alpha"  # output of nmr.render
    anti_aliasing: bool = True
    colors: str = "white"
    values: Tensor | None = None  # colours of vertices [B, V, 3] or texture images [B, 128, 128, 3]
    uv: Tensor | None = None  # [V, 2] of texture images
    target: Tensor | None = None  # images that the loss compares with

    def __str__(self) -> str:
        size = f"{self.size}x{self.size}" + " anti-aliased" * self.anti_aliasing
        count = len(self.vertices)
        return f"{self.output}, {count} mesh{'es' * (count > 1)} of {len(self.faces)} faces, {size}"

    def draw(self, vertices: Tensor, values: Tensor | None = None) -> Tensor:
        """The images that nmr draws of these vertices, in these colours."""
        options, values = {}, self.values if values is None else values
        if self.colors == "vertex":
            options["colors"] = nmr.VertexColors(values)
        elif self.colors != "white":
            options["colors"] = nmr.UVTexture(values, self.uv)
            options["lights"] = nmr.Lights() if self.colors == "uv-lights" else None
        options |= {
            "outputs": (self.output,),
            "image_size": self.size,
            "anti_aliasing": self.anti_aliasing,
        }
        return getattr(nmr.render(vertices, self.faces, self.camera, **options), self.output)

    def go_back(self, images: Tensor) -> None:
        """Backward pass of 1 - soft IoU of silhouettes, or of the mean squared difference of other images."""
        if self.output == "alpha":
            nmr.losses.soft_iou_loss(images, self.target).backward()
        else:
            (images - self.target).square().mean().backward()

    def part(self, which: slice) -> Work:
        """The workload with these meshes of the batch alone."""
        camera = nmr.LookAt(self.camera.eye[which], half_fov_deg=self.camera.half_fov_deg)
        return replace(
            self, vertices=self.vertices[which], camera=camera, target=self.target[which]
        )


def spheres(
    batch: int, subdivisions: int, size: int, colors: str = "white", **more: object
) -> Work:
    """Icospheres scaled by 0.2 .. 0.6 along each axis, with noise, seen from random azimuths.

    The targets are images of the next mesh of the batch, or of an ellipsoid in a batch of one.
    """
    g = torch.Generator().manual_seed(0)
    sphere, faces = nmr.icosphere(subdivisions)
    scale = 0.4 + 0.8 * torch.rand(batch, 1, 3, generator=g)
    noise = (
        0.03 * torch.randn(batch, len(sphere), 3, generator=g) * min(1.0, 2.0 ** (3 - subdivisions))
    )
    azimuth = 360 * torch.rand(batch, generator=g, dtype=torch.float64)
    camera = nmr.LookAt.from_angles(2.732, 30.0, azimuth, half_fov_deg=15.0)
    vertices, values = 0.5 * (sphere * scale + noise), None
    if colors != "white":
        shape = (len(sphere),) if colors == "vertex" else (TEXELS, TEXELS)
        values = torch.rand(batch, *shape, 3, generator=torch.Generator().manual_seed(1))
    others = vertices.roll(1, 0) if batch > 1 else vertices * torch.tensor([1.1, 0.7, 0.9])
    uv = sphere_uv(sphere)
    work = Work(vertices, faces, camera, size, colors=colors, values=values, uv=uv, **more)
    return replace(work, target=work.draw(others))


def sphere_uv(vertices: Tensor) -> Tensor:
    """Longitude and latitude [V, 2], both in [0, 1], of points on the unit sphere [V, 3]."""
    longitude = torch.atan2(vertices[:, 0], vertices[:, 2]) / (2 * math.pi) + 0.5
    return torch.stack([longitude, torch.asin(vertices[:, 1].clamp(-1, 1)) / math.pi + 0.5], dim=1)


def time_passes(
    threads: int,
    draw: Callable[..., Tensor],
    then: Callable[[Tensor], object],
    *leaves: Tensor,
    gradients: bool = True,
) -> Timing:
    """Time drawing, and drawing with what comes `then`: the backward pass if the leaves have `gradients`."""
    torch.set_num_threads(threads)
    leaves = [leaf.clone().requires_grad_(gradients) for leaf in leaves]
    start = time.perf_counter()
    images = draw(*leaves)
    forward = time.perf_counter()
    then(images)
    return forward - start, time.perf_counter() - start


def bench_render(name: str, options: Options) -> None:
    """Time nmr, without and with gradients of the colours, and deodr if it is installed."""
    work = spheres(**{"batch": options.batch} | WORKLOADS[name])
    counts = dict.fromkeys((options.threads, 1))
    programs = {
        f"nmr, {n} threads": partial(time_passes, n, work.draw, work.go_back, work.vertices)
        for n in counts
    }
    if work.values is not None:
        programs |= {
            f"{name}, gradients of colours": partial(run, work.values)
            for name, run in programs.items()
        }
    with ExitStack() as stack:
        if work.output != "rgb" and importlib.util.find_spec("deodr"):
            programs |= deodr_programs(work, options.threads, stack)
        report(f"{name}: {work}, forward + backward", programs, options.repeats)


def deodr_programs(work: Work, processes: int, stack: ExitStack) -> dict[str, Program]:
    """deodr in one process, and in several that share the batch if it is large enough. `stack` ends the processes."""
    check_same("deodr", work.draw(work.vertices), deodr(work)(work.vertices))
    programs: dict[str, Program] = {"deodr, 1 process": partial(run_deodr, work)}
    if 1 < processes <= len(work.vertices):
        pool = stack.enter_context(ProcessPoolExecutor(processes, get_context("spawn")))
        parts = [work.part(slice(which, None, processes)) for which in range(processes)]

        def run_parts() -> Timing:  # the slowest process counts
            return tuple(map(max, zip(*pool.map(run_deodr, parts), strict=True)))

        programs[f"deodr, {processes} processes"] = run_parts
    return programs


def check_same(name: str, ours: Tensor, theirs: Tensor) -> None:
    """Stop if the images differ, as the comparison would mean nothing. Edges may: the median over the object counts."""
    background = FAR if ours.max() > 1 else 0.0
    difference = (ours - theirs)[(ours != background) | (theirs != background)].abs().median()
    if not difference < 5e-3:  # pyrender's depth is that of a sample beside the centre
        raise SystemExit(
            f"nmr and {name} draw different images (median difference {float(difference):.1e})"
        )


def run_deodr(work: Work) -> Timing:
    return time_passes(1, deodr(work), work.go_back, work.vertices)


def deodr(work: Work) -> Callable[[Tensor], Tensor]:
    """A function that draws vertices with deodr: one mesh at a time, on one thread, without anti-aliasing."""
    from deodr.triangulated_mesh import TriMeshAdjacencies

    # nmr's world is left-handed
    mesh = TriMeshAdjacencies(work.faces.numpy().astype(np.uint32), clockwise=True)
    return lambda vertices: DeodrImages.apply(
        work.camera.transform(vertices), work.size, mesh, work.output
    )


class DeodrImages(torch.autograd.Function):
    """Images [B, S, S] of vertices in renderer space by deodr: silhouettes, or depths as colours of the vertices."""

    @staticmethod
    def forward(ctx, vertices: Tensor, size: int, mesh, output: str) -> Tensor:
        from deodr.differentiable_renderer import Scene2D

        points, ctx.size, ctx.output, ctx.scenes, images = (
            vertices.detach().double().numpy(),
            size,
            output,
            [],
            [],
        )
        num_vertices, num_faces = points.shape[1], mesh.faces.shape[0]
        for xyz in points:
            ij = np.stack(
                [(xyz[:, 0] + 1) * size / 2 - 0.5, (1 - xyz[:, 1]) * size / 2 - 0.5], axis=1
            )
            scene = Scene2D(
                faces=mesh.faces,
                faces_uv=mesh.faces,
                ij=ij,
                depths=xyz[:, 2].copy(),
                textured=np.zeros(num_faces, dtype=bool),
                uv=np.zeros((num_vertices, 2)),
                shade=np.zeros(num_vertices),
                colors=np.ones((num_vertices, 1)) if output == "alpha" else xyz[:, 2:].copy(),
                shaded=np.zeros(num_faces, dtype=bool),
                edgeflags=mesh.edge_on_silhouette(ij),
                height=size,
                width=size,
                nb_colors=1,
                texture=np.zeros((0, 0, 1)),
                background_color=np.zeros(1) if output == "alpha" else np.full(1, FAR),
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
            result[b, :, :2] = scene.ij_b * (ctx.size / 2, -ctx.size / 2)
            if ctx.output == "depth":
                result[b, :, 2] = scene.colors_b[:, 0]
        return torch.from_numpy(result).to(grad), None, None, None


def bench_voxels(options: Options) -> None:
    """Time the voxelizer (forward) and the voxelizer with the IoU (total)."""
    work = spheres(1000, 3, 64)
    vertices = work.vertices * (31 / 32) + 0.5

    def compare(voxels: Tensor) -> None:
        nmr.metrics.voxel_iou(voxels, voxels.roll(1, 0))

    draw = partial(nmr.voxelize, faces=work.faces)
    run = partial(time_passes, options.threads, draw, compare, vertices, gradients=False)
    title = "voxels: voxel IoU of 1000 meshes of 1280 faces at 32^3"
    report(title, {f"nmr, {options.threads} threads": run}, min(options.repeats, 5))


def time_by_turns(programs: dict[str, Program], repeats: int) -> list[list[Timing]]:
    """The times of each program. Repeats alternate between the programs.

    Each turn begins with a call that is not timed, because the caches are full of another program's data.
    """
    times: list[list[Timing]] = [[] for _ in programs]
    for _ in range(repeats):
        for program, timings in zip(programs.values(), times, strict=True):
            program()
            timings.append(program())
    return times


def report(title: str, programs: dict[str, Program], repeats: int) -> None:
    """Print the milliseconds of each program: median of the forward pass, median and minimum of the total.

    The load of the machine is far above 0 if it was busy.
    """
    times = dict(zip(programs, time_by_turns(programs, repeats), strict=True))
    load = os.getloadavg()[0]
    print(
        f"\n{title}\n{repeats} repeats, torch {torch.__version__}, {platform.machine()}, load {load:.1f}"
    )
    print(
        f"{'program':<40}"
        + "".join(f"{name:>12}" for name in ("forward", "total", "fastest", "x first"))
    )
    first = None
    for name, timings in times.items():
        forward, total = (
            [1e3 * second for second in column] for column in zip(*timings, strict=True)
        )
        first = first or median(total)
        numbers = (median(forward), median(total), min(total), median(total) / first)
        print(f"{name:<40}" + "".join(f"{number:>12.2f}" for number in numbers), flush=True)


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    keep_freed_memory()
    for name in WORKLOADS:
        if options.workload in ("all", name):
            bench_render(name, options)
    if options.workload in ("all", "voxels"):
        bench_voxels(options)


if __name__ == "__main__":
    main()
