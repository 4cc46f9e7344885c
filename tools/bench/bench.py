"""Measure the renderer and what belongs to it, beside other programs in the same run (compare within one run only).

  bench.py all: every row of the table, as Markdown; exit code 1 if a target is missed
  bench.py w1: 64 spheres, 64x64 anti-aliased; also deodr
  bench.py w2: one mesh of 81,920 faces, 512x512
  bench.py w3: one mesh of 1,280 faces, 1024x1024
  bench.py w4: w1 with depth, and with alpha + depth in one pass, instead of silhouettes
  bench.py colors: w1 in colour, with one thread: white, vertex colours, texture images, lights; exit code as for all
  bench.py two-threads: w1 with two threads and with one
  bench.py first: the first render in a fresh process
  bench.py smoothness: smoothness loss of 128 spheres of 1920 edges
  bench.py cameras: 64 look-at cameras
  bench.py voxels: voxel IoU of 1000 predictions
  bench.py step: a whole training step in bf16 and in fp32, and what of it is not the networks'
  bench.py evaluation: validation during training, as a share of the run
  bench.py memory: bytes per image and per raster pixel, in fresh processes
  bench.py processes: steps of the proposed method, one batch of 128 shared by 1, 2, 4 ... processes
  bench.py scaling: w1, w2, w3 at 1, 2, 4, 8, 16 threads, as far as there are cores

Medians over repeats that alternate between the programs, and the fastest. Freed memory is kept for all of them, as in
training (learn3d/device.py). `pip install deodr` for the comparison.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import bench_peers as peers
import torch
import tyro
from bench_colors import bench_colors
from bench_memory import bench_memory
from bench_processes import bench_processes
from bench_step import bench_evaluation, bench_step
from bench_work import (
    Result,
    Timing,
    Workload,
    deformed_spheres,
    measure,
    milliseconds,
    num_cores,
    run_chain,
    run_ours,
    settings,
    show,
)

import nmr
from learn3d.device import keep_freed_memory
from learn3d.terminal import without_traceback


class Target(NamedTuple):
    """A bound on the median of forward + backward with two threads.

    With a ``peer``, how many times as fast as that program of the same run ours must be, which depends little on the
    machine. Otherwise the most that it may take.
    """

    limit: float
    unit: str
    source: str
    peer: str | None = None

    def reached(self, result: Result) -> float | None:
        """What is compared with the limit; None if the peer was not measured."""
        ours = result.rows[0].total
        if self.peer is None:
            return ours
        theirs = [row.total for row in result.rows if row.program == self.peer]
        return theirs[0] / ours if theirs else None

    def missed(self, result: Result) -> bool:
        reached = self.reached(result)
        if reached is None:
            return False
        return not (reached >= self.limit if self.peer else reached <= self.limit)

    def __str__(self) -> str:
        return f">= {self.limit:g} x {self.peer}" if self.peer else f"<= {self.limit:g} {self.unit}"


MESHES = 64  # of w1 and w4
ONE_THREAD = "one thread of the same"
TARGETS = {
    "w1, 64": Target(5, "x", "five times the fastest program for processors", "deodr, 2 processes"),
    "w1, 128": Target(5, "x", "as with 64", "deodr, 2 processes"),
    "w2": Target(8, "x", "one mesh: deodr cannot share it", "deodr, 1 process"),
    "w3": Target(5, "x", "one mesh: deodr cannot share it", "deodr, 1 process"),
    "w4, 64": Target(6, "x", "as w1", "deodr, 2 processes"),
    "colors white": Target(25, "ms", "rgb follows from the silhouette"),
    "colors vertex": Target(28, "ms", "as white, and one interpolation"),
    "colors uv": Target(40, "ms", "as vertex colours, and four texels a pixel"),
    "colors uv-lights": Target(50, "ms", "as texture images, and the light of each face"),
    "two-threads": Target(1.85, "x", "the meshes of a batch are independent", ONE_THREAD),
    "first": Target(300, "ms", "nothing is compiled or imported then"),
    "smoothness": Target(3, "ms", "the same as a chain of torch calls takes tens of ms"),
    "step": Target(8, "% of the networks", "26 ms beside networks of 334 ms are 360 ms a step: 20,000 in two hours"),
    "evaluation": Target(3, "% of the run", "what a run may spend on looking at itself"),
}


@dataclass(frozen=True)
class Options:
    workload: tyro.conf.Positional[
        Literal[
            "all",
            "w1",
            "w2",
            "w3",
            "w4",
            "two-threads",
            "first",
            "smoothness",
            "cameras",
            "voxels",
            "step",
            "evaluation",
        ]
        | Literal["colors", "memory", "processes", "scaling"]
    ] = "w1"
    """What to measure."""
    batch: int | None = None
    """Meshes of w1, w4 and colors, by default 64 (all: w1 with 64 and with 128); images of a step, by default 128."""
    threads: int = 2
    """Threads of ours and of torch (colors takes one). deodr has none: it gets one process, and as many as these."""
    repeats: int = 15
    """Timed runs of each program."""


# --- renders


def render_workload(name: str, batch: int) -> tuple[str, Workload]:
    if name == "w2":
        return "W2: one mesh, 81,920 faces, 512x512", deformed_spheres(1, 6, 512, False)
    if name == "w3":
        return "W3: one mesh, 1280 faces, 1024x1024", deformed_spheres(1, 3, 1024, False)
    outputs, what = (("depth",), "depth, ") if name == "w4" else (("alpha",), "")
    title = f"{name.upper()}: {what}{batch} meshes, 1280 faces, 64x64 anti-aliased"
    return title, deformed_spheres(batch, 3, 64, True, outputs)


def bench_render(name: str, options: Options, batch: int) -> Result:
    title, workload = render_workload(name, batch)
    about, targets = settings(options.threads, options.repeats, batch=len(workload.vertices)), workload.targets()
    programs = {f"nmr, {options.threads} threads": lambda: run_ours(workload, targets)}
    if name == "w4":
        both = deformed_spheres(batch, 3, 64, True, ("alpha", "depth"))
        both_targets = both.targets()
        programs[f"nmr, {options.threads} threads, alpha + depth in one pass"] = lambda: run_ours(both, both_targets)
    processes = None
    if peers.has_deodr():
        more, processes = peers.deodr_programs(workload, targets, options.threads)
        programs |= more
    else:
        print("deodr is not installed (pip install deodr): no comparison with it")
    rows = measure(programs, options.repeats)
    if processes:
        processes.close()
    loss = "the mean squared difference" if name == "w4" else "1 - soft IoU"
    key = f"{name}, {batch}" if name in ("w1", "w4") else name
    return Result(key, f"{title}, forward + backward of {loss}", rows, about)


def bench_two_threads(options: Options) -> Result:
    """Two threads beside one, alternately."""
    title, workload = render_workload("w1", options.batch or MESHES)
    targets = workload.targets()

    def run(threads: int) -> Timing:
        torch.set_num_threads(threads)
        return run_ours(workload, targets)

    rows = measure({"nmr, 2 threads": partial(run, 2), ONE_THREAD: partial(run, 1)}, options.repeats)
    torch.set_num_threads(options.threads)
    about = settings(2, options.repeats, batch=len(workload.vertices))
    return Result("two-threads", f"{title}, with two threads and with one", rows, about)


FIRST_RENDER = """
import time, torch, nmr
torch.set_num_threads({threads})
vertices, faces = nmr.icosphere(3)
leaf = (0.5 * vertices).requires_grad_()
camera = nmr.LookAt.from_angles(2.732, 30.0, 0.0, half_fov_deg=15.0)
start = time.perf_counter()
image = nmr.render_silhouette(leaf, faces, camera, image_size=64)
forward = time.perf_counter()
image.sum().backward()
print(forward - start, time.perf_counter() - start)
"""


def bench_first(options: Options) -> Result:
    """In processes of their own, after the imports."""
    repeats = min(options.repeats, 5)
    about = settings(options.threads, repeats, batch=1)

    def run() -> Timing:
        command = [sys.executable, "-I", "-c", FIRST_RENDER.format(threads=options.threads)]
        forward, total = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
        return float(forward), float(total)

    rows = [milliseconds(f"nmr, {options.threads} threads", [run() for _ in range(repeats)])]
    return Result("first", "First render in a process, after the imports, one mesh, forward + backward", rows, about)


# --- what belongs to it


def bench_smoothness(options: Options) -> Result:
    spheres = deformed_spheres(128, 3, 64, True)
    edges = nmr.edge_table(spheres.faces)
    about = settings(options.threads, options.repeats, batch=len(spheres.vertices))
    ours = partial(run_chain, lambda vertices: nmr.losses.smoothness_loss(vertices, edges), spheres.vertices)
    programs = {f"nmr, {options.threads} threads": ours}
    title = f"Smoothness loss, B = 128, {len(edges)} edges, forward + backward"
    return Result("smoothness", title, measure(programs, options.repeats), about)


def bench_cameras(options: Options) -> Result:
    spheres = deformed_spheres(64, 3, 64, True)
    about = settings(options.threads, options.repeats, batch=len(spheres.vertices))
    grad = torch.randn(spheres.vertices.shape, generator=torch.Generator().manual_seed(0))
    ours = partial(run_chain, spheres.camera.transform, spheres.vertices, grad)
    programs = {f"nmr, {options.threads} threads": ours}
    title = "LookAt, B = 64, 642 vertices each, forward + backward"
    return Result("cameras", title, measure(programs, options.repeats), about)


def bench_voxels(options: Options) -> Result:
    repeats = min(options.repeats, 5)
    about = settings(options.threads, repeats, batch=1000)
    spheres = deformed_spheres(1000, 3, 64, True)
    vertices = spheres.vertices * (31 / 32) + 0.5

    def run() -> Timing:
        start = time.perf_counter()
        voxels = nmr.voxelize(vertices, spheres.faces)
        forward = time.perf_counter()
        (voxels & voxels.roll(1, 0)).sum((1, 2, 3)) / (voxels | voxels.roll(1, 0)).sum((1, 2, 3))
        return forward - start, time.perf_counter() - start

    rows = measure({f"nmr.voxelize, {options.threads} threads; in all with the IoU": run}, repeats)
    return Result("voxels", "Voxel IoU of 1000 meshes of 1280 faces at 32^3", rows, about)


def bench_scaling(options: Options) -> list[Result]:
    """Each thread count in turn, after one run that is not timed: the pool of threads changes its size."""
    threads = [n for n in (1, 2, 4, 8, 16) if n <= num_cores()]
    results = []
    for name in ("w1", "w2", "w3"):
        title, workload = render_workload(name, options.batch or MESHES)
        targets, times = workload.targets(), {n: [] for n in threads}
        for _ in range(options.repeats):
            for n in threads:
                torch.set_num_threads(n)
                run_ours(workload, targets)
                times[n].append(run_ours(workload, targets))
        rows = [milliseconds(f"nmr, {n} threads", seconds) for n, seconds in times.items()]
        about = settings(threads[-1], options.repeats, batch=len(workload.vertices))
        results.append(Result(f"scaling {name}", f"{title}, by threads", rows, about))
        show(results[-1])
        speedups = (f"{n}: {rows[0].total / row.total:.2f}" for n, row in zip(threads, rows, strict=True))
        print(f"times as fast as one thread: {', '.join(speedups)}", flush=True)
    return results


# --- the table


def missed(result: Result) -> bool:
    target = TARGETS.get(result.key)
    return target is not None and target.missed(result)


def markdown(results: list[Result]) -> str:
    """One line for each of our rows; peers and target stand in the first line of their workload."""
    lines = ["| workload | ours | peers, in the same run | target |", "|---|---|---|---|"]
    for result in results:
        unit = "%" if result.unit.startswith("%") else result.unit
        theirs = "; ".join(
            f"{row.program} {row.total:.1f} ({row.total / result.rows[0].total:.2f} x)"
            for row in result.rows
            if not row.ours
        )
        target = TARGETS.get(result.key)
        wanted = f"{target}{': missed' if missed(result) else ''}" if target else "-"
        for number, row in enumerate(row for row in result.rows if row.ours):
            about = "" if not row.program.count(", ") else f" ({row.program.split(', ', 1)[1]})"
            ours = f"**{row.total:.2f}** {unit}{about}; fastest {row.fastest:.2f}"
            first = number == 0
            lines.append(
                f"| {result.title if first else ''} | {ours} | {theirs if first and theirs else '-'} "
                f"| {wanted if first else '-'} |"
            )
    return "\n".join(lines)


def bench_all(options: Options) -> list[Result]:
    """Every row of the table, and the table."""
    renders = (("w1", 64), ("w1", 128), ("w2", 1), ("w3", 1), ("w4", 64))
    benches: list[Callable[[], Result]] = [partial(bench_render, name, options, batch) for name, batch in renders]
    benches += [partial(bench, options) for bench in SINGLE.values()]
    results = []
    for bench in benches:
        results.append(bench())
        show(results[-1])
    show_table(results)
    return results


def bench_all_colors(options: Options) -> list[Result]:
    """Every kind of colour, and the table."""
    results = bench_colors(options.batch or MESHES, options.repeats)
    for result in results:
        show(result)
    show_table(results)
    return results


def show_table(results: list[Result]) -> None:
    about = {key: value for key, value in results[0].settings.items() if key != "batch"}
    print(f"\nForward + backward, medians; {', '.join(f'{key} {value}' for key, value in about.items())}\n")
    print(markdown(results), flush=True)


SINGLE: dict[str, Callable[[Options], Result]] = {
    "two-threads": bench_two_threads,
    "first": bench_first,
    "smoothness": bench_smoothness,
    "cameras": bench_cameras,
    "voxels": bench_voxels,
    "step": lambda options: bench_step(options.batch, options.threads, options.repeats),
    "evaluation": lambda options: bench_evaluation(options.batch, options.threads, options.repeats),
}


@without_traceback()
def main() -> int:
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(options.threads)
    if options.workload == "memory":
        bench_memory(threads=(1, 2))
        return 0
    if options.workload == "processes":
        bench_processes(options.repeats)
        return 0
    keep_freed_memory()
    if options.workload == "all":
        results = bench_all(options)
    elif options.workload == "colors":
        results = bench_all_colors(options)
    elif options.workload == "scaling":
        results = bench_scaling(options)
    else:
        bench = SINGLE.get(options.workload)
        results = [bench(options) if bench else bench_render(options.workload, options, options.batch or MESHES)]
        show(results[0])
    if options.workload in ("all", "colors") and any(map(missed, results)):
        lines = (
            f"{r.title}: {TARGETS[r.key].reached(r):.2f}, not {TARGETS[r.key]} ({TARGETS[r.key].source})"
            for r in results
            if missed(r)
        )
        sys.exit("\n".join(["targets missed:", *lines]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
