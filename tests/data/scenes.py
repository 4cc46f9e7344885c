"""Meshes, numbers and comparisons for tests of the renderer."""

import math

import torch
from hypothesis import strategies as st

import nmr

_ODD = [
    0.0,
    -0.0,
    1.0,
    -1.0,
    0.5,
    1e-45,
    1e-30,
    1e-7,
    1e7,
    1e11,
    1e16,
    1e30,
    -1e30,
    3.4e38,
    -3.4e38,
]
_ODD += [math.inf, -math.inf, math.nan]
# of float32, special ones more often than not
any_number = st.one_of(st.sampled_from(_ODD), st.floats(-2, 2, width=32), st.floats(width=32))


def double(values):
    return torch.tensor(values, dtype=torch.float64)


def uniform(*shape, seed=0, dtype=torch.float64):
    """Numbers in [0, 1): the same in every call."""
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def normal(*shape, seed=0, dtype=torch.float64):
    """Normally distributed numbers: the same in every call."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def leaf_of(tensor):
    """A copy that gradients reach."""
    return tensor.detach().clone().requires_grad_()


def value_and_gradients(function, *inputs, upstream=None):
    """The detached output of a function, and its gradients.

    upstream: the gradient of the output; default: 1 for a number, else `normal`.
    """
    leaves = [leaf_of(x) for x in inputs]
    output = function(*leaves)
    if upstream is None:
        upstream = (
            normal(*output.shape).to(output.dtype) if output.ndim else torch.ones_like(output)
        )
    gradients = torch.autograd.grad(
        output, leaves, upstream.expand_as(output), allow_unused=True, materialize_grads=True
    )
    return [output.detach(), *gradients]


def assert_near(actual, expected, share):
    """No number of the tensors, or lists of them, differs by more than a share of the largest."""
    if isinstance(expected, torch.Tensor):
        actual, expected = [actual], [expected]
    for a, b in zip(actual, expected, strict=True):
        scale = float(b.detach().abs().max()) if b.numel() else 0.0
        torch.testing.assert_close(a, b, rtol=share, atol=share * scale)


def same_bits(a, b):
    """Whether two lists of tensors are equal."""
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def for_threads(counts, run):
    """The results of run() with each number of threads."""
    before = torch.get_num_threads()
    results = []
    try:
        for threads in counts:
            torch.set_num_threads(threads)
            results.append(run())
    finally:
        torch.set_num_threads(before)
    return results


def random_soup(seed, batch=2, num_faces=12, dtype=torch.float64, size=0.5):
    """Random triangles, some partly off the screen: vertices ``[B, V, 3]``, faces ``[F, 3]``."""
    g = torch.Generator().manual_seed(seed)
    centre = torch.rand(batch, num_faces, 1, 3, generator=g) * 2 - 1
    corners = centre + size * torch.randn(batch, num_faces, 3, 3, generator=g)
    corners[..., 2] = 1 + torch.rand(batch, num_faces, 3, generator=g)
    return corners.reshape(batch, -1, 3).to(dtype), torch.arange(num_faces * 3).view(-1, 3)


def bumpy_sphere(subdivisions=2, seed=0, least=0.7, dtype=torch.float64):
    """A sphere whose radius lies between `least` and 1: vertices ``[V, 3]``, faces ``[F, 3]``."""
    vertices, faces = nmr.icosphere(subdivisions)
    radius = least + (1 - least) * uniform(len(vertices), 1, seed=seed, dtype=dtype)
    return radius * vertices.to(dtype), faces


def square(left=-1.0, bottom=-1.0, right=1.0, top=1.0, depth=(1.0, 1.0, 1.0, 1.0)):
    """Two triangles; corners from the bottom left one counter-clockwise: vertices ``[4, 3]``, faces."""
    x, y = (left, right, right, left), (bottom, bottom, top, top)
    return double([x, y, depth]).T.contiguous(), torch.tensor([[0, 1, 2], [0, 2, 3]])
