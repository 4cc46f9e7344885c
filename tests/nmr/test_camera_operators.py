"""The operators behind the cameras: against a chain of tensor operations, opcheck, threads, refused shapes."""

import pytest
import torch

from nmr import ops


def chain(vertices, matrix, intrinsics, distortion, origin, extent, perspective):
    """The definition of `project`, for a batch."""
    u = (vertices - origin[:, None]) @ matrix[:, :, :3].mT + matrix[:, None, :, 3]
    x, y = (u[..., :2] / u[..., 2:] if perspective else u[..., :2]).unbind(-1)
    if distortion is not None and perspective:
        k1, k2, p1, p2, k3 = distortion[:, None].unbind(-1)
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        )
    q = torch.stack([x, y], dim=-1) / extent[:, None, None]
    xy = q @ intrinsics[:, :, :2].mT + intrinsics[:, None, :, 2]
    return torch.cat([xy, u[..., 2:]], dim=-1)


def random_arguments(batch, num_vertices, *, shared=False, distorted=True, dtype=torch.float64, seed=0):
    """vertices, matrix, intrinsics, distortion, origin, extent: all general, all vertices in front of the camera."""
    torch.manual_seed(seed)
    vertices = torch.rand(1 if shared else batch, num_vertices, 3, dtype=torch.float64) - 0.5
    matrix, intrinsics = torch.randn(batch, 3, 4), torch.randn(batch, 2, 3)
    matrix[:, 2] = torch.tensor([0.1, -0.2, 1.0, 3.0])
    distortion = 0.01 * torch.randn(batch, 5) if distorted else None  # all vertices are within its reach
    arguments = vertices, matrix, intrinsics, distortion, 0.1 * torch.randn(batch, 3), 0.5 + torch.rand(batch)
    return [None if x is None else x.to(dtype) for x in arguments]


def project(vertices, matrix, intrinsics, distortion, origin, extent, perspective=True, starts=None):
    return ops.project(vertices, matrix, intrinsics, distortion, origin, extent, starts, perspective)


@pytest.mark.parametrize("perspective, distorted", [(True, True), (True, False), (False, False), (False, True)])
@pytest.mark.parametrize("shared", [False, True])
def test_project_is_the_chain_and_its_gradient(perspective, distorted, shared):
    """1100 vertices: several chunks, and a last group that is not full."""
    arguments = random_arguments(3, 1100, shared=shared, distorted=distorted)
    inputs = [x.requires_grad_() for x in arguments if x is not None]
    upstream = torch.randn(3, 1100, 3, dtype=torch.float64)
    got, wanted = project(*arguments, perspective), chain(*arguments, perspective)
    torch.testing.assert_close(got, wanted, rtol=1e-12, atol=1e-12)
    kwargs = {"grad_outputs": upstream, "allow_unused": True, "materialize_grads": True}
    for a, b in zip(
        torch.autograd.grad(got, inputs, **kwargs), torch.autograd.grad(wanted, inputs, **kwargs), strict=True
    ):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("shared", [False, True])
def test_same_bits_for_any_number_of_threads(shared):
    arguments = random_arguments(5, 1500, shared=shared, dtype=torch.float32)
    upstream, before, results = torch.randn(5, 1500, 3), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            inputs = [x.clone().requires_grad_() for x in arguments]
            out = project(*inputs)
            results.append([out.detach(), *torch.autograd.grad(out, inputs, upstream)])
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
