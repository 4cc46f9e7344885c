"""render_silhouette: against the slow definition, its invariances, the operator's registration, bad input."""

import os
import subprocess
import sys

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import nmr
from nmr import reference


def random_soup(seed, batch=2, num_faces=12, dtype=torch.float32):
    """Random triangles in renderer space, some of them partly off the screen."""
    g = torch.Generator().manual_seed(seed)
    centre = torch.rand(batch, num_faces, 1, 3, generator=g) * 2 - 1
    corners = centre + 0.5 * torch.randn(batch, num_faces, 3, 3, generator=g)
    corners[..., 2] = 1 + torch.rand(batch, num_faces, 3, generator=g)
    vertices = corners.reshape(batch, -1, 3).to(dtype)
    return vertices, torch.arange(num_faces * 3).view(-1, 3)


def bumpy_spheres(batch=4, seed=0):
    """Deformed icospheres and a camera that sees each from another side."""
    g = torch.Generator().manual_seed(seed)
    vertices, faces = nmr.icosphere(3)
    vertices = 0.4 * vertices * (0.5 + torch.rand(batch, 1, 3, generator=g)) + 0.01 * torch.randn(
        batch, 642, 3, generator=g
    )
    camera = nmr.LookAt.from_angles(2.732, 30.0, torch.arange(batch) * 37.0, half_fov_deg=15.0)
    return vertices, faces, camera


