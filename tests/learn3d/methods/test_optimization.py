"""Losses, Adam, schedules and averages of the weights, and runs of every method with them."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import get_args

import pytest
import torch
from runs import same_tensors, stop_and_resume
from steps import TINY, TINY_PRGAN, TINY_VPL, make_method
from torch import nn
from torch.optim.swa_utils import AveragedModel

from learn3d import training
from learn3d.evaluation import evaluate
from learn3d.methods import _METHODS
from learn3d.methods.method import Method
from learn3d.methods.optimization import EMA, LRSchedule, TrainingSchedule, adam
from learn3d.presets import PRESETS
from learn3d.runs import checkpoint
from learn3d.training import train

#: A run of each method with tiny networks.
TINY_RUNS = {
    "proposed": TINY,
    "plus": TINY | {"preset": "plus-kato", "bank_size": 8},
    "multi-view": TINY | {"preset": "multi-view-kato"},
    "many-views": TINY | {"preset": "many-views-kato", "batch_size": 10},
    "vpl": TINY_VPL | {"preset": "peng2020-kato-vpl"},
    "prgan": TINY_PRGAN | {"preset": "gadelha2017-kato"},
}


class Scripted:
    """A method of one parameter, x = 3, whose steps have the phases that a test gives."""

    schedule = TrainingSchedule(10, "linear")
    ema = None

    def __init__(self, *phases: tuple[str, ...]) -> None:
        self.x = torch.tensor(3.0, requires_grad=True)
        self.optimizers = {name: torch.optim.SGD([self.x], lr=0.1) for name in ("first", "second")}
        self.phases = lambda batch, step: ((self.losses(names), (name,)) for name, names in phases)
        self.seen = []

    def losses(self, names: tuple[str, ...]) -> dict[str, tuple[float, torch.Tensor]]:
        self.seen.append(float(self.x))
        known = {"b": (1.0, self.x.square()), "a": (0.5, 2 * self.x), "c": (0.0, -self.x)}
        return {name: known.get(name, (1e-3, self.x * torch.inf)) for name in names}


def test_losses_are_weighted_added_up_and_returned_in_their_order() -> None:
    method = Scripted(("first", ("b", "a", "c")))
    values = training.take_step(method, None, 1)
    assert list(values.items()) == [("b", 9.0), ("a", 6.0), ("c", -3.0), ("total", 12.0)]
    assert float(method.x) == pytest.approx(3 - 0.1 * 7)
    assert method.x.grad is None


def test_phases_follow_each_other_and_the_schedule() -> None:
    method = Scripted(("first", ("a",)), ("second", ("b",)))
    values = training.take_step(method, None, 6)  # the learning rate is half of 0.1
    assert method.seen == pytest.approx([3.0, 2.95])
    assert values == pytest.approx({"a": 6.0, "b": 2.95**2, "total": 3 + 2.95**2})
    assert float(method.x) == pytest.approx(2.95 - 0.05 * 2 * 2.95)


@pytest.mark.parametrize("names", [("infinite", "a"), ("a", "infinite")])
def test_a_loss_that_is_not_finite_stops_before_any_gradient(names: tuple[str, str]) -> None:
    method = Scripted(("first", names))
    with pytest.raises(FloatingPointError, match=r"iteration 7 .*infinite inf"):
        training.take_step(method, None, 7)
    assert method.x.grad is None


def test_a_method_without_losses_says_so() -> None:
    with pytest.raises(NotImplementedError, match="Scripted must define losses"):
        Method.losses(Scripted(), None, 1)


def test_moments_of_dead_units_vanish_and_change_no_weight() -> None:
    """One gradient, then zeros: torch's own moments become denormal and stay so, ours become 0. Weights are equal."""
    layer = nn.Linear(8, 8)
    other = nn.Linear(8, 8)
    other.load_state_dict(layer.state_dict())
    ours, theirs = adam(layer, 1e-3), torch.optim.Adam(other.parameters(), lr=1e-3, fused=True)
    gradient = torch.logspace(-12, 3, 64).view(8, 8)
    for step in range(2000):
        for optimizer, network in ((ours, layer), (theirs, other)):
            network.weight.grad = gradient if step == 0 else torch.zeros(8, 8)
            network.bias.grad = torch.randn(8, generator=torch.Generator().manual_seed(step))
            optimizer.step()
    torch.testing.assert_close(layer.state_dict(), other.state_dict(), rtol=0, atol=0)
    smallest = torch.finfo(torch.float32).tiny
    assert (theirs.state[other.weight]["exp_avg"].abs() < smallest).sum() > 32
    for moment in ("exp_avg", "exp_avg_sq"):
        assert ours.state[layer.bias][moment].all()
        stuck = ours.state[layer.weight][moment]
        assert stuck[(stuck.abs() < smallest)].count_nonzero() == 0
    assert ours.state[layer.weight]["exp_avg"].count_nonzero() == 0


