import subprocess
import sys

import pytest

CODE = """
import resource, sys, torch
from learn3d.memory import keep_freed_memory
if sys.argv[1] == "keep":
    assert keep_freed_memory()
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
torch.ones(1 << 24)
before = faults()
for _ in range(10):
    torch.ones(1 << 24)  # 64 MiB each: 16384 pages of 4 KiB
print(faults() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc only")
def test_large_buffers_are_reused():
    faults = {
        mode: int(subprocess.run([sys.executable, "-c", CODE, mode], check=True, capture_output=True, text=True).stdout)
        for mode in ("keep", "plain")
    }
    assert faults["keep"] < 1000
    assert faults["keep"] < faults["plain"] / 2
