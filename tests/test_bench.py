"""tools/bench/bench.py: every program does the same work, and the table tells a missed target."""

import json
import mmap
import sys
import time
from pathlib import Path

import pytest
import torch

import nmr
from learn3d.presets import PRESETS

sys.path.insert(0, str(Path(__file__).parent.parent / "tools" / "bench"))

import bench
import bench_memory
import bench_peers
import bench_step
import bench_work

needs_deodr = pytest.mark.skipif(not bench_peers.has_deodr(), reason="deodr is not installed")


@pytest.fixture
def command(monkeypatch):
    """Calls bench.main with arguments; without deodr, and torch keeps its threads."""
    threads = torch.get_num_threads()
    monkeypatch.setattr(bench_peers, "has_deodr", lambda: False)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["bench.py", *map(str, arguments)])
        bench.main()

    yield call
    torch.set_num_threads(threads)


@needs_deodr
def test_deodr_must_draw_what_we_draw():
    spheres = bench_work.deformed_spheres(2, 3, 64, True, ("depth",))
    bench_peers.check_same_image(spheres, bench_peers.deodr_mesh(spheres.faces))
    with pytest.raises(SystemExit, match="different images"):
        bench_peers.check_same_image(spheres, bench_peers.deodr_mesh(spheres.faces.flip(1)))  # the far side


@needs_deodr
def test_deodrs_depth_has_our_gradient():
    spheres = bench_work.deformed_spheres(1, 3, 64, False, ("depth",))
    vertices, mesh = spheres.camera.transform(spheres.vertices), bench_peers.deodr_mesh(spheres.faces)
    inner = torch.zeros(1, 64, 64)
    inner[:, 24:40, 24:40] = 1
    grads = []
    for draw in (
        lambda leaf: nmr.render_depth(leaf, spheres.faces, image_size=64, anti_aliasing=False),
        lambda leaf: bench_peers.DeodrImages.apply(leaf, 64, mesh, "depth"),
    ):
        leaf = vertices.clone().requires_grad_()
        draw(leaf).backward(inner)
        grads.append(leaf.grad[..., 2].flatten())
    assert torch.corrcoef(torch.stack(grads))[0, 1] > 0.98


