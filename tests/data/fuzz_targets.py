"""What is fuzzed: files that our own writers made, the damage that suits each, and what reads them."""

from __future__ import annotations

import contextlib
import gzip
import importlib
import io
import json
import random
import tarfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mutations as m
import numpy as np
import torch
import trimesh
from lopsided_meshes import write_meshes
from PIL import Image

import nmr.neural_renderer as nr
from learn3d import checkpoint, runlog
from learn3d.config import TrainConfig, config_from_dict, config_to_dict, load_config
from learn3d.data import debian_packages, mesh_text, meshes
from learn3d.data.debian_furniture import CATALOGUE, furniture_models
from learn3d.data.framing import read_photo
from learn3d.data.mesh_cleaning import clean_mesh
from learn3d.data.photo_table import read_table, split_objects
from learn3d.data.render import DatasetConfig, make_dataset
from learn3d.experiments.results import object_sums
from learn3d.experiments.stored import read_result
from learn3d.figures.curves import read_metrics
from learn3d.inputs import parse_json
from learn3d.methods import DataShape
from learn3d.networks.resnet import _read_weights

ERRORS = (ValueError, FileNotFoundError, OSError)  # what a reader may raise


@dataclass
class Target:
    """A folder of sound files, those to damage with the damage that suits each, and what reads the folder."""

    folder: Path
    damaged: dict[str, m.Mutation]
    read: Callable[[Path], None]


def check_layout(layout: str, split: str) -> Callable[[Path], None]:
    """Reads a split by `load` and by the scan; both must agree on whether it can be read."""
    reader = importlib.import_module(f"learn3d.data.{layout}")

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


def mesh_target(tmp: Path) -> Target:
    folder = tmp / "formats"
    (folder / "sub").mkdir(parents=True)
    box = trimesh.creation.icosphere(1)
    box.visual.vertex_colors = np.arange(4 * len(box.vertices)).reshape(-1, 4) % 256
    scene = trimesh.Scene([box, trimesh.creation.box(transform=trimesh.transformations.translation_matrix([1, 2, 3]))])
    for name in ("a.off", "a.ply", "a.stl", "a.glb"):
        (scene if name == "a.glb" else box).export(folder / name)
    box.export(folder / "b.ply", encoding="ascii")
    (folder / "a.obj").write_text(OBJ)
    (folder / "a.mtl").write_text(MTL)
    Image.new("RGB", (4, 4), (200, 10, 10)).save(folder / "a.png")
    for name, content in scene.export(file_type="gltf").items():
        (folder / name).write_bytes(content)
    chosen = dict.fromkeys([p.name for p in folder.iterdir() if p.suffix in (".stl", ".glb", ".bin", ".ply")], m.damage)
    chosen |= dict.fromkeys(["a.off", "b.ply", "a.obj", "a.mtl"], m.damage_text) | {"a.png": m.damage_png}
    chosen |= {"model.gltf": m.damage_json}

    def read(folder: Path) -> None:
        for source in meshes.folder_sources(folder)[0]:
            with contextlib.suppress(ValueError):
                checked = meshes.checked(source.read(), 10_000)
                assert np.isfinite(checked.vertices).all() and checked.faces.max() < len(checked.vertices)

    return Target(folder, chosen, read)


OBJ = """mtllib a.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0.5
v 0.5 0.5 2
vt 0 0
vt 1 0
vt 1 1
usemtl red
f 1/1 2/2 3/3 4/1
usemtl blue
f 1/1 2/2 5/3
f 2//1 3//1 5//1
f -5 -4 -3 -2 -1
"""
MTL = "newmtl red\nKd 1 0 0\nmap_Kd a.png\nnewmtl blue\nKd 0 0 1\n"
AC3D = """AC3Db
MATERIAL "" rgb 1 1 1
OBJECT world
kids 2
OBJECT poly
name "fuselage"
data 4
abcd
loc 1 2 3
rot 1 0 0 0 1 0 0 0 1
numvert 5
0 0 0
1 0 0
1 1 0
0 1 0
0.5 0.5 2
numsurf 3
SURF 0x10
mat 0
refs 4
0 0 0
1 0 0
2 0 0
3 0 0
SURF 0x20
refs 5
0 0 0
1 0 0
2 0 0
3 0 0
4 0 0
SURF 0x10
refs 3
0 0 0
1 0 0
4 0 0
kids 1
OBJECT poly
numvert 3
0 0 0
1 0 0
0 1 0
numsurf 1
SURF 0x10
refs 3
0 0 0
1 0 0
2 0 0
kids 0
OBJECT poly
kids 0
"""


