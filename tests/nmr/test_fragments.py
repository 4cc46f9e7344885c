"""fragments and depth_image: against the slow definition and finite differences, their invariances, bad input."""

import pytest
import reference
import torch
from scenes import random_soup

import nmr

FAR = 50.0


def face_index_of(vertices, faces, raster_size, fill_back=True, starts=None):
    height, width = (raster_size, raster_size) if isinstance(raster_size, int) else raster_size
    return nmr.ops.rasterize(vertices, faces, starts, height, width, fill_back, 0.1, FAR, True)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("fill_back", [False, True])
@pytest.mark.parametrize("raster_size", [18, 23, (9, 40), (40, 9)])
def test_equals_the_slow_definition(seed, fill_back, raster_size):
    vertices, faces = random_soup(seed)
    face_index = face_index_of(vertices, faces, raster_size, fill_back)
    assert not fill_back or (face_index >= len(faces)).any()
    leaf = vertices.clone().requires_grad_()
    weights, depth = nmr.ops.fragments(leaf, faces, None, face_index, FAR, True)
    slow_leaf = vertices.clone().requires_grad_()
    slow = [
        reference.fragments(slow_leaf[b], faces, face_index[b].flip(0).long(), FAR)
        for b in range(2)
    ]
    slow_weights, slow_depth = (torch.stack([s[n].flip(0) for s in slow]) for n in range(2))
    torch.testing.assert_close(weights, slow_weights, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(depth, slow_depth, rtol=1e-9, atol=1e-9)
    g = torch.Generator().manual_seed(seed)
    upstream = [torch.randn(t.shape, generator=g, dtype=t.dtype) for t in (weights, depth)]
    torch.autograd.backward([weights, depth], upstream)
    torch.autograd.backward([slow_weights, slow_depth], upstream)
    torch.testing.assert_close(
        leaf.grad, slow_leaf.grad, rtol=1e-7, atol=1e-7 * float(slow_leaf.grad.abs().max())
    )
    assert leaf.grad.any(dim=1).all()


@pytest.mark.parametrize("anti_aliasing", [False, True])
@pytest.mark.parametrize("size", [(22, 22), (8, 50), (50, 8)])
def test_depth_image_is_the_mean_of_the_depth_of_fragments(anti_aliasing, size):
    vertices, faces = random_soup(6, dtype=torch.float32)
    face_index = face_index_of(vertices, faces, size)
    leaves = [vertices.clone().requires_grad_() for _ in range(2)]
    _, depth = nmr.ops.fragments(leaves[0], faces, None, face_index, FAR, True)
    mean = depth.view(2, size[0] // 2, 2, size[1] // 2, 2).mean((2, 4)) if anti_aliasing else depth
    image = nmr.ops.depth_image(leaves[1], faces, None, face_index, anti_aliasing, FAR, True)
    torch.testing.assert_close(image, mean)
    upstream = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    mean.backward(upstream)
    image.backward(upstream)
    torch.testing.assert_close(leaves[1].grad, leaves[0].grad)


def test_an_anti_aliased_face_index_map_is_even():
    vertices, faces = random_soup(0)
    with pytest.raises(ValueError, match=r"even size, got \[2, 9, 9\]"):
        nmr.ops.depth_image(
            vertices, faces, None, face_index_of(vertices, faces, 9), True, FAR, True
        )
