import subprocess
import sys

import pytest

CODE = """
import sys, torch
from learn3d.device import keep_freed_memory
if sys.argv[1] == "keep" and not keep_freed_memory():
    sys.exit("unavailable")
def step():
    return [torch.ones(n << 20) for n in (1, 4, 2, 8, 3, 8, 1)]  # like a training step: buffers of 4 .. 32 MiB
def faults():
    import resource
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
step(); step()
before = faults()
for _ in range(10):
    step()
print(faults() - before)
"""


def test_large_buffers_are_reused():
    faults = {}
    for mode in ("keep", "plain"):
        run = subprocess.run(
            [sys.executable, "-I", "-c", CODE, mode], capture_output=True, text=True
        )
        if run.stderr.strip() == "unavailable":
            pytest.skip("needs Linux with glibc")
        assert run.returncode == 0, run.stderr
        faults[mode] = int(run.stdout)
    assert faults["keep"] < faults["plain"] / 2
