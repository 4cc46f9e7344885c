"""sample_texture_cubes and interpolate: slow definitions, finite differences, their invariances, bad input."""

import numpy as np
import pytest
import torch
from scenes import different_soups, for_threads, pack, random_soup

import nmr
from nmr import _C, reference

EPS = 1e-3


def fragments_of(vertices, faces, raster_size, starts=None):
    face_index = nmr.ops.rasterize(vertices, faces, starts, raster_size, raster_size, True, 0.1, 50.0)
    return face_index, nmr.ops.fragments(vertices, faces, starts, face_index, 50.0)[0]


def random_like(shape, dtype=torch.float64, seed=0):
    return torch.rand(shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def with_gradients(op, *leaves, seed=1):
    """The output and the gradients of a random sum of it; every image of the batch has the same upstream gradient."""
    leaves = [t.clone().requires_grad_() for t in leaves]
    output = op(*leaves)
    upstream = torch.randn(output.shape[1:], dtype=output.dtype, generator=torch.Generator().manual_seed(seed))
    output.backward(upstream.expand_as(output))
    return [output.detach(), *(t.grad for t in leaves)]


# --- texture cubes


@pytest.mark.parametrize("size, channels", [(1, 3), (2, 3), (3, 1), (4, 5)])
@pytest.mark.parametrize("texture_batch", [1, 2])
def test_texture_cubes_equal_the_slow_definition(size, channels, texture_batch):
    vertices, faces = random_soup(0)
    face_index, weights = fragments_of(vertices, faces, 10)
    assert (face_index >= len(faces)).any() and (face_index < 0).any()
    textures = random_like((texture_batch, len(faces), size, size, size, channels))
    colors, grad = with_gradients(lambda t: nmr.ops.sample_texture_cubes(t, face_index, weights, None, EPS), textures)

    def slow(textures):
        out = torch.zeros(*face_index.shape, channels, dtype=torch.float64)
        for b, y, x in (face_index >= 0).nonzero().tolist():
            cube = textures[b % texture_batch, face_index[b, y, x] % len(faces)]
            out[b, y, x] = reference.texture_color(cube, weights[b, y, x], EPS)
        return out

    slow_colors, slow_grad = with_gradients(slow, textures)
    torch.testing.assert_close(colors, slow_colors)
    torch.testing.assert_close(grad, slow_grad)


def test_axis_k_of_a_cube_is_the_weight_of_vertex_k():
    """A cube that holds its own coordinates gives the weights back, for originals and reversed copies alike."""
    vertices, faces = random_soup(1)
    face_index, weights = fragments_of(vertices, faces, 16)
    axis = torch.linspace(0, 1, 3, dtype=torch.float64)
    cube = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).expand(1, len(faces), -1, -1, -1, -1)
    colors = nmr.ops.sample_texture_cubes(cube.contiguous(), face_index, weights, None, 1e-12)
    torch.testing.assert_close(colors, weights)


@pytest.mark.parametrize("eps", [0.0, 1e-12, 0.5])
def test_texture_cubes_at_their_far_end(eps):
    """At a corner of a face, where t = ts - 1 unless eps keeps it below: the last texel, never the one beyond."""
    textures = random_like((1, 1, 4, 4, 4, 1), torch.float32)
    face_index = torch.zeros((1, 1, 1), dtype=torch.int32)
    for k in range(3):
        weights = torch.zeros((1, 1, 1, 3))
        weights[..., k] = 1
        index = [0, 0, 0]
        index[k] = 3
        color = nmr.ops.sample_texture_cubes(textures, face_index, weights, None, eps).item()
        last = textures[0, 0][tuple(index)].item()
        index[k] = 2
        expected = (1 - eps) * last + eps * textures[0, 0][tuple(index)].item()
        assert color == pytest.approx(expected, rel=1e-6)
    assert (
        nmr.ops.sample_texture_cubes(textures, face_index, weights * float("nan"), None, eps) == textures[0, 0, 0, 0, 0]
    )


