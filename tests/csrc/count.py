"""Counts the instructions of every kernel in the workload and compares them with the stored bounds (instructions.json).

    python tests/csrc/count.py build/native/count/workload x86-64-v3            prints both; status 1 above a bound
    python tests/csrc/count.py build/native/count/workload x86-64-v3 --store    makes the counts the bounds

A bound belongs to one compiler (its major version) and one target.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

BOUNDS = Path(__file__).with_name("instructions.json")
STAGES = Path(__file__).parents[2] / "csrc" / "stages.h"
IMAGES, RUNS = 4, 2
SLACK = 1.05


def run(*command: str) -> str:
    """Standard output of a command."""
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode != 0:
        sys.exit(f"{command[0]} failed:\n{result.stderr}")
    return result.stdout


def compiler_name() -> str:
    """As in ``GCC 12`` or ``clang 14``."""
    text = run(os.environ.get("CXX", "c++"), "--version")
    return f"{'clang' if 'clang' in text else 'GCC'} {re.search(r'([0-9]+)[.][0-9]+[.][0-9]+', text)[1]}"


def count(workload: str) -> dict[str, int]:
    """Instructions per image of each kernel that stages.h declares, with all that it calls, by name."""
    with tempfile.TemporaryDirectory() as folder:
        output = f"{folder}/callgrind.out"
        run(
            "valgrind",
            "--tool=callgrind",
            f"--callgrind-out-file={output}",
            workload,
            str(IMAGES),
            str(RUNS),
        )
        report = run("callgrind_annotate", "--inclusive=yes", "--threshold=100", output)
    pattern = r"^ *([\d,]+) .*:(?:void )?nmr::(\w+)(?:<float>)?\(nmr::\w+(?:<float>)? const&\)"
    found = defaultdict(int)  # lambdas and lines of code match, too, but have smaller numbers
    for number, name in re.findall(pattern, report, re.MULTILINE):
        found[name] = max(found[name], int(number.replace(",", "")))
    kernels = re.findall(r"void (\w+)\(const \w+(?:<T>)?& args\)", STAGES.read_text())
    return {name: round(found[name] / IMAGES / RUNS) for name in kernels}


def main() -> None:
    workload, target, *store = sys.argv[1:]
    key = f"{compiler_name()}, {target}"
    counts, bounds = count(workload), json.loads(BOUNDS.read_text())
    if store:
        bounds[key] = counts
        BOUNDS.write_text(json.dumps(bounds, indent=2) + "\n")
    exceeded = False
    for name, instructions in counts.items():
        bound = bounds.get(key, {}).get(name)
        ratio = instructions / bound if bound else 0
        exceeded |= ratio > SLACK
        verdict = f"{ratio:.3f} of the bound" if bound else f"no bound is stored for {key}"
        print(
            f"{name}: {instructions} instructions per image, {verdict}{': MORE THAN IS ALLOWED' * (ratio > SLACK)}"
        )
    sys.exit(exceeded)


if __name__ == "__main__":
    main()
