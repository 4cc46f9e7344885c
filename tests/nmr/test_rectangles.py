"""Images of height x width through the public functions.

A wide image holds the square one as its middle.
"""

import functools

import pytest
import torch
from scenes import assert_near, bumpy_sphere, double, uniform, value_and_gradients

import nmr

SIZE = 32  # of the square in the middle
WIDE, TALL = (SIZE, 2 * SIZE), (2 * SIZE, SIZE)
EYE = [1.0, 0.9, -2.2]
CAMERAS = {
    "look_at": nmr.LookAt(EYE, half_fov_deg=22.0),
    "look": nmr.Look(EYE, [-1.0, -0.9, 2.2], half_fov_deg=22.0),
    "orthographic": nmr.Orthographic(EYE, scale=0.9),
    "two poses": nmr.LookAt.from_angles(2.6, [20.0, -30.0], [10.0, 200.0], half_fov_deg=22.0),
}


def mesh():
    """A lumpy sphere and colours of its vertices: [V, 3], [F, 3], [V, 3]."""
    vertices, faces = bumpy_sphere(1, seed=1)
    return 0.9 * vertices, faces, uniform(*vertices.shape, seed=2)


def middle_of(image, size):
    """The square in the middle of ``[B, h, w, ...]``."""
    start = [(side - SIZE) // 2 for side in size]
    return image[:, start[0] : start[0] + SIZE, start[1] : start[1] + SIZE]


def outside_of(image, size):
    """Its pixels beside the middle, as a vector."""
    beside = torch.ones(size, dtype=torch.bool)
    middle_of(beside[None], size)[...] = False
    return image[:, beside]


@pytest.mark.parametrize("size", [WIDE, TALL])
@pytest.mark.parametrize("camera", CAMERAS)
def test_the_middle_is_the_square_image(camera, size, anti_aliasing):
    vertices, faces, tint = mesh()
    names, scale = ("rgb", "alpha", "depth", "normals"), 2 if anti_aliasing else 1
    how = dict(outputs=(*names, "fragments"), anti_aliasing=anti_aliasing)
    how |= dict(lights=nmr.Lights(smooth=True), colors=nmr.VertexColors(tint))
    square, wide = (
        nmr.render(vertices, faces, CAMERAS[camera], image_size=n, **how) for n in (SIZE, size)
    )
    assert 0.2 < square.alpha.mean() < 0.9
    for name in names:
        image, expected = getattr(wide, name), getattr(square, name)
        assert image.shape[1:3] == size
        assert_near(middle_of(image, size), expected, 1e-6)
    assert (outside_of(wide.depth, size) == 100).all() and not outside_of(wide.alpha, size).any()
    raster = wide.fragments.sided_face_index
    assert raster.shape[1:] == (scale * size[0], scale * size[1])
    uncut, cut = (
        x.unflatten(2, (-1, scale)).unflatten(1, (-1, scale)).transpose(2, 3)
        for x in (square.fragments.sided_face_index, raster)
    )
    assert torch.equal(middle_of(cut, size), uncut)


@pytest.mark.parametrize("size", [(1, 64), (64, 1), (1, 1), (3, 8192), (8192, 3)])
def test_extreme_shapes(size):
    """Everything is drawn and has gradients; the object covers the same part of the image."""
    vertices = double([[-0.96, -1.08, 2.0], [1.08, -0.96, 2.0], [0.0, 1.08, 3.0]])

    def image(leaf, output, **how):
        mesh = leaf, torch.tensor([[0, 1, 2]])
        return getattr(nmr.render(*mesh, outputs=output, image_size=size, **how), output)

    alpha = image(vertices, "alpha")
    assert alpha.shape == (1, *size) and 0.2 < alpha.mean() < 0.9
    for output, gradient in (
        ("rgb", "nmr"),
        ("depth", "nmr"),
        ("alpha", "nmr"),
        ("alpha", "local"),
    ):
        draw = functools.partial(image, output=output, gradient=gradient)
        grad = value_and_gradients(draw, vertices)[1]
        assert grad.isfinite().all() and (grad.any() or output != "depth")
