"""Predicted shapes: the surface of a grid, and the fit to a mask."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from steps import INFO, make_method

import nmr
from learn3d.pictures import grid_surface
from learn3d.studio.picture_to_mesh.options import KNOWN_CAMERAS, FitOptions
from learn3d.studio.picture_to_mesh.reconstruction import reconstruct_dataset
from learn3d.studio.picture_to_mesh.refinement import refine


def test_surface_of_a_ball_is_where_the_ball_is() -> None:
    sphere, faces = nmr.icosphere(3)
    centre = torch.tensor([0.1, -0.05, 0.2])
    grid = nmr.voxelize(0.25 * sphere + centre + 0.5, faces, size=64)[0].float()
    vertices, found, *_ = grid_surface(grid)
    distance = (vertices - centre).norm(dim=1)
    # the cells that the surface touches count as inside
    assert 0.24 < distance.min() < distance.max() < 0.28
    assert torch.allclose(vertices.mean(0), centre, atol=0.02)
    normals = nmr.face_normals(vertices, found)
    outwards = vertices[found].mean(1) - centre
    assert ((normals * outwards).sum(1) > 0).all()
    reference = nmr.face_normals(sphere, faces)
    assert ((reference * sphere[faces].mean(1)).sum(1) > 0).all()  # the same winding
    assert torch.allclose(grid_surface(grid, box=2.0)[0], 2 * vertices)


def test_full_and_empty_grids() -> None:
    vertices, faces, *_ = grid_surface(torch.zeros(8, 8, 8))
    assert (vertices.shape, faces.shape) == ((0, 3), (0, 3))
    vertices, *_ = grid_surface(torch.ones(8, 8, 8))
    assert vertices.abs().max() == torch.tensor(0.5)


def make(plane: float | None):
    settings = {"encoder": "conv-small", "lambda_novel_view": 0.0}
    info = dataclasses.replace(INFO, mirror_plane_deg=plane)
    return make_method("plus-kato", info, **settings)


def steps_of(code: int, vertices: int) -> FitOptions:
    return dataclasses.replace(KNOWN_CAMERAS, code_steps=code, vertex_steps=vertices)


@pytest.mark.parametrize("steps", [(60, 0), (0, 30), (15, 15)])
def test_the_silhouette_comes_closer(tiny_set, steps: tuple[int, int]) -> None:
    method, batch = make(None), tiny_set.batch(torch.tensor([0, 30]))

    def loss(vertices: torch.Tensor) -> float:
        return float(nmr.losses.soft_iou_loss(method.render(vertices, batch.poses), batch.masks))

    with torch.no_grad():
        before = method.decode(method.encode(batch.images)).vertices
        after = refine(method, batch.images, batch.masks, batch.poses, steps_of(*steps))
        free = dataclasses.replace(steps_of(*steps), smoothness=0.0)
        rough = refine(method, batch.images, batch.masks, batch.poses, free)
    assert loss(after.vertices) < loss(before) - 0.02
    smooth, rough = (
        float(nmr.losses.smoothness_loss(each.vertices, method.edges)) for each in (after, rough)
    )
    assert smooth < rough


def test_each_image_is_fitted_on_its_own_vertices_and_stays_symmetric(tiny_set) -> None:
    method, few = make(37.5), steps_of(0, 5)
    batches = [tiny_set.batch(torch.tensor(chosen)) for chosen in ([0, 30], [0])]
    both, alone = (refine(method, b.images, b.masks, b.poses, few).vertices for b in batches)
    torch.testing.assert_close(both[:1], alone, atol=5e-5, rtol=0)
    torch.testing.assert_close(method.generator.symmetrized(both), both)


def test_shapes_of_a_data_set_are_refined(finished_run, tiny_folder, tmp_path) -> None:
    options = {"data": tiny_folder, "indices": [3], "mesh_format": "obj"}
    plain = reconstruct_dataset(finished_run, tmp_path / "plain", **options)
    fitted = reconstruct_dataset(finished_run, tmp_path / "fitted", refined=True, **options)
    assert plain[0].read_text() != fitted[0].read_text()


def test_voxels_cannot_be_fitted(tiny_set) -> None:
    channels = {
        "generator_channels": (4, 4, 2, 1),
        "discriminator_channels": (4, 8, 8, 8),
    }
    method = make_method("gadelha2017-kato", **channels)
    batch = tiny_set.batch(torch.tensor([0]))
    with pytest.raises(ValueError, match="leave out --refine"):
        refine(method, batch.images, batch.masks, batch.poses)
