"""render_silhouette: against the slow definition, its invariances, the operator's registration, bad input."""

import os
import subprocess
import sys

import pytest
import reference
import torch
from scenes import random_soup

import nmr

RECTANGLES = [(7, 16), (15, 6), (1, 9), (9, 1)]


def render_with_gradient(vertices, faces, upstream_seed=0, **kwargs):
    vertices = vertices.clone().requires_grad_()
    alpha = nmr.render_silhouette(vertices, faces, **kwargs)
    g = torch.Generator().manual_seed(upstream_seed)
    alpha.backward(torch.randn(alpha.shape, generator=g, dtype=alpha.dtype))
    return alpha.detach(), vertices.grad


@pytest.mark.parametrize(
    "seed, size", [(seed, (15, 15)) for seed in range(6)] + [(5, size) for size in RECTANGLES]
)
@pytest.mark.parametrize("anti_aliasing", [False, True])
@pytest.mark.parametrize("fill_back", [False, True])
def test_equals_the_slow_definition(seed, size, anti_aliasing, fill_back):
    vertices, faces = random_soup(seed)
    upstream = torch.randn(
        2, *size, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
    )
    leaf = vertices.clone().requires_grad_()
    alpha = nmr.render_silhouette(
        leaf, faces, image_size=size, anti_aliasing=anti_aliasing, fill_back=fill_back
    )
    alpha.backward(upstream)
    for b in range(2):
        index = reference.face_index(
            vertices[b], faces, tuple(n * (1 + anti_aliasing) for n in size), fill_back
        )
        assert torch.equal(alpha[b], reference.silhouette(index, anti_aliasing, torch.float64))
        grad = reference.silhouette_gradient(
            vertices[b], faces, index, upstream[b], anti_aliasing, fill_back
        )
        torch.testing.assert_close(
            leaf.grad[b], grad, rtol=1e-9, atol=1e-9 * float(grad.abs().max())
        )
    assert leaf.grad[..., :2].any() and not leaf.grad[..., 2].any()


def test_row_zero_is_the_top_and_winding_matters_without_fill_back():
    top_right = torch.tensor([[[0.2, 0.2, 1.0], [0.8, 0.2, 1.0], [0.8, 0.8, 1.0]]])
    alpha = nmr.render_silhouette(
        top_right, torch.tensor([[0, 1, 2]]), image_size=10, fill_back=False
    )
    assert alpha[0, :5, 5:].any() and not alpha[0, 5:].any() and not alpha[0, :, :5].any()
    clockwise = torch.tensor([[0, 2, 1]])
    assert not nmr.render_silhouette(top_right, clockwise, image_size=10, fill_back=False).any()
    assert torch.equal(nmr.render_silhouette(top_right, clockwise, image_size=10), alpha)


def test_one_openmp_runtime():
    """torch and the extension must share libgomp, or threads are oversubscribed and forks hang."""
    code = (
        "import nmr, torch\n"
        "v, f = nmr.icosphere(1); nmr.render_silhouette(v * .3 + torch.tensor([0, 0, 2.]), f, image_size=8)\n"
        "maps = {line.split()[-1] for line in open('/proc/self/maps') if 'libgomp' in line}\n"
        "assert len(maps) <= 1, maps"
    )
    if sys.platform != "linux":
        pytest.skip("reads /proc/self/maps")
    subprocess.run([sys.executable, "-I", "-c", code], check=True)


def test_vertices_without_a_finite_image_get_no_gradient_and_spoil_nothing():
    """A vertex in the plane of the eye, at the eye, or NaN: without clipping, other faces keep image and gradient."""
    vertices, faces = nmr.icosphere(1)
    bad = torch.tensor([[0.0, 1.0, -3.0], [0.0, 0.0, -3.0], [float("nan"), 0.0, 0.0]])
    eye = torch.tensor([0.0, 0.0, -3.0], requires_grad=True)
    extra = torch.tensor([[0, 1, len(vertices) + k] for k in range(3)])
    options = {"camera": nmr.LookAt(eye), "image_size": 16, "clip": False}
    good = render_with_gradient(vertices[None], faces, **options)
    eye_grad, eye.grad = eye.grad, None
    both = torch.cat([vertices, bad])[None]
    spoiled = render_with_gradient(both, torch.cat([faces, extra]), **options)
    assert torch.equal(spoiled[0], good[0]) and torch.equal(spoiled[1][:, :-3], good[1])
    assert not spoiled[1][:, -3:].any() and torch.equal(eye.grad, eye_grad) and eye_grad.any()


