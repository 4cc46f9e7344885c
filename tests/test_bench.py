"""tools/bench: every program does the same work, and each workload runs."""

import importlib.util
import re
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent.parent / "tools" / "bench"))

import bench
import peers


@pytest.mark.skipif(importlib.util.find_spec("deodr") is None, reason="deodr is not installed")
def test_deodr_must_draw_what_we_draw(monkeypatch):
    work = bench.spheres(2, 3, 64, output="depth")
    with ExitStack() as stack:
        (program,) = bench.deodr_programs(work, 1, stack).values()
        assert 0 < program()[0]
        monkeypatch.setattr(
            bench,
            "deodr",
            lambda work, draw=bench.deodr: draw(replace(work, faces=work.faces.flip(1))),
        )
        with pytest.raises(SystemExit, match="nmr and deodr draw different images"):  # the far side
            bench.deodr_programs(work, 1, stack)


@pytest.mark.parametrize(
    ("workload", "rows"), [("w1", 2), ("w4", 2), ("white", 2), ("uv-lights", 4), ("voxels", 1)]
)
def test_every_program_of_a_workload_is_timed(monkeypatch, capsys, workload, rows):
    threads = torch.get_num_threads()
    monkeypatch.setattr(bench.importlib.util, "find_spec", lambda name: None)  # without deodr
    monkeypatch.setattr(sys, "argv", ["bench.py", workload, "--batch", "2", "--repeats", "1"])
    bench.main()
    torch.set_num_threads(threads)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.count(".") == 4]
    assert len(lines) == rows
    for line in lines:
        forward, total, fastest, ratio = map(float, line.split()[-4:])
        assert 0 <= forward <= total == fastest and ratio >= 0  # 0.0 if a neighbour takes the core


@pytest.mark.parametrize("kind", bench.COLORS)
def test_every_kind_of_colour_draws_its_own_image_and_reaches_its_values(kind):
    work = bench.spheres(2, 3, 32, output="rgb", colors=kind)
    leaves = [
        leaf.clone().requires_grad_() for leaf in (work.vertices, work.values) if leaf is not None
    ]
    image = work.draw(*leaves)
    (image - 0.5).square().mean().backward()
    assert all(leaf.grad.any() for leaf in leaves)
    inner = image[:, 15:17, 15:17].detach()
    assert torch.equal(inner, torch.ones_like(inner)) == (kind == "white")
    unlit = bench.spheres(2, 3, 32, output="rgb", colors="uv")
    assert torch.equal(image.detach(), unlit.draw(work.vertices)) == (kind == "uv")


def test_peers_are_timed_if_they_are_installed_and_draw_the_same(monkeypatch, capsys) -> None:
    def absent(work: bench.Work) -> None:
        raise ModuleNotFoundError("No module named 'absent'")

    same, options = (lambda work: (work.draw, work.draw)), {"subdivisions": 1, "size": 32}
    itself = peers.Peer(same, options, "pip install itself")
    monkeypatch.setattr(peers, "PEERS", {"itself": itself, "absent": itself._replace(make=absent)})
    peers.main(repeats=1)
    row = r"alpha \| 80 \| 32x32 \| vertices \| 1 \| "
    rows = rf"\| itself \| {row}[\d.]+ \| [\d.]+ \| .*\n\| absent \| {row}not measured \(ModuleNotFoundError"
    assert re.search(rows, capsys.readouterr().out)
    other = itself._replace(make=lambda work: (work.draw, lambda _: torch.zeros(1, 32, 32)))
    monkeypatch.setattr(peers, "PEERS", {"other": other})
    with pytest.raises(SystemExit, match="nmr and other draw different images"):
        peers.main(repeats=1)
