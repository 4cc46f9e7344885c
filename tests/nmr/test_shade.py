"""texture_cubes and interpolate: slow definitions, finite differences, their invariances, bad input."""

import pytest
import torch
from scenes import random_soup, uniform, value_and_gradients
from torch.testing import assert_close

import nmr

EPS = 1e-3


def fragments_of(vertices, faces, size):
    index = nmr.ops.rasterize(vertices, faces, None, size, size, True, 0.1, 50.0, True)
    return index, nmr.ops.fragments(vertices, faces, None, index, 50.0, True)[0]


@pytest.mark.parametrize("eps", [0.0, 1e-12, 0.5])
def test_texture_cubes_at_their_far_end(eps):
    """At a corner of a face, where t = ts - 1 unless eps keeps it below: the last texel, never the one beyond."""
    textures = uniform(1, 1, 4, 4, 4, 1, dtype=torch.float32)

    def color_at(weights):
        face_index = torch.zeros((1, 1, 1), dtype=torch.int32)
        return nmr.ops.texture_cubes(textures, face_index, weights.view(1, 1, 1, 3), None, eps)

    for corner in torch.eye(3):
        last, before = (textures[0, 0][tuple((n * corner).long())].item() for n in (3, 2))
        expected = (1 - eps) * last + eps * before
        assert color_at(corner).item() == pytest.approx(expected, rel=1e-6)
    assert color_at(torch.full((3,), float("nan"))) == textures[0, 0, 0, 0, 0]


@pytest.mark.parametrize("attribute_batch", [1, 2])
@pytest.mark.parametrize("corners_per_image", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 6])
def test_interpolate_equals_the_formula(attribute_batch, corners_per_image, channels):
    vertices, faces = random_soup(0)
    face_index, weights = fragments_of(vertices, faces, 14)
    batch = 2 if corners_per_image else 1
    corners = (9 * uniform(batch, len(faces), 3)).long()
    given = corners if corners_per_image else corners[0]

    def fast(attributes, weights):
        return nmr.ops.interpolate(attributes, given, face_index, weights, None)

    def formula(attributes, weights):
        image = torch.arange(2).view(2, 1, 1)
        corner = corners[image % batch, face_index.clamp_min(0).long() % len(faces)]
        picked = attributes[image[..., None] % attribute_batch, corner]
        return (weights[..., None] * picked).sum(-2) * (face_index >= 0)[..., None]

    inputs = uniform(attribute_batch, 9, channels), weights
    assert_close(*(value_and_gradients(function, *inputs) for function in (fast, formula)))