def test_texture_cubes_gradcheck():
    vertices, faces = random_soup(2, num_faces=3)
    face_index, weights = fragments_of(vertices, faces, 5)
    textures = random_like((1, 3, 2, 2, 2, 2)).requires_grad_()
    assert torch.autograd.gradcheck(lambda t: nmr.ops.sample_texture_cubes(t, face_index, weights, None, EPS), textures)


# --- interpolate


@pytest.mark.parametrize("attribute_batch", [1, 2])
@pytest.mark.parametrize("corners_per_image", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 6])
def test_interpolate_equals_the_formula(attribute_batch, corners_per_image, channels):
    vertices, faces = random_soup(0)
    face_index, weights = fragments_of(vertices, faces, 14)
    attributes = random_like((attribute_batch, 9, channels))
    g = torch.Generator().manual_seed(0)
    corners = torch.randint(0, 9, (2, len(faces), 3) if corners_per_image else (len(faces), 3), generator=g)

    def formula(attributes, weights):
        face = face_index.clamp_min(0).long() % len(faces)
        picked = torch.stack(
            [attributes[b % attribute_batch][(corners[b] if corners_per_image else corners)[face[b]]] for b in range(2)]
        )
        values = (weights[..., None] * picked).sum(-2)
        return torch.where((face_index >= 0)[..., None], values, torch.zeros_like(values))

    ours = with_gradients(lambda a, w: nmr.ops.interpolate(a, corners, face_index, w, None), attributes, weights)
    slow = with_gradients(formula, attributes, weights)
    for a, b in zip(ours, slow, strict=True):
        torch.testing.assert_close(a, b)


def test_interpolate_gradcheck():
    vertices, faces = random_soup(2, num_faces=3)
    face_index, weights = fragments_of(vertices, faces, 5)
    attributes = random_like((1, 9, 2)).requires_grad_()
    weights.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda a, w: nmr.ops.interpolate(a, faces, face_index, w, None), (attributes, weights)
    )


def test_interpolate_through_fragments_gradcheck():
    """Colours depend on the vertices through the weights: perspective-correct interpolation is differentiable."""
    vertices, faces = random_soup(3, num_faces=3)
    face_index, _ = fragments_of(vertices, faces, 6)
    attributes = random_like((2, 9, 2))

    def colors(vertices):
        weights, _ = nmr.ops.fragments(vertices, faces, None, face_index, 50.0)
        return nmr.ops.interpolate(attributes, faces, face_index, weights, None)

    assert torch.autograd.gradcheck(colors, vertices.requires_grad_())


@pytest.mark.parametrize("of_attributes, of_weights", [(True, False), (False, True)])
def test_interpolate_computes_only_the_gradients_asked_for(of_attributes, of_weights):
    vertices, faces = random_soup(2)
    face_index, weights = fragments_of(vertices, faces, 12)
    attributes = random_like((1, 36, 3))
    both = with_gradients(lambda a, w: nmr.ops.interpolate(a, faces, face_index, w, None), attributes, weights)[1:]
    attributes.requires_grad_(of_attributes)
    weights.requires_grad_(of_weights)
    output = nmr.ops.interpolate(attributes, faces, face_index, weights, None)
    upstream = torch.randn(output.shape[1:], dtype=output.dtype, generator=torch.Generator().manual_seed(1))
    output.backward(upstream.expand_as(output))
    for leaf, asked, expected in zip((attributes, weights), (of_attributes, of_weights), both, strict=True):
        assert torch.equal(leaf.grad, expected) if asked else leaf.grad is None


# --- both


