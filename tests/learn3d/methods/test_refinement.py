"""Shapes fitted to masks of known pose."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from PIL import Image

import nmr
from learn3d.data.poses import LookAtPoses
from learn3d.methods import DatasetInfo, create_method
from learn3d.methods.refinement import refine
from learn3d.presets import PRESETS
from learn3d.reconstruction import reconstruct, reconstruct_dataset, reconstruct_files


def make(plane: float | None):
    settings = dataclasses.replace(
        PRESETS["plus-kato"].settings, encoder="conv-small", generator="sphere-small", lambda_novel_view=0.0
    )
    return create_method(settings, DatasetInfo(24, mirror_plane_deg=plane), device="cpu", precision="fp32", seed=0)


@pytest.mark.parametrize("steps", [(30, 0), (0, 30), (15, 15)])
def test_the_silhouette_comes_closer(tiny_set, steps: tuple[int, int]) -> None:
    method, batch = make(None), tiny_set.batch(torch.tensor([0, 30]))

    def loss(vertices: torch.Tensor) -> float:
        return float(nmr.losses.soft_iou_loss(method.render(vertices, batch.poses), batch.masks))

    with torch.no_grad():
        before = method.decode(method.encode(batch.images)).vertices
        after = refine(method, batch.images, batch.masks, batch.poses, code_steps=steps[0], vertex_steps=steps[1])
    assert loss(after.vertices) < loss(before) - 0.02


def test_methods_that_train_on_larger_silhouettes_are_refined(tiny_set) -> None:
    method = create_method(PRESETS["kato2019-kar"].settings, DatasetInfo(24), device="cpu", precision="fp32", seed=0)
    batch = tiny_set.batch(torch.tensor([0]))
    images = torch.zeros(1, 4, method.image_size, method.image_size, dtype=torch.uint8)
    shapes = refine(method, images, batch.masks, batch.poses, code_steps=1, vertex_steps=1)
    assert shapes.vertices.shape == (1, 1352, 3) and shapes.vertices.isfinite().all()


def test_symmetric_shapes_stay_symmetric(tiny_set) -> None:
    method, batch = make(37.5), tiny_set.batch(torch.tensor([0, 30]))
    vertices = refine(method, batch.images, batch.masks, batch.poses, code_steps=3, vertex_steps=3).vertices
    torch.testing.assert_close(method.generator.symmetrized(vertices), vertices)


def test_each_image_is_fitted_on_its_own_vertices(tiny_set) -> None:
    method, batch = make(None), tiny_set.batch(torch.tensor([0, 30]))
    both = refine(method, batch.images, batch.masks, batch.poses, code_steps=0, vertex_steps=5).vertices
    first = tiny_set.batch(torch.tensor([0]))
    alone = refine(method, first.images, first.masks, first.poses, code_steps=0, vertex_steps=5).vertices
    torch.testing.assert_close(both[:1], alone, atol=1e-5, rtol=0)


def test_reconstructions_of_data_sets_and_files(finished_run, tiny_folder, tmp_path) -> None:
    options = {"frames": 1, "image_size": 16, "mesh_format": "obj"}
    plain = reconstruct_dataset(finished_run, tmp_path / "plain", tiny_folder, [3], **options)
    fitted = reconstruct_dataset(finished_run, tmp_path / "fitted", tiny_folder, [3], refined=True, **options)
    assert plain[0].read_text() != fitted[0].read_text()
    with np.load(tiny_folder / "02691156_test_images.npz") as archive:
        stored = archive["arr_0"][0, 3]
    rgba = np.concatenate([255 - stored[:3], stored[3:]]).transpose(1, 2, 0)
    Image.fromarray(np.ascontiguousarray(rgba)).save(tmp_path / "box.png")
    pose = LookAtPoses(torch.tensor([-45.0]), 30.0, 2.732, 15.0)
    from_file = reconstruct_files(
        finished_run, tmp_path / "file", [tmp_path / "box.png"], crop=False, poses=pose, **options
    )
    assert from_file[0].read_text() == fitted[0].read_text()
    with pytest.raises(ValueError, match="1 images but 2 poses"):
        reconstruct_files(finished_run, tmp_path / "file", [tmp_path / "box.png"], poses=pose[torch.tensor([0, 0])])


def test_voxels_cannot_be_fitted(tiny_set) -> None:
    settings = dataclasses.replace(
        PRESETS["gadelha2017-kato"].settings, generator_channels=(4, 4, 2, 1), discriminator_channels=(4, 8, 8, 8)
    )
    method = create_method(settings, DatasetInfo(24), device="cpu", precision="fp32", seed=0)
    batch = tiny_set.batch(torch.tensor([0]))
    with pytest.raises(ValueError, match="leave out --refine"):
        reconstruct(method, batch.images.numpy(), batch.masks, batch.poses)
