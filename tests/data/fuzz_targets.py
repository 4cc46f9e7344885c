"""What is fuzzed: files that our own writers made, the damage that suits each, and what reads them."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import mutations as m
import numpy as np
import stub_work
import torch
import trimesh
from lopsided_meshes import write_meshes
from PIL import Image
from reader_checks import problems
from runs import metadata
from shapenet_files import write_dvr

import nmr.neural_renderer as nr
from learn3d.config import config_to_dict
from learn3d.data.framing import read_photo
from learn3d.data.layouts import reader
from learn3d.files import formats, sandbox
from learn3d.presets import config_from_dict, configure, load_config
from learn3d.runs import checkpoint, log
from learn3d.studio.make_data import meshes
from learn3d.studio.make_data.render import DatasetConfig, make_dataset
from learn3d.studio.tables.experiment import read_result
from learn3d.studio.tables.report import read_metrics

ERRORS = (ValueError, FileNotFoundError, OSError)  # what a reader may raise


@dataclass
class Target:
    """A folder of sound files, those to damage with the damage that suits each, and what reads the folder."""

    folder: Path
    damaged: dict[str, m.Mutation]
    read: Callable[[Path], None]


SETTINGS = {  # of data sets whose meshes are written by `write_meshes`; 24 views unless said
    "kato": {"test": 1, "val": 0},
    "kar": {"test": 1, "val": 0, "views": 4},
    "pascal3d": {"val": 1, "views": 4},
    "photos": {"test": 1, "val": 0, "views": 4},
}
NPZ = m.damage_zip(m.damage_npy)
FILES: dict[str, dict[str, m.Mutation]] = {  # one of each kind; ID: an object or image, see `first`
    "kato": {"03001627_test_images.npz": NPZ, "03001627_test_voxels.npz": NPZ},
    "dvr": {
        "03001627/ID/cameras.npz": NPZ,
        "03001627/ID/pointcloud.npz": NPZ,
        "03001627/ID/image/0000.png": m.damage_png,
        "03001627/ID/mask/0003.png": m.damage_png,
        "03001627/softras_test.lst": m.damage_text,
    },
    "kar": {
        "renders/03001627/ID/render_0.png": m.damage_png,
        "renders/03001627/ID/depth_1.png": m.damage_png,
        "renders/03001627/ID/view.txt": m.damage_text,
        "voxels/modelVoxels32/03001627/ID.mat": m.damage,
        "splits.json": m.damage_json,
    },
    "pascal3d": {"chair_val.npz": NPZ},
    "photos": {"chair/poses.csv": m.damage_text, "chair/images/ID": m.damage_png},
}


def layout_target(tmp: Path, layout: str) -> Target:
    """A made data set; `load` and the check must agree on whether it can be read."""
    source, folder, split = tmp / "meshes", tmp / layout, "val" if layout == "pascal3d" else "test"
    if layout == "dvr":
        write_dvr(folder, {"train": ["b1"], "test": ["a0"]})
    else:
        source.mkdir()
        write_meshes(source)
        config = DatasetConfig(
            output=folder, category="chair", source=source, layout=layout, **SETTINGS[layout]
        )
        make_dataset(config)
    first = {
        "dvr": lambda: (folder / "03001627" / "softras_test.lst").read_text().split()[0],
        "kar": lambda: json.loads((folder / "splits.json").read_text())["03001627"]["test"][0],
        "photos": lambda: next(
            row.split(",")[0]
            for row in (folder / "chair" / "poses.csv").read_text().split("\n")
            if ",test" in row
        ),
    }.get(layout, str)()
    load = reader(layout).load

    def read(folder: Path) -> None:
        found = [p for p in problems(layout, folder, split) if p.severity == "error"]
        try:
            dataset = load(folder, "chair", split)
        except ERRORS:
            assert found, "the scan did not see what load refused"
            raise
        assert not found, f"load read what the scan refused: {found}"
        batch = dataset.batch(torch.arange(min(3, len(dataset))))
        assert dataset.images.dtype == np.uint8 and batch.masks.isfinite().all()
        assert dataset.poses.eyes().isfinite().all()
        if dataset.voxels is not None:
            assert dataset.voxels.dtype == bool and dataset.voxels.view(np.uint8).max() <= 1
        if dataset.points is not None:
            assert np.isfinite(dataset.points).all()

    return Target(
        folder, {name.replace("ID", first): how for name, how in FILES[layout].items()}, read
    )


class StandIn:
    """As much of a method as a checkpoint asks for, after a step."""

    def __init__(self) -> None:
        self.networks = {
            "encoder": torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.BatchNorm1d(2))
        }
        self.optimizers = {
            "encoder": torch.optim.Adam(self.networks["encoder"].parameters(), fused=True)
        }

    def step(self) -> None:
        self.networks["encoder"](torch.ones(2, 3)).sum().backward()
        self.optimizers["encoder"].step()


def checkpoint_target(tmp: Path) -> Target:
    torch.manual_seed(0)
    method = StandIn()
    method.step()
    tensors = checkpoint.network_tensors(method) | {"random.cpu": torch.get_rng_state()}
    tensors |= checkpoint.optimizer_tensors("encoder", method.optimizers["encoder"])
    checkpoint.save(tmp / "last.safetensors", tensors, metadata())

    def read(folder: Path) -> None:
        path = folder / "last.safetensors"
        checkpoint.load_metadata(path)
        tensors, _ = checkpoint.load(path)
        fresh = StandIn()
        checkpoint.restore_networks(fresh, tensors, path)
        checkpoint.restore_optimizer("encoder", fresh.optimizers["encoder"], tensors, path)
        fresh.step()

    return Target(tmp, {"last.safetensors": m.damage_safetensors}, read)


def weights_target(tmp: Path) -> Target:
    torch.save({"conv1.weight": torch.arange(6.0), "bn1.bias": torch.zeros(2)}, tmp / "a.pth")
    torch.save(
        {"conv1.weight": torch.arange(6.0)}, tmp / "b.pth", _use_new_zipfile_serialization=False
    )

    def read(folder: Path) -> None:
        for name in ("a.pth", "b.pth"):
            sandbox.read(formats.read_state_dict, folder / name)

    return Target(tmp, {"a.pth": m.damage_zip(), "b.pth": m.damage}, read)


def config_target(tmp: Path) -> Target:
    config = configure(
        data=Path("d"), category="chair", output=Path("o"), preset="peng2020-kar", view_bins="15x20"
    )
    (tmp / "config.json").write_text(json.dumps(config_to_dict(config)))

    def read(folder: Path) -> None:
        config = load_config(folder / "config.json")
        assert config_from_dict(config_to_dict(config)) == config

    return Target(tmp, {"config.json": m.damage_json}, read)


def results_target(tmp: Path) -> Target:
    (tmp / "test.json").write_text(stub_work.result().model_dump_json())
    lines = [
        json.dumps({"step": step, "split": "train", "total": 1 / step, "mmd": 2.0})
        for step in range(1, 6)
    ]
    (tmp / "metrics.jsonl").write_text("\n".join(lines) + "\n")

    def read(folder: Path) -> None:
        with contextlib.suppress(ValueError):
            assert all(read_metrics(folder).values())
        log._drop_after(folder / "metrics.jsonl", 3)
        read_result(folder / "test.json")

    return Target(tmp, {"test.json": m.damage_json, "metrics.jsonl": m.damage_text}, read)


def photo_target(tmp: Path) -> Target:
    rng = np.random.default_rng(0)
    image, exif = Image.fromarray(rng.integers(0, 256, (40, 30, 3), np.uint8)), Image.Exif()
    exif[0x0112] = 6  # turned
    names = ["a.jpg", "a.webp", "a.bmp", "a.png"]
    for name in names:
        image.save(tmp / name, **({"exif": exif} if name != "a.bmp" else {}))
    Image.fromarray(rng.integers(0, 2, (40, 30), np.uint8) * 255).save(tmp / "mask.png")

    def read(folder: Path) -> None:
        for name in names:
            with contextlib.suppress(*ERRORS):
                colors, mask = read_photo(folder / name, folder / "mask.png")
                assert colors.shape == (*mask.shape, 3)

    return Target(
        tmp, dict.fromkeys([*names, "mask.png"], m.damage) | {"a.png": m.damage_png}, read
    )


OBJ = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0.5\nv 0.5 0.5 2\nvt 0 0\nvt 1 0\nvt 1 1\nusemtl red\n"
OBJ += "f 1/1 2/2 3/3 4/1\nusemtl blue\nf 1/1 2/2 5/3\nf 2//1 3//1 5//1\nf -5 -4 -3 -2 -1\n"
MTL = "newmtl red\nKd 1 0 0\nmap_Kd a.png\nnewmtl blue\nKd 0 0 1\n"


def write_obj(folder: Path) -> dict[str, m.Mutation]:
    """A textured OBJ file."""
    folder.mkdir(exist_ok=True)
    (folder / "a.obj").write_text(OBJ)
    (folder / "a.mtl").write_text(MTL)
    Image.new("RGB", (4, 4), (200, 10, 10)).save(folder / "a.png")
    return {"a.obj": m.damage_text, "a.mtl": m.damage_text, "a.png": m.damage_png}


def mesh_target(tmp: Path) -> Target:
    damaged = write_obj(tmp / "formats")
    folder = tmp / "formats"
    ball = trimesh.creation.icosphere(1)
    ball.visual.vertex_colors = np.arange(4 * len(ball.vertices)).reshape(-1, 4) % 256
    scene = trimesh.Scene(
        [
            ball,
            trimesh.creation.box(transform=trimesh.transformations.translation_matrix([1, 2, 3])),
        ]
    )
    for name in ("a.off", "a.ply", "a.stl", "a.glb"):
        (scene if name == "a.glb" else ball).export(folder / name)
    ball.export(folder / "b.ply", encoding="ascii")
    for name, content in scene.export(file_type="gltf").items():
        (folder / name).write_bytes(content)
    plain = [
        path.name for path in folder.iterdir() if path.suffix in (".stl", ".glb", ".bin", ".ply")
    ]
    damaged |= dict.fromkeys(plain, m.damage) | dict.fromkeys(["a.off", "b.ply"], m.damage_text)

    def read(folder: Path) -> None:
        for read_one in meshes.mesh_sources(folder).values():
            with contextlib.suppress(*ERRORS):
                checked = meshes.check(read_one())
                assert np.isfinite(checked.vertices).all() and checked.faces.max() < len(
                    checked.vertices
                )

    return Target(folder, damaged | {"model.gltf": m.damage_json}, read)


def pack_target(tmp: Path) -> Target:
    box = trimesh.creation.box()
    np.savez(tmp / "pack.npz", v0=box.vertices, f0=box.faces, v1=box.vertices, f1=box.faces)

    def read(folder: Path) -> None:
        for read_one in meshes.mesh_sources(folder / "pack.npz").values():
            with contextlib.suppress(ValueError):
                meshes.check(read_one())

    return Target(tmp, {"pack.npz": NPZ}, read)


def drop_in_target(tmp: Path) -> Target:
    def read(folder: Path) -> None:
        for bilinear in (True, False):
            vertices, faces, textures = nr.load_obj(
                folder / "a.obj", load_texture=True, texture_size=2, use_bilinear=bilinear
            )
            assert 0 <= faces.min() <= faces.max() < len(vertices) and len(textures) == len(faces)
            assert vertices.isfinite().all() and textures.isfinite().all()

    return Target(tmp, write_obj(tmp), read)


TARGETS: dict[str, Callable[[Path], Target]] = {
    **{layout: partial(layout_target, layout=layout) for layout in FILES},
    "meshes": mesh_target,
    "mesh pack": pack_target,
    "checkpoint": checkpoint_target,
    "weights": weights_target,
    "config": config_target,
    "results": results_target,
    "photographs": photo_target,
    "neural_renderer": drop_in_target,
}
