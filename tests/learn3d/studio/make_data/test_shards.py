"""Shards made by several processes: the same objects as from one process, also after kills and with bad meshes."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import subprocess
import sys
import time

import pytest
import stub_work
import torch
from lopsided_meshes import write_meshes
from runs import contents

from learn3d import tasks
from learn3d.data.conventions import has_shards
from learn3d.data.layouts import load_dataset
from learn3d.studio.make_data import render
from learn3d.studio.make_data.render import DatasetConfig, make_dataset
from learn3d.tasks import Workers

MAKE = """
import sys
from learn3d import commands
from learn3d.studio.make_data import render
render.OBJECTS_PER_SHARD = 2
if __name__ == "__main__":
    sys.exit(commands.main("make-dataset", *sys.argv[1:]))
"""
NUMBERS = {"category": "chair", "procedural": 4, "augment": 1, "test": 1, "val": 1}


@pytest.fixture
def config(tmp_path, monkeypatch) -> DatasetConfig:
    """Two objects in a shard: two shards to train on, one each to validate and to test."""
    monkeypatch.setattr(render, "OBJECTS_PER_SHARD", 2)
    return DatasetConfig(output=tmp_path / "shards", **NUMBERS, shards=True, workers=Workers(2))


@pytest.fixture
def here(monkeypatch) -> None:
    """Shards are made in this process: starting Python and torch takes seconds."""
    monkeypatch.setattr(tasks, "run_tasks", stub_work.run_tasks_here)


def test_the_objects_and_the_report_are_those_of_one_process(config, tmp_path, capsys) -> None:
    report = make_dataset(DatasetConfig(output=tmp_path / "one", **NUMBERS))
    assert render.make_shards(config) == 0
    out, err = capsys.readouterr()
    assert [*out.splitlines()[:2], "[4/4] " in err] == [*report.text().splitlines()[:2], True]
    assert "train 1: 2 objects" in (config.output / "03001627" / "train-00001.log").read_text()
    one, other = (folder / "03001627_contact.png" for folder in (tmp_path / "one", config.output))
    assert one.read_bytes() == other.read_bytes()
    for split in ("train", "val", "test"):
        one, other = (
            load_dataset("kato", f, "chair", split) for f in (tmp_path / "one", config.output)
        )
        every = torch.arange(len(one))
        assert len(one) == len(other) and torch.equal(
            one.batch(every).images, other.batch(every).images
        )
        assert torch.equal(one.batch(every).voxels, other.batch(every).voxels)


def test_a_second_call_makes_nothing_and_other_settings_are_refused(config, here, capsys) -> None:
    assert render.make_shards(config) == 0
    before = contents(config.output, "*/*/*")
    assert render.make_shards(config) == 0
    assert "4 shards, 0 to be made" in capsys.readouterr().err
    assert contents(config.output, "*/*/*") == before
    with pytest.raises(ValueError, match="were made with another seed; repeat those settings"):
        render.make_shards(dataclasses.replace(config, seed=1))
    photograph = config.output / "03001627" / "photograph.png"
    photograph.write_bytes(b"mine")
    assert render.make_shards(dataclasses.replace(config, seed=1, overwrite=True)) == 0
    assert photograph.read_bytes() == b"mine", "only shards are replaced"
    assert contents(config.output, "*/*/*") != before


def test_bad_meshes_are_listed_and_another_list_of_meshes_is_refused(
    tmp_path, here, capsys
) -> None:
    """The order of the meshes decides which of them are kept for the test."""
    (tmp_path / "meshes").mkdir()
    folder = write_meshes(tmp_path / "meshes")
    for name in ("a.obj", "zz.ply"):
        (folder / name).write_text("v 0 0\n")
    config = DatasetConfig(
        output=tmp_path / "shards", category="mug", source=folder, test=1, val=0, shards=True
    )
    assert render.make_shards(config) == 0
    out = capsys.readouterr().out
    assert ", 2 skipped" in out and "skipped a.obj" in out and "skipped zz.ply" in out
    (folder / "a.obj").write_text("v 0\n")
    with pytest.raises(ValueError, match="were made with another list of meshes"):
        render.make_shards(config)
    (folder / "a.obj").write_text("v 0 0\n")
    assert render.make_shards(config) == 0
    (folder / "a.obj").rename(folder / "zzz.obj")
    with pytest.raises(ValueError, match="were made with another list of meshes"):
        render.make_shards(config)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
def test_a_killed_call_is_continued(config, here, tmp_path, monkeypatch) -> None:
    """Killed with its workers, or stopped, at several moments, the same command ends with the same files."""
    # enough that no call ends before its signal
    config = dataclasses.replace(config, procedural=24)
    whole = dataclasses.replace(config, output=tmp_path / "whole")
    assert render.make_shards(whole) == 0
    monkeypatch.undo()
    (tmp_path / "make.py").write_text(MAKE)
    words = ["--output", str(config.output), "--shards", "--jobs", "2"]
    words += [str(word) for name in NUMBERS for word in (f"--{name}", getattr(config, name))]
    for kind in (signal.SIGKILL, signal.SIGTERM):
        begun = len(list(config.output.glob("*/*/[0-9]*.safetensors")))
        with subprocess.Popen(
            [sys.executable, tmp_path / "make.py", *words], start_new_session=True
        ) as process:
            deadline = time.monotonic() + 60
            while (
                len(list(config.output.glob("*/*/[0-9]*.safetensors"))) <= begun
                and time.monotonic() < deadline
            ):
                time.sleep(0.01)
            with contextlib.suppress(ProcessLookupError):
                if kind == signal.SIGKILL:
                    os.killpg(process.pid, kind)
                else:
                    process.send_signal(kind)
    assert not has_shards(config.output, "chair", "train")
    assert (
        subprocess.run([sys.executable, tmp_path / "make.py", *words], timeout=300).returncode == 0
    )
    assert contents(config.output, "*/*/*") == contents(whole.output, "*/*/*")