def test_any_instruction_set_gives_the_same_bits():
    code = (
        "import hashlib, sys, torch, nmr\n"
        "v, f = nmr.icosphere(2)\n"
        "for dtype in (torch.float32, torch.float64):\n"
        "    x = (v.to(dtype) * .6 + torch.tensor([.1, .2, 2.], dtype=dtype)).requires_grad_()\n"
        "    a = nmr.render_silhouette(x[None], f, image_size=(37, 50))\n"
        "    g = torch.linspace(-1, 1, a.numel(), dtype=dtype).view(a.shape).sin()\n"
        "    a.backward(g)\n"
        "    assert x.grad.any()\n"
        "    print(hashlib.sha256(x.grad.numpy().tobytes()).hexdigest())"
    )
    outputs = [
        subprocess.run(
            [sys.executable, "-I", "-c", code],
            check=True,
            capture_output=True,
            env={**os.environ, "NMR_CPU_LEVEL": level},
        ).stdout
        for level in ("base", "v3", "")
    ]
    assert outputs[0] == outputs[1] == outputs[2] and len(outputs[0].split()) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc/self/statm")
def test_memory_of_large_images_is_given_back():
    code = (
        "import resource, torch, nmr\n"
        "from nmr import _C\n"
        "def held(): return int(open('/proc/self/statm').read().split()[1]) * resource.getpagesize() / 2**20\n"
        "torch.set_num_threads(2)\n"
        "v, f = nmr.icosphere(2); v = (v * .6 + torch.tensor([0, 0, 2.]))[None].requires_grad_()\n"
        "def step(size): nmr.render_silhouette(v, f, image_size=size).sum().backward()\n"
        "step(64); before = held()\n"
        "step(2048); large = held()\n"
        "step(700); _C.free_scratch(); step(64)\n"
        "print(large - before, held() - before)"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-c", code], check=True, capture_output=True, text=True
    )
    grown, after = map(float, done.stdout.split())
    assert grown < 100 and after < 100, done.stdout  # MiB; the buffers of the large image take 500


def test_running_out_of_memory_is_an_exception():
    """Not the end of the process: the kernels' threads hand std::bad_alloc to the caller."""
    code = (
        "import resource, torch, nmr\n"
        "torch.set_num_threads(2)\n"
        "def meshes(n):\n"
        "    v, f = nmr.icosphere(n)\n"
        "    return (v * .3 + torch.tensor([0, 0, 2.])).repeat(2, 1, 1).requires_grad_(), f\n"
        "small, large = meshes(1), meshes(7)\n"
        "nmr.render_silhouette(*small, image_size=64).sum().backward()\n"
        "held = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (held + 2**24, -1))\n"  # a table of 327,680 faces takes more
        "try: nmr.render_silhouette(*large, image_size=64).sum().backward()\n"
        "except (MemoryError, RuntimeError): print('refused')\n"
        "nmr.render_silhouette(*small, image_size=64); print('alive')"
    )
    if sys.platform != "linux":
        pytest.skip("sets RLIMIT_AS")
    done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["refused", "alive"], done.stderr


def test_behind_the_camera_and_off_screen_draw_nothing():
    vertices, faces = nmr.icosphere(1)
    for shift in ([0, 0, -5.0], [5.0, 0, 3.0], [0, -7.0, 3.0], [0, 0, 500.0]):
        alpha, grad = render_with_gradient(
            vertices[None] + torch.tensor(shift), faces, image_size=16
        )
        assert not alpha.any() and not grad.any()
