"""Two processes on gloo against one: the same weights, losses, validation and files, and how they end together."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
import tiny_networks
import torch
from safetensors.torch import load_file
from train_in_ranks import evaluate_last, linear_optimizer

from learn3d.config import TrainConfig, config_to_dict
from learn3d.data.sampling import VIEWS_OF_OBJECT
from learn3d.distributed import launch
from learn3d.distributed.launch import init_process_group
from learn3d.distributed.process_group import SINGLE_PROCESS, LostPeerError, ProcessGroup
from learn3d.training import train

TASKS = Path(__file__).parents[2] / "data" / "train_in_ranks.py"
TRAIN = Path(__file__).parents[3] / "tools" / "train.py"
SMALL = {"encoder": "conv-small", "generator": "sphere-small"}
VPL = {"discriminator_channels": 4, "generator": "sphere-small"}
PATCH = {"image_size": 64, "silhouette_size": 64, "discriminator_channels": 4, "layout": "kato"}
PATCH |= {"generator": "sphere-small", "symmetry": 45.0}
PRGAN = {"generator_channels": (4, 4, 2, 1), "discriminator_channels": (4, 8, 8, 8), "encoder_from_step": 3}

#: Runs of 4 steps by name: options, and the tolerances of weights and of losses.
RUNS: dict[str, tuple[dict[str, object], float, float]] = {
    # 5 images for 2 processes: one has 3 of them.
    "proposed": (SMALL | {"augment": ("channels",), "batch_size": 5, "ema_decay": 0.9}, 1e-6, 1e-6),
    "vanilla": (SMALL | {"preset": "peng2020-kato-vanilla", "augment": ("flip",), "lr_schedule": "cosine"}, 1e-6, 1e-6),
    "pairs": ({"preset": "kato2018-kato", "encoder": "conv-small", "batch_size": 6}, 1e-5, 1e-5),
    "groups": ({"preset": "many-views-kato", **SMALL, "batch_size": 15, "symmetry": "x"}, 1e-5, 1e-5),
    # Batch norms, and for each image a random view of another one, which may be with the other process.
    "vpl": (VPL | {"preset": "peng2020-kato-vpl", "batch_size": 5}, 1e-4, 1e-4),
    "reversal": (PATCH | {"preset": "kato2019-kar", "batch_size": 5, "augment": ()}, 1e-4, 1e-4),
    # Shapes of both processes are compared with each other.
    "plus": (SMALL | {"preset": "plus-kato", "batch_size": 5, "bank_size": 8, "symmetry": "x"}, 1e-5, 1e-5),
    "prgan": (PRGAN | {"preset": "gadelha2017-kato", "batch_size": 5}, 1e-5, 1e-3),
}


# --- one process


@pytest.mark.parametrize(
    ("world", "batch_size", "sampling", "parts"),
    [
        (2, 5, "views", [[0, 1, 2], [3, 4]]),
        (3, 4, "classes", [[0, 1], [2], [3]]),
        (2, 6, "pairs", [[0, 1, 3, 4], [2, 5]]),
        (2, 15, "groups", [[0, 1, 3, 4, 6, 7, 9, 10, 12, 13], [2, 5, 8, 11, 14]]),
    ],
)
def test_each_row_belongs_to_one_process(world: int, batch_size: int, sampling: str, parts: list[list[int]]) -> None:
    ranks = [ProcessGroup(rank, world).split_batch(batch_size, VIEWS_OF_OBJECT[sampling]) for rank in range(world)]
    assert [r.rows.tolist() for r in ranks] == parts
    assert sum(r.batch_share for r in ranks) == pytest.approx(1)


@pytest.mark.parametrize(
    ("batch_size", "sampling", "message"),
    [
        (2, "views", "a batch of 2 is too small for 3 processes; start at most 2"),
        (4, "pairs", "a batch of 2 objects with 2 views each is too small for 3 processes; start at most 2"),
    ],
)
def test_too_many_processes_are_refused(batch_size: int, sampling: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ProcessGroup(0, 3).split_batch(batch_size, VIEWS_OF_OBJECT[sampling])


def test_without_torchrun_there_is_one_process(monkeypatch) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with init_process_group("cpu") as group:
        assert group == SINGLE_PROCESS
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.delenv("RANK", raising=False)
    with pytest.raises(ValueError, match="environment variable RANK expected"), init_process_group("cpu"):
        pass


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_processes_that_do_not_meet_say_where_and_what_to_look_for(monkeypatch) -> None:
    port = free_port()
    for name, value in {"RANK": 1, "WORLD_SIZE": 2, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}.items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.setattr(launch, "TIMEOUT", timedelta(seconds=1))
    said = rf"the 2 processes of the run did not find each other by 127.0.0.1:{port} \(.*\); one of them has ended"
    with pytest.raises(LostPeerError, match=said), init_process_group("cpu"):
        pass


@pytest.mark.parametrize("name", ["images", "masks", "poses", "view_ids", "object_ids", "voxels"])
def test_all_data_count_when_processes_compare_them(tiny_set, name: str) -> None:
    own = dataclasses.replace(tiny_set, masks=tiny_set.images[:, 3].copy())
    value = getattr(own, name)
    if name == "poses":
        other = dataclasses.replace(value, azimuth_deg=value.azimuth_deg.roll(1))
    else:
        other = np.roll(value, 1, axis=0)
    assert dataclasses.replace(own, **{name: other}).digest() != own.digest()


# --- two processes


@dataclasses.dataclass
class Processes:
    """Two processes, and what they said when they ended."""

    processes: list[subprocess.Popen]

    def wait(self, timeout: float = 240) -> tuple[list[int], list[str]]:
        try:
            said = [process.communicate(timeout=timeout)[1] for process in self.processes]
        finally:
            for process in self.processes:
                process.kill()
        return [process.returncode for process in self.processes], said


def start_processes(*command: object, world: int = 2) -> Processes:
    """Start processes as torchrun does, but without it: that saves a third of the time."""
    common = os.environ | {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "OMP_NUM_THREADS": "1"}
    common |= dict.fromkeys(("WORLD_SIZE", "LOCAL_WORLD_SIZE"), str(world))
    line = [sys.executable, *map(str, command)]
    own = [dict.fromkeys(("RANK", "LOCAL_RANK"), str(rank)) for rank in range(world)]
    return Processes([subprocess.Popen(line, env=common | names, stderr=subprocess.PIPE, text=True) for names in own])


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, tiny_config: Callable[..., TrainConfig]) -> Iterator[Path]:
    """Folder of one/<name> and two/<name>: the same runs in one and in two processes, which take one start."""
    root = tmp_path_factory.mktemp("ranks")
    threads, patch = torch.get_num_threads(), pytest.MonkeyPatch()
    torch.set_num_threads(1)
    tiny_networks.put_in_place(patch)

    def config(place: str, **options: object) -> TrainConfig:
        return tiny_config(root / place, max_val_images=24, **options)

    tasks = [{"config": config(f"two/{name}", **options), "linear": True} for name, (options, _, _) in RUNS.items()]
    plain = RUNS["proposed"][0]
    half, whole = ({"config": config(f"two/{name}", iterations=n, **plain)} for name, n in (("half", 2), ("adam", 4)))
    tasks += [whole, half, half | {"config": config("two/one-then-two", **plain), "resume": True, "linear": True}]
    tasks += [{"config": config("two/two-then-one", iterations=2, **plain), "linear": True}]
    tasks += [{"config": config("two/half", **plain), "resume": True}, {"evaluate": str(root / "two/proposed")}]
    differ = {"seed_of_rank_1": 1, "raises": "the processes of this run differ in options, weights; give all of them"}
    tasks += [{"config": config("two/differ", **plain)} | differ]
    nan = {"fault": "nan", "raises": "the loss is not finite at iteration 1 (projection nan"}
    tasks += [{"config": config("two/nan", **plain)} | nan]
    with linear_optimizer():
        train(config("two/one-then-two", iterations=2, **plain))
        (root / "tasks.json").write_text(json.dumps(tasks, default=lambda c: config_to_dict(c)))
        processes = start_processes(TASKS, root / "tasks.json")
        for name, (options, _, _) in RUNS.items():
            train(config(f"one/{name}", **options))
        codes, said = processes.wait()
        assert codes == [0, 0], said
        train(config("two/two-then-one", **plain), resume=True)
    torch.set_num_threads(threads)
    yield root
    patch.undo()
    shutil.rmtree(root)


def distance(a: Path, b: Path) -> float:
    """|w - w'| / |w| over all weights of two runs; everything that is not a weight is the same in both."""
    ours, theirs = (load_file(folder / "last.safetensors") for folder in (a, b))
    assert ours.keys() == theirs.keys()
    assert torch.equal(ours["random.cpu"], theirs["random.cpu"])
    names = [name for name in ours if name.startswith(("network", "ema"))]
    difference = sum(float((ours[name].double() - theirs[name].double()).square().sum()) for name in names)
    return (difference / sum(float(ours[name].double().square().sum()) for name in names)) ** 0.5


