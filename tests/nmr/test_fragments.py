"""fragments and depth_image: against the slow definition and finite differences, their invariances, bad input."""

import pytest
import reference
import torch
from scenes import assert_near, random_soup, value_and_gradients
from torch.testing import assert_close

import nmr

FAR = 50.0


def face_index_of(vertices, faces, size, fill_back=True, perspective=True):
    how = fill_back, 0.1, FAR, perspective
    return nmr.ops.rasterize(vertices, faces, None, *size, *how)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("size", [(18, 18), (23, 23), (9, 40), (40, 9)])
def test_equals_the_slow_definition(seed, fill_back, size, perspective):
    vertices, faces = random_soup(seed)
    index = face_index_of(vertices, faces, size, fill_back, perspective)
    assert not fill_back or (index >= len(faces)).any()

    def fast(vertices):
        weights, depth = nmr.ops.fragments(vertices, faces, None, index, FAR, perspective)
        return torch.cat([weights, depth[..., None]], dim=-1)

    def slow(vertices):
        images = []
        for mesh, own in zip(vertices, index.flip(1).long(), strict=True):
            weights, depth = reference.fragments(mesh, faces, own, FAR, perspective)
            images.append(torch.cat([weights, depth[..., None]], dim=-1))
        return torch.stack(images).flip(1)

    (image, grad), (wanted, wanted_grad) = (
        value_and_gradients(function, vertices) for function in (fast, slow)
    )
    assert_close(image, wanted, rtol=1e-9, atol=1e-9)
    assert_near(grad, wanted_grad, 1e-7)
    assert grad.any(dim=1).all()
