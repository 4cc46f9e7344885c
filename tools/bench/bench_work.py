"""The workloads of tools/bench/bench.py, and the measurement of their times."""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median

import torch
from torch import Tensor

import nmr

TEXELS = 128  # along each side of a texture image


@dataclass(frozen=True)
class Workload:
    """Meshes [B, V, 3] in world space with a camera each, and the images to be drawn of them."""

    vertices: Tensor
    faces: Tensor
    camera: nmr.LookAt
    size: int
    anti_aliasing: bool = True
    outputs: tuple[str, ...] = ("alpha",)  # outputs of nmr.render; the loss is the sum over them
    values: Tensor | None = None  # colours of vertices [B, V, 3] or texture images [B, 128, 128, 3]; None: white
    lights: bool = False

    def __str__(self) -> str:
        size = f"{self.size}x{self.size}" + " anti-aliased" * self.anti_aliasing
        return f"{', '.join(self.outputs)}, {len(self.vertices)} meshes of {len(self.faces)} faces, {size}"

    @property
    def faces_and_size(self) -> str:
        return f"{len(self.faces):,} faces, {self.size} px"

    def images(self, vertices: Tensor, values: Tensor | None = None) -> tuple[Tensor, ...]:
        """The images that nmr draws of these vertices in these colours, in the order of `outputs`."""
        options = {"image_size": self.size, "anti_aliasing": self.anti_aliasing}
        if "rgb" in self.outputs:
            values = self.values if values is None else values
            if values is not None and values.ndim == 3:
                options["colors"] = nmr.VertexColors(values)
            elif values is not None:
                options["colors"] = nmr.UVTexture(values, sphere_uv(nmr.icosphere(3)[0]))
            options["lights"] = nmr.Lights() if self.lights else None
        images = nmr.render(vertices, self.faces, self.camera, outputs=self.outputs, **options)
        return tuple(getattr(images, name) for name in self.outputs)

    def targets(self) -> tuple[Tensor, ...]:
        """Images of the next mesh of the batch, or of an ellipsoid in a batch of one."""
        other = self.vertices.roll(1, 0) if len(self.vertices) > 1 else self.vertices * torch.tensor([1.1, 0.7, 0.9])
        with torch.no_grad():
            return self.images(other)

    def loss(self, images: tuple[Tensor, ...], targets: tuple[Tensor, ...]) -> Tensor:
        """1 - soft IoU of silhouettes, and the mean squared difference of other images."""
        return sum(
            nmr.losses.soft_iou_loss(image, target) if name == "alpha" else (image - target).square().mean()
            for name, image, target in zip(self.outputs, images, targets, strict=True)
        )

    def part(self, which: slice) -> Workload:
        """The workload with these meshes of the batch alone."""
        camera = nmr.LookAt(self.camera.eye[which], half_fov_deg=self.camera.half_fov_deg)
        return replace(self, vertices=self.vertices[which], camera=camera)

    def run(self, targets: tuple[Tensor, ...], learn_values: bool = False) -> Timing:
        """Time forward and backward pass: gradients of the vertices and, with `learn_values`, of the colours."""
        leaf = self.vertices.clone().requires_grad_()
        values = self.values.clone().requires_grad_() if learn_values else self.values
        start = time.perf_counter()
        images = self.images(leaf, values)
        forward = time.perf_counter()
        self.loss(images, targets).backward()
        return forward - start, time.perf_counter() - start


def deformed_spheres(batch: int, subdivisions: int, size: int, **more: object) -> Workload:
    """Icospheres scaled by 0.2 .. 0.6 along each axis, with noise, seen from random azimuths."""
    g = torch.Generator().manual_seed(0)
    sphere, faces = nmr.icosphere(subdivisions)
    scale = 0.4 + 0.8 * torch.rand(batch, 1, 3, generator=g)
    noise = 0.03 * torch.randn(batch, len(sphere), 3, generator=g) * min(1.0, 2.0 ** (3 - subdivisions))
    azimuth = 360 * torch.rand(batch, generator=g, dtype=torch.float64)
    camera = nmr.LookAt.from_angles(2.732, 30.0, azimuth, half_fov_deg=15.0)
    return Workload(0.5 * (sphere * scale + noise), faces, camera, size, **more)


def colored_spheres(kind: str, batch: int, size: int = 64) -> Workload:
    """Spheres of 1,280 faces, each with its own colours. kind: white, vertex, uv or uv-lights."""
    spheres = deformed_spheres(batch, 3, size, outputs=("rgb",), lights=kind == "uv-lights")
    shape = (spheres.vertices.shape[1],) if kind == "vertex" else (TEXELS, TEXELS)
    values = torch.rand(batch, *shape, 3, generator=torch.Generator().manual_seed(1))
    return replace(spheres, values=None if kind == "white" else values)


def sphere_uv(vertices: Tensor) -> Tensor:
    """Longitude and latitude [V, 2], both in [0, 1], of points on the unit sphere [V, 3]."""
    longitude = torch.atan2(vertices[:, 0], vertices[:, 2]) / (2 * math.pi) + 0.5
    return torch.stack([longitude, torch.asin(vertices[:, 1].clamp(-1, 1)) / math.pi + 0.5], dim=1)


Timing = tuple[float, float]  # seconds: forward pass, total
Program = Callable[[], Timing]


def measure(programs: dict[str, Program], repeats: int) -> dict[str, tuple[float, float, float]]:
    """Milliseconds of each program: median of the forward pass, median and minimum of the total.

    Repeats alternate between the programs. Each turn begins with a call that is not timed, because the caches are full
    of another program's data.
    """
    times: dict[str, list[Timing]] = {name: [] for name in programs}
    for _ in range(repeats):
        for name, program in programs.items():
            program()
            times[name].append(program())
    rows = {}
    for name, seconds in times.items():
        forward, total = ([1e3 * second for second in column] for column in zip(*seconds, strict=True))
        rows[name] = median(forward), median(total), min(total)
    return rows


def report(title: str, programs: dict[str, Program], repeats: int) -> None:
    """Measure one workload and print the times, with the load of the machine: far above 0 means that it was busy."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
    rows = measure(programs, repeats)
    print(f"\n{title}\n{repeats} repeats, torch {torch.__version__}, {platform.machine()}, load {load:.1f}")
    print(f"{'program':<40}" + "".join(f"{name:>12}" for name in ("forward", "total", "fastest", "x first")))
    first = next(iter(rows.values()))[1]
    for name, (forward, total, fastest) in rows.items():
        print(f"{name:<40}{forward:>12.2f}{total:>12.2f}{fastest:>12.2f}{total / first:>12.2f}", flush=True)
