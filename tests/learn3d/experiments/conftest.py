"""What tests of the tables share: a worker that trains nothing, options, a plan, a report."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from learn3d.experiments.experiment import Call, run_experiment
from learn3d.experiments.plan import Options, plan_runs
from learn3d.experiments.tables import TABLES

#: Stands in for the worker: a category called "fails" fails, "waits" goes on until it is interrupted, others leave a
#: result whose IoUs depend on the variant, the seed and the object.
STUB = """
import json, os, sys, time
request = json.loads(sys.stdin.readline())
config, folder = request["config"], request["config"]["output"]
print("threads", os.environ["OMP_NUM_THREADS"], config["threads"], "fresh", request["fresh"], flush=True)
print("own session", os.getsid(0) == os.getpid() if hasattr(os, "getsid") else None, flush=True)
if request["category"] == "fails":
    print("first line"); print("error: no such data"); sys.exit(1)
if request["category"] == "waits":
    try:
        print("waiting", flush=True); time.sleep(60)
    except KeyboardInterrupt:
        time.sleep(0.5 * (request["variant"]["name"] == "proposed"))
        print("saved", flush=True); sys.exit(75)
base = {"vanilla": 0.3, "proposed": 0.4}[request["variant"]["name"]] + 0.01 * request["seed"]
means = [round(base + 0.02 * k, 5) for k in range(5)]
table = {"names": list("abcde"), "images": [24] * 5, "defined": [24] * 5, "kato18": means, "kato19": means}
iou = sum(means) / 5
result = {"config": config, "command": "learn3d train ...", "data": os.path.realpath(config["data"])}
result |= {"checkpoint": request["variant"]["checkpoint"], "seed": request["seed"]}
result |= {"iterations": config["iterations"], "step": config["iterations"], "seconds": 60.0, "conditions": {}}
result |= {"trained_by": {"commit": "0123456789ab"}, "tested_by": {"commit": "ba9876543210"}}
result |= {"voxel_iou_kato18": iou, "voxel_iou_kato19": iou - 0.05, "mmd": 1 - base, "mmd_paper": 0.5, "images": 120}
result |= {"chamfer_l1": 0.1, "f_score": 0.6, "undefined": 0, "objects": table, "views": table}
json.dump(result, open(os.path.join(folder, "test.json"), "w"))
print("tested", flush=True)
"""


@pytest.fixture(scope="session")
def stub(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """The command of that worker."""
    path = tmp_path_factory.mktemp("stub") / "stub.py"
    path.write_text(STUB)
    return sys.executable, str(path)


@pytest.fixture
def options(tmp_path: Path) -> Callable[..., Options]:
    """Options of two methods on one category, with changes."""

    def make(**changes: object) -> Options:
        given = {"categories": ("airplane",), "methods": ("vanilla", "proposed"), "iterations": 6, "batch_size": 4}
        return Options(tmp_path / "data", tmp_path / "out", **(given | changes))

    return make


@pytest.fixture
def made_by_hand(tmp_path, finished_run, tiny_folder, options):
    """The plan of a run whose folder holds one that tools/train.py would have left: four steps of batch 4."""
    (tmp_path / "out" / "runs" / "airplane").mkdir(parents=True)
    (tmp_path / "out" / "runs" / "airplane" / "proposed-seed0").symlink_to(finished_run)
    given = {"methods": ("proposed",), "iterations": 4}
    own = ("precision=fp32", "encoder=conv-small", "generator=sphere-small")

    def plan(changes: tuple[str, ...] = (), **more: object):
        given_options = options(**(given | more), changes=own + changes)
        return plan_runs(TABLES["kato"], dataclasses.replace(given_options, data=tiny_folder))[0]

    return plan


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory, stub: tuple[str, str]) -> Path:
    """The folder of a table of two categories and three seeds. Do not change it."""
    folder = tmp_path_factory.mktemp("reported") / "out"
    asked = {"categories": ("airplane", "chair"), "methods": ("vanilla", "proposed"), "iterations": 6, "batch_size": 4}
    given = Options(folder.parent / "data", folder, seeds=3, **asked)
    assert run_experiment(Call("kato", given, jobs=2), worker=stub) == 0
    return folder


@pytest.fixture
def report(tmp_path: Path, reported: Path) -> dict:
    """That table's report; a copy of the folder is `tmp_path / "out"`."""
    shutil.copytree(reported, tmp_path / "out")
    return json.loads((tmp_path / "out" / "kato.json").read_text())
