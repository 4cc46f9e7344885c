"""Colour images with one thread: white, vertex colours, a texture image, a texture image with lights."""

from __future__ import annotations

import math
import time
from functools import partial

import torch
from bench_work import Program, Result, Timing, Workload, deformed_spheres, measure, settings
from torch import Tensor

import nmr

TEXELS = 128  # along each side of a texture image
KINDS = {
    "white": "white",
    "vertex": "vertex colours",
    "uv": f"texture images of {TEXELS}x{TEXELS}",
    "uv-lights": f"texture images of {TEXELS}x{TEXELS} and lights",
}
FIXED, LEARNED = "nmr, 1 thread", "nmr, 1 thread, colours learned, too"


def sphere_uv(vertices: Tensor) -> Tensor:
    """Longitude and latitude ``[V, 2]`` of points on the unit sphere ``[V, 3]``, both in [0, 1]."""
    longitude = torch.atan2(vertices[:, 0], vertices[:, 2]) / (2 * math.pi) + 0.5
    return torch.stack([longitude, torch.asin(vertices[:, 1].clamp(-1, 1)) / math.pi + 0.5], dim=1)


class ColorWorkload:
    """Spheres with colours of one of the ``KINDS``, for each mesh its own."""

    def __init__(self, spheres: Workload, kind: str):
        self.spheres = spheres
        self.kind = kind
        g = torch.Generator().manual_seed(1)
        batch, num_vertices = spheres.vertices.shape[:2]
        shape = (num_vertices,) if kind == "vertex" else (TEXELS, TEXELS)
        self.values = None if kind == "white" else torch.rand(batch, *shape, 3, generator=g)
        self.uv = sphere_uv(nmr.icosphere(3)[0])
        with torch.no_grad():  # images of the neighbour in the batch
            self.target = self.image(spheres.vertices.roll(1, 0), self.values)

    def image(self, vertices: Tensor, values: Tensor | None) -> Tensor:
        """``[B, size, size, 3]``"""
        colors = None
        if values is not None:
            colors = nmr.VertexColors(values) if self.kind == "vertex" else nmr.UVTexture(values, self.uv)
        lights = nmr.Lights() if self.kind == "uv-lights" else None
        spheres = self.spheres
        options = {"colors": colors, "lights": lights, "image_size": spheres.size}
        return nmr.render_rgb(vertices, spheres.faces, spheres.camera, **options)

    def run(self, learned: bool) -> Timing:
        """From vertices in world space to their gradients and, if they are learned, those of the colours."""
        vertices = self.spheres.vertices.clone().requires_grad_()
        values = self.values.clone().requires_grad_() if learned else self.values
        start = time.perf_counter()
        image = self.image(vertices, values)
        forward = time.perf_counter()
        (image - self.target).square().mean().backward()
        return forward - start, time.perf_counter() - start


def bench_colors(batch: int, repeats: int) -> list[Result]:
    """One thread; fixed colours, which targets apply to, and learned ones take turns."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    spheres = deformed_spheres(batch, 3, 64, True, ("rgb",))
    results = []
    for kind, what in KINDS.items():
        workload = ColorWorkload(spheres, kind)
        programs: dict[str, Program] = {FIXED: partial(workload.run, False)}
        if workload.values is not None:
            programs[LEARNED] = partial(workload.run, True)
        title = f"Colours: {batch} meshes, 1280 faces, 64x64 anti-aliased, {what}, forward + backward"
        about = settings(1, repeats, batch=batch)
        results.append(Result(f"colors {kind}", title, measure(programs, repeats), about))
    torch.set_num_threads(threads)
    return results
