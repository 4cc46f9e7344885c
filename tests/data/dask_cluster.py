"""A Dask scheduler with two workers in processes of their own."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator

from children import environment


@contextlib.contextmanager
def dask_cluster() -> Iterator[tuple[str, subprocess.Popen]]:
    """Address and process of the scheduler. It gives a task up when its first worker dies; workers are replaced."""
    pipes = {
        "stdin": subprocess.PIPE,
        "stdout": subprocess.PIPE,
        "stderr": subprocess.DEVNULL,
        "text": True,
    }
    failures = environment(DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0")
    with subprocess.Popen([sys.executable, __file__], **pipes, env=failures) as process:
        yield process.stdout.readline().strip(), process
        process.stdin.close()


if __name__ == "__main__":
    from distributed import LocalCluster

    with LocalCluster(
        2, threads_per_worker=1, dashboard_address=None, worker_dashboard_address=None
    ) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
