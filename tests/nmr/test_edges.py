"""resolve: NMR's gradient for images of any channels, against the slow definition; its invariances, bad input."""

import pytest
import reference
import torch
from scenes import assert_near, leaf_of, normal, random_soup, uniform, value_and_gradients
from torch.autograd import gradcheck
from torch.testing import assert_close

import nmr

EPS = 1e-3


def face_index_of(vertices, faces, size, fill_back=True):
    size = (size, size) if isinstance(size, int) else size
    return nmr.ops.rasterize(vertices, faces, None, *size, fill_back, 0.1, 50.0, True)


def random_image(face_index, channels, dtype=torch.float64):
    """Random colours before a background of one colour."""
    image = uniform(*face_index.shape, channels, dtype=dtype)
    return torch.where(face_index[..., None] >= 0, image, 0.3)


def resolve(image, vertices, faces, face_index, anti_aliasing=False, background=None):
    how = face_index, anti_aliasing, EPS, False, True
    return nmr.ops.resolve(image, background, vertices, faces, None, *how)


@pytest.mark.parametrize("seed, channels", [(0, 1), (1, 2), (2, 3), (3, 4), (4, 7)])
def test_equals_the_slow_definition(seed, channels, anti_aliasing, fill_back):
    vertices, faces = random_soup(seed)
    size = [(10, 10), (10, 16), (23, 7)][seed % 3]
    raster = tuple(n * (1 + anti_aliasing) for n in size)
    face_index = face_index_of(vertices, faces, raster, fill_back)
    image = random_image(face_index, channels)
    upstream = normal(2, *size, channels) * (uniform(2, *size, 1) > 0.3)
    resolved, grad = value_and_gradients(
        lambda x: resolve(image, x, faces, face_index, anti_aliasing), vertices, upstream=upstream
    )
    for b, mesh in enumerate(vertices):
        index, from_below = face_index[b].flip(0).long(), image[b].flip(0)
        assert_close(resolved[b], reference.resolve(from_below, anti_aliasing))
        how = anti_aliasing, fill_back, EPS
        slow = reference.edge_gradient(mesh, faces, index, from_below, upstream[b], *how)
        assert_near(grad[b], slow, 1e-9)
    assert grad[..., :2].any() and not grad[..., 2].any()


def test_gradient_in_the_image_is_the_mean_s(anti_aliasing):
    mesh = random_soup(0)
    face_index = face_index_of(*mesh, 6)
    image = leaf_of(random_image(face_index, 2))
    gradcheck(lambda image: resolve(image, *mesh, face_index, anti_aliasing), image)


def test_not_a_number_in_a_pixel_gives_none_in_a_vertex():
    vertices, faces = random_soup(0, dtype=torch.float32)
    face_index = face_index_of(vertices, faces, 24)
    image = random_image(face_index, 3, torch.float32)
    image[:, 4, 3], image[:, 12, 12] = float("nan"), float("inf")
    _, grad = value_and_gradients(lambda x: resolve(image, x, faces, face_index), vertices)
    assert grad.any() and not grad.isnan().any()


def test_background_is_the_colour_of_pixels_without_a_face(per_image):
    """The same as an image that holds it, in values and gradients."""
    vertices, faces = random_soup(0)
    face_index = face_index_of(vertices, faces, 20)
    inputs = random_image(face_index, 3), vertices, uniform(2 if per_image else 1, 3, seed=1)

    def given(image, vertices, background):
        return resolve(image, vertices, faces, face_index, True, background)

    def filled(image, vertices, background):
        image = torch.where(face_index[..., None] >= 0, image, background[:, None, None])
        return resolve(image, vertices, faces, face_index, True)

    assert_close(value_and_gradients(given, *inputs), value_and_gradients(filled, *inputs))
