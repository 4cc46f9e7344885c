"""The operators behind the cameras: against a chain of tensor operations, opcheck, threads, refused shapes."""

import pytest
import torch

from nmr import ops

STARTS = torch.tensor([[0, 0], [3, 0], [7, 0]])


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
    distortion = 0.1 * torch.randn(batch, 5) if distorted else None
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


def test_project_without_origin_and_extent():
    vertices, matrix, intrinsics, *_ = random_arguments(2, 5)
    zero, one = torch.zeros(2, 3, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    wanted = chain(vertices, matrix, intrinsics, None, zero, one, True)
    torch.testing.assert_close(ops.project(vertices, matrix, intrinsics, None, None, None, None, True), wanted)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_opcheck(dtype):
    vertices, matrix, intrinsics, distortion, origin, extent = random_arguments(2, 7, dtype=dtype)
    upstream = torch.randn(2, 7, 3, dtype=dtype)
    wanted = [True, False, True, True, False, True]
    packed = vertices.detach().reshape(14, 3), torch.tensor([[0, 0], [9, 0], [14, 0]])
    torch.library.opcheck(ops.project, (packed[0], matrix, intrinsics, distortion, origin, extent, packed[1], True))
    forward, up = torch.randn(2, 3, dtype=dtype), torch.randn(2, 3, dtype=dtype)
    torch.library.opcheck(ops.pose_backward, (forward, up, torch.randn(2, 3, 4, dtype=dtype)))
    torch.library.opcheck(
        ops.project_backward,
        (vertices, matrix, intrinsics, distortion, origin, extent, None, True, upstream, wanted),
    )
    for x in (vertices, matrix, intrinsics, distortion, origin, extent, forward, up):
        x.requires_grad_()
    torch.library.opcheck(ops.pose, (forward, up))
    torch.library.opcheck(ops.project, (vertices, matrix, intrinsics, distortion, origin, extent, None, True))
    torch.library.opcheck(ops.project, (vertices, matrix, intrinsics, None, None, None, None, False))


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


@pytest.mark.parametrize("index", range(1, 6))
def test_the_operators_refuse_other_shapes(index):
    """One more check than in the Python layer, so that no call reads outside an array."""
    arguments = random_arguments(2, 4)
    names = ["vertices", "matrix", "intrinsics", "distortion", "origin", "extent"]
    arguments[index] = arguments[index][:, :1] if arguments[index].ndim > 1 else arguments[index][:1]
    with pytest.raises(ValueError, match=f"{names[index]} must have shape"):
        project(*arguments)


@pytest.mark.parametrize(
    "call, words",
    [
        (
            lambda a: project(torch.rand(3, 4, 3).double(), *a[1:]),
            r"vertices must have shape \[1, V, 3\] or \[B, V, 3\]",
        ),
        (lambda a: project(*a, starts=STARTS), r"packed vertices must have shape \[N, 3\]"),
        (
            lambda a: project(torch.rand(7, 3).double(), *(x[:1] for x in a[1:]), starts=STARTS),
            "starts are those of 2 meshes",
        ),
        (lambda a: ops.pose(torch.rand(2, 2), torch.rand(2, 3)), r"forward must have shape \[B, 3\], got \[2, 2\]"),
        (lambda a: ops.pose(torch.rand(2, 3), torch.rand(1, 3)), r"up must have shape \[2, 3\], got \[1, 3\]"),
        (
            lambda a: ops.project_backward(*a, None, True, torch.rand(2, 3, 3).double(), [True] + [False] * 5),
            r"grad_points must have shape \[2, 4, 3\]",
        ),
    ],
)
def test_the_operators_refuse_what_does_not_fit(call, words):
    with pytest.raises(ValueError, match=words):
        call(random_arguments(2, 4))
