"""texture_cubes and interpolate: slow definitions, finite differences, their invariances, bad input."""

import pytest
import reference
import torch
from scenes import random_soup

import nmr

EPS = 1e-3


def fragments_of(vertices, faces, raster_size, starts=None):
    face_index = nmr.ops.rasterize(
        vertices, faces, starts, raster_size, raster_size, True, 0.1, 50.0, True
    )
    return face_index, nmr.ops.fragments(vertices, faces, starts, face_index, 50.0, True)[0]


def random_like(shape, dtype=torch.float64, seed=0):
    return torch.rand(shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def with_gradients(op, *leaves, seed=1):
    """The output and the gradients of a random sum of it; every image of the batch has the same upstream gradient."""
    leaves = [t.clone().requires_grad_() for t in leaves]
    output = op(*leaves)
    upstream = torch.randn(
        output.shape[1:], dtype=output.dtype, generator=torch.Generator().manual_seed(seed)
    )
    output.backward(upstream.expand_as(output))
    return [output.detach(), *(t.grad for t in leaves)]


@pytest.mark.parametrize("size, channels", [(1, 3), (2, 3), (3, 1), (4, 5)])
@pytest.mark.parametrize("texture_batch", [1, 2])
def test_texture_cubes_equal_the_slow_definition(size, channels, texture_batch):
    vertices, faces = random_soup(0)
    face_index, weights = fragments_of(vertices, faces, 10)
    assert (face_index >= len(faces)).any() and (face_index < 0).any()
    textures = random_like((texture_batch, len(faces), size, size, size, channels))
    colors, grad = with_gradients(
        lambda t: nmr.ops.texture_cubes(t, face_index, weights, None, EPS), textures
    )

    def slow(textures):
        out = torch.zeros(*face_index.shape, channels, dtype=torch.float64)
        for b, y, x in (face_index >= 0).nonzero().tolist():
            cube = textures[b % texture_batch, face_index[b, y, x] % len(faces)]
            out[b, y, x] = reference.texture_color(cube, weights[b, y, x], EPS)
        return out

    slow_colors, slow_grad = with_gradients(slow, textures)
    torch.testing.assert_close(colors, slow_colors)
    torch.testing.assert_close(grad, slow_grad)


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
        color = nmr.ops.texture_cubes(textures, face_index, weights, None, eps).item()
        last = textures[0, 0][tuple(index)].item()
        index[k] = 2
        expected = (1 - eps) * last + eps * textures[0, 0][tuple(index)].item()
        assert color == pytest.approx(expected, rel=1e-6)
    color = nmr.ops.texture_cubes(textures, face_index, weights * float("nan"), None, eps)
    assert color == textures[0, 0, 0, 0, 0]


@pytest.mark.parametrize("attribute_batch", [1, 2])
@pytest.mark.parametrize("corners_per_image", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 6])
def test_interpolate_equals_the_formula(attribute_batch, corners_per_image, channels):
    vertices, faces = random_soup(0)
    face_index, weights = fragments_of(vertices, faces, 14)
    attributes = random_like((attribute_batch, 9, channels))
    g = torch.Generator().manual_seed(0)
    corners = torch.randint(
        0, 9, (2, len(faces), 3) if corners_per_image else (len(faces), 3), generator=g
    )

    def formula(attributes, weights):
        face = face_index.clamp_min(0).long() % len(faces)
        picked = torch.stack(
            [
                attributes[b % attribute_batch][
                    (corners[b] if corners_per_image else corners)[face[b]]
                ]
                for b in range(2)
            ]
        )
        values = (weights[..., None] * picked).sum(-2)
        return torch.where((face_index >= 0)[..., None], values, torch.zeros_like(values))

    ours = with_gradients(
        lambda a, w: nmr.ops.interpolate(a, corners, face_index, w, None), attributes, weights
    )
    slow = with_gradients(formula, attributes, weights)
    for a, b in zip(ours, slow, strict=True):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize("of_attributes, of_weights", [(True, False), (False, True)])
def test_interpolate_computes_only_the_gradients_asked_for(of_attributes, of_weights):
    vertices, faces = random_soup(2)
    face_index, weights = fragments_of(vertices, faces, 12)
    attributes = random_like((1, 36, 3))
    both = with_gradients(
        lambda a, w: nmr.ops.interpolate(a, faces, face_index, w, None), attributes, weights
    )[1:]
    attributes.requires_grad_(of_attributes)
    weights.requires_grad_(of_weights)
    output = nmr.ops.interpolate(attributes, faces, face_index, weights, None)
    upstream = torch.randn(
        output.shape[1:], dtype=output.dtype, generator=torch.Generator().manual_seed(1)
    )
    output.backward(upstream.expand_as(output))
    for leaf, asked, expected in zip(
        (attributes, weights), (of_attributes, of_weights), both, strict=True
    ):
        assert torch.equal(leaf.grad, expected) if asked else leaf.grad is None
