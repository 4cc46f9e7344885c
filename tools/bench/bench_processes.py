"""Steps of the proposed method at one global batch in several processes.

Examples:
  python tools/bench/bench.py processes                                     as many ways as the cores allow, a table
  torchrun --nproc-per-node 2 tools/bench/bench_processes.py --threads 8    one of them
  torchrun --nnodes 2 ... tools/bench/bench_processes.py --threads 8        on several machines, the same on each
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal

import torch
import tyro
from bench_step import sphere_dataset
from bench_work import num_cores

from learn3d.data import conventions
from learn3d.data.sampling import shuffled_epochs
from learn3d.device import keep_freed_memory, resolve_precision
from learn3d.distributed.launch import init_process_group
from learn3d.distributed.process_group import ProcessGroup
from learn3d.methods import DatasetInfo, create_method
from learn3d.presets import PRESETS
from learn3d.terminal import Stop, without_traceback


@dataclass(frozen=True)
class Options:
    threads: int = 1
    """Threads of each process."""
    repeats: int = 15
    """Timed steps."""
    batch: int = 128
    """Images per step, of all processes together."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the networks run."""
    precision: Literal["auto", "bf16", "fp32"] = "auto"
    """Arithmetic of the networks."""


def measure_steps(options: Options, group: ProcessGroup) -> tuple[float, float, float]:
    """Milliseconds: median step, fastest step, and the CPU time of a step in this process, which hardly depends
    on what else the machine does."""
    keep_freed_memory()
    torch.set_num_threads(options.threads)
    dataset, precision = sphere_dataset(), resolve_precision(options.precision, options.device)
    group = group.split_batch(options.batch, "views")
    method = create_method(
        PRESETS["peng2020-kato"].settings,
        DatasetInfo(conventions.NUM_VIEWS),
        device=options.device,
        precision=precision,
        seed=0,
    )
    method.distribute(group)
    steps, busy = [], []
    for step in range(1, options.repeats + 3):
        began, before = time.perf_counter(), time.process_time()
        method.take_step(dataset.batch(shuffled_epochs(len(dataset), options.batch, 0, step), group.rows), step)
        group.stopped_by(Stop())
        if step > 2:
            steps.append(1e3 * (time.perf_counter() - began))
            busy.append(1e3 * (time.process_time() - before))
    return median(steps), min(steps), median(busy)


def ways(cores: int) -> list[tuple[int, int]]:
    """(processes, threads of each): all cores shared in every way by powers of two, one thread, and half of them."""
    powers = [2**k for k in range(cores.bit_length()) if 2**k <= cores]
    return [(1, n) for n in powers] + [(n, powers[-1] // n) for n in powers[1:]]


def bench_processes(repeats: int) -> None:
    """Each way in processes of its own, one after the other, and the table in Markdown: ratios of the fastest steps."""
    rows, first = [], 0.0
    for processes, threads in ways(num_cores()):
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
        command += [str(Path(__file__)), "--threads", str(threads), "--repeats", str(repeats)]
        result = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
        if result.returncode:
            raise SystemExit(f"{' '.join(command)} failed")
        print(result.stdout, end="", flush=True)
        step, fastest, busy = map(float, re.findall(r"([\d.]+) ms", result.stdout))
        first = first or fastest
        cells = (f"{processes} x {threads}", f"{step:.0f}", f"{fastest:.0f}", f"{busy:.0f}")
        rows.append(f"| {' | '.join(cells)} | {first / fastest:.2f} |")
    print("\n| processes x threads | ms a step | fastest | CPU ms of a process | times as fast |")
    print("|---|---|---|---|---|")
    print("\n".join(rows))


@without_traceback()
def main() -> int:
    options = tyro.cli(Options, description=__doc__)
    with init_process_group(options.device) as group:
        step, fastest, busy = measure_steps(options, group)
    if group.is_main:
        print(
            f"{group.world_size} x {options.threads} threads, batch {options.batch}: {step:.1f} ms a step, fastest "
            f"{fastest:.1f} ms, CPU {busy:.1f} ms"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