@pytest.mark.parametrize("batch, raster_size", [(5, 40), (2, 300)])
@pytest.mark.parametrize("shared", [False, True])
def test_same_bits_for_any_number_of_threads(batch, raster_size, shared):
    vertices, faces = random_soup(4, batch, 60, torch.float32)
    face_index, weights = fragments_of(vertices, faces, raster_size)
    textures = random_like((1 if shared else batch, len(faces), 3, 3, 3, 3), torch.float32)
    attributes = random_like((1 if shared else batch, vertices.shape[1], 3), torch.float32)

    def run():
        return [
            *with_gradients(lambda t: nmr.ops.sample_texture_cubes(t, face_index, weights, None, EPS), textures),
            *with_gradients(lambda a, w: nmr.ops.interpolate(a, faces, face_index, w, None), attributes, weights),
        ]

    results = for_threads((1, 2, 5), run)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_packed_equals_one_by_one():
    meshes = different_soups()
    vertices, faces, starts = pack(meshes)
    face_index, weights = fragments_of(vertices, faces, 150, starts)
    textures = random_like((len(faces), 2, 2, 2, 3), torch.float32)
    attributes = random_like((len(vertices), 4), torch.float32)
    cubes = with_gradients(lambda t: nmr.ops.sample_texture_cubes(t, face_index, weights, starts, EPS), textures)
    values = with_gradients(lambda a, w: nmr.ops.interpolate(a, faces, face_index, w, starts), attributes, weights)
    for b, (_, f) in enumerate(meshes):
        image = slice(b, b + 1)
        rows, own = (slice(starts[b, k], starts[b + 1, k]) for k in range(2))
        o, w = face_index[image], weights[image]
        single = with_gradients(
            lambda t, o=o, w=w: nmr.ops.sample_texture_cubes(t, o, w, None, EPS), textures[None, own]
        )
        assert torch.equal(single[0], cubes[0][image]) and torch.equal(single[1][0], cubes[1][own])
        single = with_gradients(lambda a, w, o=o, f=f: nmr.ops.interpolate(a, f, o, w, None), attributes[None, rows], w)
        assert torch.equal(single[0], values[0][image]) and torch.equal(single[1][0], values[1][rows])
        assert torch.equal(single[2], values[2][image])


@pytest.mark.parametrize("batch, num_faces", [(0, 5), (2, 0)])
@pytest.mark.parametrize("shared", [False, True])
def test_empty_batches_and_meshes(batch, num_faces, shared):
    vertices, faces = torch.zeros(batch, 15, 3), torch.zeros(num_faces, 3, dtype=torch.long)
    face_index, weights = fragments_of(vertices, faces, 8)
    lead = 1 if shared else batch
    textures, attributes = torch.ones(lead, num_faces, 2, 2, 2, 3), torch.ones(lead, 15, 3)
    for output, *grads in (
        with_gradients(lambda t: nmr.ops.sample_texture_cubes(t, face_index, weights, None, EPS), textures),
        with_gradients(lambda a, w: nmr.ops.interpolate(a, faces, face_index, w, None), attributes, weights),
    ):
        assert output.shape == (batch, 8, 8, 3) and not output.any() and not any(g.any() for g in grads)


@pytest.mark.parametrize("dtype, packed", [(torch.float32, False), (torch.float64, True)])
def test_opcheck(dtype, packed):
    vertices, faces = random_soup(0, dtype=dtype)
    starts, lead = None, (2,)
    if packed:
        vertices, faces, starts = pack([(v, faces) for v in vertices])
        lead = ()
    face_index, weights = fragments_of(vertices, faces, 10, starts)
    textures = random_like((*lead, 12 * (1 + packed), 2, 2, 2, 3), dtype)
    attributes = random_like((*lead, 36 * (1 + packed), 2), dtype)
    leaf = textures.clone().requires_grad_()
    torch.library.opcheck(nmr.ops.sample_texture_cubes, (leaf, face_index, weights, starts, EPS))
    colors = random_like((2, 10, 10, 3), dtype)
    shape = list(textures.shape)
    torch.library.opcheck(nmr.ops.texture_cubes_backward, (face_index, weights, starts, colors, shape, EPS))
    leaves = attributes.clone().requires_grad_(), weights.clone().requires_grad_()
    torch.library.opcheck(nmr.ops.interpolate, (leaves[0], faces, face_index, leaves[1], starts))
    arguments = attributes, faces, face_index, weights, starts, colors[..., :2]
    torch.library.opcheck(nmr.ops.interpolate_backward, (*arguments, True, False))