def test_schedules() -> None:
    def factors(**schedule: object) -> list[float]:
        return [TrainingSchedule(4, **schedule).lr_factor(step) for step in (1, 2, 3, 4)]

    assert factors() == [1, 1, 1, 1]
    assert factors(lr_schedule="linear") == [1, 0.75, 0.5, 0.25]
    cosine = [(1 + math.cos(math.pi * k / 4)) / 2 for k in range(4)]
    assert factors(lr_schedule="cosine") == pytest.approx(cosine)
    assert factors(warmup_steps=2) == [0.5, 1, 1, 1]
    assert factors(warmup_steps=2, lr_schedule="linear") == [0.5, 1, 1, 0.5]
    for name in get_args(LRSchedule):
        TrainingSchedule(4, name)
    published = TrainingSchedule(200_000, "step")
    rates = [published.lr_factor(step) for step in (1, 190_000, 190_001, 200_000)]
    assert rates == [1, 1, 0.1, 0.1]
    with pytest.raises(ValueError, match="the schedule 'cubic' has no branch"):
        factors(lr_schedule="cubic")
    with pytest.raises(ValueError, match="warmup_steps"):
        TrainingSchedule(10, warmup_steps=10)


def test_the_average_is_that_of_torch() -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4))
    average = EMA(nn.ModuleDict({"net": network}), decay=0.5)

    def lerp(old: torch.Tensor, new: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        return old + (new - old) * (1 - min(0.5, (1 + step) / (10 + step)))

    reference = AveragedModel(network, avg_fn=lerp, use_buffers=True)
    reference.update_parameters(network)  # begins with the first weights
    for step in range(1, 12):
        with torch.no_grad():
            for parameter in network.parameters():
                parameter += torch.randn_like(parameter)
        network(torch.randn(6, 3))  # changes the statistics
        average.update(step)
        reference.update_parameters(network)
    wanted = {f"net.{name}": value for name, value in reference.module.state_dict().items()}
    wanted["net.1.num_batches_tracked"] = torch.tensor(11)
    torch.testing.assert_close(average.tensors, wanted, atol=1e-5, rtol=1e-5)

    own, averaged = copy.deepcopy(network.state_dict()), copy.deepcopy(average.tensors)
    with average.in_place():
        same_tensors({f"net.{name}": t for name, t in network.state_dict().items()}, averaged)
    same_tensors(network.state_dict(), own)
    same_tensors(average.tensors, averaged)


def test_steps_follow_the_schedule_and_ignore_the_average(tiny_names, tiny_set) -> None:
    ends = []
    for average in (0.0, 0.9):
        schedule = TrainingSchedule(4, "linear", ema_decay=average)
        method = make_method("peng2020-kato", schedule=schedule, **TINY, learning_rate=1e-3)
        for step in (1, 2, 3):
            training.take_step(method, tiny_set.batch(torch.arange(4)), step)
            rates = [o.param_groups[0]["lr"] for o in method.optimizers.values()]
            assert rates == [1e-3 * (1 - (step - 1) / 4)] * 3
            with method.in_use():
                assert not method.networks.training
                method.encode(tiny_set.batch(torch.arange(2)).images)
        ends.append(method.networks.state_dict())
    same_tensors(*ends)


def test_every_method_has_a_tiny_run() -> None:
    presets = {run.get("preset", "peng2020-kato") for run in TINY_RUNS.values()}
    assert {type(PRESETS[name].settings) for name in presets} == set(_METHODS), (
        "add a run to TINY_RUNS"
    )


@pytest.mark.parametrize("name", TINY_RUNS)
def test_a_run_with_schedule_and_average_resumes_bit_for_bit(
    name: str, tiny_names, tiny_config, tmp_path: Path
) -> None:
    options = TINY_RUNS[name] | {
        "lr_schedule": "cosine",
        "warmup_steps": 1,
        "ema_decay": 0.8,
        "validate_every": 2,
    }
    train(tiny_config(tmp_path / "straight", **options))
    stop_and_resume(tiny_config(tmp_path / "stopped", **options), 2)
    for file in ("last", "best"):
        runs = (tmp_path / "straight", tmp_path / "stopped")
        same_tensors(*(checkpoint.load(run / f"{file}.safetensors")[0] for run in runs))
    straight, stopped = ((run / "metrics.jsonl").read_text() for run in runs)
    assert straight == stopped


def test_what_a_run_is_evaluated_with_is_the_average(
    tiny_names, tiny_config, tmp_path: Path
) -> None:
    train(tiny_config(tmp_path, **TINY, ema_decay=0.8, validate_every=4, learning_rate=1e-2))
    last, best = (checkpoint.load(tmp_path / f"{file}.safetensors")[0] for file in ("last", "best"))
    averages, own, selected = (
        {key.removeprefix(kind): t for key, t in tensors.items() if key.startswith(kind)}
        for tensors, kind in ((last, "ema."), (last, "network."), (best, "network."))
    )
    loaded, config, _ = checkpoint.load_method(tmp_path / "last.safetensors")
    same_tensors(loaded.networks.state_dict(), averages)
    measured = evaluate(loaded, checkpoint.load_data(config, "val"), max_images=4).means
    records = map(json.loads, (tmp_path / "metrics.jsonl").read_text().splitlines())
    (validation,) = (record for record in records if record["split"] == "val")
    assert validation == {"step": 4, "split": "val"} | measured, "during the training, too"
    same_tensors(selected, averages)
    assert not any(name.startswith("ema.") for name in best)
    assert any(not torch.equal(own[name], value) for name, value in averages.items())


def test_a_schedule_keeps_the_number_of_iterations(tiny_names, tiny_config, tmp_path: Path) -> None:
    train(tiny_config(tmp_path, **TINY, lr_schedule="linear"))
    with pytest.raises(ValueError, match="iterations"):
        train(tiny_config(tmp_path, **TINY, lr_schedule="linear", iterations=6), resume=True)
