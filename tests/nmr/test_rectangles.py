"""Images of height x width through the public functions.

A wide image holds the square one as its middle, and a tall scene is the transpose of a wide one.
"""

import math

import numpy as np
import pytest
import torch

import nmr
import nmr.neural_renderer as nr

SIZE = 32  # of the square in the middle
WIDE, TALL = (SIZE, 2 * SIZE), (2 * SIZE, SIZE)
EYE = [1.0, 0.9, -2.2]
CAMERAS = {
    "look_at": nmr.LookAt(EYE, half_fov_deg=22.0),
    "look": nmr.Look(EYE, [-1.0, -0.9, 2.2], half_fov_deg=22.0),
    "orthographic": nmr.Orthographic(EYE, scale=0.9),
    "two poses": nmr.LookAt.from_angles(2.6, [20.0, -30.0], [10.0, 200.0], half_fov_deg=22.0),
}


def mesh(dtype=torch.float64):
    """A lumpy sphere of radius 0.6 to 0.9, and uneven numbers for colours: [V, 3], [F, 3], a function of a shape."""
    vertices, faces = nmr.icosphere(1)
    generator = torch.Generator().manual_seed(1)

    def numbers(*shape):
        return torch.rand(*shape, generator=generator, dtype=dtype)

    return vertices.to(dtype) * (0.6 + 0.3 * numbers(len(vertices), 1)), faces, numbers


