"""Measure the renderer and what belongs to it, beside other programs in the same run (compare within one run only).

  bench.py all: every row of the table, as Markdown; exit code 1 if a target is missed
  bench.py w1: 64 spheres, 64x64 anti-aliased; also deodr
  bench.py w2: one mesh of 81,920 faces, 512x512
  bench.py w3: one mesh of 1,280 faces, 1024x1024
  bench.py w4: w1 with depth instead of silhouettes
  bench.py colors: w1 in colour, with one thread: white, vertex colours, texture images, lights; exit code as for all
  bench.py two-threads: w1 with two threads and with one
  bench.py voxels: voxel IoU of 1000 predictions
  bench.py step: a whole training step in bf16 and in fp32, and what of it is not the networks'
  bench.py memory: bytes per image and per raster pixel, in fresh processes (Linux)

Medians over repeats that alternate between the programs, and the fastest. Freed memory is kept for all of them, as in
training (learn3d/device.py). `pip install deodr` for the comparison.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import bench_peers as peers
import torch
import tyro
from bench_memory import bench_memory
from bench_step import bench_step
from bench_work import Program, Result, Timing, Workload, colored_spheres, deformed_spheres, measure, settings, show

import nmr
from learn3d.device import keep_freed_memory
from learn3d.terminal import unknown_name, without_traceback


class Target(NamedTuple):
    """The most that the first row of a result may have, or, with a ``peer``, how many times as fast it must be."""

    limit: float
    peer: str | None = None  # a program of the same run: such a target depends little on the machine

    def __str__(self) -> str:
        return f">= {self.limit:g} x {self.peer}" if self.peer else f"<= {self.limit:g}"


ONE_THREAD = "one thread of the same"
TARGETS = {
    "w1, 64": Target(5, "deodr, 2 processes"),
    "w1, 128": Target(5, "deodr, 2 processes"),
    "w2": Target(8, "deodr, 1 process"),  # one mesh: deodr cannot share it
    "w3": Target(5, "deodr, 1 process"),
    "w4, 64": Target(6, "deodr, 2 processes"),
    "colors white": Target(25),  # rgb follows from the silhouette
    "colors vertex": Target(28),  # as white, and one interpolation
    "colors uv": Target(40),  # as vertex colours, and four texels a pixel
    "colors uv-lights": Target(50),  # as texture images, and the light of each face
    "two-threads": Target(1.85, ONE_THREAD),  # the meshes of a batch are independent
    "step": Target(8),  # 26 ms beside networks of 334 ms: 20,000 steps in two hours
}
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
    batch: int | None = None
    """Meshes of w1, w4 and colors, by default 64 (all: w1 with 64 and with 128); images of a step, by default 128."""
    threads: int = 2
    """Threads of ours and of torch (colors takes one). deodr has none: it gets one process, and as many as these."""
    repeats: int = 15
    """Timed runs of each program."""

    @property
    def meshes(self) -> int:
        return self.batch or 64


def bench_render(name: str, options: Options, batch: int = 1) -> Result:
    """Ours beside deodr."""
    key, size, output = name, "64x64 anti-aliased", "depth" if name == "w4" else "alpha"
    if name in ("w1", "w4"):
        workload, key = deformed_spheres(batch, 3, 64, outputs=(output,)), f"{name}, {batch}"
    else:
        size = "512x512" if name == "w2" else "1024x1024"
        workload = deformed_spheres(1, 6 if name == "w2" else 3, int(size.split("x")[0]), anti_aliasing=False)
    programs = {f"nmr, {options.threads} threads": _program(workload)}
    with ExitStack() as stack:
        if peers.has_deodr():
            programs |= peers.deodr_programs(workload, workload.targets(), options.threads, stack)
        else:
            print("deodr is not installed (pip install deodr): no comparison with it")
        rows = measure(programs, options.repeats)
    loss = "the mean squared difference" if name == "w4" else "1 - soft IoU"
    title = f"{name.upper()}: {output}, {batch} meshes of {len(workload.faces)} faces, {size}"
    about = settings(options.threads, options.repeats, batch=batch)
    return Result(key, f"{title}, forward + backward of {loss}", rows, about)


def _program(workload: Workload, learn_values: bool = False) -> Program:
    return partial(workload.run, workload.targets(), learn_values)


def bench_colors(options: Options) -> list[Result]:
    """One thread; fixed colours, which targets apply to, and learned ones take turns."""
    torch.set_num_threads(1)
    results = []
    for kind, name in COLORS.items():
        workload = colored_spheres(kind, options.meshes)
        programs = {"nmr, 1 thread": _program(workload)}
        if workload.values is not None:
            programs["nmr, 1 thread, colours learned, too"] = _program(workload, learn_values=True)
        title = f"Colours: {options.meshes} meshes, 1280 faces, 64x64 anti-aliased, {name}, forward + backward"
        about = settings(1, options.repeats, batch=options.meshes)
        results.append(Result(f"colors {kind}", title, measure(programs, options.repeats), about))
        show(results[-1])
    torch.set_num_threads(options.threads)
    return results


def bench_two_threads(options: Options) -> Result:
    """Two threads beside one, alternately."""
    program = _program(deformed_spheres(options.meshes, 3, 64))

    def run(threads: int) -> Timing:
        torch.set_num_threads(threads)
        return program()

    rows = measure({"nmr, 2 threads": partial(run, 2), ONE_THREAD: partial(run, 1)}, options.repeats)
    torch.set_num_threads(options.threads)
    about = settings(2, options.repeats, batch=options.meshes)
    return Result("two-threads", "W1 with two threads and with one", rows, about)


def bench_voxels(options: Options) -> Result:
    """Voxels, and in all with the IoU."""
    spheres = deformed_spheres(1000, 3, 64)
    vertices = spheres.vertices * (31 / 32) + 0.5

    def run() -> Timing:
        start = time.perf_counter()
        voxels = nmr.voxelize(vertices, spheres.faces)
        forward = time.perf_counter()
        nmr.metrics.voxel_iou(voxels, voxels.roll(1, 0))
        return forward - start, time.perf_counter() - start

    repeats = min(options.repeats, 5)
    rows = measure({f"nmr, {options.threads} threads": run}, repeats)
    about = settings(options.threads, repeats, batch=1000)
    return Result("voxels", "Voxel IoU of 1000 meshes of 1280 faces at 32^3", rows, about)


def bench_all(options: Options) -> list[Result]:
    """Every row of the table."""
    results = []
    for name, batch in (("w1", 64), ("w1", 128), ("w2", 1), ("w3", 1), ("w4", 64)):
        results.append(bench_render(name, options, batch))
        show(results[-1])
    for bench in SINGLE.values():
        results.append(bench(options))
        show(results[-1])
    return results


def reached(result: Result) -> float | None:
    """The figure that is compared with the target; None without a target, or if its peer was not measured."""
    ours = result.rows[0].total
    if result.key not in TARGETS or TARGETS[result.key].peer is None:
        return ours if result.key in TARGETS else None
    return next((row.total / ours for row in result.rows if row.program == TARGETS[result.key].peer), None)


def missed(result: Result) -> bool:
    """Whether a result misses its target."""
    if (value := reached(result)) is None:
        return False
    target = TARGETS[result.key]
    return not (value >= target.limit if target.peer else value <= target.limit)


def markdown(results: list[Result]) -> str:
    """One line for each of our rows; peers and target stand in the first line of their workload."""
    lines = ["| workload | ours | peers, in the same run | target |", "|---|---|---|---|"]
    for result in results:
        first, target = result.rows[0], TARGETS.get(result.key, "-")
        peers = [row for row in result.rows if not row.program.startswith("nmr")]
        theirs = "; ".join(f"{row.program} {row.total:.1f} ({row.total / first.total:.2f} x)" for row in peers)
        more = [result.title, theirs or "-", f"{target}{': missed' if missed(result) else ''}"]
        for row in result.rows:
            if row not in peers:
                about = row.program.partition(", ")[2]
                ours = f"**{row.total:.2f}** {result.unit.split()[0]} ({about}); fastest {row.fastest:.2f}"
                lines.append(f"| {more[0]} | {ours} | {more[1]} | {more[2]} |")
                more = ["", "-", "-"]
    return "\n".join(lines)


SINGLE: dict[str, Callable[[Options], Result]] = {
    "two-threads": bench_two_threads,
    "voxels": bench_voxels,
    "step": lambda options: bench_step(options.batch, options.threads, options.repeats),
}
ALONE: dict[str, Callable[[Options], Result]] = SINGLE | {
    "w1": lambda options: bench_render("w1", options, options.meshes),
    "w2": lambda options: bench_render("w2", options),
    "w3": lambda options: bench_render("w3", options),
    "w4": lambda options: bench_render("w4", options, options.meshes),
}
TABLES: dict[str, Callable[[Options], list[Result]]] = {"all": bench_all, "colors": bench_colors}


@without_traceback()
def main() -> int:
    options = tyro.cli(Options, description=__doc__)
    name = options.workload
    torch.set_num_threads(options.threads)
    if name == "memory":
        bench_memory()
        return 0
    keep_freed_memory()
    if name in ALONE:
        show(ALONE[name](options))
        return 0
    if name not in TABLES:
        raise ValueError(unknown_name("workload", name, [*TABLES, *ALONE, "memory"]))
    results = TABLES[name](options)
    about = ", ".join(f"{key} {value}" for key, value in results[0].settings.items() if key != "batch")
    print(f"\nForward + backward, medians; {about}\n\n{markdown(results)}", flush=True)
    wrong = [r for r in results if missed(r)]
    lines = [f"{r.title}: {reached(r):.2f}, not {TARGETS[r.key]}" for r in wrong]
    if lines:
        sys.exit("\n".join(["targets missed:", *lines]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
