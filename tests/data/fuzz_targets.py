"""What is fuzzed: files that our own writers made, the damage that suits each, and what reads them."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import fuzz_meshes
import mutations as m
import numpy as np
import stub_work
import torch
from lopsided_meshes import write_meshes
from mutations import Target
from PIL import Image
from runs import metadata

from learn3d.config import TrainConfig, config_from_dict, config_to_dict, load_config
from learn3d.data.framing import read_photo
from learn3d.data.readers import READERS
from learn3d.data.readers.photo_table import read_table, split_objects
from learn3d.experiments.experiment import read_result
from learn3d.figures.curves import read_metrics
from learn3d.files import sandbox, weights
from learn3d.files.reading import parse_json
from learn3d.make_data.render import DatasetConfig, make_dataset
from learn3d.runs import checkpoint, log

ERRORS = (ValueError, FileNotFoundError, OSError)  # what a reader may raise


def check_layout(layout: str, split: str) -> Callable[[Path], None]:
    """Reads a split by `load` and by the scan; both must agree on whether it can be read."""
    reader = READERS[layout]

    def read(folder: Path) -> None:
        found = [p for p in reader.problems(folder, "chair", split) if p.severity == "error"]
        reader.count(folder, "chair", split) if not found else None
        try:
            dataset = reader.load(folder, "chair", split)
        except ERRORS:
            assert found, "the scan did not see what load refused"
            raise
        assert not found, f"load read what the scan refused: {found}"
        batch = dataset.batch(torch.arange(min(3, len(dataset))))
        assert dataset.images.dtype == np.uint8 and batch.masks.isfinite().all()
        assert dataset.poses.features().isfinite().all()
        if dataset.voxels is not None:
            assert dataset.voxels.dtype == bool and dataset.voxels.view(np.uint8).max() <= 1
        if dataset.points is not None:
            assert np.isfinite(dataset.points).all()

    return read


SETTINGS = {
    "kato": {"test": 1, "val": 0},
    "dvr": {"test": 1, "val": 0},
    "kar": {"test": 1, "val": 0, "views": 2},
    "r2n2": {},
    "pascal3d": {"val": 1, "views": 2},
    "photos": {"test": 1, "val": 0, "views": 2},
}


def layout_target(tmp: Path, layout: str) -> Target:
    """A made data set, and one file of each kind of the split that is read."""
    source, folder = tmp / "meshes", tmp / layout
    source.mkdir()
    write_meshes(source)
    config = DatasetConfig(output=folder, category="chair", source=source, layout=layout, **SETTINGS[layout])
    make_dataset(config, progress=False)
    npz, split = m.damage_zip(m.damage_npy), "val" if layout == "pascal3d" else "test"
    first = None
    if layout == "dvr":
        first = (folder / "03001627" / "softras_test.lst").read_text().split()[0]
    elif layout == "kar":
        first = json.loads((folder / "splits.json").read_text())["03001627"]["test"][0]
    elif layout == "r2n2":
        first = sorted(p.name for p in (folder / "ShapeNetRendering" / "03001627").iterdir())[-1]
    elif layout == "photos":
        rows = (folder / "chair" / "poses.csv").read_text().split("\n")
        first = next(row.split(",")[0] for row in rows if ",test" in row)
    files: dict[str, dict[str, m.Mutation]] = {
        "kato": {"03001627_test_images.npz": npz, "03001627_test_voxels.npz": npz},
        "dvr": {
            f"03001627/{first}/cameras.npz": npz,
            f"03001627/{first}/pointcloud.npz": npz,
            f"03001627/{first}/image/0000.png": m.damage_png,
            f"03001627/{first}/mask/0003.png": m.damage_png,
            "03001627/softras_test.lst": m.damage_text,
        },
        "kar": {
            f"renders/03001627/{first}/render_0.png": m.damage_png,
            f"renders/03001627/{first}/depth_1.png": m.damage_png,
            f"renders/03001627/{first}/view.txt": m.damage_text,
            f"voxels/modelVoxels32/03001627/{first}.mat": m.damage,
            "splits.json": m.damage_json,
        },
        "r2n2": {
            f"ShapeNetRendering/03001627/{first}/rendering/00.png": m.damage_png,
            f"ShapeNetRendering/03001627/{first}/rendering/rendering_metadata.txt": m.damage_text,
            f"ShapeNetVox32/03001627/{first}/model.binvox": m.damage,
        },
        "pascal3d": {"chair_val.npz": npz},
        "photos": {"chair/poses.csv": m.damage_text, f"chair/images/{first}": m.damage_png},
    }
    return Target(folder, files[layout], check_layout(layout, split))


def checkpoint_target(tmp: Path) -> Target:
    torch.manual_seed(0)
    method = StandIn()
    loss = method.networks["encoder"](torch.ones(2, 3)).sum()
    loss.backward()
    method.optimizers["encoder"].step()
    tensors = checkpoint.network_tensors(method) | {"random.cpu": torch.get_rng_state()}
    tensors |= checkpoint.optimizer_state("encoder", method.optimizers["encoder"])[0]
    checkpoint.save(tmp / "last.safetensors", tensors, metadata())

    def read(folder: Path) -> None:
        path = folder / "last.safetensors"
        checkpoint.load_metadata(path)
        tensors, about = checkpoint.load(path)
        fresh = StandIn()
        checkpoint.restore_networks(fresh, tensors, path)
        checkpoint.restore_optimizer("encoder", fresh.optimizers["encoder"], tensors, about.optimizers, path)
        fresh.networks["encoder"](torch.ones(2, 3)).sum().backward()
        fresh.optimizers["encoder"].step()

    return Target(tmp, {"last.safetensors": m.damage_safetensors}, read)


class StandIn:
    """As much of a method as a checkpoint asks for."""

    def __init__(self) -> None:
        self.networks = {"encoder": torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.BatchNorm1d(2))}
        parameters = self.networks["encoder"].parameters()
        self.optimizers = {"encoder": torch.optim.Adam(parameters, fused=True)}


def weights_target(tmp: Path) -> Target:
    torch.save({"conv1.weight": torch.arange(6.0), "bn1.bias": torch.zeros(2)}, tmp / "a.pth")
    torch.save({"conv1.weight": torch.arange(6.0)}, tmp / "b.pth", _use_new_zipfile_serialization=False)

    def read(folder: Path) -> None:
        for name in ("a.pth", "b.pth"):
            sandbox.read(weights.read_state_dict, folder / name, memory=weights.MEMORY)

    return Target(tmp, {"a.pth": m.damage_zip(), "b.pth": m.damage}, read)


def config_target(tmp: Path) -> Target:
    config = TrainConfig(data=Path("d"), category="chair", output=Path("o"), preset="peng2020-kar", view_bins="15x20")
    (tmp / "config.json").write_text(json.dumps(config_to_dict(config)))

    def read(folder: Path) -> None:
        config = load_config(folder / "config.json")
        assert config_from_dict(config_to_dict(config)) == config

    return Target(tmp, {"config.json": m.damage_json}, read)


RESULT: dict[str, Any] = stub_work.result().model_dump()


def results_target(tmp: Path) -> Target:
    (tmp / "test.json").write_text(json.dumps(RESULT))
    lines = [json.dumps({"step": step, "split": "train", "total": 1 / step, "mmd": 2.0}) for step in range(1, 6)]
    (tmp / "metrics.jsonl").write_text("\n".join(lines) + "\n")

    def read(folder: Path) -> None:
        with contextlib.suppress(ValueError):
            for curve in read_metrics(folder).values():
                assert curve.steps.shape == curve.values.shape
        kept = (folder / "metrics.jsonl").read_bytes()
        try:
            log._forget_after(folder / "metrics.jsonl", 3)
        finally:
            (folder / "metrics.jsonl").write_bytes(kept)
        result = read_result(folder / "test.json")
        sums, defined = result.objects.sums("kato18")
        assert sums.shape == defined.shape and np.isfinite(sums).all()

    return Target(tmp, {"test.json": m.damage_json, "metrics.jsonl": m.damage_text}, read)


def photo_target(tmp: Path) -> Target:
    rng = np.random.default_rng(0)
    image = Image.fromarray(rng.integers(0, 256, (40, 30, 3), np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 6
    names = ["a.jpg", "a.webp", "a.bmp", "a.tiff", "a.png"]
    for name in names:
        image.save(tmp / name, exif=exif) if name != "a.bmp" else image.save(tmp / name)
    Image.fromarray(rng.integers(0, 2, (40, 30), np.uint8) * 255).save(tmp / "mask.png")

    def read(folder: Path) -> None:
        for name in names:
            with contextlib.suppress(*ERRORS):
                colors, mask = read_photo(folder / name, folder / "mask.png")
                assert colors.shape == (*mask.shape, 3)

    return Target(tmp, dict.fromkeys([*names, "mask.png"], m.damage) | {"a.png": m.damage_png}, read)


def table_target(tmp: Path) -> Target:
    row = {"file": "a.jpg", "azimuth_deg": 30, "elevation_deg": 20, "distance": 3, "fov_deg": 40, "object": "a"}
    rows = [row | {"file": f"{k}.jpg", "object": f"o{k}", "split": "train"} for k in range(4)]
    lines = [",".join(rows[0]), *(",".join(map(str, r.values())) for r in rows)]
    (tmp / "poses.csv").write_text("\n".join(lines) + "\n")

    def read(folder: Path) -> None:
        photos, faults = read_table(folder / "poses.csv")
        assert all(np.isfinite([p.azimuth_deg, p.distance, p.fov_deg]).all() for p in photos)
        assert all(isinstance(fault, str) for fault in faults)
        split_objects(folder / "poses.csv", photos)

    return Target(tmp, {"poses.csv": m.damage_text}, read)


def json_target(tmp: Path) -> Target:
    (tmp / "a.json").write_text(json.dumps(RESULT))
    return Target(tmp, {"a.json": m.damage_json}, lambda folder: parse_json((folder / "a.json").read_bytes()))


TARGETS: dict[str, Callable[[Path], Target]] = {
    **{layout: partial(layout_target, layout=layout) for layout in SETTINGS},
    "meshes": fuzz_meshes.mesh_target,
    "mesh text": fuzz_meshes.mesh_text_target,
    "mesh pack": fuzz_meshes.pack_target,
    "debian": fuzz_meshes.debian_target,
    "checkpoint": checkpoint_target,
    "weights": weights_target,
    "config": config_target,
    "results": results_target,
    "photographs": photo_target,
    "tables": table_target,
    "neural_renderer": fuzz_meshes.drop_in_target,
    "json": json_target,
}
