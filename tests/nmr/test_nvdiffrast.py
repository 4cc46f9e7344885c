"""The interface of nvdiffrast.torch: values against slow references, gradients against finite differences."""

import importlib
import sys

import pytest
import torch

import nmr
import nmr.nvdiffrast
import nmr.nvdiffrast.torch as dr

CONTEXT = dr.RasterizeCudaContext()
SIZE = (13, 17)


def triangles(seed, faces=12, behind=True):
    """Random triangles in clip space, some of which cross the plane of the eye: pos [2, V, 4], tri [F, 3]."""
    generator = torch.Generator().manual_seed(seed)
    pos = 2 * torch.rand(2, 3 * faces, 4, generator=generator, dtype=torch.float64) - 1
    pos[..., 3] = pos[..., 3] + 0.6 if behind else pos[..., 3].abs() + 0.3
    pos[..., 2] *= 0.9
    return pos, torch.arange(3 * faces).view(-1, 3)


def sphere(size=0.9):
    """A sphere with shared vertices, in perspective: pos [1, V, 4], tri."""
    vertices, tri = nmr.icosphere(1)
    vertices = size * vertices.double() + torch.tensor([0.04, -0.03, -3.0])
    columns = [
        2.5 * vertices[:, 0],
        2.5 * vertices[:, 1],
        -1.2 * vertices[:, 2] - 2.2,
        -vertices[:, 2],
    ]
    return torch.stack(columns, dim=1).unsqueeze(0), tri


def weights_at(pos, tri, x, y):
    """Weights of all faces [F, 3] at a point of the screen, z / w [F], and whether they cover it [F]."""
    corners = pos[tri]  # [F, 3, 4]
    matrix = corners[..., [0, 1, 3]].transpose(1, 2)
    part = torch.linalg.solve(
        matrix, torch.tensor([x, y, 1.0], dtype=pos.dtype).expand(len(tri), 3)
    )
    weights = part / part.sum(1, keepdim=True)
    z, w = ((weights * corners[..., k]).sum(1) for k in (2, 3))
    # part sums to 1 / w of the point, so a positive part lies in front of the eye
    return weights, z / w, (part >= 0).all(1) & ((z / w).abs() <= 1)


def centre(row, column, size=SIZE):
    return (2 * column + 1) / size[1] - 1, (2 * row + 1) / size[0] - 1


def slow_rast(pos, tri, size=SIZE, layer=0):
    rast, slopes = torch.zeros(*size, 4, dtype=pos.dtype), torch.zeros(*size, 4, dtype=pos.dtype)
    for row in range(size[0]):
        for column in range(size[1]):
            weights, depth, covers = weights_at(pos, tri, *centre(row, column, size))
            order = torch.where(covers, depth, torch.inf).argsort()
            if layer >= int(covers.sum()):
                continue
            face = int(order[layer])
            rast[row, column] = torch.tensor([*weights[face, :2], depth[face], face + 1])
            for k, (dx, dy) in enumerate([(1e-5, 0), (0, 1e-5)]):
                ahead, back = (
                    weights_at(pos, tri, *centre(row + s * dy, column + s * dx, size))[0]
                    for s in (1, -1)
                )
                slopes[row, column, k::2] = ((ahead - back)[face, :2]) / 2e-5
    return rast, slopes


@pytest.mark.parametrize("behind", [True, False])
def test_rasterize(behind):
    pos, tri = triangles(3, behind=behind)
    rast, rast_db = dr.rasterize(CONTEXT, pos, tri.int(), SIZE)
    for image in range(2):
        wanted, slopes = slow_rast(pos[image], tri)
        assert (wanted[..., 3] > 0).float().mean() > 0.3
        torch.testing.assert_close(rast[image], wanted)
        torch.testing.assert_close(rast_db[image], slopes, rtol=1e-4, atol=1e-4)
    single, _ = dr.rasterize(CONTEXT, pos.float(), tri, SIZE)
    assert (single[..., 3] == rast[..., 3]).float().mean() > 0.98


