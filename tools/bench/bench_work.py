"""Workloads, our renderer on them, the stopwatch and the report of tools/bench/bench.py."""

from __future__ import annotations

import math
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

TEXELS = 128  # along each side of a texture image


@dataclass(frozen=True)
class Workload:
    """Meshes ``[B, V, 3]`` in world space and a camera each; images of ``size``, anti-aliased or not."""

    vertices: Tensor
    faces: Tensor
    camera: nmr.LookAt
    size: int
    anti_aliasing: bool = True
    outputs: tuple[str, ...] = ("alpha",)  # of nmr.render; the loss is the sum over them
    values: Tensor | None = None  # colours [B, V, 3] of vertices, or texture images [B, 128, 128, 3]; None: white
    lights: bool = False

    def images(self, vertices: Tensor, values: Tensor | None = None) -> tuple[Tensor, ...]:
        """Our images of ``vertices`` with the colours ``values``, in the order of ``outputs``."""
        options = {"image_size": self.size, "anti_aliasing": self.anti_aliasing}
        if self.outputs == ("alpha",):
            return (nmr.render_silhouette(vertices, self.faces, self.camera, **options),)
        if self.outputs == ("depth",):
            return (nmr.render_depth(vertices, self.faces, self.camera, **options),)
        values = self.values if values is None else values
        colors = values if values is None or values.ndim == 4 else nmr.VertexColors(values)
        if values is not None and values.ndim == 4:
            colors = nmr.UVTexture(values, sphere_uv(nmr.icosphere(3)[0]))
        options |= {"colors": colors, "lights": nmr.Lights() if self.lights else None}
        if self.outputs == ("rgb",):
            return (nmr.render_rgb(vertices, self.faces, self.camera, **options),)
        return tuple(nmr.render(vertices, self.faces, self.camera, outputs=self.outputs, **options))

    def targets(self) -> tuple[Tensor, ...]:
        """Images of the neighbour in the batch (of an ellipsoid if there is none)."""
        alone = len(self.vertices) == 1
        with torch.no_grad():
            return self.images(self.vertices * torch.tensor([1.1, 0.7, 0.9]) if alone else self.vertices.roll(1, 0))

    def loss(self, images: tuple[Tensor, ...], targets: tuple[Tensor, ...]) -> Tensor:
        """1 - soft IoU of silhouettes, mean squared difference of anything else."""
        return sum(
            nmr.losses.soft_iou_loss(image, target) if name == "alpha" else (image - target).square().mean()
            for name, image, target in zip(self.outputs, images, targets, strict=True)
        )

    def part(self, some: slice) -> Workload:
        """Some meshes of the batch."""
        camera = nmr.LookAt(self.camera.eye[some], half_fov_deg=self.camera.half_fov_deg)
        return replace(self, vertices=self.vertices[some], camera=camera)

    def run(self, targets: tuple[Tensor, ...], learn_values: bool = False) -> Timing:
        """From vertices in world space to their gradients and, if they are learned, those of the colours."""
        leaf = self.vertices.clone().requires_grad_()
        values = self.values.clone().requires_grad_() if learn_values else self.values
        start = time.perf_counter()
        images = self.images(leaf, values)
        forward = time.perf_counter()
        self.loss(images, targets).backward()
        return forward - start, time.perf_counter() - start


def deformed_spheres(batch: int, subdivisions: int, size: int, **more: object) -> Workload:
    """Icospheres, axes scaled by 0.4..1.2, noise 0.03, times 0.5; distance 2.732, elevation 30, half fov 15."""
    g = torch.Generator().manual_seed(0)
    sphere, faces = nmr.icosphere(subdivisions)
    scale = 0.4 + 0.8 * torch.rand(batch, 1, 3, generator=g)
    noise = 0.03 * torch.randn(batch, len(sphere), 3, generator=g) * min(1.0, 2.0 ** (3 - subdivisions))
    azimuth = 360 * torch.rand(batch, generator=g, dtype=torch.float64)
    camera = nmr.LookAt.from_angles(2.732, 30.0, azimuth, half_fov_deg=15.0)
    return Workload(0.5 * (sphere * scale + noise), faces, camera, size, **more)


def colored_spheres(kind: str, batch: int, size: int = 64) -> Workload:
    """Spheres with colours of a kind, for each mesh its own: white, vertex, uv or uv-lights."""
    spheres = deformed_spheres(batch, 3, size, outputs=("rgb",), lights=kind == "uv-lights")
    shape = (spheres.vertices.shape[1],) if kind == "vertex" else (TEXELS, TEXELS)
    values = torch.rand(batch, *shape, 3, generator=torch.Generator().manual_seed(1))
    return replace(spheres, values=None if kind == "white" else values)


def sphere_uv(vertices: Tensor) -> Tensor:
    """Longitude and latitude ``[V, 2]`` of points on the unit sphere ``[V, 3]``, both in [0, 1]."""
    longitude = torch.atan2(vertices[:, 0], vertices[:, 2]) / (2 * math.pi) + 0.5
    return torch.stack([longitude, torch.asin(vertices[:, 1].clamp(-1, 1)) / math.pi + 0.5], dim=1)


Timing = tuple[float, float]  # seconds forward, and in all
Program = Callable[[], Timing]


@dataclass(frozen=True)
class Row:
    """One program on one workload; medians but for ``fastest``. The name of ours begins with nmr."""

    program: str
    forward: float | None
    total: float
    fastest: float


@dataclass(frozen=True)
class Result:
    """One workload; the first row is ours, and the target applies to it."""

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
    rows = []
    for name, seconds in times.items():
        forward, total = ([1e3 * second for second in column] for column in zip(*seconds, strict=True))
        rows.append(Row(name, median(forward), median(total), min(total)))
    return rows


def settings(threads: int, repeats: int, **more: int | float | str) -> dict[str, int | float | str]:
    """What a figure depends on besides the program. A load far above 0 at the start means that the machine was busy."""
    cpuinfo = Path("/proc/cpuinfo")
    name = re.search(r"model name\s*: (.+)", cpuinfo.read_text()) if cpuinfo.exists() else None
    about = {"threads": threads, **more, "repeats": repeats, "torch": torch.__version__}
    return about | {
        "machine": name[1] if name else platform.machine(),
        "cores": num_cores(),
        "load": round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else "unknown",
    }


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
