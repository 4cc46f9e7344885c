"""A tiny data set in Kato's layout, and one short run of the real networks on it, shared by the tests."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import tiny_networks
import torch
from dask_cluster import dask_cluster

from learn3d import commands, training
from learn3d.config import TrainConfig
from learn3d.data.dataset import ViewDataset
from learn3d.data.readers import kato
from learn3d.methods.pose_invariant import PoseInvariantSettings
from learn3d.presets import PRESETS, configure, full_name
from learn3d.tasks import Workers
from learn3d.training import train


@pytest.fixture(scope="session")
def read_metrics() -> Callable[[Path], list[dict[str, object]]]:
    """Reads the metrics.jsonl of a run folder."""
    return lambda folder: [
        json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()
    ]


def tiny_arrays(objects: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Images and voxels of boxes of random size, the same in every view; colours are noise inside the mask."""
    rng = np.random.default_rng(seed)
    images = np.zeros((objects, 24, 4, 64, 64), np.uint8)
    voxels = np.zeros((objects, 32, 32, 32), bool)
    for i, (h, w) in enumerate(rng.integers(8, 24, (objects, 2))):
        images[i, :, :3, 32 - h : 32 + h, 32 - w : 32 + w] = rng.integers(
            0, 256, (24, 3, 2 * h, 2 * w), np.uint8
        )
        images[i, :, 3, 32 - h : 32 + h, 32 - w : 32 + w] = 255
        voxels[i, 16 - h // 2 : 16 + h // 2, 8:24, 16 - w // 2 : 16 + w // 2] = True
    return images, voxels


@pytest.fixture(scope="session")
def tiny_set() -> ViewDataset:
    return kato.from_arrays(*tiny_arrays(3, seed=0), category="airplane", split="test")


@pytest.fixture(scope="session")
def tiny_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with 3 objects to train on and 1 to validate on."""
    folder = tmp_path_factory.mktemp("data")
    for seed, (split, objects) in enumerate({"train": 3, "val": 1, "test": 1}.items()):
        images, voxels = tiny_arrays(objects, seed)
        np.savez_compressed(folder / f"02691156_{split}_images.npz", images)
        np.savez_compressed(folder / f"02691156_{split}_voxels.npz", voxels)
    return folder


@pytest.fixture
def run_folder(tmp_path: Path) -> Iterator[Path]:
    """A folder for a run, removed afterwards: checkpoints are large."""
    yield tmp_path / "run"
    shutil.rmtree(tmp_path / "run", ignore_errors=True)


@pytest.fixture(scope="session")
def tiny_config(tiny_folder: Path) -> Callable[..., TrainConfig]:
    """Makes a configuration for a few steps of batch 4 on the tiny data; options may be settings of the method.

    The networks are small where the preset has those of Peng et al. 2020.
    """

    def make(output: Path, **options: object) -> TrainConfig:
        defaults = {
            "iterations": 4,
            "batch_size": 4,
            "precision": "fp32",
            "log_every": 1,
            "max_val_images": 4,
        }
        options = {"preset": "peng2020-kato"} | options
        preset = PRESETS[full_name(options["preset"])].settings
        if isinstance(preset, PoseInvariantSettings) and preset.encoder == "conv":
            options = {"encoder": "conv-small", "generator": "sphere-small"} | options
        return configure(
            **({"data": tiny_folder, "category": "airplane", "output": output} | defaults | options)
        )

    return make


@pytest.fixture(scope="session")
def finished_run(
    tmp_path_factory: pytest.TempPathFactory, tiny_config: Callable[..., TrainConfig]
) -> Iterator[Path]:
    """The folder of a run of four steps that nothing interrupted. Do not change it."""
    folder = tmp_path_factory.mktemp("runs") / "finished"
    summary = train(tiny_config(folder))
    assert summary.finished
    assert summary.progress.step == 4
    yield folder
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def tiny_names() -> Iterator[None]:
    """The names conv, conv-small and sphere-small mean the networks of `tiny_networks`."""
    with pytest.MonkeyPatch.context() as patch:
        tiny_networks.put_in_place(patch)
        yield


@pytest.fixture(scope="module")
def tiny_run(
    tiny_names: None, tiny_config: Callable[..., TrainConfig]
) -> Callable[..., TrainConfig]:
    """Makes a configuration of six steps of milliseconds with everything in them, every two steps."""
    small = {
        "encoder": "conv-small",
        "generator": "sphere-small",
        "batch_size": 2,
        "threads": 1,
        "iterations": 6,
    }
    often = {"log_every": 1, "validate_every": 2, "checkpoint_every": 2, "pictures_every": 2}
    return lambda output, **options: tiny_config(output, **(small | often | options))


@pytest.fixture(scope="module")
def undisturbed(
    tiny_run: Callable[..., TrainConfig], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The folder of such a run that nothing disturbed. Do not change it."""
    folder = tmp_path_factory.mktemp("undisturbed") / "run"
    train(tiny_run(folder))
    return folder


@pytest.fixture
def command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Calls `learn3d` with these words; its exit status and what it wrote to both outputs."""

    def call(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["learn3d", *map(str, words)])
        try:
            status = commands.main()
        except SystemExit as end:  # --help
            status = end.code
        return status, *capsys.readouterr()

    return call


@pytest.fixture(scope="session")
def cluster() -> Iterator[Workers]:
    """A Dask cluster with two workers."""
    pytest.importorskip("distributed")
    with dask_cluster() as (address, _):
        yield Workers(cluster=address)


@pytest.fixture(autouse=True, scope="session")
def small_picture_grids() -> Iterator[None]:
    """Two rows instead of eight in the grids that a run draws."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "PICTURE_ROWS", 2)
        yield


@pytest.fixture(autouse=True)
def keep_threads() -> Iterator[None]:
    """Put back the number of threads that a test may have set."""
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)
