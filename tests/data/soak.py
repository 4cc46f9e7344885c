"""A long run of a tiny model in a process of its own: what it holds and what a step costs, as it goes on.

python soak.py CONFIG_JSON STEPS prints one line of JSON for every STEPS steps: their CPU seconds, and the resident
memory in bytes, open files and threads of the process, once everything that it no longer uses is given back.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import sys
import threading
import time

import tiny_networks

from learn3d import training
from learn3d.presets import config_from_dict
from learn3d.runs import log


class Soaked(log.RunLog):
    every = 100
    cpu_before = 0.0

    def step(self, step: int, losses: dict[str, float]) -> None:
        super().step(step, losses)
        if step % self.every == 0:
            cpu = time.process_time() - self.cpu_before
            gc.collect()
            ctypes.CDLL(None).malloc_trim(0)
            with open("/proc/self/statm") as file:
                resident = int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
            files = len(os.listdir("/proc/self/fd"))
            values = {
                "step": step,
                "resident": resident,
                "files": files,
                "threads": threading.active_count(),
            }
            print(json.dumps(values | {"cpu": cpu}), flush=True)
            self.cpu_before = time.process_time()


if __name__ == "__main__":
    config = config_from_dict(json.loads(sys.argv[1]))
    Soaked.every = int(sys.argv[2])
    tiny_networks.put_in_place()
    training.PICTURE_ROWS = 1
    training.open_log = Soaked
    training.train(config)
