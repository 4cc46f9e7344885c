import numpy as np
import pytest
import torch
from vectors import load_vector, vector_names

import nmr


@pytest.mark.parametrize("name", vector_names("loss_smooth_*"))
def test_smoothness_vectors(name):
    v = load_vector(name)
    vertices = torch.from_numpy(v["vertices"]).requires_grad_()
    edges = nmr.edge_table(torch.from_numpy(v["faces"]))
    loss = nmr.losses.smoothness_loss(vertices, edges)
    loss.backward()
    print(name, loss.item(), float(v["loss"]), (vertices.grad.numpy()-v["grad_vertices"]).__abs__().max(), np.abs(v["grad_vertices"]).max())
    np.testing.assert_allclose(loss.item(), v["loss"], rtol=1e-5)
    np.testing.assert_allclose(vertices.grad.numpy(), v["grad_vertices"], rtol=1e-3, atol=1e-4 * np.abs(v["grad_vertices"]).max())
