import numpy as np
import pytest
import torch

import nmr.neural_renderer as nr


@pytest.mark.parametrize("kind", [torch.int32, torch.int64, torch.float32, "array"])
def test_corners(kind):
    vertices = torch.rand(2, 7, 3, requires_grad=True)
    faces = torch.randint(0, 7, (2, 5, 3))
    given = faces.numpy().astype(np.int32) if kind == "array" else faces.to(kind)
    corners = nr.vertices_to_faces(vertices, given)
    assert torch.equal(corners, torch.stack([vertices[b, faces[b]] for b in range(2)]))
    assert torch.equal(nr.vertices_to_faces(vertices, given[:1]), vertices[:, faces[0]])
    assert torch.equal(nr.vertices_to_faces(vertices, given[0]), vertices[:, faces[0]])
    corners.sum().backward()
    assert torch.equal(vertices.grad[..., 0].sum(1), torch.tensor([15.0, 15.0]))
