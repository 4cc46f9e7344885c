"""The environment of programs that tests start."""

import os
import sys


def environment(**more: str) -> dict[str, str]:
    """That of this process; the programs find the same packages, and have one thread and no GPU."""
    fixed = {
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "CUDA_VISIBLE_DEVICES": "",
    }
    return os.environ | fixed | more
