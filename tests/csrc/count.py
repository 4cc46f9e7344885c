"""Counts instructions of the kernels and compares them with the stored bounds (instructions.json).

    python tests/csrc/count.py build/native/count/workload g++            prints both; status 1 above a bound
    python tests/csrc/count.py build/native/count/workload g++ --store    makes what is counted the bound

A bound belongs to one compiler (its major version) and one target; the count of another is only printed. Programs for
x86-64 are counted by callgrind, those for arm64 by QEMU.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

BOUNDS = Path(__file__).with_name("instructions.json")
IMAGES = 4
SLACK = 1.05

# Rows of workload.cpp: W1, then other stages on the same meshes.
W1 = ("forward", "backward")
STAGES = (
    "vertex_colors_forward",
    "vertex_colors_backward",
    "edges_backward",
    "uv_forward",
    "uv_backward",
    "lights_forward",
    "lights_backward",
    "layers",
    "soft_forward",
    "soft_backward",
)
TARGETS = ("x86-64-v3", "x86-64", "arm64")


def compiler_name(compiler: str) -> str:
    """As in ``GCC 12`` or ``clang 14``."""
    text = subprocess.run([compiler, "--version"], check=True, capture_output=True, text=True).stdout
    version = re.search(r"(\d+)\.\d+\.\d+", text)
    return f"{'clang' if 'clang' in text else 'GCC'} {version[1] if version else '?'}"


def run(*command: str) -> str:
    """Standard error of a command."""
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode != 0:
        sys.exit(f"{command[0]} failed:\n{result.stderr}")
    return result.stderr


def count_callgrind(workload: str, row: str) -> int:
    """Instructions per image of one row."""
    function = f"counted_{row}" if row in W1 else "counted_row"
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "callgrind.out"
        tool = ["valgrind", "--tool=callgrind", f"--toggle-collect={function}", f"--callgrind-out-file={output}"]
        run(*tool, workload, str(IMAGES), row)
        return round(int(re.search(r"^(?:summary|totals): (\d+)", output.read_text(), re.MULTILINE)[1]) / IMAGES)


def count_qemu(plugin: str, workload: str, row: str) -> int:
    """The same: what running the row two more times adds to the whole program."""
    command = ["qemu-aarch64", "-L", "/usr/aarch64-linux-gnu", "-plugin", plugin, workload, str(IMAGES), row]
    once, more = (int(re.search(r"instructions: (\d+)", run(*command, times))[1]) for times in ("1", "3"))
    return round((more - once) / 2 / IMAGES)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workload")
    parser.add_argument("compiler")
    parser.add_argument("--target", choices=TARGETS, default=TARGETS[0])
    parser.add_argument("--store", action="store_true")
    options = parser.parse_args()
    key = f"{compiler_name(options.compiler)}, {options.target}"
    with ThreadPoolExecutor(os.cpu_count()) as pool, tempfile.TemporaryDirectory() as folder:
        count = count_callgrind
        if options.target == "arm64":
            plugin = str(Path(folder) / "count.so")
            run("cc", "-shared", "-fPIC", "-O2", "-o", plugin, str(Path(__file__).with_name("qemu_count.c")))
            count = partial(count_qemu, plugin)
        rows = (*W1, *STAGES)
        counts = dict(zip(rows, pool.map(partial(count, options.workload), rows), strict=True))
    bounds = json.loads(BOUNDS.read_text()) if BOUNDS.exists() else {}
    if options.store:
        bounds[key] = counts
        BOUNDS.write_text(json.dumps(bounds, indent=2) + "\n")
    exceeded = False
    for name, instructions in counts.items():
        label = f"W1 {name}" if name in W1 else name
        bound = bounds.get(key, {}).get(name)
        if bound is None:
            print(f"{label}: {instructions} instructions per image; no bound is stored for {key}")
            continue
        ratio = instructions / bound
        exceeded |= ratio > SLACK
        verdict = "MORE THAN IS ALLOWED" if ratio > SLACK else "ok" if ratio > 0.9 else "ok; the bound could be lowered"
        print(f"{label}: {instructions} instructions per image, bound {bound} ({key}), {ratio:.3f}: {verdict}")
    sys.exit(exceeded)


if __name__ == "__main__":
    main()