def test_second_derivatives_are_refused():
    vertices, faces = random_soup(0)
    face_index, weights = fragments_of(vertices, faces, 10)
    textures = random_like((1, 12, 2, 2, 2, 3)).requires_grad_()
    attributes = random_like((1, 36, 3)).requires_grad_()
    for leaf, output in (
        (textures, nmr.ops.sample_texture_cubes(textures, face_index, weights, None, EPS)),
        (attributes, nmr.ops.interpolate(attributes, faces, face_index, weights, None)),
    ):
        (grad,) = torch.autograd.grad(output.square().sum(), leaf, create_graph=True)
        with pytest.raises(RuntimeError, match="render_rgb has no second derivative"):
            grad.square().sum().backward()


CALLS = {
    "cubes": lambda a: _C.texture_cubes_forward(
        a["textures"], a["face_index"], a["weights"], a["starts"], a["colors"], EPS, 1
    ),
    "cubes_backward": lambda a: _C.texture_cubes_backward(
        a["face_index"], a["weights"], a["starts"], a["colors"], a["textures"], EPS, 1
    ),
    "interpolate": lambda a: _C.interpolate_forward(
        a["attributes"], a["corners"], a["face_index"], a["weights"], a["starts"], a["colors"], 1
    ),
    "interpolate_backward": lambda a: _C.interpolate_backward(
        a["attributes"],
        a["corners"],
        a["face_index"],
        a["weights"],
        a["starts"],
        a["colors"],
        a["grad"],
        a["grad_w"],
        1,
    ),
}
ALL = tuple(CALLS)
CUBES, INTERPOLATE = ALL[:2], ALL[2:]
PACKED = dict(
    starts=np.array([[0, 0], [5, 3], [9, 4]]),
    textures=np.zeros((4, 2, 2, 2, 3)),
    attributes=np.zeros((9, 3)),
    grad=np.zeros((9, 3)),
    corners=np.zeros((4, 3), np.int64),
)


