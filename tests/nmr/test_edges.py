"""resolve: NMR's gradient for images of any channels, against the slow definition; its invariances, bad input."""

import pytest
import reference
import torch
from scenes import random_soup

import nmr

EPS = 1e-3


def face_index_of(vertices, faces, raster_size, fill_back=True, starts=None):
    return nmr.ops.rasterize(
        vertices, faces, starts, raster_size, raster_size, fill_back, 0.1, 50.0, True
    )


def random_image(face_index, channels, dtype=torch.float64, seed=0):
    """Random colours, the same for an image wherever it lies in the batch; the background is of one colour."""
    g = torch.Generator().manual_seed(seed)
    image = torch.rand(*face_index.shape[1:], channels, generator=g, dtype=dtype).expand(
        *face_index.shape, -1
    )
    return torch.where(face_index[..., None] >= 0, image, torch.full_like(image, 0.3)).contiguous()


def resolve_with_gradient(
    image, vertices, faces, starts, face_index, anti_aliasing=False, zeros=0.3
):
    """The resolved image and both gradients of a random upstream, of which a part is zero."""
    vertices, image = vertices.clone().requires_grad_(), image.clone().requires_grad_()
    resolved = nmr.ops.resolve(
        image, None, vertices, faces, starts, face_index, anti_aliasing, EPS, False, True
    )
    g = torch.Generator().manual_seed(1)
    upstream = torch.randn(resolved.shape[1:], generator=g, dtype=resolved.dtype)
    upstream[torch.rand(upstream.shape[:2], generator=g) < zeros] = 0
    resolved.backward(upstream.expand_as(resolved))
    return resolved.detach(), image.grad, vertices.grad, upstream


@pytest.mark.parametrize("seed, channels", [(0, 1), (1, 2), (2, 3), (3, 4), (4, 7)])
@pytest.mark.parametrize("anti_aliasing", [False, True])
@pytest.mark.parametrize("fill_back", [False, True])
def test_equals_the_slow_definition(seed, channels, anti_aliasing, fill_back):
    vertices, faces = random_soup(seed)
    face_index = face_index_of(vertices, faces, 20 if anti_aliasing else 19, fill_back)
    image = random_image(face_index, channels)
    resolved, _, grad, upstream = resolve_with_gradient(
        image, vertices, faces, None, face_index, anti_aliasing
    )
    for b in range(2):
        index, from_below = face_index[b].flip(0).long(), image[b].flip(0)
        torch.testing.assert_close(resolved[b], reference.resolve(from_below, anti_aliasing))
        slow = reference.edge_gradient(
            vertices[b], faces, index, from_below, upstream, anti_aliasing, fill_back, EPS
        )
        torch.testing.assert_close(grad[b], slow, rtol=1e-9, atol=1e-9 * float(slow.abs().max()))
    assert grad[..., :2].any() and not grad[..., 2].any()


@pytest.mark.parametrize("anti_aliasing", [False, True])
def test_gradient_in_the_image_is_the_mean_s(anti_aliasing):
    vertices, faces = random_soup(0)
    face_index = face_index_of(vertices, faces, 6)
    image = random_image(face_index, 2).requires_grad_()

    def resolve(image):
        return nmr.ops.resolve(
            image, None, vertices, faces, None, face_index, anti_aliasing, EPS, False, True
        )

    assert torch.autograd.gradcheck(resolve, image)


def test_not_a_number_in_a_pixel_gives_none_in_a_vertex():
    vertices, faces = random_soup(0, dtype=torch.float32)
    face_index = face_index_of(vertices, faces, 24)
    image = random_image(face_index, 3, torch.float32)
    image[:, 4, 3], image[:, 12, 12] = float("nan"), float("inf")
    _, _, grad, _ = resolve_with_gradient(image, vertices, faces, None, face_index)
    assert grad.any() and not grad.isnan().any()


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("per_image", [False, True])
def test_background_is_the_colour_of_pixels_without_a_face(threads, per_image):
    """The same as an image that holds it, in values and gradients; the gradient has the same bits for any threads."""
    vertices, faces = random_soup(0)
    face_index = face_index_of(vertices, faces, 20)
    image = random_image(face_index, 3)
    behind = torch.rand(2 if per_image else 1, 3, dtype=torch.float64)
    upstream = torch.randn(
        2, 10, 10, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    filled = torch.where(face_index[..., None] >= 0, image, behind[:, None, None])
    results = []
    for given, background in ((image, behind), (filled, None)):
        leaves = [x.clone().requires_grad_() for x in (given, vertices, behind)]
        pixels = (
            leaves[0]
            if background is not None
            else torch.where(face_index[..., None] >= 0, leaves[0], leaves[2][:, None, None])
        )
        mesh = leaves[1], faces, None, face_index
        resolved = nmr.ops.resolve(
            pixels, None if background is None else leaves[2], *mesh, True, EPS, False, True
        )
        resolved.backward(upstream)
        results.append([resolved.detach(), *(leaf.grad for leaf in leaves)])
    torch.testing.assert_close(*results)
