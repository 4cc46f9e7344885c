"""What fits the processor: the precision, the layout of images, and one thread or all by the time of the steps."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from steps import make_method

from learn3d import device
from learn3d.device import TRIAL, ThreadTuner, resolve_precision
from learn3d.runs import checkpoint
from learn3d.training import train


@pytest.fixture
def many_cores(monkeypatch) -> None:
    """A machine of 16 cores on which nothing fixes the number of threads."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 16)
    monkeypatch.setattr(torch, "set_num_threads", lambda count: None)


def run(tuner: ThreadTuner, steps: int, seconds: Callable[[int], float]) -> list[str]:
    """Take steps whose duration depends on the number of threads; returns the lines for the log."""
    return [line for _ in range(steps) if (line := tuner.after_step(seconds(tuner.threads)))]


def quiet(count: int) -> float:
    return 0.4 / count


def busy(count: int) -> float:
    return 0.9 if count > 1 else 0.06


@pytest.mark.parametrize(
    ("seconds", "chosen", "line"),
    [
        (quiet, 16, "threads: 16 (25 ms a step; with 1: 400 ms a step); --threads fixes it"),
        (busy, 1, "threads: 1 (60 ms a step; with 16: 900 ms a step); --threads fixes it"),
    ],
)
def test_the_faster_of_one_and_all_is_taken(many_cores, seconds, chosen: int, line: str) -> None:
    tuner = ThreadTuner(None)
    assert (str(tuner), tuner.chosen) == ("16 threads or 1, whichever is faster", None)
    run(tuner, 1, lambda count: 60.0)  # the first step, which prepares everything, does not count
    assert run(tuner, 2 * TRIAL - 1, seconds) == [line]
    assert (tuner.threads, tuner.chosen, str(tuner)) == (
        chosen,
        chosen,
        {1: "1 thread", 16: "16 threads"}[chosen],
    )
    assert run(tuner, 500, lambda count: 60.0) == [], "later steps change nothing"


@pytest.mark.parametrize(("fixed", "count"), [("option", 4), ("environment", 16), ("core", 1)])
def test_a_fixed_number_stays(many_cores, monkeypatch, fixed: str, count: int) -> None:
    if fixed == "environment":
        monkeypatch.setenv("OMP_NUM_THREADS", "16")
    if fixed == "core":
        monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    tuner = ThreadTuner(4 if fixed == "option" else None)
    tuner.resume(2)
    assert run(tuner, 100, busy) == []
    assert (tuner.threads, tuner.chosen) == (count, None)


def test_a_resumed_run_keeps_its_number(tiny_run, run_folder, monkeypatch, capsys) -> None:
    """The number is in the checkpoint, and is not tried again while the machine has as many cores."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    used, after_step = [], ThreadTuner.after_step
    monkeypatch.setattr(torch, "set_num_threads", used.append)

    def slow_with_two(tuner: ThreadTuner, seconds: float) -> str:
        return after_step(tuner, seconds + 100 * (used[-1] == 2))

    monkeypatch.setattr(ThreadTuner, "after_step", slow_with_two)
    train(tiny_run(run_folder, iterations=2 * TRIAL, threads=None))
    assert used == [2, 1, 1, 2], "a training leaves the number of the process"
    assert checkpoint.load_metadata(run_folder).progress.threads == 1
    assert "threads: 1 (" in capsys.readouterr().err
    used.clear()
    train(tiny_run(run_folder, iterations=2 * TRIAL + 3, threads=None), resume=True)
    assert used == [2, 1, 2], "all while the data are read, then the number of the checkpoint"
    monkeypatch.setattr(torch, "get_num_threads", lambda: 4)
    train(tiny_run(run_folder, iterations=2 * TRIAL + 4, threads=3), resume=True)
    assert used[-2:] == [3, 4], "unless another one is asked for"


@pytest.mark.parametrize(
    ("vendor", "flags", "wanted"),
    [
        ("AuthenticAMD", "fpu avx512_bf16", "bf16"),
        ("GenuineIntel", "fpu avx512_bf16", "fp32"),
        ("GenuineIntel", "avx512_bf16 amx_bf16", "bf16"),
        ("AuthenticAMD", "avx2", "fp32"),
    ],
)
def test_auto_precision_follows_the_cpu(monkeypatch, tmp_path, vendor, flags, wanted) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(f"vendor_id : {vendor}\nmodel name : x\nflags\t\t: {flags}\n")
    monkeypatch.setattr(device, "CPUINFO", str(cpuinfo))
    assert resolve_precision("auto", "cpu") == wanted
    assert resolve_precision("fp32", "cpu") == "fp32"
    monkeypatch.setattr(device, "CPUINFO", str(tmp_path / "missing"))
    assert resolve_precision("auto", "cpu") == "fp32"


@pytest.mark.parametrize(
    ("capability", "layout"),
    [("AVX512", torch.channels_last), ("AVX2", torch.contiguous_format)],
)
def test_convolutions_in_fp32_have_the_faster_layout(monkeypatch, capability, layout) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    method = make_method("peng2020-kato")
    assert method.memory_format is layout
    assert method.encoder.convolutions[0].weight.is_contiguous(memory_format=layout)