def mesh_text_target(tmp: Path) -> Target:
    folder = tmp / "text"
    folder.mkdir()
    (folder / "a.obj").write_text(OBJ)
    (folder / "a.ac").write_text(AC3D)

    def read(folder: Path) -> None:
        for parts in (
            [mesh_text.read_obj((folder / "a.obj").read_text("latin-1"))],
            [(p.vertices, p.faces) for p in mesh_text.read_ac3d((folder / "a.ac").read_text("latin-1"))],
        ):
            for vertices, faces in parts:
                assert not len(faces) or 0 <= faces.min() <= faces.max() < len(vertices)
                with contextlib.suppress(ValueError):
                    clean_mesh(vertices, faces)

    return Target(folder, {"a.obj": m.damage_text, "a.ac": m.damage_text}, read)


def pack_target(tmp: Path) -> Target:
    box = trimesh.creation.box()
    np.savez(tmp / "pack.npz", n=2, v0=box.vertices, f0=box.faces, v1=box.vertices, f1=box.faces)

    def read(folder: Path) -> None:
        for source in meshes.pack_sources(folder / "pack.npz"):
            with contextlib.suppress(ValueError):
                meshes.checked(source.read(), 10_000)

    return Target(tmp, {"pack.npz": m.damage_zip(m.damage_npy)}, read)


def catalogue_bytes() -> bytes:
    out, lines = io.BytesIO(), ["id=Test", "license=Free"]
    for number in (1, 2):
        lines += [f"name#{number}=Oak chair", f"category#{number}=Living", f"model#{number}=/m/a.obj"]
        lines += [f"width#{number}=4", f"height#{number}=4", f"depth#{number}=4", f"creator#{number}=A\\u00e9"]
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(CATALOGUE, "\n".join(lines) + "\nmodelRotation#2=1 0 0 0 1 0 0 0 1\n")
        archive.writestr("m/a.obj", OBJ)
    return out.getvalue()


