"""A long run of a tiny model in a process of its own: what it holds and what a step costs, as it goes on.

python soak.py CONFIG_JSON STEPS prints one line of JSON for every STEPS steps: resident memory in bytes, open files,
CPU seconds and threads of the process.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time

import tiny_networks

from learn3d import training, validation
from learn3d.config import config_from_dict
from learn3d.runs.log import RunLog


class Soaked(RunLog):
    every = 100

    def step(self, step: int, losses: dict[str, float]) -> None:
        super().step(step, losses)
        if step % self.every == 0:
            with open("/proc/self/statm") as file:
                resident = int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
            files = len(os.listdir("/proc/self/fd"))
            values = {"step": step, "resident": resident, "files": files, "threads": threading.active_count()}
            print(json.dumps(values | {"cpu": time.process_time()}), flush=True)


if __name__ == "__main__":
    config = config_from_dict(json.loads(sys.argv[1]))
    Soaked.every = int(sys.argv[2])
    tiny_networks.put_in_place()
    validation.PICTURE_ROWS = 1
    training.RunLog = Soaked
    training.train(config)
