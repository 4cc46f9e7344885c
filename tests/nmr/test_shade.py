"""texture_cubes and interpolate: slow definitions, finite differences, their invariances, bad input."""

import pytest
import torch
from scenes import uniform

import nmr


@pytest.mark.parametrize("eps", [0.0, 1e-12, 0.5])
def test_texture_cubes_at_their_far_end(eps):
    """At a corner of a face, where t = ts - 1 unless eps keeps it below: the last texel, never the one beyond."""
    textures = uniform(1, 2, 4, 4, 4, 1, dtype=torch.float32)
    textures[:, 1] = torch.nan

    def color_at(weights):
        face_index = torch.zeros((1, 1, 1), dtype=torch.int32)
        return nmr.ops.texture_cubes(textures, face_index, weights.view(1, 1, 1, 3), None, eps)

    for corner in torch.eye(3):
        last, before = (textures[0, 0][tuple((n * corner).long())].item() for n in (3, 2))
        expected = (1 - eps) * last + eps * before
        assert color_at(corner).item() == pytest.approx(expected, rel=1e-6)
    assert color_at(torch.full((3,), float("nan"))) == textures[0, 0, 0, 0, 0]
