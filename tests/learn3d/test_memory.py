import subprocess
import sys

import pytest

CODE = """
import resource, sys, torch
from learn3d.memory import keep_freed_memory
if sys.argv[1] == "keep":
    assert keep_freed_memory()
def step():
    return [torch.ones(n << 20) for n in (1, 4, 2, 8, 3, 8, 1)]  # like a training step: buffers of 4 .. 32 MiB
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
step(); step()
before = faults()
for _ in range(10):
    step()
print(faults() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc only")
def test_large_buffers_are_reused():
    faults = {
        mode: int(subprocess.run([sys.executable, "-c", CODE, mode], check=True, capture_output=True, text=True).stdout)
        for mode in ("keep", "plain")
    }
    assert faults["keep"] < faults["plain"] / 2