def render_with_gradient(vertices, faces, upstream_seed=0, **kwargs):
    vertices = vertices.clone().requires_grad_()
    alpha = nmr.render_silhouette(vertices, faces, **kwargs)
    g = torch.Generator().manual_seed(upstream_seed)
    alpha.backward(torch.randn(alpha.shape, generator=g, dtype=alpha.dtype))
    return alpha.detach(), vertices.grad


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("anti_aliasing", [False, True])
@pytest.mark.parametrize("fill_back", [False, True])
def test_equals_the_slow_definition(seed, anti_aliasing, fill_back):
    vertices, faces = random_soup(seed, dtype=torch.float64)
    size = 11 if anti_aliasing else 19
    upstream = torch.randn(2, size, size, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    leaf = vertices.clone().requires_grad_()
    alpha = nmr.render_silhouette(leaf, faces, image_size=size, anti_aliasing=anti_aliasing, fill_back=fill_back)
    alpha.backward(upstream)
    for b in range(2):
        index = reference.face_index(vertices[b], faces, size * (1 + anti_aliasing), fill_back)
        assert torch.equal(alpha[b], reference.silhouette(index, anti_aliasing, torch.float64))
        grad = reference.silhouette_gradient(vertices[b], faces, index, upstream[b], anti_aliasing, fill_back)
        torch.testing.assert_close(leaf.grad[b], grad, rtol=1e-9, atol=1e-9 * float(grad.abs().max()))
    assert leaf.grad[..., :2].any() and not leaf.grad[..., 2].any()


@pytest.mark.parametrize("size", [(7, 16), (15, 6), (1, 9), (9, 1)])
@pytest.mark.parametrize("anti_aliasing", [False, True])
def test_rectangles_equal_the_slow_definition(size, anti_aliasing):
    vertices, faces = random_soup(5, dtype=torch.float64)
    upstream = torch.randn(2, *size, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    raster = tuple(n * (1 + anti_aliasing) for n in size)
    index = torch.stack([reference.face_index(v, faces, raster) for v in vertices])
    grad = nmr.ops.silhouette_backward(
        vertices, faces, None, index.flip(1).to(torch.int32).contiguous(), upstream, anti_aliasing, 1e-4
    )
    for b in range(2):
        expected = reference.silhouette_gradient(vertices[b], faces, index[b], upstream[b], anti_aliasing)
        torch.testing.assert_close(grad[b], expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))
    assert grad.any()


def test_same_bits_for_any_number_of_threads():
    vertices, faces, camera = bumpy_spheres(batch=7)
    vertices = camera.transform(vertices)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            results += [render_with_gradient(vertices, faces, image_size=64) for _ in range(2)]
    finally:
        torch.set_num_threads(before)
    for alpha, grad in results[1:]:
        assert torch.equal(alpha, results[0][0]) and torch.equal(grad, results[0][1])


def test_same_bits_for_any_batch_size():
    vertices, faces = random_soup(3, batch=5)
    leaf = vertices.clone().requires_grad_()
    nmr.render_silhouette(leaf, faces, image_size=24).square().sum().backward()
    for b in range(5):
        single = vertices[b].clone().requires_grad_()
        nmr.render_silhouette(single, faces, image_size=24).square().sum().backward()
        assert torch.equal(single.grad, leaf.grad[b])


def test_faces_per_image_equal_shared_faces():
    vertices, faces, camera = bumpy_spheres(batch=2)
    vertices = camera.transform(vertices)
    shared = render_with_gradient(vertices, faces, image_size=32)
    own = render_with_gradient(vertices, faces.expand(2, -1, -1).to(torch.int32), image_size=32)
    assert torch.equal(shared[0], own[0]) and torch.equal(shared[1], own[1])


def test_face_order_does_not_change_the_image():
    vertices, faces, camera = bumpy_spheres()
    permuted = faces[torch.randperm(len(faces), generator=torch.Generator().manual_seed(0))]
    a = nmr.render_silhouette(vertices, faces, camera, image_size=64)
    assert a.any() and torch.equal(a, nmr.render_silhouette(vertices, permuted, camera, image_size=64))


def test_hidden_faces_get_no_gradient():
    near = torch.tensor([[-0.5, -0.5, 1.0], [0.5, -0.5, 1.0], [0.0, 0.6, 1.0]])
    hidden = 0.3 * near + torch.tensor([0.0, 0.0, 1.7])
    alone = render_with_gradient(near[None], torch.tensor([[0, 1, 2]]), image_size=32)
    both = render_with_gradient(torch.cat([near, hidden])[None], torch.tensor([[0, 1, 2], [3, 4, 5]]), image_size=32)
    assert torch.equal(both[0], alone[0])
    assert torch.equal(both[1][:, :3], alone[1]) and alone[1].any() and not both[1][:, 3:].any()


def test_row_zero_is_the_top_and_winding_matters_without_fill_back():
    top_right = torch.tensor([[[0.2, 0.2, 1.0], [0.8, 0.2, 1.0], [0.8, 0.8, 1.0]]])
    alpha = nmr.render_silhouette(top_right, torch.tensor([[0, 1, 2]]), image_size=10, fill_back=False)
    assert alpha[0, :5, 5:].any() and not alpha[0, 5:].any() and not alpha[0, :, :5].any()
    clockwise = torch.tensor([[0, 2, 1]])
    assert not nmr.render_silhouette(top_right, clockwise, image_size=10, fill_back=False).any()
    assert torch.equal(nmr.render_silhouette(top_right, clockwise, image_size=10), alpha)


def test_gradient_descent_finds_the_target():
    """What a user does with it: the silhouette of a sphere becomes that of a flat ellipsoid."""
    vertices, faces = nmr.icosphere(2)
    camera = nmr.LookAt.from_angles(2.732, 20.0, [0.0, 60.0, 120.0], half_fov_deg=20.0)
    target = nmr.render_silhouette(vertices * torch.tensor([0.6, 0.25, 0.4]), faces, camera, image_size=48)
    shape = (0.4 * vertices).requires_grad_()
    optimizer = torch.optim.Adam([shape], lr=0.01)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        loss = nmr.losses.soft_iou_loss(nmr.render_silhouette(shape, faces, camera, image_size=48), target)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[0] > 0.3 and losses[-1] < 0.08


def op_arguments(dtype=torch.float32, requires_grad=True):
    vertices, faces = random_soup(0, dtype=dtype)
    return vertices.requires_grad_(requires_grad), faces, None, 12, 12, True, True, 0.1, 100.0, 1e-4, False


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_opcheck(dtype):
    torch.library.opcheck(nmr.ops.silhouette, op_arguments(dtype))
    _, face_index = nmr.ops.silhouette(*op_arguments(dtype, False))
    torch.library.opcheck(nmr.ops.rasterize, (*op_arguments(dtype, False)[:3], 24, 24, True, 0.1, 100.0))
    vertices, faces = op_arguments(dtype, False)[:2]
    upstream = torch.randn(2, 12, 12, dtype=dtype)
    torch.library.opcheck(nmr.ops.silhouette_backward, (vertices, faces, None, face_index, upstream, True, 1e-4))


def test_compile_fullgraph():
    vertices, faces, camera = bumpy_spheres(batch=2)

    def loss(v):
        return nmr.render_silhouette(v, faces, camera, image_size=32).square().mean()

    eager, compiled = vertices.clone().requires_grad_(), vertices.clone().requires_grad_()
    loss(eager).backward()
    torch.compile(loss, fullgraph=True, backend="aot_eager")(compiled).backward()
    torch.testing.assert_close(compiled.grad, eager.grad, rtol=1e-4, atol=1e-6)


def test_second_derivative_is_refused():
    vertices, faces = random_soup(0)
    vertices.requires_grad_()
    loss = nmr.render_silhouette(vertices, faces, image_size=12).square().sum()
    (grad,) = torch.autograd.grad(loss, vertices, create_graph=True)
    with pytest.raises(RuntimeError, match="no second derivative"):
        grad.square().sum().backward()


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


# --- bad input

NASTY = [
    0.0,
    -0.0,
    1.0,
    -1.0,
    0.5,
    1e-45,
    1e-30,
    1e30,
    -1e30,
    3.4e38,
    -3.4e38,
    np.inf,
    -np.inf,
    np.nan,
    1e-7,
    0.9999999,
]


@st.composite
def nasty_meshes(draw):
    dtype = draw(st.sampled_from([np.float32, np.float64]))
    num_vertices = draw(st.integers(1, 8))
    numbers = st.one_of(
        st.sampled_from(NASTY), st.floats(-2, 2, width=32), st.floats(allow_nan=True, allow_infinity=True, width=32)
    ).map(dtype)
    vertices = draw(hnp.arrays(dtype, (draw(st.integers(1, 2)), num_vertices, 3), elements=numbers))
    faces = draw(hnp.arrays(np.int64, (draw(st.integers(0, 6)), 3), elements=st.integers(0, num_vertices - 1)))
    return torch.from_numpy(vertices), torch.from_numpy(faces)


@settings(max_examples=400, deadline=None)
@given(nasty_meshes(), st.integers(1, 17), st.booleans(), st.booleans())
def test_any_mesh_gives_finite_coverage_and_no_nan(mesh, image_size, anti_aliasing, fill_back):
    vertices, faces = mesh
    alpha, grad = render_with_gradient(
        vertices, faces, image_size=image_size, anti_aliasing=anti_aliasing, fill_back=fill_back
    )
    assert ((alpha >= 0) & (alpha <= 1)).all()
    assert not grad.isnan().any()
    used = torch.zeros(vertices.shape[1], dtype=torch.bool)
    used[faces.flatten()] = True
    assert not grad[:, ~used].any()


@settings(max_examples=200, deadline=None)
@given(nasty_meshes(), hnp.arrays(np.float64, (3, 3), elements=st.sampled_from([0.0, 1.0, -2.0, 1e-30, 1e30, *NASTY])))
def test_any_mesh_through_any_camera(mesh, pose):
    vertices, faces = mesh
    eye, at, up = torch.from_numpy(pose).unbind(0)
    eye.requires_grad_()
    for camera in (nmr.LookAt(eye, at, up), nmr.LookAt.from_angles(2.0, 10.0, 20.0)):
        alpha, grad = render_with_gradient(vertices, faces, camera=camera, image_size=8)
        assert alpha.isfinite().all() and not grad.isnan().any()
        assert eye.grad is None or not eye.grad.isnan().any()


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


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_gradient_that_is_not_finite_does_not_vanish(bad):
    """A gradient scaler must see it, and the next step must not."""
    vertices, faces, camera = bumpy_spheres(batch=3)
    vertices = camera.transform(vertices)
    healthy = render_with_gradient(vertices, faces, image_size=32)[1]
    upstream = torch.randn(3, 32, 32, generator=torch.Generator().manual_seed(0))
    upstream[1, 20, 3] = bad
    leaf = vertices.clone().requires_grad_()
    nmr.render_silhouette(leaf, faces, image_size=32).backward(upstream)
    assert leaf.grad[1][healthy[1] != 0].isnan().all() and not leaf.grad[..., 2].any()
    assert torch.equal(leaf.grad[::2], healthy[::2])
    assert torch.equal(render_with_gradient(vertices, faces, image_size=32)[1], healthy)


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
    done = subprocess.run([sys.executable, "-I", "-c", code], check=True, capture_output=True, text=True)
    grown, after = map(float, done.stdout.split())
    assert grown < 100 and after < 100, done.stdout  # MiB; the buffers of the large image take 500


def test_autocast_leaves_the_renderer_alone():
    vertices, faces, camera = bumpy_spheres(batch=2)
    plain = render_with_gradient(vertices, faces, camera=camera, image_size=16)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        leaf = vertices.clone().requires_grad_()
        alpha = nmr.render_silhouette(leaf, faces, camera, image_size=16)
    alpha.backward(torch.randn(alpha.shape, generator=torch.Generator().manual_seed(0)))
    assert torch.equal(alpha, plain[0]) and torch.equal(leaf.grad, plain[1])


def test_running_out_of_memory_is_an_exception():
    """Not the end of the process: the kernels' threads hand std::bad_alloc to the caller."""
    code = (
        "import resource, torch, nmr\n"
        "torch.set_num_threads(2)\n"
        "v, f = nmr.icosphere(1); v = (v * .3 + torch.tensor([0, 0, 2.])).expand(2, -1, -1)\n"
        "nmr.render_silhouette(v, f, image_size=64)\n"
        "held = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (held + 3 * 2**30, -1))\n"
        "try: nmr.render_silhouette(v, f, image_size=8192)\n"
        "except (MemoryError, RuntimeError): print('refused')\n"
        "nmr.render_silhouette(v, f, image_size=64); print('alive')"
    )
    if sys.platform != "linux":
        pytest.skip("sets RLIMIT_AS")
    done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["refused", "alive"], done.stderr


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_tensors_are_staged_through_the_host():
    vertices, faces, camera = bumpy_spheres(batch=2)
    cpu = render_with_gradient(camera.transform(vertices), faces, image_size=16)
    leaf = camera.transform(vertices).cuda().requires_grad_()
    alpha = nmr.render_silhouette(leaf, faces, image_size=16)
    alpha.backward(torch.randn(alpha.shape, generator=torch.Generator().manual_seed(0)).cuda())
    assert alpha.is_cuda and leaf.grad.is_cuda
    assert torch.equal(alpha.cpu(), cpu[0]) and torch.equal(leaf.grad.cpu(), cpu[1])
    edges = nmr.edge_table(faces)
    assert nmr.losses.smoothness_loss(leaf, edges).is_cuda and nmr.voxelize(leaf, faces).is_cuda


def test_behind_the_camera_and_off_screen_draw_nothing():
    vertices, faces = nmr.icosphere(1)
    for shift in ([0, 0, -5.0], [5.0, 0, 3.0], [0, -7.0, 3.0], [0, 0, 500.0]):
        alpha, grad = render_with_gradient(vertices[None] + torch.tensor(shift), faces, image_size=16)
        assert not alpha.any() and not grad.any()


@pytest.mark.parametrize("batch, num_faces", [(0, 5), (2, 0)])
def test_empty_batches_and_meshes(batch, num_faces):
    vertices = torch.zeros(batch, 15, 3, requires_grad=True)
    alpha = nmr.render_silhouette(vertices, torch.zeros(num_faces, 3, dtype=torch.long), image_size=8)
    alpha.sum().backward()
    assert alpha.shape == (batch, 8, 8) and not alpha.any() and not vertices.grad.any()


GOOD = dict(vertices=torch.zeros(2, 4, 3), faces=torch.zeros(5, 3, dtype=torch.long))


@pytest.mark.parametrize(
    "change, error, words",
    [
        (dict(vertices=[[0.0]]), TypeError, "use torch.as_tensor"),
        (dict(vertices=torch.zeros(2, 4)), ValueError, r"vertices must have shape \[B, V, 3\].*float32 \[2, 4\]"),
        (dict(vertices=torch.zeros(2, 4, 3, dtype=torch.bfloat16)), TypeError, r"bfloat16.*vertices.float\(\)"),
        (dict(vertices=torch.zeros(2, 4, 3, dtype=torch.long)), TypeError, "float32 or float64"),
        (dict(faces=torch.zeros(5, 3)), TypeError, r"integer tensor.*call faces.long\(\)"),
        (dict(faces=np.zeros((5, 3), int)), TypeError, "use torch.as_tensor"),
        (dict(faces=torch.zeros(5, 4, dtype=torch.long)), ValueError, r"\[F, 3\]"),
        (dict(faces=torch.zeros(3, 5, 3, dtype=torch.long)), ValueError, "batch size of the vertices, 2"),
        (dict(faces=torch.full((5, 3), 4)), ValueError, "vertex 4, but a mesh has 4 vertices"),
        (dict(faces=torch.full((5, 3), -1)), ValueError, "vertex -1"),
        (dict(camera="front"), TypeError, "transform"),
        (dict(image_size=0), ValueError, "image_size must lie in 1"),
        (dict(image_size=8.0), TypeError, "image_size must be an integer"),
        (dict(image_size=1 << 20), ValueError, "image_size"),
        (dict(near=2.0, far=1.0), ValueError, "near < far"),
        (dict(near=float("nan")), ValueError, "near < far"),
        (dict(eps=0.0), ValueError, "eps must be positive"),
        (dict(eps=1e-60), ValueError, "positive in torch.float32"),
        (dict(camera=nmr.LookAt(torch.rand(3, 3))), ValueError, "2 meshes"),
    ],
)
def test_errors_say_what_was_wanted(change, error, words):
    with pytest.raises(error, match=words):
        nmr.render_silhouette(**{**GOOD, **change})
