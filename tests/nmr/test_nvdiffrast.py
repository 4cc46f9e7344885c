"""The interface of nvdiffrast.torch: values against slow references, gradients against finite differences."""

import itertools

import pytest
import torch
from scenes import double, leaf_of, uniform, value_and_gradients
from torch.autograd import gradcheck
from torch.testing import assert_close

import nmr
import nmr.nvdiffrast.torch as dr

CONTEXT = dr.RasterizeCudaContext()
SIZE = (13, 17)


def triangles(seed, faces=12, behind=True):
    """Random triangles in clip space, some of which cross the plane of the eye: pos [2, V, 4], tri [F, 3]."""
    pos = 2 * uniform(2, 3 * faces, 4, seed=seed) - 1
    pos[..., 3] = pos[..., 3] + 0.6 if behind else pos[..., 3].abs() + 0.3
    pos[..., 2] *= 0.9
    return pos, torch.arange(3 * faces).view(-1, 3)


def sphere():
    """A sphere with shared vertices, in perspective: pos [1, V, 4], tri."""
    vertices, tri = nmr.icosphere(1)
    x, y, z = (0.9 * vertices.double() + double([0.04, -0.03, -3.0])).unbind(1)
    return torch.stack([2.5 * x, 2.5 * y, -1.2 * z - 2.2, -z], dim=1).unsqueeze(0), tri


def weights_at(pos, tri, x, y):
    """Weights of all faces [F, 3] at a point of the screen, z / w [F], and whether they cover it [F]."""
    corners = pos[tri]  # [F, 3, 4]
    matrix = corners[..., [0, 1, 3]].transpose(1, 2)
    part = torch.linalg.solve(matrix, double([x, y, 1.0]).expand(len(tri), 3))
    weights = part / part.sum(1, keepdim=True)
    z, w = (weights.unsqueeze(1) @ corners[..., 2:]).squeeze(1).unbind(1)
    # part sums to 1 / w of the point, so a positive part lies in front of the eye
    return weights, z / w, (part >= 0).all(1) & ((z / w).abs() <= 1)


def centre(row, column, size=SIZE):
    return (2 * column + 1) / size[1] - 1, (2 * row + 1) / size[0] - 1


def slow_rast(pos, tri, size=SIZE, layer=0):
    rast, slopes = torch.zeros(2, *size, 4).double()
    for row, column in itertools.product(*map(range, size)):
        weights, depth, covers = weights_at(pos, tri, *centre(row, column, size))
        if layer >= int(covers.sum()):
            continue
        face = int(torch.where(covers, depth, torch.inf).argsort()[layer])
        rast[row, column] = torch.tensor([*weights[face, :2], depth[face], face + 1])
        for k, (dx, dy) in enumerate([(1e-5, 0), (0, 1e-5)]):
            ahead, back = (
                weights_at(pos, tri, *centre(row + s * dy, column + s * dx, size))[0][face, :2]
                for s in (1, -1)
            )
            slopes[row, column, k::2] = (ahead - back) / 2e-5
    return rast, slopes


@pytest.mark.parametrize("behind", [True, False])
def test_rasterize(behind):
    pos, tri = triangles(3, behind=behind)
    rast, rast_db = dr.rasterize(CONTEXT, pos, tri.int(), SIZE)
    for image in range(2):
        wanted, slopes = slow_rast(pos[image], tri)
        assert (wanted[..., 3] > 0).float().mean() > 0.3
        assert_close(rast[image], wanted)
        assert_close(rast_db[image], slopes, rtol=1e-4, atol=1e-4)
    single, _ = dr.rasterize(CONTEXT, pos.float(), tri, SIZE)
    assert (single[..., 3] == rast[..., 3]).float().mean() > 0.98


def test_range_mode():
    pos, tri = triangles(5)
    ranges = torch.tensor([[4, 8], [0, 3], [2, 0]], dtype=torch.int32)
    rast, _ = dr.rasterize(CONTEXT, pos[0], tri, SIZE, ranges=ranges)
    assert not rast[2].any()
    for image, (first, count) in zip(rast[:2], ranges.tolist(), strict=False):
        wanted, _ = slow_rast(pos[0], tri[first : first + count])
        wanted[..., 3] += first * (wanted[..., 3] > 0)
        assert_close(image, wanted)