def middle_of(image, size):
    """The square in the middle of ``[B, h, w, ...]``."""
    start = [(side - SIZE) // 2 for side in size]
    return image[:, start[0] : start[0] + SIZE, start[1] : start[1] + SIZE]


def outside_of(image, size):
    """Its pixels beside the middle, as a vector."""
    beside = torch.ones(size, dtype=torch.bool)
    middle_of(beside[None], size)[...] = False
    return image[:, beside]


def close(actual, expected, scale=1e-6):
    scale *= max(1.0, expected.abs().max().item())
    torch.testing.assert_close(actual, expected, atol=scale, rtol=1e-6)


@pytest.mark.parametrize("size", [WIDE, TALL])
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("anti_aliasing", [True, False])
def test_the_middle_is_the_square_image(camera, size, anti_aliasing):
    vertices, faces, numbers = mesh()
    outputs = ("rgb", "alpha", "depth", "normals", "fragments")
    settings = dict(outputs=outputs, lights=nmr.Lights(smooth=True), anti_aliasing=anti_aliasing)
    settings["colors"] = nmr.VertexColors(numbers(len(vertices), 3))
    square = nmr.render(vertices, faces, CAMERAS[camera], image_size=SIZE, **settings)
    wide = nmr.render(vertices, faces, CAMERAS[camera], image_size=size, **settings)
    assert 0.2 < square.alpha.mean() < 0.9
    for name in ("rgb", "alpha", "depth", "normals"):
        image, expected = getattr(wide, name), getattr(square, name)
        assert image.shape[1:3] == size
        close(middle_of(image, size), expected)
    assert (outside_of(wide.depth, size) == 100).all() and not outside_of(wide.alpha, size).any()
    scale = 2 if anti_aliasing else 1
    assert wide.fragments.weights.shape[1:3] == (scale * size[0], scale * size[1])
    cut = (
        wide.fragments.sided_face_index.unflatten(2, (-1, scale))
        .unflatten(1, (-1, scale))
        .transpose(2, 3)
    )
    uncut = (
        square.fragments.sided_face_index.unflatten(2, (-1, scale))
        .unflatten(1, (-1, scale))
        .transpose(2, 3)
    )
    assert torch.equal(middle_of(cut, size), uncut)


def across(vertices):
    """Coordinates in renderer space of the transposed picture: rows become columns."""
    return vertices[..., [1, 0, 2]] * vertices.new_tensor([-1, -1, 1])


@pytest.mark.parametrize("size", [(23, 41), (12, 40), (64, 9)])
@pytest.mark.parametrize("anti_aliasing", [True, False])
def test_swapped_scenes_are_transposes(size, anti_aliasing):
    """In renderer space, so that nothing but the raster is at work; all outputs, with gradients, in odd sizes."""
    vertices, faces, numbers = mesh()
    vertices = vertices * vertices.new_tensor([0.8, 0.7, 0.3]) + vertices.new_tensor(
        [0.15, -0.1, 2.0]
    )
    values, background = numbers(len(vertices), 3), numbers(3)
    outputs, results = ("rgb", "alpha", "depth"), []
    weights = [numbers(1, *size, 3), numbers(1, *size) - 0.5, numbers(1, *size) - 0.5]
    for shape in (size, size[::-1]):
        leaf = (vertices.clone() if shape == size else across(vertices)).requires_grad_()
        tint = values.clone().requires_grad_()
        # the transposed picture is a mirror image
        winding = faces if shape == size else faces.flip(-1)
        settings = dict(
            colors=nmr.VertexColors(tint), background=background, anti_aliasing=anti_aliasing
        )
        images = nmr.render(
            leaf, winding, outputs=outputs, image_size=shape, eps=1e-12, fill_back=False, **settings
        )
        images = [image if shape == size else image.transpose(1, 2) for image in images]
        sum(
            (image * weight).sum() for image, weight in zip(images, weights, strict=True)
        ).backward()
        results.append((*(image.detach() for image in images), leaf.grad, tint.grad))
    assert 0.1 < results[0][1].mean() < 0.9
    *images, grad, tint = results[1]
    for actual, expected in zip((*images, across(grad), tint), results[0], strict=True):
        assert expected.any()
        close(actual, expected, 1e-5)


@pytest.mark.parametrize("size", [(32, 64), (64, 32), (31, 97), (97, 31), (40, 41)])
@pytest.mark.parametrize("camera", ["look_at", "look", "orthographic"])
def test_pixels_are_square(camera, size):
    """A sphere looks round, and the field of view belongs to the shorter side."""
    vertices, faces = nmr.icosphere(4)
    camera = {
        "look_at": nmr.LookAt([0.0, 0.0, -3.0], half_fov_deg=30.0),
        "look": nmr.Look([0.0, 0.0, -3.0], half_fov_deg=30.0),
        "orthographic": nmr.Orthographic(
            [0.0, 0.0, -3.0], scale=math.tan(math.asin(1 / 3)) / math.tan(math.pi / 6)
        ),
    }[camera]
    alpha = nmr.render_silhouette(vertices, faces, camera, image_size=size)[0]
    width = min(size) * math.tan(math.asin(1 / 3)) / math.tan(math.pi / 6)
    radius = (alpha.sum() / math.pi).sqrt()
    assert abs(2 * radius - width) < 0.15
    assert abs(alpha.sum(0).max() - width) <= 1 and abs(alpha.sum(1).max() - width) <= 1
    y, x = (torch.arange(side) + 0.5 for side in size)
    assert abs((alpha.sum(0) * x).sum() / alpha.sum() - size[1] / 2) < 0.05
    assert abs((alpha.sum(1) * y).sum() / alpha.sum() - size[0] / 2) < 0.05


@pytest.mark.parametrize("size", [(1, 64), (64, 1), (1, 1), (3, 8192), (8192, 3)])
def test_extreme_shapes(size):
    """Everything is drawn and has gradients; the object covers the same part of the image."""
    vertices = torch.tensor([[-0.8, -0.9, 2.0], [0.9, -0.8, 2.0], [0.0, 0.9, 3.0]]) * torch.tensor(
        [1.2, 1.2, 1]
    )
    vertices, faces = vertices.requires_grad_(), torch.tensor([[0, 1, 2]])
    images = nmr.render(vertices, faces, outputs=("rgb", "alpha", "depth"), image_size=size)
    assert images.alpha.shape == (1, *size) and 0.2 < images.alpha.mean() < 0.9
    (images.rgb.sum() + images.depth.sum()).backward()
    assert vertices.grad.isfinite().all() and vertices.grad.any()
    for gradient in ("nmr", "local"):
        leaf = vertices.detach().requires_grad_()
        nmr.render_silhouette(leaf, faces, image_size=size, gradient=gradient).sum().backward()
        assert leaf.grad.isfinite().all()


def sphere(batch=2):
    vertices, faces = nmr.icosphere(1)
    return vertices.expand(batch, -1, -1), faces.expand(batch, -1, -1)


@pytest.mark.parametrize("size", [(16, 32), [16, 32], np.array([16, 32]), torch.tensor([16, 32])])
@pytest.mark.parametrize("mode", ["look", "look_at"])
@pytest.mark.parametrize("perspective", [True, False])
def test_wide_images_show_more_at_the_sides(size, mode, perspective):
    vertices, faces = sphere()
    vertices = vertices * 0.7 + torch.tensor([0.3, -0.2, 0])
    textures = torch.rand(2, 80, 2, 2, 2, 3)
    renderer = nr.Renderer(camera_mode=mode, image_size=16, perspective=perspective)
    square = renderer(vertices, faces, textures)
    renderer.image_size = size
    for image, wide in zip(square, renderer(vertices, faces, textures), strict=True):
        assert wide.shape[-2:] == (16, 32)
        torch.testing.assert_close(wide[..., 8:24], image, atol=1e-5, rtol=1e-5)
    assert (
        renderer.render_silhouettes(vertices, faces).shape
        == renderer.render_depth(vertices, faces).shape
    )
