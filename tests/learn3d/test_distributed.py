"""Two ranks learn what one process learns, and go on after one of them was killed."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import train_ranks
from children import environment
from runs import check_same
from steps import TINY, make_method

from learn3d import distributed
from learn3d.config import TrainConfig, config_to_dict
from learn3d.methods.prgan import PrGANSettings
from learn3d.presets import PRESETS
from learn3d.runs import checkpoint

RUNS = {  # for each: its preset, options, and the bound of relative differences of losses and weights
    "proposed": ("peng2020-kato", TINY, 1e-5),
    "long": (
        "peng2020-kato",
        TINY | {"iterations": 100, "validate_every": 50, "checkpoint_every": 50},
        1e-5,
    ),
    "plus": ("plus-kato", TINY | {"symmetry": "x", "bank_size": 16, "lambda_view": 0.1}, 1e-5),
    "pairs": ("multi-view-kato", TINY, 1e-5),
    "groups": ("many-views-kato", TINY | {"symmetry": "x", "batch_size": 20}, 1e-5),
    "vpl": ("peng2020-kato-vpl", TINY | {"lambda_discriminator": 0.0}, 1e-5),
}
OFTEN = {"log_every": 1, "validate_every": 2, "checkpoint_every": 2, "pictures_every": 4}


def run(tasks: list[dict], path: Path, ranks: int = 1) -> subprocess.CompletedProcess:
    """Run tasks of `train_ranks` in one process or in several ranks."""
    path.write_text(json.dumps(tasks))
    torchrun = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={ranks}"]
    torchrun = torchrun if ranks > 1 else []
    command = [sys.executable, *torchrun, train_ranks.__file__, path]
    return subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=500)


def task(config: TrainConfig, output: Path, **how: object) -> dict:
    return {"config": config_to_dict(dataclasses.replace(config, output=output)), **how}


def losses(metrics: list[dict]) -> dict[int, dict[str, float]]:
    """The losses of each step."""
    named = ("step", "split")
    return {
        line["step"]: {name: value for name, value in line.items() if name not in named}
        for line in metrics
        if line["split"] == "train"
    }


def difference(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> float:
    """The largest |a - b| / |a| over the tensors of the networks."""
    assert one.keys() == other.keys()
    parts = [(a.double(), other[k].double()) for k, a in one.items() if k.startswith("network.")]
    return max(float((a - b).norm() / a.norm().clamp(min=1e-3)) for a, b in parts)


@pytest.fixture(scope="module")
def folders(tiny_config, tmp_path_factory) -> tuple[Path, Path]:
    """Folders of runs in one process and in two ranks."""
    root = tmp_path_factory.mktemp("ranks")
    for ranks in (1, 2):
        tasks = []
        for name, (preset, options, _) in RUNS.items():
            config = tiny_config(root, **{"preset": preset, "batch_size": 8} | OFTEN | options)
            tasks.append(
                task(config, root / str(ranks) / name, rate=1e-4 if name == "long" else 3e-3)
            )
        ended = run(tasks, root / f"{ranks}.json", ranks)
        assert ended.returncode == 0, ended.stderr
    return root / "1", root / "2"


def test_every_method_has_a_run_or_is_refused(monkeypatch) -> None:
    kinds = {type(preset.settings) for preset in PRESETS.values()}
    assert {type(PRESETS[preset].settings) for preset, *_ in RUNS.values()} == kinds - {
        PrGANSettings
    }
    for preset, options in {"gadelha2017-kato": {}, "peng2020-kato-vpl": TINY}.items():
        networks = make_method(preset, **options).networks
        distributed.check_networks(networks)
        with monkeypatch.context() as patch, pytest.raises(ValueError, match="got 2 ranks; start"):
            patch.setattr(distributed, "world_size", lambda: 2)
            distributed.check_networks(networks)


@pytest.mark.parametrize("name", RUNS)
def test_two_ranks_learn_what_one_process_learns(folders, read_metrics, name) -> None:
    bound = RUNS[name][2]
    one, two = (losses(read_metrics(folder / name)) for folder in folders)
    assert list(one) == list(two) == list(range(1, (100 if name == "long" else 4) + 1))
    for step, values in one.items():
        assert two[step] == pytest.approx(values, rel=bound, abs=bound), step
    saved = [checkpoint.load(folder / name / "last.safetensors")[0] for folder in folders]
    assert difference(*saved) < bound
    assert torch.equal(*(tensors["random.cpu"] for tensors in saved)), (
        "random numbers do not depend on the ranks"
    )
    files = [sorted(path.name for path in (folder / name).iterdir()) for folder in folders]
    assert files[0] == files[1]


def test_a_run_continues_with_another_number_of_ranks(
    folders, tiny_config, tmp_path, read_metrics
) -> None:
    config = tiny_config(tmp_path, **TINY | OFTEN, batch_size=8, iterations=6)
    half = dataclasses.replace(config, iterations=4)
    for first in (1, 2):
        output = tmp_path / str(first)
        for ranks, steps, resume in ((first, half, False), (3 - first, config, True)):
            tasks = [task(steps, output, rate=3e-3, resume=resume)]
            ended = run(tasks, tmp_path / "tasks.json", ranks)
            assert ended.returncode == 0, ended.stderr
    one, two = (losses(read_metrics(tmp_path / name)) for name in "12")
    assert list(one) == list(two) == [1, 2, 3, 4, 5, 6]
    for step, values in one.items():
        assert two[step] == pytest.approx(values, rel=1e-5, abs=1e-5)


def test_killed_ranks_leave_a_run_that_goes_on_to_the_same_bits(tiny_config, tmp_path) -> None:
    config = tiny_config(tmp_path, **TINY | OFTEN, batch_size=8, iterations=8)
    ended = run([task(config, tmp_path / "whole")], tmp_path / "tasks.json", 2)
    assert ended.returncode == 0, ended.stderr
    resume = False
    for kill in ([1, 1], [0, 4], [1, 8]):
        tasks = [task(config, tmp_path / "killed", kill=kill, resume=resume)]
        ended = run(tasks, tmp_path / "tasks.json", 2)
        assert ended.returncode == 1
        said = f"rank {1 - kill[0]}: another rank ended or does not answer"
        assert said in ended.stderr and "--resume" in ended.stderr, ended.stderr
        resume = (tmp_path / "killed" / "config.json").exists()
    ended = run([task(config, tmp_path / "killed", resume=resume)], tmp_path / "tasks.json", 2)
    assert ended.returncode == 0, ended.stderr
    check_same(tmp_path / "killed", tmp_path / "whole")


def test_a_batch_that_ranks_cannot_share_is_refused(monkeypatch) -> None:
    assert distributed.own_rows(5, 2).tolist() == [0, 1, 2, 3]
    monkeypatch.setattr(distributed, "world_size", lambda: 2)
    monkeypatch.setattr(distributed, "rank", lambda: 1)
    assert distributed.own_rows(16, 2).tolist() == [4, 5, 6, 7, 12, 13, 14, 15]
    with pytest.raises(ValueError, match="batch_size must be a multiple of 8 for 2 ranks"):
        distributed.own_rows(12, 2)