def test_depth_peeling():
    pos, tri = triangles(5)
    with dr.DepthPeeler(CONTEXT, pos, tri, SIZE) as peeler:
        for layer in range(6):
            rast, _ = peeler.rasterize_next_layer()
            assert_close(rast[1], slow_rast(pos[1], tri, layer=layer)[0])
        with pytest.raises(RuntimeError, match="call rasterize_next_layer"):
            dr.rasterize(CONTEXT, pos, tri, SIZE)
    with pytest.raises(RuntimeError, match="is entered once"):
        peeler.__enter__()


def check_gradient(function, *inputs):
    inputs = [leaf_of(x) for x in inputs]
    gradcheck(function, inputs, eps=1e-7, atol=1e-4, rtol=1e-3, nondet_tol=0)


def test_gradients_of_rasterize_and_interpolate():
    pos, tri = triangles(7, faces=4)

    def values(pos, attr):
        rast, rast_db = dr.rasterize(CONTEXT, pos, tri, (5, 6))
        assert (rast[..., 3] > 0).any()
        return dr.interpolate(attr, rast, tri, rast_db, diff_attrs=[2, 0])

    check_gradient(values, pos, uniform(1, 12, 3))


def test_interpolate():
    pos, tri = triangles(7, faces=4)
    attr = uniform(1, 12, 3)
    rast, rast_db = dr.rasterize(CONTEXT, leaf_of(pos), tri, (5, 6), grad_db=False)
    assert rast.requires_grad and not rast_db.requires_grad
    out, slopes = dr.interpolate(attr, rast, tri, rast_db, diff_attrs="all")
    u, v, _, number = rast.unsqueeze(-1).unbind(-2)
    a, b, c = attr[0][tri[number.squeeze(-1).long() - 1]].unbind(-2)  # of any face on background
    wanted = u * a + v * b + (1 - u - v) * c
    assert_close(out, torch.where(number > 0, wanted, 0))
    by_x = (a - c) * rast_db[..., :1] + (b - c) * rast_db[..., 2:3]
    assert_close(slopes[..., ::2], torch.where(number > 0, by_x, 0))


def slow_antialias(color, rast, pos, tri):
    """As the documentation says, pair by pair, for one image."""
    height, width, _ = color.shape
    scale = torch.tensor([width, height]) / 2
    screen = (pos[:, :2] / pos[:, 3:] + 1) * scale - 0.5  # in pixels; centres are the integers
    out = color.clone()
    for row, column, axis in itertools.product(range(height), range(width), (0, 1)):
        p, q = (row, column), (row + axis, column + 1 - axis)
        if q[0] >= height or q[1] >= width or rast[p][3] == rast[q][3]:
            continue
        p_is_near = rast[q][3] == 0 or (rast[p][3] > 0 and rast[p][2] < rast[q][2])
        near, far = (p, q) if p_is_near else (q, p)
        face = tri[int(rast[near][3]) - 1].tolist()
        line, place = near if axis == 0 else near[::-1]
        for k in range(3):
            ends = {face[k - 1], face[k - 2]}
            a, b = (screen[v] for v in ends)
            edge = b - a
            apexes = [
                screen[v] for other in tri.tolist() if ends < {*other} for v in {*other} - ends
            ]
            sides = {bool(edge[0] * (c - a)[1] > edge[1] * (c - a)[0]) for c in apexes}
            steep = abs(edge[1 - axis]) > abs(edge[axis])
            if len(sides) > 1 or not steep or (a[1 - axis] < line) == (b[1 - axis] < line):
                continue
            share = (line - a[1 - axis]) / edge[1 - axis]
            distance = (a[axis] + share * edge[axis] - place) * (1 if p_is_near else -1)
            if 0 <= distance <= 1:
                to, other = (far, near) if distance > 0.5 else (near, far)
                out[to] = out[to] + abs(distance - 0.5) * (color[other] - color[to])
    return out


