"""The surface of a fitted shape: closed, outside only, thin parts whole."""

from __future__ import annotations

import torch
import trimesh

import nmr
from learn3d.studio.picture_to_mesh.smoothing import outer_surface, smooth


def test_a_round_shrinks_by_a_half_and_grows_by_a_little_more() -> None:
    ball, faces = nmr.icosphere(1)
    vertices = ball + 0.1 * torch.rand(ball.shape, generator=torch.Generator().manual_seed(0))
    edges, near = nmr.unique_edges(faces), torch.zeros(len(ball), len(ball))
    near[edges[:, 0], edges[:, 1]] = near[edges[:, 1], edges[:, 0]] = 1
    wanted = vertices
    for step in (0.5, -0.53):
        wanted = wanted + step * (near @ wanted / near.sum(1, keepdim=True) - wanted)
    torch.testing.assert_close(smooth(vertices, faces, rounds=1), wanted)


def test_crossing_parts_become_one_closed_surface_and_thin_ones_stay() -> None:
    ball, faces = nmr.icosphere(3)
    parts = [
        0.3 * ball,
        0.3 * ball + torch.tensor([0.3, 0, 0]),
        torch.tensor([0.003, 0.5, 0.2]) * ball,
    ]
    inverted = faces[:, [0, 2, 1]]
    triangles = torch.cat([faces, inverted + len(ball), faces + 2 * len(ball)])
    twice, _ = outer_surface(2 * torch.cat(parts), triangles)
    vertices, triangles = outer_surface(torch.cat(parts), triangles)
    torch.testing.assert_close(twice, 2 * vertices)
    mesh = trimesh.Trimesh(vertices.numpy(), triangles.numpy(), process=False)
    assert mesh.is_watertight and mesh.body_count == 1
    lens = torch.pi * 0.3**3 * 5 / 12  # of two balls of radius r at the distance r
    assert abs(mesh.volume / (2 * 4 / 3 * torch.pi * 0.3**3 - lens) - 1) < 0.08, (
        "and faces point outwards"
    )
    assert torch.allclose(vertices[:, 1].abs().max(), torch.tensor(0.5), atol=0.03), (
        "the sheet is whole"
    )
