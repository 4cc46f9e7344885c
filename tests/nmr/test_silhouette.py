"""render_silhouette: against the slow definition, its invariances, the operator's registration, bad input."""

import os
import subprocess
import sys

import pytest
import reference
import torch
from scenes import assert_near, normal, random_soup, value_and_gradients

import nmr

RECTANGLES = [(7, 16), (15, 6), (1, 9), (9, 1)]


@pytest.mark.parametrize("gradient", ["nmr", "local"])
@pytest.mark.parametrize(
    "seed, size", [(seed, (15, 15)) for seed in range(6)] + [(2, size) for size in RECTANGLES]
)
def test_equals_the_slow_definition(seed, size, gradient, anti_aliasing, fill_back):
    vertices, faces = random_soup(seed)
    upstream, raster = normal(2, *size, seed=seed), tuple(n * (1 + anti_aliasing) for n in size)
    eps = (1e-4, 2.0)[seed % 2]  # 2: many ties of local gradients
    how = dict(anti_aliasing=anti_aliasing, eps=eps)
    alpha, grad = value_and_gradients(
        lambda x: nmr.render_silhouette(
            x, faces, image_size=size, fill_back=fill_back, gradient=gradient, **how
        ),
        vertices,
        upstream=upstream,
    )
    for b, mesh in enumerate(vertices):
        index = reference.face_index(mesh, faces, raster, fill_back)
        assert fill_back == bool((index >= len(faces)).any())  # reversed copies own pixels, too
        assert torch.equal(alpha[b], reference.silhouette(index, anti_aliasing, torch.float64))
        given = mesh, faces, index, upstream[b]
        if gradient == "nmr":
            slow = reference.silhouette_gradient(*given, fill_back=fill_back, **how)
        else:
            slow = reference.local_gradient(*given, **how)
        assert_near(grad[b], slow, 1e-9)
    assert grad[..., :2].any() and not grad[..., 2].any()


def on_pixel_centres(vertices, seed):
    """Corners on centres and borders of 16 pixels: no rounding excuses a difference."""
    flat = (2 * torch.floor(8 * (vertices[..., :2] + 1)) + 1 - 16) / 16
    return torch.cat([flat, vertices[..., 2:]], dim=-1)


def almost_equally_near(vertices, seed):
    """Faces on one plane, but for some units in the last place of their depths: only the
    published rounding tells which is nearer, bounds must not.
    """
    x, y, _ = vertices.unbind(-1)
    q = 0.4 + 0.02 * (seed % 5) * x - 0.03 * y
    z = 1 / q if seed % 2 else 2 + q  # one plane with perspective, or without
    steps = torch.arange(z.numel()).view_as(z) * (seed + 1) % 7
    z = z * (1 + steps * torch.finfo(z.dtype).eps)
    return torch.stack([x, y, z], dim=-1)


def almost_on_a_line(vertices, seed):
    """Faces so thin that rounding puts pixels beyond their ends inside of their edges."""
    a, b, c = on_pixel_centres(vertices, seed).unflatten(1, (-1, 3)).unbind(2)
    c[..., :2] = torch.lerp(a, b, 0.3)[..., :2]
    return torch.stack([a, b, c], dim=2).flatten(1, 2)


@pytest.mark.parametrize("place", [None, on_pixel_centres, almost_equally_near, almost_on_a_line])
@pytest.mark.parametrize("seed", range(4))
def test_the_face_index_map_is_the_definition(place, seed, dtype, perspective):
    """Of several sizes; every third soup is cut by near and far."""
    vertices, faces = random_soup(seed)
    vertices = vertices.to(dtype)
    vertices = vertices if place is None else place(vertices, seed)
    near, far = (1.3, 1.7) if seed % 3 == 1 and place is None else (0.1, 100.0)
    on_centres = place in (on_pixel_centres, almost_on_a_line)
    sizes = [(16, 16)] if on_centres else [(24, 24), (6, 45)]
    for size in sizes:
        how = seed % 2 == 0, near, far, perspective
        drawn = nmr.ops.rasterize(vertices, faces, None, *size, *how)
        for index, mesh in zip(drawn, vertices, strict=True):
            assert torch.equal(index.flip(0).long(), reference.face_index(mesh, faces, size, *how))


def test_of_equally_near_faces_the_first_is_drawn(dtype):
    vertices = torch.tensor([[-0.9, -0.9, 2.0], [0.9, -0.9, 2.0], [0.0, 0.9, 2.0]], dtype=dtype)
    faces = torch.tensor([[2, 1, 0], [0, 1, 2], [0, 1, 2]])
    drawn = nmr.ops.rasterize(vertices[None], faces, None, 24, 24, True, 0.1, 100.0, True)
    assert set(drawn.unique().tolist()) == {-1, 1}


def test_row_zero_is_the_top_and_winding_matters_without_fill_back():
    top_right = torch.tensor([[0.2, 0.2, 1.0], [0.8, 0.2, 1.0], [0.8, 0.8, 1.0]])

    def draw(face, **how):
        return nmr.render_silhouette(top_right, torch.tensor([face]), image_size=10, **how)

    alpha = draw([0, 1, 2], fill_back=False)
    assert alpha[0, :5, 5:].any() and not alpha[0, 5:].any() and not alpha[0, :, :5].any()
    assert not draw([0, 2, 1], fill_back=False).any()
    assert torch.equal(draw([0, 2, 1]), alpha)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_one_number_that_is_not_finite_reaches_every_visible_face_of_its_image(bad):
    vertices, faces = random_soup(0)
    upstream = normal(2, 12, 12)
    upstream[0, 5, 5] = bad
    _, grad = value_and_gradients(
        lambda x: nmr.render_silhouette(x, faces, image_size=12, anti_aliasing=False),
        vertices,
        upstream=upstream,
    )
    seen = nmr.render_face_index(vertices, faces, image_size=12)[0].unique()[1:].long()
    wanted = torch.zeros_like(grad, dtype=torch.bool)
    wanted[0, faces[seen], :2] = True
    assert 3 < len(seen) < len(faces) and torch.equal(grad.isnan(), wanted)


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


@pytest.mark.parametrize("shift", [[0, 0, -5.0], [5.0, 0, 3.0], [0, -7.0, 3.0], [0, 0, 500.0]])
def test_behind_the_camera_and_off_screen_draw_nothing(shift):
    vertices, faces = nmr.icosphere(1)
    alpha, grad = value_and_gradients(
        lambda x: nmr.render_silhouette(x, faces, image_size=16), vertices + torch.tensor(shift)
    )
    assert not alpha.any() and not grad.any()
