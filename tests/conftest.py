import os
import signal
import sys
from pathlib import Path

import pytest
from hypothesis import settings

# One thread, as in tools/test.sh: bits depend on the number of threads, and tests share their cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).parent / "data"))

# A shell lets what it starts in the background ignore SIGINT, and so would the programs that tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# On CI the same examples every time: a new counter-example belongs to whoever looks for it, not to an unrelated change.
settings.register_profile("ci", derandomize=True, print_blob=True)
if os.environ.get("CI"):
    settings.load_profile("ci")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--fuzz-examples",
        type=int,
        default=0,
        help="damaged files per reader in test_fuzz_readers.py, new ones each time",
    )