def test_range_mode_and_layers():
    pos, tri = triangles(5)
    ranges = torch.tensor([[4, 8], [0, 3], [2, 0]], dtype=torch.int32)
    rast, _ = dr.rasterize(CONTEXT, pos[0], tri, SIZE, ranges=ranges)
    for image, (first, count) in zip(rast, ranges.tolist(), strict=True):
        wanted, _ = (
            slow_rast(pos[0], tri[first : first + count])
            if count
            else (torch.zeros_like(rast[0]), None)
        )
        wanted[..., 3] += first * (wanted[..., 3] > 0)
        torch.testing.assert_close(image, wanted)
    with dr.DepthPeeler(CONTEXT, pos, tri, SIZE) as peeler:
        for layer in range(6):
            rast, _ = peeler.rasterize_next_layer()
            torch.testing.assert_close(rast[1], slow_rast(pos[1], tri, layer=layer)[0])
        with pytest.raises(RuntimeError, match="call rasterize_next_layer"):
            dr.rasterize(CONTEXT, pos, tri, SIZE)
    with pytest.raises(RuntimeError, match="is entered once"):
        peeler.__enter__()


def check_gradient(function, *inputs):
    inputs = [x.detach().clone().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(function, inputs, eps=1e-7, atol=1e-4, rtol=1e-3, nondet_tol=0)


def test_gradients_of_rasterize_and_interpolate():
    pos, tri = triangles(7, faces=4)
    attr = torch.rand(1, 12, 3, dtype=torch.float64)
    size = (5, 6)

    def values(pos, attr):
        rast, rast_db = dr.rasterize(CONTEXT, pos, tri, size)
        assert (rast[..., 3] > 0).any()
        return dr.interpolate(attr, rast, tri, rast_db, diff_attrs=[2, 0])

    check_gradient(values, pos, attr)
    rast, rast_db = dr.rasterize(CONTEXT, pos, tri, size, grad_db=False)
    assert not rast_db.requires_grad
    out, slopes = dr.interpolate(attr, rast, tri, rast_db, diff_attrs="all")
    face = rast[..., 3].long() - 1
    corners = attr[0][tri[face]]  # of any face on background
    weights = torch.stack([rast[..., 0], rast[..., 1], 1 - rast[..., 0] - rast[..., 1]], dim=-1)
    covered = (face >= 0).unsqueeze(-1)
    torch.testing.assert_close(
        out, torch.where(covered, (weights.unsqueeze(-1) * corners).sum(-2), 0)
    )
    by_x = (corners[..., 0, :] - corners[..., 2, :]) * rast_db[..., :1]
    by_x = by_x + (corners[..., 1, :] - corners[..., 2, :]) * rast_db[..., 2:3]
    torch.testing.assert_close(slopes[..., ::2], torch.where(covered, by_x, 0))


def slow_texture(tex, u, v, mode):
    """Bilinear at one place; tex [h, w, C] with row 0 at v = 0."""
    height, width, _ = tex.shape
    x, y = u * width - 0.5, v * height - 0.5
    color = 0
    for row in (int(y // 1), int(y // 1) + 1):
        for column in (int(x // 1), int(x // 1) + 1):
            inside = 0 <= row < height and 0 <= column < width
            weight = (
                (1 - abs(x - column)) * (1 - abs(y - row)) * (1 if inside or mode != "zero" else 0)
            )
            if mode == "wrap":
                texel = tex[row % height, column % width]
            else:
                texel = tex[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
            color = color + weight * texel
    return color


def texture_inputs(seed=0, cube=False):
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    if cube:
        return rand(1, 6, 4, 4, 2), 2 * rand(2, 3, 4, 3) - 1, 0.3 * rand(2, 3, 4, 6), rand(2, 3, 4)
    return rand(2, 8, 4, 3), 3 * rand(2, 3, 4, 2) - 1, 0.3 * rand(2, 3, 4, 4), rand(2, 3, 4)


@pytest.mark.parametrize("mode", ["wrap", "clamp", "zero"])
def test_texture(mode):
    tex, uv, uv_da, bias = texture_inputs()
    out = dr.texture(tex, uv, boundary_mode=mode)
    levels = [tex]
    while max(levels[-1].shape[1:3]) > 1:
        image = levels[-1].permute(0, 3, 1, 2)
        kernel = [min(2, side) for side in image.shape[2:]]
        levels.append(torch.nn.functional.avg_pool2d(image, kernel).permute(0, 2, 3, 1))
    smooth = dr.texture(tex, uv, uv_da, bias, boundary_mode=mode)
    stepped = dr.texture(
        tex, uv, uv_da, bias, filter_mode="linear-mipmap-nearest", boundary_mode=mode
    )
    nearest = dr.texture(tex, uv, filter_mode="nearest", boundary_mode=mode)
    for place in torch.cartesian_prod(*map(torch.arange, uv.shape[:3])).tolist():
        b, at = place[0], tuple(place)
        u, v = uv[at].tolist()
        samples = [slow_texture(level[b], u, v, mode) for level in levels]
        torch.testing.assert_close(out[at], samples[0])
        jacobian = uv_da[at].view(2, 2) * torch.tensor([[4.0], [8.0]])
        level = torch.linalg.matrix_norm(jacobian, 2).log2() + bias[at]
        level = min(max(float(level), 0.0), 3.0)
        low = min(int(level), 2)
        torch.testing.assert_close(
            smooth[at], samples[low] + (level - low) * (samples[low + 1] - samples[low])
        )
        torch.testing.assert_close(stepped[at], samples[round(level)])
        snapped = [(x * n // 1 + 0.5) / n for x, n in zip((u, v), (4, 8), strict=True)]
        torch.testing.assert_close(nearest[at], slow_texture(tex[b], *snapped, mode))
    for mip in (dr.texture_construct_mip(tex), levels[1:]):
        torch.testing.assert_close(
            dr.texture(tex, uv, uv_da, bias, mip=mip, boundary_mode=mode), smooth
        )
    torch.testing.assert_close(
        dr.texture(tex, uv, uv_da, bias, max_mip_level=1, boundary_mode=mode),
        dr.texture(tex, uv, uv_da, bias, mip=levels[1:2], boundary_mode=mode),
    )


@pytest.mark.parametrize("mode", ["wrap", "clamp", "zero", "cube"])
def test_gradients_of_texture(mode):
    tex, uv, uv_da, bias = texture_inputs(1, mode == "cube")
    check_gradient(lambda *inputs: dr.texture(*inputs, boundary_mode=mode), tex, uv, uv_da, bias)
    check_gradient(lambda tex, uv: dr.texture(tex, uv, boundary_mode=mode), tex, uv)
    check_gradient(lambda tex: dr.texture(tex, uv, filter_mode="nearest", boundary_mode=mode), tex)


def test_cube_map():
    """Texels that show their own direction are a smooth map without seams; faces are OpenGL's."""
    size = 32
    t, s = torch.meshgrid(*2 * [(2 * torch.arange(size) + 1) / size - 1], indexing="ij")
    one = torch.ones_like(s)
    faces = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    texels = torch.stack(
        [torch.nn.functional.normalize(torch.stack(face, -1), dim=-1) for face in faces]
    )[None]
    toward = torch.nn.functional.normalize(
        torch.randn(1, 40, 50, 3, generator=torch.manual_seed(0)), dim=-1
    )
    edges = torch.tensor(
        [[1.0, 1.0, 0.3], [-1.0, 0.2, 1.0], [0.4, -1.0, -1.0], [1.0, 1.0, 1.0], [-1.0, 1.0, -1.0]]
    )
    toward[0, 0, :5] = torch.nn.functional.normalize(edges, dim=-1)
    seen = dr.texture(texels, 3 * toward, boundary_mode="cube")
    assert (seen - toward).abs().max() < 0.03
    nearest = dr.texture(texels, toward, filter_mode="nearest", boundary_mode="cube")
    assert (nearest - toward).abs().max() < 0.07
    steps = 1e-5 * torch.randn(1, 40, 50, 3, generator=torch.manual_seed(1))
    assert (dr.texture(texels, toward + steps, boundary_mode="cube") - seen).abs().max() < 1e-3
    invalid = (
        torch.tensor([[0.0, 0.0, 0.0], [float("nan"), 1.0, 0.0]]).view(1, 1, 2, 3).requires_grad_()
    )
    colors = dr.texture(texels, invalid, boundary_mode="cube")
    assert torch.autograd.grad(colors.sum(), invalid)[0].eq(0).all()
    assert colors.eq(0).all()


def test_sample_texture():
    """The same as a UVTexture at the same places."""
    vertices, faces = nmr.icosphere(2)
    image, uv = torch.rand(32, 64, 3, generator=torch.manual_seed(0)), vertices[:, :2] * 2
    fragments = nmr.render_fragments(vertices, faces, nmr.LookAt([0.0, 0.5, -3.0]), image_size=20)
    places = fragments.interpolate(uv)
    inside = fragments.covered.unsqueeze(-1)
    for wrap in ("repeat", "clamp", "mirror"):
        wanted = nmr.UVTexture(image, uv, wrap=wrap).sample(fragments)
        torch.testing.assert_close(inside * nmr.sample_texture(image, places, wrap=wrap), wanted)
    tex, uv, uv_da, _ = texture_inputs(2)
    uv_da[..., [1, 2]] = 0  # the axes of the ellipse are those of the pixel
    smooth = nmr.sample_texture(tex.flip(1), uv, uv_da)
    torch.testing.assert_close(smooth, dr.texture(tex, uv, uv_da))
    with pytest.raises(
        ValueError, match=r"derivatives must have shape \[B, H, W, 4\], got float64 \[2, 3, 4, 2\]"
    ):
        nmr.sample_texture(tex, uv, uv)
    with pytest.raises(TypeError, match=r"uv must be a float tensor \[B, H, W, 2\], got list"):
        nmr.sample_texture(tex, [0.5, 0.5])
    with pytest.raises(ValueError, match=r"image must be one for all 1 images"):
        nmr.sample_texture(tex, uv[:1])


def slow_antialias(color, rast, pos, tri):
    """As the documentation says, pair by pair, for one image."""
    height, width, _ = color.shape
    scale = torch.tensor([width, height]) / 2
    screen = (pos[:, :2] / pos[:, 3:] + 1) * scale - 0.5  # in pixels; centres are the integers
    out = color.clone()
    for row in range(height):
        for column in range(width):
            for axis in (0, 1):
                p, q = (row, column), (row + axis, column + 1 - axis)
                if q[0] >= height or q[1] >= width or rast[p][3] == rast[q][3]:
                    continue
                near, far = (
                    (p, q)
                    if rast[q][3] == 0 or (rast[p][3] > 0 and rast[p][2] < rast[q][2])
                    else (q, p)
                )
                face = tri[int(rast[near][3]) - 1].tolist()
                for k in range(3):
                    ends = {face[k - 1], face[k - 2]}
                    a, b = (screen[v] for v in ends)
                    sides = []
                    for other in tri.tolist():
                        if ends < set(other):
                            (apex,) = set(other) - ends
                            c = screen[apex]
                            sides.append(
                                bool((b[0] - a[0]) * (c[1] - a[1]) > (b[1] - a[1]) * (c[0] - a[0]))
                            )
                    place = near[1] if axis == 0 else near[0]
                    line = near[0] if axis == 0 else near[1]
                    across = 1 - axis
                    steep = abs(b[across] - a[across]) > abs(b[axis] - a[axis])
                    if len(set(sides)) > 1 or not steep or (a[across] < line) == (b[across] < line):
                        continue
                    share = (line - a[across]) / (b[across] - a[across])
                    distance = abs(a[axis] + share * (b[axis] - a[axis]) - place)
                    toward = (a[axis] + share * (b[axis] - a[axis]) - place) * (
                        1 if near == p else -1
                    )
                    if not 0 <= toward <= 1:
                        continue
                    to, other = (far, near) if distance > 0.5 else (near, far)
                    out[to] = out[to] + abs(distance - 0.5) * (color[other] - color[to])
    return out


@pytest.mark.parametrize(
    "scene", [sphere, lambda: (triangles(9, behind=False)[0][:1], triangles(9)[1])]
)
def test_antialias(scene):
    pos, tri = scene()
    rast, _ = dr.rasterize(CONTEXT, pos, tri, SIZE)
    color = torch.rand(1, *SIZE, 2, dtype=torch.float64, generator=torch.manual_seed(0))
    out = dr.antialias(color, rast, pos, tri)
    wanted = slow_antialias(color[0], rast[0], pos[0], tri)
    assert 5 < (wanted != color[0]).any(-1).sum() < wanted.shape[0] * wanted.shape[1] * 0.7
    torch.testing.assert_close(out[0], wanted)
    check_gradient(lambda color, pos: dr.antialias(color, rast, pos, tri), color, pos)
    topology = dr.antialias_construct_topology_hash(tri)
    leaf = pos.clone().requires_grad_()
    once, twice = (
        torch.autograd.grad(
            dr.antialias(color, rast, leaf, tri, topology, n)[..., 0].square().sum(), leaf
        )[0]
        for n in (1.0, 2.0)
    )
    torch.testing.assert_close(twice, 2 * once)


def pipeline(pos, tex, vertices_uv, tri):
    rast, rast_db = dr.rasterize(CONTEXT, pos, tri, SIZE)
    uv, uv_da = dr.interpolate(vertices_uv, rast, tri, rast_db, "all")
    color = dr.texture(tex, uv, uv_da, boundary_mode="clamp")
    return dr.antialias(color, rast, pos, tri)


def test_threads_and_second_derivatives():
    pos, tri = sphere()
    pos = pos.float().expand(3, -1, -1).contiguous().requires_grad_()
    inputs = pos, torch.rand(1, 8, 8, 3, requires_grad=True), pos.detach()[..., :2]
    results = []
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        image = pipeline(*inputs, tri)
        results.append([image, *torch.autograd.grad(image.square().sum(), inputs[:2])])
    torch.set_num_threads(1)
    assert all(
        torch.equal(*pair) for other in results[1:] for pair in zip(results[0], other, strict=True)
    )
    assert all(x.abs().sum() > 0 for x in results[0])
    with pytest.raises(RuntimeError, match="has no second derivative"):
        torch.autograd.grad(pipeline(*inputs, tri).sum(), pos, create_graph=True)[
            0
        ].sum().backward()


def test_install_as(monkeypatch, tmp_path):
    (tmp_path / "nvdiffrast").mkdir()  # a checkout beside the script is no package
    monkeypatch.syspath_prepend(tmp_path)
    for key in [key for key in sys.modules if key.partition(".")[0] == "nvdiffrast"]:
        monkeypatch.delitem(sys.modules, key)
    nmr.nvdiffrast.install_as()
    try:
        assert importlib.import_module("nvdiffrast.torch") is dr
        assert sys.modules["nvdiffrast"].torch is dr
    finally:
        for key in [key for key in sys.modules if key.partition(".")[0] == "nvdiffrast"]:
            del sys.modules[key]
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


@pytest.mark.parametrize(
    "call, words",
    [
        (
            lambda: dr.rasterize(None, POS, TRI, (4, 4)),
            "first argument must be a RasterizeCudaContext, got NoneType",
        ),
        (
            lambda: dr.rasterize(CONTEXT, POS.half(), TRI, (4, 4)),
            "pos must be a float32 or float64 tensor",
        ),
        (
            lambda: dr.rasterize(CONTEXT, POS[..., :3], TRI, (4, 4)),
            "pos must have four coordinates",
        ),
        (
            lambda: dr.rasterize(CONTEXT, POS[0], TRI, (4, 4)),
            r"needs ranges, an integer tensor \[B, 2\], got NoneType",
        ),
        (
            lambda: dr.rasterize(CONTEXT, POS[0], TRI, (4, 4), torch.tensor([[0, 2]])),
            "must lie within the 1 faces",
        ),
        (lambda: dr.rasterize(CONTEXT, POS, TRI[None], (4, 4)), r"tri must have shape \[F, 3\]"),
        (
            lambda: dr.rasterize(CONTEXT, POS, TRI + 3, (4, 4)),
            "refer to vertex 3, but a mesh has 3 vertices",
        ),
        (
            lambda: dr.DepthPeeler(CONTEXT, POS, TRI, (4, 4)).rasterize_next_layer(),
            "inside of `with DepthPeeler",
        ),
        (lambda: dr.interpolate(POS, RAST + 5, TRI), "does not belong to these faces"),
        (lambda: dr.interpolate(POS, RAST, TRI, diff_attrs=[0]), "diff_attrs needs rast_db"),
        (lambda: dr.texture(TEX, UV, filter_mode="cubic"), "filter_mode must be 'auto' or"),
        (
            lambda: dr.texture(TEX, UV, filter_mode="linear-mipmap-linear"),
            "needs uv_da or mip_level_bias",
        ),
        (
            lambda: dr.texture(TEX, UV, boundary_mode="cube"),
            r"tex must have shape \[B, 6, h, h, C\]",
        ),
        (lambda: dr.texture(TEX.expand(3, 4, 4, 1), UV), "tex must have batch size 1 or 1"),
        (
            lambda: dr.texture(TEX, UV, RAST, mip=[TEX]),
            r"half the sides of the one before, \[1, 2, 2, 1\]",
        ),
        (lambda: dr.texture(TEX, UV, RAST, mip=3), "mip must be made by texture_construct_mip"),
        (
            lambda: dr.texture(TEX, UV, RAST, mip=dr.texture_construct_mip(TEX[:, :2])),
            r"mip belongs to a texture \[1, 2, 4, 1\]",
        ),
        (
            lambda: dr.texture_construct_mip(TEX, -1),
            "max_mip_level must be an integer of at least 0",
        ),
        (lambda: dr.antialias(UV, RAST, POS, TRI, 3), "topology_hash must be made by"),
        (
            lambda: dr.antialias(
                UV, RAST, POS, TRI, dr.antialias_construct_topology_hash(TRI.expand(2, 3))
            ),
            r"topology_hash belongs to faces \[2, 3\]",
        ),
    ],
)
def test_errors(call, words):
    with pytest.raises((TypeError, ValueError, RuntimeError), match=words):
        call()