@pytest.mark.parametrize(
    "calls, packed, change, words",
    [
        (ALL, False, dict(face_index=np.full((2, 8, 9), -1, np.int32)), r"weights must have shape \[2, 8, 9, 3\]"),
        (
            ALL,
            False,
            dict(face_index=np.zeros((8, 8), np.int32)),
            r"face_index must have shape \[0, H, W\], got \[8, 8\]",
        ),
        (
            ALL,
            False,
            dict(face_index=np.full((2, 8, 8), 8, np.int32)),
            "the face index map does not belong to these faces",
        ),
        (
            ALL,
            True,
            dict(face_index=np.full((2, 8, 8), 2, np.int32)),
            "the face index map does not belong to these faces",
        ),
        (ALL, False, dict(weights=np.zeros((2, 8, 8, 2))), r"weights must have shape \[2, 8, 8, 3\]"),
        (ALL[:1], False, dict(colors=np.zeros((2, 8, 8, 2))), r"^colors must have shape \[2, 8, 8, 3\]"),
        (ALL[1:2], False, dict(colors=np.zeros((2, 8, 8, 2))), r"grad_colors must have shape \[2, 8, 8, 3\]"),
        (ALL[2:3], False, dict(colors=np.zeros((2, 8, 8, 2))), r"^values must have shape \[2, 8, 8, 3\]"),
        (ALL[3:], False, dict(colors=np.zeros((2, 8, 8, 2))), r"grad_values must have shape \[2, 8, 8, 3\]"),
        (ALL, True, dict(starts=np.array([[0, 0], [5, 3], [9, 5]])), r"starts must ascend from \(0, 0\)"),
        (ALL, True, dict(starts=np.array([[0, 0], [5, 5], [9, 4]])), r"starts must ascend from \(0, 0\)"),
        (ALL, True, dict(starts=np.zeros((3, 3), np.int64)), r"starts must have shape \[B \+ 1, 2\]"),
        (ALL, True, dict(starts=np.zeros((0, 2), np.int64)), r"starts must have shape \[B \+ 1, 2\]"),
        (CUBES, False, dict(textures=np.zeros((4, 2, 2, 2, 3))), r"must have shape \[B or 1, F, ts, ts, ts, C\]"),
        (CUBES, True, dict(textures=np.zeros((1, 4, 2, 2, 2, 3))), r"must have shape \[M, ts, ts, ts, C\]"),
        (CUBES, False, dict(textures=np.zeros((2, 4, 2, 2, 3, 3))), "cubes of the same size"),
        (CUBES, False, dict(textures=np.zeros((2, 4, 0, 0, 0, 3))), "cubes of the same size"),
        (CUBES, False, dict(textures=np.zeros((3, 4, 2, 2, 2, 3))), "textures must have the batch size 2 or 1"),
        (INTERPOLATE, False, dict(attributes=np.zeros((9, 3))), r"attributes must have shape \[B or 1, N, C\]"),
        (INTERPOLATE, True, dict(attributes=np.zeros((1, 9, 3))), r"attributes must have shape \[N, C\]"),
        (INTERPOLATE, False, dict(attributes=np.zeros((3, 9, 3))), "attributes must have the batch size 2 or 1"),
        (
            INTERPOLATE,
            False,
            dict(corners=np.zeros((4, 2), np.int64)),
            r"corners must have shape \[F, 3\] or \[B, F, 3\]",
        ),
        (INTERPOLATE, True, dict(corners=np.zeros((1, 4, 3), np.int64)), r"corners must have shape \[M, 3\]"),
        (
            INTERPOLATE,
            False,
            dict(corners=np.zeros((3, 4, 3), np.int64)),
            r"corners \[B, F, 3\] must have the batch size 2",
        ),
        (
            INTERPOLATE,
            False,
            dict(corners=np.full((4, 3), 9)),
            "corners refer to attribute 9, but a mesh has 9 attributes",
        ),
        (
            INTERPOLATE,
            True,
            dict(corners=np.full((4, 3), 4)),
            "corners refer to attribute 4, but a mesh has 4 attributes",
        ),
        (INTERPOLATE, False, dict(corners=np.full((4, 3), -1)), "corners refer to attribute -1"),
        (ALL[3:], False, dict(grad=np.zeros((2, 9, 2))), r"grad_attributes must have shape \[2, 9, 3\]"),
        (ALL[3:], False, dict(grad_w=np.zeros((2, 8, 8))), r"grad_weights must have shape \[2, 8, 8, 3\]"),
    ],
)
def test_no_call_reads_or_writes_outside_an_array(calls, packed, change, words):
    arguments = dict(
        textures=np.zeros((2, 4, 2, 2, 2, 3)),
        attributes=np.zeros((2, 9, 3)),
        corners=np.zeros((4, 3), np.int64),
        starts=None,
        face_index=np.zeros((2, 8, 8), np.int32),
        weights=np.zeros((2, 8, 8, 3)),
        colors=np.zeros((2, 8, 8, 3)),
        grad=np.zeros((2, 9, 3)),
        grad_w=np.zeros((2, 8, 8, 3)),
    )
    if packed:
        arguments.update(PACKED)
    for call in calls:
        CALLS[call](arguments)
        with pytest.raises(ValueError, match=words):
            CALLS[call]({**arguments, **change})
