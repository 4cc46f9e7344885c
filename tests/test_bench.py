"""tools/bench/bench.py: every program does the same work, and the table tells a missed target."""

import mmap
import sys
from pathlib import Path

import pytest
import torch

import nmr

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
        return bench.main()

    yield call
    torch.set_num_threads(threads)


@needs_deodr
def test_deodr_must_draw_what_we_draw():
    spheres = bench_work.deformed_spheres(2, 3, 64, outputs=("depth",))
    bench_peers.check_same_image(spheres, bench_peers.deodr_mesh(spheres.faces))
    with pytest.raises(SystemExit, match="different images"):
        bench_peers.check_same_image(spheres, bench_peers.deodr_mesh(spheres.faces.flip(1)))  # the far side


@needs_deodr
def test_deodrs_depth_has_our_gradient():
    spheres = bench_work.deformed_spheres(1, 3, 64, anti_aliasing=False, outputs=("depth",))
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
    fast = result("w3", ("nmr, 2 threads", 2.0), ("deodr, 1 process", 11.6))
    slow = result("w4, 64", ("nmr, 2 threads", 8.0), ("nmr, 2 threads, both", 20.0), ("deodr, 2 processes", 24.0))
    alone = result("w1, 64", ("nmr, 2 threads", 8.0))  # without deodr there is nothing to miss
    other = result("voxels", ("nmr, 2 threads", 1000.0))
    assert list(map(bench.missed, (fast, slow, alone, other))) == [False, True, False, False]
    assert bench.markdown([fast, slow, other]).splitlines()[2:] == [
        "| workload w3 | **2.00** ms (2 threads); fastest 1.00 | deodr, 1 process 11.6 (5.80 x) "
        "| >= 5 x deodr, 1 process |",
        "| workload w4, 64 | **8.00** ms (2 threads); fastest 4.00 | deodr, 2 processes 24.0 (3.00 x) "
        "| >= 6 x deodr, 2 processes: missed |",
        "|  | **20.00** ms (2 threads, both); fastest 10.00 | - | - |",
        "| workload voxels | **1000.00** ms (2 threads); fastest 500.00 | - | - |",
    ]


def test_a_missed_target_is_exit_code_1(command, monkeypatch, capsys):
    late = [result("step", ("nmr, all", 8.1)), result("w2", ("nmr, 2", 5.0), ("deodr, 1 process", 39.0))]
    monkeypatch.setitem(bench.TABLES, "all", lambda options: late)
    with pytest.raises(SystemExit, match=r"missed:\nworkload step: 8\.10, not <= 8\nworkload w2: 7\.80, not >= 8 x "):
        command("all")
    monkeypatch.setitem(bench.TABLES, "all", lambda options: [result("step", ("nmr, all", 7.9))])
    assert command("all") == 0
    assert command("al") == 1 and "did you mean 'all'?" in capsys.readouterr().err


@pytest.mark.parametrize("workload", ["w1", "w4", "two-threads", "voxels"])
def test_rows_of_the_table(command, capsys, workload):
    command(workload, "--batch", 2, "--repeats", 1)
    ours = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("nmr"))
    forward, total, fastest, ratio = map(float, ours.split()[-4:])
    assert 0 < forward < total == fastest < 10_000 and ratio == 1


def test_colors_are_drawn_with_one_thread_and_checked_against_their_targets(command, monkeypatch, capsys):
    for kind in bench.COLORS:
        monkeypatch.setitem(bench.TARGETS, f"colors {kind}", bench.Target(0 if kind == "uv" else 1e6))
    with pytest.raises(SystemExit, match=r"^targets missed:\nColours: 2 meshes.*texture images of 128x128, forward.*$"):
        command("colors", "--batch", 2, "--repeats", 1, "--threads", 2)
    shown, table = capsys.readouterr().out.split("| target |\n|---|---|---|---|\n")
    assert shown.count("\nthreads 1, batch 2") == 4 and table.count("colours learned, too") == 3
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize("kind", bench.COLORS)
def test_every_kind_of_colour_draws_its_own_image_and_reaches_its_values(kind):
    workload = bench_work.colored_spheres(kind, 2, 32)
    vertices = workload.vertices.clone().requires_grad_()
    values = None if kind == "white" else workload.values.clone().requires_grad_()
    (image,) = workload.images(vertices, values)
    (image - 0.5).square().mean().backward()
    assert vertices.grad.any() and (values is None or values.grad.any())
    inner = image[:, 15:17, 15:17].detach()
    assert torch.equal(inner, torch.ones_like(inner)) == (kind == "white")
    (unlit,) = bench_work.colored_spheres("uv", 2, 32).images(workload.vertices)
    assert torch.equal(image.detach(), unlit) == (kind == "uv")


def test_step_says_its_parts(command, capsys):
    command("step", "--batch", 4, "--repeats", 1, "--threads", 1)
    assert capsys.readouterr().out.count("ms of a step of") == 2, "in either precision"


def test_networks_whose_shapes_are_not_rendered_have_the_same_to_do():
    config, dataset = bench_step.proposed(2, num_objects=2)
    method = bench_step.build(config, dataset, "fp32")
    bench_step.stop_rendering(method)
    before = {name: value.clone() for name, value in method.generator.named_parameters()}
    method.take_step(dataset.batch(torch.tensor([0, 30]), voxels=False), 1)
    assert all(not torch.equal(value, before[name]) for name, value in method.generator.named_parameters())