@pytest.mark.parametrize("name", RUNS)
def test_two_processes_learn_what_one_does(runs: Path, read_metrics, name: str) -> None:
    _, of_weights, of_losses = RUNS[name]
    assert distance(runs / "one" / name, runs / "two" / name) < of_weights
    one, two = (read_metrics(runs / place / name) for place in ("one", "two"))
    assert [line.keys() for line in one] == [line.keys() for line in two]
    assert [line["split"] for line in one] == ["train"] * 4 + ["val"]
    for ours, theirs in zip(one[:4], two[:4], strict=True):
        numbers = {key: value for key, value in ours.items() if key != "split"}
        assert {key: theirs[key] for key in numbers} == pytest.approx(numbers, rel=of_losses, abs=1e-6)
    # A voxel more or less where a surface passes its corner.
    assert two[4]["voxel_iou"] == pytest.approx(one[4]["voxel_iou"], abs=1e-3)


def test_the_files_are_those_of_one_process(runs: Path) -> None:
    ours, theirs = ({path.name for path in (runs / place / "proposed").iterdir()} for place in ("one", "two"))
    assert theirs - {"evaluation.json"} == ours
    assert len(list((runs / "two" / "proposed" / "tensorboard").iterdir())) == 1


def test_validation_is_that_of_one_process_to_the_bit(runs: Path) -> None:
    said = json.loads((runs / "two" / "proposed" / "evaluation.json").read_text())
    result = evaluate_last(runs / "two" / "proposed")
    assert said == json.loads(json.dumps(result.means | {"ious": result.values["voxel_iou"].tolist()}))
    assert len(said["ious"]) == 24


