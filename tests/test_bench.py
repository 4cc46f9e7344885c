"""tools/bench/bench.py: every program does the same work, and each workload runs."""

import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent.parent / "tools" / "bench"))

import bench
import bench_peers
import bench_work


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


@pytest.mark.skipif(not bench_peers.has_deodr(), reason="deodr is not installed")
def test_deodr_must_draw_what_we_draw(monkeypatch):
    spheres = bench_work.deformed_spheres(2, 3, 64, outputs=("depth",))
    with ExitStack() as stack:
        (program,) = bench_peers.deodr_programs(spheres, spheres.targets(), 1, stack).values()
        assert 0 < program()[0]
        monkeypatch.setattr(bench_peers, "deodr_mesh", lambda faces, make=bench_peers.deodr_mesh: make(faces.flip(1)))
        with pytest.raises(SystemExit, match="nmr and deodr draw different images"):  # the far side
            bench_peers.deodr_programs(spheres, spheres.targets(), 1, stack)


@pytest.mark.parametrize(("workload", "rows"), [("w1", 2), ("w4", 2), ("colors", 7), ("voxels", 1)])
def test_every_program_of_a_workload_is_timed(command, capsys, workload, rows):
    assert command(workload, "--batch", 2, "--repeats", 1) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.count(".") == 4]
    assert len(lines) == rows
    for line in lines:
        forward, total, fastest, ratio = map(float, line.split()[-4:])
        assert 0 <= forward <= total == fastest and ratio > 0


def test_the_table_of_peers_names_all_and_measures_those_that_are_there(monkeypatch, capsys):
    def blurred(work):
        row = bench_peers._depth(work, "none", lambda: torch.zeros(1, work.size, work.size))
        return replace(row, theirs=lambda v: row.ours(v) + shift)

    monkeypatch.setattr(bench_peers, "PEERS", (*((make, 2, 64) for make, *_ in bench_peers.PEERS), (blurred, 1, 16)))
    shift = 0.0
    bench_peers.print_table(1)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 7 and "depth, 80 faces, 16 px | none" in lines[-1] and all(x.count("|") >= 5 for x in lines)
    shift = 0.01
    with pytest.raises(SystemExit, match=r"nmr and none .* draw different images"):
        bench_peers.print_table(1)


def test_unknown_workloads_are_named(command, capsys):
    assert command("al") == 1 and "did you mean 'all'?" in capsys.readouterr().err


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