@pytest.mark.parametrize(
    "scene", [sphere, lambda: (triangles(9, behind=False)[0][:1], triangles(9)[1])]
)
def test_antialias(scene):
    pos, tri = scene()
    rast, _ = dr.rasterize(CONTEXT, pos, tri, SIZE)
    color = uniform(1, *SIZE, 2)
    out = dr.antialias(color, rast, pos, tri)
    wanted = slow_antialias(color[0], rast[0], pos[0], tri)
    changed = (wanted != color[0]).any(-1)
    assert 5 < changed.sum() < 0.7 * changed.numel()
    assert_close(out[0], wanted)
    check_gradient(lambda color, pos: dr.antialias(color, rast, pos, tri), color, pos)
    topology = dr.antialias_construct_topology_hash(tri)
    once, twice = (
        value_and_gradients(lambda x, n=n: dr.antialias(color, rast, x, tri, topology, n), pos)[1]
        for n in (1.0, 2.0)
    )
    assert once.any()
    assert_close(twice, 2 * once)


def test_calls_without_an_effect():
    dr.set_log_level(0)
    assert dr.get_log_level() == 1
    context = dr.RasterizeGLContext(output_db=False, mode="manual", device="cuda:0")
    context.set_context()
    context.release_context()


POS = torch.zeros(1, 3, 4)
TRI = torch.zeros(1, 3, dtype=torch.int32)
UV = torch.zeros(1, 2, 2, 2)
TEX = torch.zeros(1, 4, 4, 1)
RAST = torch.zeros(1, 2, 2, 4)


def raster(context=CONTEXT, pos=POS, tri=TRI, **how):
    return dr.rasterize(context, pos, tri, (4, 4), **how)


def texture(tex=TEX, uv_da=None, **how):
    return dr.texture(tex, UV, uv_da, **how)


def antialias(topology_hash):
    return dr.antialias(UV, RAST, POS, TRI, topology_hash)


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda: raster(None), "first argument must be a RasterizeCudaContext, got NoneType"),
        (lambda: raster(pos=POS.half()), "pos must be a float32 or float64 tensor"),
        (lambda: raster(pos=POS[..., :3]), "pos must have four coordinates"),
        (lambda: raster(pos=POS[0]), r"needs ranges, an integer tensor \[B, 2\], got NoneType"),
        (
            lambda: raster(pos=POS[0], ranges=torch.tensor([[0, 2]])),
            "must lie within the 1 faces",
        ),
        (lambda: raster(tri=TRI[None]), r"tri must have shape \[F, 3\]"),
        (lambda: raster(tri=TRI + 3), "tri refer to row 3, but pos has 3 rows"),
        (
            lambda: dr.DepthPeeler(CONTEXT, POS, TRI, (4, 4)).rasterize_next_layer(),
            "inside of `with DepthPeeler",
        ),
        (lambda: dr.interpolate(POS, RAST + 5, TRI), "does not belong to these faces"),
        (lambda: dr.interpolate(POS, RAST, TRI, diff_attrs=[0]), "diff_attrs needs rast_db"),
        (lambda: texture(filter_mode="cubic"), "filter_mode must be 'auto' or"),
        (lambda: texture(filter_mode="linear-mipmap-linear"), "needs uv_da or mip_level_bias"),
        (lambda: texture(boundary_mode="cube"), r"tex must have shape \[B, 6, h, h, C\]"),
        (lambda: texture(TEX.expand(3, 4, 4, 1)), "tex must have batch size 1 or 1"),
        (lambda: texture(uv_da=RAST, mip=[TEX]), r"half the sides .* before, \[1, 2, 2, 1\]"),
        (lambda: texture(uv_da=RAST, mip=3), "mip must be made by texture_construct_mip"),
        (
            lambda: texture(uv_da=RAST, mip=dr.texture_construct_mip(TEX[:, :2])),
            r"mip belongs to a texture \[1, 2, 4, 1\]",
        ),
        (lambda: dr.texture_construct_mip(TEX, -1), "max_mip_level .* integer of at least 0"),
        (lambda: antialias(3), "topology_hash must be made by"),
        (
            lambda: antialias(dr.antialias_construct_topology_hash(TRI.expand(2, 3))),
            r"topology_hash belongs to faces \[2, 3\]",
        ),
    ],
)
def test_errors(call, words):
    with pytest.raises((TypeError, ValueError, RuntimeError), match=words):
        call()


def test_the_default_device_does_not_matter():
    pos, tri = triangles(0)
    usual = dr.rasterize(CONTEXT, pos, tri, SIZE)
    torch.set_default_device("meta")
    try:
        found = dr.rasterize(CONTEXT, pos, tri, SIZE)
    finally:
        torch.set_default_device(None)
    assert all(torch.equal(a, b) for a, b in zip(found, usual, strict=True))