def deb_bytes(files: dict[str, bytes], kind: str = "xz") -> bytes:
    """A Debian package of these files."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode=f"w:{kind}") as tar:
        for path, content in files.items():
            info = tarfile.TarInfo(path)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    out = bytearray(b"!<arch>\n")
    for name, content in (("debian-binary", b"2.0\n"), (f"data.tar.{kind}", data.getvalue())):
        out += f"{name:<16}{0:<12}{0:<6}{0:<6}{'100644':<8}{len(content):<10}`\n".encode()
        out += content + b"\n" * (len(content) % 2)
    return bytes(out)


def damage_deb(rng: random.Random, content: bytes) -> bytes:
    """The catalogue in it, the tar archive under its compression, or plain damage."""
    kind = rng.random()
    if kind < 0.3:
        return m.damage(rng, content)
    sh3f, name = catalogue_bytes(), "usr/share/x.sh3f"
    if kind < 0.6:
        return deb_bytes({name: m.damage_zip(m.damage_text)(rng, sh3f)}, rng.choice(["xz", "gz", "bz2"]))
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w") as tar:
        info = tarfile.TarInfo(rng.choice([name, "n" * 300, "../x", "/x"]))
        info.size = len(sh3f)
        tar.addfile(info, io.BytesIO(sh3f))
    packed = gzip.compress(m.damage(rng, data.getvalue()))
    start = content.index(b"data.tar")
    head = f"{'data.tar.gz':<16}{0:<12}{0:<6}{0:<6}{'100644':<8}{len(packed):<10}`\n".encode()
    return content[:start] + head + packed


def debian_target(tmp: Path) -> Target:
    path = tmp / "sweethome3d-furniture_1_all.deb"
    path.write_bytes(deb_bytes({"usr/share/x.sh3f": catalogue_bytes()}))

    def read(folder: Path) -> None:
        package = debian_packages.find_package("sweethome3d-furniture", folder)
        for candidate in furniture_models(package, ("chair",), folder / "licences", False):
            if candidate is not None and not isinstance(candidate.mesh, str):
                candidate.title.encode()
                with contextlib.suppress(ValueError):
                    clean_mesh(*candidate.mesh)

    return Target(tmp, {path.name: damage_deb}, read)


def checkpoint_target(tmp: Path) -> Target:
    torch.manual_seed(0)
    method = StandIn()
    loss = method.networks["encoder"](torch.ones(2, 3)).sum()
    loss.backward()
    method.optimizers["encoder"].step()
    tensors = checkpoint.network_tensors(method) | {"random.cpu": torch.get_rng_state()}
    tensors |= checkpoint.optimizer_tensors("encoder", method.optimizers["encoder"])
    config = TrainConfig(data=Path("d"), category="chair", output=Path("o"))
    about = checkpoint.method_metadata(DataShape(24), config)
    about |= {"step": 3, "best_iou": 0.5, "best_step": 2, "seconds": 1.5, "object_share": 0.5}
    about |= {"conditions": {"samples": 72, "images": "0a", "precision": "fp32"}, "versions": {"torch": "2"}}
    checkpoint.save(tmp / "last.safetensors", tensors, about)

    def read(folder: Path) -> None:
        path = folder / "last.safetensors"
        metadata = checkpoint.load_metadata(path)
        assert type(metadata.get("step", 0)) is int
        if "config" in metadata:
            config_from_dict(metadata["config"], source=str(path))
        tensors, _ = checkpoint.load(path)
        fresh = StandIn()
        checkpoint.restore_networks(fresh, tensors, path)
        checkpoint.restore_optimizer("encoder", fresh.optimizers["encoder"], tensors, path)
        checkpoint.random_state(tensors, path)
        fresh.networks["encoder"](torch.ones(2, 3)).sum().backward()
        fresh.optimizers["encoder"].step()
        if {"shape", "num_views"} & set(metadata):
            checkpoint.data_shape(metadata)

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
            _read_weights(folder / name)

    return Target(tmp, {"a.pth": m.damage_zip(), "b.pth": m.damage}, read)


def config_target(tmp: Path) -> Target:
    config = TrainConfig(data=Path("d"), category="chair", output=Path("o"), preset="peng2020-kar", view_bins="15x20")
    (tmp / "config.json").write_text(json.dumps(config_to_dict(config)))

    def read(folder: Path) -> None:
        config = load_config(folder / "config.json")
        assert config_from_dict(config_to_dict(config)) == config

    return Target(tmp, {"config.json": m.damage_json}, read)


RESULT: dict[str, Any] = {
    "config": {"data": "d", "category": "chair", "output": "o"},
    "command": "python tools/train.py",
    "data": "/d",
    "checkpoint": "last",
    "iterations": 10,
    "step": 10,
    "seconds": 1.5,
    "images": 24,
    "conditions": {"precision": "fp32"},
    "voxel_iou_kato18": 0.5,
    "voxel_iou_kato19": 0.4,
    "mmd": None,
    "objects": {
        "names": ["a", "b"],
        "images": [12, 12],
        "defined": [12, 0],
        "kato18": [0.5, None],
        "kato19": [0, None],
    },
}


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
            runlog._forget_after(folder / "metrics.jsonl", 3)
        finally:
            (folder / "metrics.jsonl").write_bytes(kept)
        result = read_result(folder / "test.json")
        sums, defined = object_sums(result, "kato18")
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
    (tmp / "poses.json").write_text(json.dumps(rows))
    lines = [",".join(rows[0]), *(",".join(map(str, r.values())) for r in rows)]
    (tmp / "poses.csv").write_text("\n".join(lines) + "\n")

    def read(folder: Path) -> None:
        for name in ("poses.csv", "poses.json"):
            photos, faults = read_table(folder / name)
            assert all(np.isfinite([p.azimuth_deg, p.distance, p.fov_deg]).all() for p in photos)
            assert all(isinstance(fault, str) for fault in faults)
            split_objects(folder / name, photos)

    return Target(tmp, {"poses.csv": m.damage_text, "poses.json": m.damage_json}, read)


def drop_in_target(tmp: Path) -> Target:
    (tmp / "a.obj").write_text(OBJ)
    (tmp / "a.mtl").write_text(MTL)
    Image.new("RGB", (4, 4), (200, 10, 10)).save(tmp / "a.png")

    def read(folder: Path) -> None:
        for bilinear in (True, False):
            vertices, faces, textures = nr.load_obj(
                folder / "a.obj", load_texture=True, texture_size=2, use_bilinear=bilinear
            )
            assert 0 <= faces.min() <= faces.max() < len(vertices) and len(textures) == len(faces)
            assert vertices.isfinite().all() and textures.isfinite().all()

    return Target(tmp, {"a.obj": m.damage_text, "a.mtl": m.damage_text, "a.png": m.damage_png}, read)


def json_target(tmp: Path) -> Target:
    (tmp / "a.json").write_text(json.dumps(RESULT))
    return Target(tmp, {"a.json": m.damage_json}, lambda folder: parse_json((folder / "a.json").read_bytes()))


TARGETS: dict[str, Callable[[Path], Target]] = {
    **{layout: partial(layout_target, layout=layout) for layout in SETTINGS},
    "meshes": mesh_target,
    "mesh text": mesh_text_target,
    "mesh pack": pack_target,
    "debian": debian_target,
    "checkpoint": checkpoint_target,
    "weights": weights_target,
    "config": config_target,
    "results": results_target,
    "photographs": photo_target,
    "tables": table_target,
    "neural_renderer": drop_in_target,
    "json": json_target,
}
