"""Marching cubes: where the surface lies and which way its faces look."""

import torch

import nmr
from learn3d.methods.surfaces import grid_surface


def test_surface_of_a_ball_is_where_the_ball_is() -> None:
    sphere, faces = nmr.icosphere(3)
    centre = torch.tensor([0.1, -0.05, 0.2])
    grid = nmr.voxelize(0.25 * sphere + centre + 0.5, faces, size=64)[0].float()
    vertices, found, _ = grid_surface(grid)
    distance = (vertices - centre).norm(dim=1)
    assert 0.24 < distance.min() < distance.max() < 0.28  # the cells that the surface touches count as inside
    assert torch.allclose(vertices.mean(0), centre, atol=0.02)
    normals = nmr.face_normals(vertices, found)
    outwards = vertices[found].mean(1) - centre
    assert ((normals * outwards).sum(1) > 0).all()
    reference = nmr.face_normals(sphere, faces)
    assert ((reference * sphere[faces].mean(1)).sum(1) > 0).all()  # the same winding
    assert torch.allclose(grid_surface(grid, box=2.0)[0], 2 * vertices)


def test_full_and_empty_grids() -> None:
    vertices, faces, _ = grid_surface(torch.zeros(8, 8, 8))
    assert (vertices.shape, faces.shape) == ((0, 3), (0, 3))
    vertices, *_ = grid_surface(torch.ones(8, 8, 8))
    assert vertices.abs().max() == torch.tensor(0.5)