class SlowBackward(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return 2 * x

    @staticmethod
    def backward(ctx, grad):
        time.sleep(0.01)
        return 2 * grad


def test_the_stopwatch_times_both_ways_and_changes_no_gradient():
    watch = bench_step.Stopwatch()
    x = torch.ones(3, requires_grad=True)
    y = watch.timed("slow", SlowBackward.apply)(x)
    watch.timed("sum", torch.sum)(y * y).backward()
    assert x.grad.tolist() == [8.0, 8.0, 8.0]
    assert watch.seconds["slow", "backward"] >= 0.01
    assert set(watch.seconds) == {(part, way) for part in ("slow", "sum") for way in ("forward", "backward")}


@pytest.mark.skipif(not bench_memory.STATUS.exists(), reason="only Linux has /proc")
def test_the_peak_is_no_less_than_what_is_there():
    before = bench_memory.resident("VmRSS")
    block = mmap.mmap(-1, 1 << 25)  # new pages: an allocator may hand out old ones
    block.write(bytes([1]) * len(block))
    assert bench_memory.resident("VmRSS") - before > 0.9 * len(block)
    assert bench_memory.resident("VmHWM") >= 0.99 * bench_memory.resident("VmRSS")


def result(key, *programs):
    rows = [bench_work.Row(name, None, total, total / 2) for name, total in programs]
    return bench_work.Result(key, f"workload {key}", rows)


def test_the_table_marks_what_misses_its_target():
    fast = result("w3", ("nmr, 2 threads", 7.9), ("deodr, 1 process", 11.6))
    slow = result("w4, 64", ("nmr, 2 threads", 8.1), ("nmr, 2 threads, both", 20.0), ("deodr", 51.6))
    other = result("cameras", ("nmr, 2 threads", 1000.0))
    assert list(map(bench.missed, (fast, slow, other))) == [False, True, False]
    assert bench.markdown([fast, slow, other]).splitlines()[2:] == [
        "| workload w3 | **7.90** ms (2 threads); fastest 3.95 | deodr, 1 process 11.6 | <= 8 ms |",
        "| workload w4, 64 | **8.10** ms (2 threads); fastest 4.05 | deodr 51.6 | <= 8 ms: missed |",
        "|  | **20.00** ms (2 threads, both); fastest 10.00 | - | - |",
        "| workload cameras | **1000.00** ms (2 threads); fastest 500.00 | - | - |",
    ]


def test_a_missed_target_is_exit_code_1(command, monkeypatch, capsys):
    monkeypatch.setattr(bench, "bench_all", lambda options: [result("w2", ("nmr", 12.1))])
    with pytest.raises(SystemExit, match=r"targets missed:\nworkload w2: 12\.10 > 12 "):
        command("all")
    monkeypatch.setattr(bench, "bench_all", lambda options: [result("w2", ("nmr", 11.9))])
    command("all")


def test_commands(command, tmp_path):
    for workload in ("w1", "w4"):
        command(workload, "--batch", 2, "--repeats", 1, "--json", tmp_path / "figures.json")
        (figures,) = json.loads((tmp_path / "figures.json").read_text())
        assert figures["key"] == f"{workload}, 2" and figures["settings"]["batch"] == 2
        assert all(row["total"] > row["forward"] > 0 for row in figures["rows"])


def test_a_part_within_a_part_counts_once():
    watch = bench_step.Stopwatch()
    inner = watch.timed("inner", lambda: time.sleep(0.02))
    watch.timed("outer", lambda: (inner(), time.sleep(0.005)))()
    assert watch.seconds["inner", "forward"] >= 0.02
    assert 0.005 <= watch.seconds["outer", "forward"] < 0.02


@pytest.mark.parametrize("preset", ["peng2020-kato", "peng2020-kato-vpl", "kato2018-kato"])
def test_the_parts_of_a_step_are_the_step(preset):
    options = bench_step.StepOptions(preset=preset, batch=4, repeats=1, threads=1)
    _, steps, _ = bench_step.measure_steps(options, ["fp32"])
    (parts,) = steps["fp32"]
    whole = parts.pop(("step", "forward"))
    assert sum(parts.values()) == pytest.approx(whole)
    assert all(seconds >= 0 for seconds in parts.values())
    names = {part for part, _ in parts}
    wanted = {"data: samples", "data: batch", "data: augmentation", "images to floats", "camera", "rendering"}
    wanted |= {"projection loss", "smoothness", "logging", "networks: encoder", "networks: generator"}
    assert wanted | {"networks: backward", bench_step.REST} <= names
    for part in ("camera", "rendering", "projection loss", "smoothness", "networks: backward"):
        assert parts[part, "backward"] > 0, part


def test_steps_of_every_preset_can_be_prepared():
    for name, preset in PRESETS.items():
        config, dataset, tensors = bench_step.prepare(bench_step.StepOptions(preset=name, batch=2))
        assert dataset.image_size == preset.settings.image_size and tensors is None and config.batch_size == 2


def test_step_and_evaluation_say_what_they_measured(command, capsys, tmp_path):
    common = ("--batch", 4, "--repeats", 1, "--threads", 1)
    command("step", *common, "--json", tmp_path / "step.json")
    text = capsys.readouterr().out
    assert "sum of the parts" in text and "all else, in % of the networks" in text
    (figures,) = json.loads((tmp_path / "step.json").read_text())
    assert figures["unit"] == "% of the networks" and len(figures["rows"]) == 2
    command("evaluation", *common, "--clock", "cpu")
    assert "16800 images every 2000 steps" in capsys.readouterr().out
