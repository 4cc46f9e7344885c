"""Measure the renderer, its losses and its metrics. Compare only numbers of one run.

  bench.py all: everything below
  bench.py w1: 64 spheres, 64x64 anti-aliased
  bench.py w2: one mesh of 81,920 faces, 512x512
  bench.py w3: one mesh of 1,280 faces, 1024x1024
  bench.py w4: w1 with depth instead of silhouettes
  bench.py colors: w1 in colour, with one thread: white, vertex colours, texture images, lights
  bench.py voxels: voxel IoU of 1000 predictions
  bench.py peers: one thread of ours beside deodr, PyTorch3D, Open3D and Mesa, as a table in Markdown

Prints the median and the fastest of the repeats in milliseconds; repeats alternate between the programs. Freed memory
is kept, as in training (learn3d/device.py). w1 to w4 are measured with deodr as well, if it is installed.
"""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial

import bench_peers as peers
import torch
import tyro
from bench_work import Program, Timing, colored_spheres, deformed_spheres, report

import nmr
from learn3d.device import keep_freed_memory
from learn3d.terminal import unknown_name, without_traceback

COLORS = {
    "white": "white",
    "vertex": "vertex colours",
    "uv": "texture images of 128x128",
    "uv-lights": "texture images of 128x128 and lights",
}


@dataclass(frozen=True)
class Options:
    workload: tyro.conf.Positional[str] = "w1"
    """Name of the workload, from the list above."""
    batch: int = 64
    """Meshes of w1, w4 and colors."""
    threads: int = 2
    """Threads of nmr and torch (colors takes one). deodr has no threads: it gets one process, and as many as these."""
    repeats: int = 15
    """Timed runs of each program."""


def with_threads(threads: int, program: Program) -> Timing:
    torch.set_num_threads(threads)
    return program()


def bench_render(name: str, options: Options) -> None:
    """Time nmr, and deodr if it is installed."""
    if name in ("w1", "w4"):
        work = deformed_spheres(options.batch, 3, 64, outputs=("depth" if name == "w4" else "alpha",))
    else:
        subdivisions, size = {"w2": (6, 512), "w3": (3, 1024)}[name]
        work = deformed_spheres(1, subdivisions, size, anti_aliasing=False)
    run = partial(work.run, work.targets())
    programs = {f"nmr, {n} threads": partial(with_threads, n, run) for n in dict.fromkeys((options.threads, 1))}
    with ExitStack() as stack:
        if peers.has_deodr():
            programs |= peers.deodr_programs(work, work.targets(), options.threads, stack)
        report(f"{name}: {work}, forward + backward", programs, options.repeats)


def bench_colors(options: Options) -> None:
    """Time one thread, without and with gradients of the colours."""
    for kind, about in COLORS.items():
        work = colored_spheres(kind, options.batch)
        learned = [False] if work.values is None else [False, True]
        runs = {learn: partial(work.run, work.targets(), learn) for learn in learned}
        names = {False: "nmr, 1 thread", True: "nmr, 1 thread, gradients of colours"}
        programs = {names[learn]: partial(with_threads, 1, run) for learn, run in runs.items()}
        report(f"colors: {work}, {about}, forward + backward", programs, options.repeats)


def bench_voxels(options: Options) -> None:
    """Time the voxelizer (forward) and the voxelizer with the IoU (total)."""
    spheres = deformed_spheres(1000, 3, 64)
    vertices = spheres.vertices * (31 / 32) + 0.5

    def run() -> Timing:
        start = time.perf_counter()
        voxels = nmr.voxelize(vertices, spheres.faces)
        forward = time.perf_counter()
        nmr.metrics.voxel_iou(voxels, voxels.roll(1, 0))
        return forward - start, time.perf_counter() - start

    programs = {f"nmr, {options.threads} threads": partial(with_threads, options.threads, run)}
    report("voxels: voxel IoU of 1000 meshes of 1280 faces at 32^3", programs, min(options.repeats, 5))


BENCHES = {name: partial(bench_render, name) for name in ("w1", "w2", "w3", "w4")}
BENCHES |= {"colors": bench_colors, "voxels": bench_voxels, "peers": lambda options: peers.print_table(options.repeats)}


@without_traceback()
def main() -> int:
    options = tyro.cli(Options, description=__doc__)
    if options.workload not in ("all", *BENCHES):
        raise ValueError(unknown_name("workload", options.workload, ["all", *BENCHES]))
    keep_freed_memory()
    for name, bench in BENCHES.items():
        if options.workload in ("all", name):
            bench(options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
