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
    large = deformed_spheres(batch, 3, size, anti_aliasing=anti_aliasing, outputs=outputs)
    large = replace(large, values=large.vertices if "rgb" in outputs else None)
    small = large.part(slice(0, threads))
    small = replace(small, values=small.vertices if "rgb" in outputs else None)
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


def bench_memory() -> None:
    """Print bytes per image and per raster pixel of forward + backward beside those of the published renderer."""
    print("Growth of the peak resident size, forward + backward from world-space vertices, each in a fresh process")
    print("| outputs | workload | threads | bytes / image | bytes / raster pixel | published | first call, MB |")
    print("|---|---|---|---|---|---|---|")
    for outputs, published in PUBLISHED.items():
        for title, (batch, size, anti_aliasing) in WORKLOADS.items():
            for threads in (1, 2):
                with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                    first, more = pool.submit(peak_growth, batch, size, anti_aliasing, outputs, threads).result()
                image, pixels = more / batch, (size * (1 + anti_aliasing)) ** 2
                cells = ["+".join(outputs), f"{batch} x {title}", threads, f"{image:,.0f}", f"{image / pixels:.1f}"]
                print(f"| {' | '.join(map(str, [*cells, published, f'{first / 1e6:.1f}']))} |", flush=True)