def test_two_processes_resume_to_the_bit(runs: Path) -> None:
    straight, resumed = (load_file(runs / "two" / name / "last.safetensors") for name in ("adam", "half"))
    assert all(torch.equal(straight[name], resumed[name]) for name in straight)


@pytest.mark.parametrize("name", ["one-then-two", "two-then-one"])
def test_another_number_of_processes_resumes(runs: Path, name: str) -> None:
    assert distance(runs / "one" / "proposed", runs / "two" / name) < 1e-6


def test_processes_that_differ_or_fail_together_leave_no_checkpoint(runs: Path) -> None:
    """What they raise is checked where it is raised, in both processes."""
    for name in ("differ", "nan"):
        assert not (runs / "two" / name / "last.safetensors").exists()


def test_the_error_of_one_process_ends_all(tiny_config, tmp_path) -> None:
    options = {"iterations": 1000, "validate_every": 1000} | SMALL
    task = {"config": config_to_dict(tiny_config(tmp_path / "run", **options)), "fault": "error"}
    (tmp_path / "tasks.json").write_text(json.dumps([task]))
    codes, said = start_processes(TASKS, tmp_path / "tasks.json").wait()
    assert 0 not in codes
    assert "RuntimeError: the cat is on the keyboard" in said[1]
    assert "another process of the run failed, was killed or does not answer" in said[0]


def command(tiny_folder: Path, run_folder: Path) -> list[object]:
    where = ["--data", tiny_folder, "--category", "airplane", "--output", run_folder]
    small = "--batch-size 4 --log-every 1 --encoder conv-small --generator sphere-small"
    return [TRAIN, *where, "--preset", "peng2020-kato-vanilla", *small.split()]


def wait_for_steps(run_folder: Path, process: subprocess.Popen) -> None:
    deadline = time.monotonic() + 120
    metrics = run_folder / "metrics.jsonl"
    while not (metrics.exists() and metrics.stat().st_size) and time.monotonic() < deadline:
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)


@pytest.mark.skipif(os.name != "posix", reason="sends signals to other processes")
def test_a_signal_to_one_stops_all_and_a_killed_one_ends_all(tiny_folder, run_folder) -> None:
    started = start_processes(*command(tiny_folder, run_folder))
    wait_for_steps(run_folder, started.processes[0])
    started.processes[1].send_signal(signal.SIGTERM)
    codes, said = started.wait()
    assert codes == [0, 0], said
    assert "stopped by SIGTERM after step" in said[0]
    assert said[1] == ""
    saved = load_file(run_folder / "last.safetensors")

    (run_folder / "metrics.jsonl").unlink()
    resumed = start_processes(TRAIN, "--output", run_folder, "--resume")
    wait_for_steps(run_folder, resumed.processes[0])
    resumed.processes[1].kill()
    codes, said = resumed.wait(timeout=60)
    assert codes == [1, -signal.SIGKILL], said
    assert f"error: rank 0 on {socket.gethostname()}: another process of the run failed, was killed" in said[0]
    assert all(torch.equal(saved[name], value) for name, value in load_file(run_folder / "last.safetensors").items())


def test_torchrun_reports_what_went_wrong(tmp_path) -> None:
    arguments = ["--data", tmp_path, "--category", "airplane", "--output", tmp_path / "run"]
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    result = subprocess.run([*torchrun, str(TRAIN), *map(str, arguments)], capture_output=True, text=True, timeout=120)
    assert result.returncode == 1
    assert "error: rank " in result.stderr
    assert "02691156_train_images.npz" in result.stderr.split("Root Cause")[1]


RESTARTED = """
import os, time
from learn3d.distributed.launch import init_process_group
first, rank = os.environ["TORCHELASTIC_RESTART_COUNT"] == "0", os.environ["RANK"]
if not first and rank == "1":
    time.sleep(2)  # the other one would find the address that this one had
with init_process_group("cpu") as group:
    if first:
        raise RuntimeError("once more")
    assert group.all_reduce_mean({"value": 1.0}) == {"value": 2.0}
"""


def test_processes_that_torchrun_starts_again_do_not_look_for_those_before_them(tmp_path) -> None:
    (tmp_path / "restarted.py").write_text(RESTARTED)
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command = [*torchrun, "--max-restarts", "1", str(tmp_path / "restarted.py")]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert "once more" in result.stderr
    assert result.returncode == 0, result.stderr
