"""Counts the instructions of workload W1 under callgrind and compares them with the stored bound (instructions.json).

    python tests/csrc/count.py build/native/count/workload g++            prints both; status 1 above the bound
    python tests/csrc/count.py build/native/count/workload g++ --store    makes what is counted the bound

The bound belongs to one compiler (its major version) and one instruction set, x86-64-v3; another compiler's count is
only printed.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

BOUNDS = Path(__file__).with_name("instructions.json")
IMAGES = 4
SLACK = 1.05


def compiler_name(compiler: str) -> str:
    """As in ``GCC 12`` or ``clang 14``."""
    text = subprocess.run([compiler, "--version"], check=True, capture_output=True, text=True).stdout
    version = re.search(r"(\d+)\.\d+\.\d+", text)
    return f"{'clang' if 'clang' in text else 'GCC'} {version[1] if version else '?'}"


def count(workload: str, function: str) -> int:
    """Instructions per image between entering and leaving a function of the workload."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "callgrind.out"
        command = ["valgrind", "--tool=callgrind", f"--toggle-collect={function}", f"--callgrind-out-file={output}"]
        result = subprocess.run([*command, workload, str(IMAGES), "--count"], capture_output=True, text=True)
        if result.returncode != 0:
            sys.exit(f"callgrind failed:\n{result.stderr}")
        return round(int(re.search(r"^(?:summary|totals): (\d+)", output.read_text(), re.MULTILINE)[1]) / IMAGES)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workload")
    parser.add_argument("compiler")
    parser.add_argument("--store", action="store_true")
    options = parser.parse_args()
    compiler = compiler_name(options.compiler)
    counts = {name: count(options.workload, f"counted_{name}") for name in ("forward", "backward")}
    bounds = json.loads(BOUNDS.read_text()) if BOUNDS.exists() else {}
    if options.store:
        bounds[compiler] = counts
        BOUNDS.write_text(json.dumps(bounds, indent=2) + "\n")
    exceeded = False
    for name, instructions in counts.items():
        bound = bounds.get(compiler, {}).get(name)
        if bound is None:
            print(f"W1 {name}: {instructions} instructions per image; no bound is stored for {compiler}")
            continue
        ratio = instructions / bound
        exceeded |= ratio > SLACK
        verdict = "MORE THAN IS ALLOWED" if ratio > SLACK else "ok" if ratio > 0.9 else "ok; the bound could be lowered"
        print(f"W1 {name}: {instructions} instructions per image, bound {bound} ({compiler}), {ratio:.3f}: {verdict}")
    sys.exit(exceeded)


if __name__ == "__main__":
    main()
