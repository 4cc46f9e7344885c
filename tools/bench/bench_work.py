"""What tools/bench/bench.py measures with: workloads, our renderer on them, the stopwatch and the report."""

from __future__ import annotations

import os
import platform
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median

import torch
from torch import Tensor

import nmr


@dataclass(frozen=True)
class Workload:
    """Meshes ``[B, V, 3]`` in world space and a camera each; images of ``size``, anti-aliased or not."""

    vertices: Tensor
    faces: Tensor
    camera: nmr.LookAt
    size: int
    anti_aliasing: bool
    outputs: tuple[str, ...] = ("alpha",)  # of nmr.render; the loss is the sum over them

    def images(self, vertices: Tensor) -> tuple[Tensor, ...]:
        """Our images of ``vertices``, in the order of ``outputs``."""
        options = {"image_size": self.size, "anti_aliasing": self.anti_aliasing}
        if self.outputs == ("alpha",):
            return (nmr.render_silhouette(vertices, self.faces, self.camera, **options),)
        if self.outputs == ("depth",):
            return (nmr.render_depth(vertices, self.faces, self.camera, **options),)
        colors = nmr.VertexColors(self.vertices.detach()) if "rgb" in self.outputs else None
        return tuple(nmr.render(vertices, self.faces, self.camera, outputs=self.outputs, colors=colors, **options))

    def targets(self) -> tuple[Tensor, ...]:
        """Images of the neighbour in the batch (of an ellipsoid if there is none)."""
        alone = len(self.vertices) == 1
        vertices = self.vertices * torch.tensor([1.1, 0.7, 0.9]) if alone else self.vertices.roll(1, 0)
        with torch.no_grad():
            return self.images(vertices)

    def loss(self, images: tuple[Tensor, ...], targets: tuple[Tensor, ...]) -> Tensor:
        """1 - soft IoU of silhouettes, mean squared difference of anything else."""
        return sum(
            nmr.losses.soft_iou_loss(image, target) if name == "alpha" else (image - target).square().mean()
            for name, image, target in zip(self.outputs, images, targets, strict=True)
        )

    def part(self, which: int, of: int) -> Workload:
        """Every of-th mesh of the batch, from number ``which`` on."""
        some = slice(which, None, of)
        camera = nmr.LookAt(self.camera.eye[some], half_fov_deg=self.camera.half_fov_deg)
        return replace(self, vertices=self.vertices[some], camera=camera)


def deformed_spheres(
    batch: int, subdivisions: int, size: int, anti_aliasing: bool, outputs: tuple[str, ...] = ("alpha",)
) -> Workload:
    """Icospheres, axes scaled by 0.4..1.2, noise 0.03, times 0.5; distance 2.732, elevation 30, half fov 15."""
    g = torch.Generator().manual_seed(0)
    sphere, faces = nmr.icosphere(subdivisions)
    scale = 0.4 + 0.8 * torch.rand(batch, 1, 3, generator=g)
    noise = 0.03 * torch.randn(batch, len(sphere), 3, generator=g) * min(1.0, 2.0 ** (3 - subdivisions))
    azimuth = 360 * torch.rand(batch, generator=g, dtype=torch.float64)
    camera = nmr.LookAt.from_angles(2.732, 30.0, azimuth, half_fov_deg=15.0)
    return Workload(0.5 * (sphere * scale + noise), faces, camera, size, anti_aliasing, outputs)


Timing = tuple[float, float]  # seconds forward, and in all
Program = Callable[[], Timing]


def run_ours(workload: Workload, targets: tuple[Tensor, ...]) -> Timing:
    """From vertices in world space to their gradients."""
    leaf = workload.vertices.clone().requires_grad_()
    start = time.perf_counter()
    images = workload.images(leaf)
    forward = time.perf_counter()
    workload.loss(images, targets).backward()
    return forward - start, time.perf_counter() - start


def run_chain(function: Callable[[Tensor], Tensor], vertices: Tensor, grad: Tensor | None = None) -> Timing:
    """Any differentiable function of vertices, and its gradient."""
    leaf = vertices.clone().requires_grad_()
    start = time.perf_counter()
    result = function(leaf)
    forward = time.perf_counter()
    result.backward(grad)
    return forward - start, time.perf_counter() - start


@dataclass(frozen=True)
class Row:
    """One program on one workload; medians but for ``fastest``."""

    program: str
    forward: float | None
    total: float
    fastest: float

    @property
    def ours(self) -> bool:
        return self.program.startswith("nmr")


@dataclass(frozen=True)
class Result:
    """One workload; the first row is ours, and what a target applies to."""

    key: str  # in bench.TARGETS, if it has a target
    title: str
    rows: list[Row]
    settings: dict[str, int | float | str] = field(default_factory=dict)
    unit: str = "ms"


def measure(programs: dict[str, Program], repeats: int) -> list[Row]:
    """Median and fastest milliseconds of each program.

    Repeats alternate between them; the first call of each turn finds the caches full of another program's data and is
    not timed.
    """
    times: dict[str, list[Timing]] = {name: [] for name in programs}
    for _ in range(repeats):
        for name, program in programs.items():
            program()
            times[name].append(program())
    return [milliseconds(name, seconds) for name, seconds in times.items()]


def milliseconds(program: str, seconds: list[Timing]) -> Row:
    forward, total = ([1e3 * second for second in column] for column in zip(*seconds, strict=True))
    return Row(program, median(forward), median(total), min(total))


def settings(threads: int, repeats: int, **more: int | float | str) -> dict[str, int | float | str]:
    """What a figure depends on besides the program. A load far above 0 at the start means that the machine was busy."""
    about = {"threads": threads, **more, "repeats": repeats, "torch": torch.__version__}
    about |= {"machine": processor(), "cores": num_cores()}
    if hasattr(os, "getloadavg"):
        about["load"] = round(os.getloadavg()[0], 1)
    return about


def processor() -> str:
    """The processor's name, as in ``AMD EPYC 9B45``; the instruction set if the system does not tell."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor() or platform.machine()
    found = dict(re.findall(r"^(model name|cpu family|model)\s*:\s*(.+)$", text, re.MULTILINE))
    if "model name" not in found:
        return platform.machine()
    return f"{found['model name']} (family {found.get('cpu family', '?')}, model {found.get('model', '?')})"


def num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def show(result: Result) -> None:
    """Print one result as text."""
    print(f"\n{result.title}\n" + ", ".join(f"{k} {v}" for k, v in result.settings.items()))
    print(f"{'program':<58}" + "".join(f"{name:>12}" for name in ("forward", "total", "fastest", "x ours")))
    for row in result.rows:
        forward = f"{row.forward:>12.2f}" if row.forward is not None else f"{'':>12}"
        ratio = row.total / result.rows[0].total
        print(f"{row.program:<58}{forward}{row.total:>12.2f}{row.fastest:>12.2f}{ratio:>12.2f}")
    print(f"({result.unit}; medians, and the fastest total)", flush=True)
