"""Memory of the renderer: how the peak resident size of a fresh process grows over a large batch. Linux only."""

from __future__ import annotations

import contextlib
import ctypes
import re
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import torch
from bench_work import Workload, deformed_spheres

STATUS, CLEAR_REFS = Path("/proc/self/status"), Path("/proc/self/clear_refs")
# Bytes per raster pixel of the published renderer's buffers alone: 24, and 36 for depth, and 76 for rgb.
PUBLISHED = {("alpha",): 24, ("alpha", "depth"): 60, ("rgb", "alpha", "depth"): 136}
WORKLOADS = {"W1, 64x64 anti-aliased": (256, 64, True), "512x512": (24, 512, False)}


def resident(name: str) -> int:
    """Bytes: "VmRSS" now, "VmHWM" at the peak."""
    return 1024 * int(re.search(rf"{name}:\s+(\d+) kB", STATUS.read_text())[1])


def run(workload: Workload) -> None:
    """Forward and backward by a gradient that is given, of both signs."""
    leaf = workload.vertices.clone().requires_grad_()
    images = workload.images(leaf)
    torch.autograd.backward(images, [0.5 - image.detach() for image in images])


def peak_growth(batch: int, size: int, anti_aliasing: bool, outputs: tuple[str, ...], threads: int) -> tuple[int, int]:
    """Bytes that the peak grows: for a first small batch (scratch of each thread and more), and over the large one."""
    torch.set_num_threads(threads)
    large = deformed_spheres(batch, 3, size, anti_aliasing, outputs)
    some = slice(0, threads)
    small = replace(large, vertices=large.vertices[some], camera=replace(large.camera, eye=large.camera.eye[some]))
    run(replace(small, size=8))  # loads everything
    growth = []
    for workload in (small, large):
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)
        with contextlib.suppress(OSError):
            CLEAR_REFS.write_text("5")  # the peak is the present size
        before = resident("VmRSS")
        run(workload)
        growth.append(resident("VmHWM") - before)
    return growth[0], growth[1]


def bench_memory(threads: tuple[int, ...]) -> None:
    """Print bytes per image and per raster pixel of forward + backward beside those of the published renderer."""
    if not STATUS.exists():
        raise SystemExit("memory is measured by /proc/self/status, which only Linux has")
    print("Growth of the peak resident size, forward + backward from world-space vertices, each in a fresh process")
    print("outputs".ljust(18) + "workload".ljust(24) + "B".rjust(5) + "threads".rjust(9), end="")
    print("".join(name.rjust(17) for name in ("bytes / image", "/ raster pixel", "published", "first call MB")))
    for outputs, published in PUBLISHED.items():
        for title, (batch, size, anti_aliasing) in WORKLOADS.items():
            for count in threads:
                with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                    first, more = pool.submit(peak_growth, batch, size, anti_aliasing, outputs, count).result()
                image, pixels = more / batch, (size * (1 + anti_aliasing)) ** 2
                print(f"{'+'.join(outputs):<18}{title:<24}{batch:>5}{count:>9}{image:>17,.0f}", end="")
                print(f"{image / pixels:>17.1f}{published:>17}{first / 1e6:>17.1f}", flush=True)
