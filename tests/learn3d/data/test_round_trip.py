"""Meshes -> files of a layout -> its reader, also in shards: masks, cameras and voxels are those of the meshes."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
import stub_work
import torch
import trimesh
from fuzz_targets import SETTINGS
from lopsided_meshes import write_meshes

import nmr
from learn3d import tasks
from learn3d.data import shards
from learn3d.data.conventions import mesh_to_object
from learn3d.data.disk_array import DiskArray
from learn3d.data.layouts import LAYOUTS, load_dataset
from learn3d.data.mirror_plane import find_mirror_plane
from learn3d.studio.make_data.render import DatasetConfig, make_dataset
from learn3d.studio.make_data.writers import WRITERS


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    return write_meshes(tmp_path_factory.mktemp("meshes"))


@pytest.fixture(scope="module", params=[name for name, writer in WRITERS.items() if writer.write])
def made(request, sources, tmp_path_factory):
    """A data set of each layout."""
    output = tmp_path_factory.mktemp("data")
    settings = SETTINGS[request.param]
    config = DatasetConfig(
        output=output, category="chair", source=sources, layout=request.param, **settings
    )
    make_dataset(config)
    card = json.loads((output / "03001627_card.json").read_text())
    return SimpleNamespace(layout=request.param, folder=output, sources=sources, card=card)


def mesh_of(made, split, number, name, count):
    """The true mesh of an object in the layout's object frame, float32 [V, 3], and its faces."""
    files = made.card["splits"][split]
    if made.layout == "kato" or (
        made.layout == "pascal3d" and split == "val"
    ):  # whose readers have no names
        file = files[number * len(files) // count]
    elif (
        made.layout == "pascal3d"
    ):  # pictures of every object in chair_train, then others of them in chair_imagenet
        file = files[number % (count // 2) * len(files) // (count // 2)]
    else:
        (file,) = (f for f in files if f.removesuffix(".ply").replace(" ", "_") in name)
    mesh = trimesh.load(made.sources / file, force="mesh", process=False)
    vertices = (mesh.vertices - mesh.bounds.mean(axis=0)) / mesh.extents.max()
    if made.layout == "pascal3d":  # the frame of mesh files, half the diagonal 1
        vertices = vertices * 2 / np.linalg.norm(np.ptp(vertices, axis=0))
    else:
        vertices = vertices @ mesh_to_object("y", "x").T
    return torch.tensor(vertices, dtype=torch.float32), torch.tensor(np.asarray(mesh.faces))


def test_masks_cameras_and_voxels(made):
    for split in ("train", "val" if made.layout == "pascal3d" else "test"):
        dataset = load_dataset(made.layout, made.folder, "chair", split)
        assert dataset.inverted == LAYOUTS[made.layout].inverted
        assert (dataset.voxels is not None) == LAYOUTS[made.layout].voxels
        expected = SETTINGS[made.layout].get("views", 24)
        if made.layout == "kar" and split == "train":
            expected = 1  # the published protocol
        assert len(dataset) == expected * (4 if split == "train" else 1)
        batch = dataset.batch(torch.arange(len(dataset)))
        for number in range(dataset.num_objects):
            samples = torch.from_numpy(np.flatnonzero(dataset.object_ids == number))
            vertices, faces = mesh_of(
                made, split, number, dataset.object_names[number], dataset.num_objects
            )
            cameras = batch.poses[samples].cameras()
            if made.layout == "pascal3d":  # every 3.5th pixel, as published
                rows = torch.arange(64) * 224 // 64
                wanted = nmr.render_silhouette(vertices, faces, cameras, image_size=224)[:, rows][
                    :, :, rows
                ]
            else:  # the covered share of each pixel
                fine = nmr.render_silhouette(vertices, faces, cameras, image_size=256)
                wanted = torch.nn.functional.avg_pool2d(fine[:, None], 4)[:, 0]
            error = (wanted - batch.masks[samples]).abs().mean((1, 2))
            shifted = [(wanted - wanted.roll(1, axis)).abs().mean((1, 2)) for axis in (1, 2)]
            # Stored masks are samples of that, so they differ a little; half a pixel in one view would be too much.
            relative = error / torch.minimum(*shifted)
            assert relative.max() < 0.5 and relative.mean() < 0.25, (split, relative)
            if dataset.voxels is not None:
                voxels = dataset.convention.voxelize(vertices, faces)[0].numpy()
                assert (voxels == dataset.voxels[number]).all()
        # colours: nothing outside of the object, something on it
        colors = batch.images[:, :3].float()
        background = colors.permute(0, 2, 3, 1)[(batch.images[:, 3] == 0)]
        if made.layout == "pascal3d":
            assert background.std() > 5
        else:  # Kar's masks, from depth, have harder edges than the colours
            assert (background == (0 if dataset.inverted else 255)).float().mean() > 0.98


def test_shards_keep_batches(made, tmp_path, command, monkeypatch):
    monkeypatch.setattr(shards, "SHARD_BYTES", 1)  # one object in each
    monkeypatch.setattr(tasks, "run_tasks", stub_work.run_tasks_here)
    words = ("--data", made.folder, "--layout", made.layout, "--output", tmp_path)
    status, _, said = command("convert-dataset", *words)
    assert status == 0, said
    before = load_dataset(made.layout, made.folder, "chair", "train")
    # as they come in shards of one object
    before = before.select(np.argsort(before.object_ids, kind="stable"))
    after = load_dataset(made.layout, tmp_path, "chair", "train")
    assert isinstance(after.images, DiskArray) and after.info() == before.info()
    for name in ("view_names", "object_names", "convention", "image_size"):
        assert getattr(after, name) == getattr(before, name), name
    order = torch.randperm(len(before))
    one, other = before.batch(order), after.batch(order)
    for name in ("images", "masks", "view_ids", "object_ids", "class_ids", "voxels"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None and b is None) or torch.equal(a, b), name
    assert torch.equal(one.poses.eyes(), other.poses.eyes())
    assert after.mean_object_size() == pytest.approx(before.mean_object_size())
    assert after.check_masks() == before.check_masks()
    if LAYOUTS[made.layout].angles:
        assert find_mirror_plane(after) == find_mirror_plane(before)
    else:
        val, test = (
            load_dataset(made.layout, tmp_path, "chair", split) for split in ("val", "test")
        )
        assert val.digest() == test.digest()
