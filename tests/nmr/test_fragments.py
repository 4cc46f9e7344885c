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


@pytest.mark.parametrize("size", [(22, 22), (8, 50), (50, 8)])
def test_depth_image_is_the_mean_of_the_depth_of_fragments(anti_aliasing, size, perspective):
    vertices, faces = random_soup(6, dtype=torch.float32)
    index = face_index_of(vertices, faces, size, perspective=perspective)

    def mean(vertices):
        depth = nmr.ops.fragments(vertices, faces, None, index, FAR, perspective)[1]
        return torch.nn.functional.avg_pool2d(depth, 2) if anti_aliasing else depth

    def image(vertices):
        how = anti_aliasing, FAR, perspective
        return nmr.ops.depth_image(vertices, faces, None, index, *how)

    assert_close(*(value_and_gradients(function, vertices) for function in (image, mean)))


def test_an_anti_aliased_face_index_map_is_even():
    mesh = random_soup(0)
    with pytest.raises(ValueError, match=r"even size, got \[2, 9, 9\]"):
        nmr.ops.depth_image(*mesh, None, face_index_of(*mesh, (9, 9)), True, FAR, True)
