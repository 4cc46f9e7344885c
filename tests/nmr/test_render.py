"""render and its outputs: against closed forms, the published renderer, each other; gradients; bad input."""

import dataclasses
import functools

import pytest
import torch
from scenes import (
    assert_near,
    bumpy_sphere,
    double,
    leaf_of,
    same_bits,
    square,
    uniform,
    value_and_gradients,
)
from torch.autograd import gradcheck
from torch.testing import assert_close

import nmr

CAMERA = nmr.LookAt.from_angles(2.732, 20.0, [0.0, 100.0], half_fov_deg=25.0)


def pixel_centres(size):
    """x and y in [-1, 1] of the pixels of an image, row 0 = top."""
    centre = (2 * torch.arange(size).double() + 1 - size) / size
    return torch.meshgrid(centre, -centre, indexing="xy")


def test_depth_and_weights_of_a_tilted_plane_in_perspective():
    """The camera-space plane Z = 3 + X, seen as x = X / Z: Z = 3 / (1 - x)."""
    points = double([[-1.0, -1.0], [1.2, -0.9], [0.9, 1.1], [-1.1, 0.8]])
    z = 3 + points[:, :1]
    vertices, faces = torch.cat([points / z, z], dim=1), torch.tensor([[0, 1, 2], [2, 3, 0]])
    fragments = nmr.render_fragments(vertices, faces, image_size=40)
    x, y = pixel_centres(40)
    inside = fragments.covered[0]
    depth, weights = fragments.depth[0][inside], fragments.weights[0]
    assert inside.sum() > 100
    assert_close(depth, (3 / (1 - x))[inside], rtol=1e-10, atol=0)
    # Perspective-correct weights interpolate what is linear in space: the points themselves.
    at_pixels = fragments.interpolate(points)[0]
    expected = torch.stack([x, y], dim=-1)[inside] * depth.unsqueeze(-1)
    assert_close(at_pixels[inside], expected, rtol=1e-9, atol=1e-9)
    assert_close(weights[inside].sum(-1), torch.ones_like(depth))
    assert not weights[~inside].any() and not at_pixels[~inside].any()


def test_fragments_know_front_from_back():
    vertices, faces = square(-0.5, -0.5, 0.5, 0.5)
    front = nmr.render_fragments(vertices, faces, image_size=8)
    back = nmr.render_fragments(vertices, faces.flip(1), image_size=8)
    assert front.covered.any() and torch.equal(front.covered, back.covered)
    assert not front.is_back.any() and torch.equal(back.is_back, back.covered)
    assert torch.equal(front.face_index, nmr.render_face_index(vertices, faces, image_size=8))
    assert torch.equal(front.face_index, back.face_index) and back.sided_face_index.max() == 3
    # Weights are in the face's own order, whichever way round it is drawn.
    assert_close(front.weights, back.weights.flip(-1), rtol=1e-12, atol=1e-12)


def test_background():
    vertices, faces = bumpy_sphere()
    one, each = [0.1, 0.2, 0.3], torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    for background, expected in (
        (0.25, torch.full((2, 3), 0.25)),
        (one, torch.tensor([one, one])),
        (each, each),
    ):
        rgb = nmr.render_rgb(0.3 * vertices, faces, CAMERA, background=background, image_size=16)
        assert_close(rgb[:, 0, 0], expected.double())
        assert (rgb[:, 8, 8] == 1).all()  # white without colours


def all_outputs(leaf, faces, wanted, **how):
    how = dict(lights=nmr.Lights(), background=0.3, image_size=20) | how
    colors = nmr.VertexColors((leaf.detach() + 1) / 2)
    return nmr.render(leaf, faces, CAMERA, outputs=wanted, colors=colors, **how)


@pytest.mark.parametrize("gradient", ["nmr", "local"])
@pytest.mark.parametrize("output", ["rgb", "alpha", "depth", "normals"])
def test_outputs_together_equal_outputs_alone(output, gradient, anti_aliasing):
    vertices, faces = bumpy_sphere(dtype=torch.float32)
    how = dict(anti_aliasing=anti_aliasing, gradient=gradient)
    (image, grad), *others = (
        value_and_gradients(
            lambda x, wanted=wanted: getattr(all_outputs(x, faces, wanted, **how), output), vertices
        )
        for wanted in (
            (output,),
            tuple({"alpha", "depth", output}),
            ("fragments", "normals", "depth", "rgb", "alpha"),
        )
    )
    assert image.any() and grad.any()
    for other_image, other_grad in others:
        assert torch.equal(other_image, image)
        assert_near(other_grad, grad, 1e-5)


def test_each_output_has_a_function_of_its_own():
    mesh, size = (*bumpy_sphere(), CAMERA), dict(image_size=16)
    images = nmr.render(*mesh, outputs=("rgb", "alpha", "depth", "normals", "fragments"), **size)
    assert torch.equal(nmr.render(*mesh, outputs="depth", **size).depth, images.depth)
    alone = nmr.render_rgb, nmr.render_silhouette, nmr.render_depth, nmr.render_normals
    assert same_bits([*images][:4], [draw(*mesh, **size) for draw in alone])
    fragments = nmr.render_fragments(*mesh, anti_aliasing=True, **size)
    assert fragments.sided_face_index.shape == (2, 32, 32)
    for name in ("sided_face_index", "weights"):
        assert torch.equal(getattr(images.fragments, name), getattr(fragments, name))


def test_rgb_and_alpha_decide_together():
    """One resolve of the stacked channels, as the published render does: not the sum of two."""
    vertices, faces = bumpy_sphere()

    def rendered(x):
        images = all_outputs(x, faces, ("rgb", "alpha"))
        return torch.cat([images.rgb, images.alpha.unsqueeze(-1)], dim=-1)

    def stacked(x):
        fragments = all_outputs(x, faces, ("fragments",)).fragments
        constant = dataclasses.replace(fragments, weights=fragments.weights.detach())
        shaded = nmr.VertexColors((vertices + 1) / 2).sample(constant)
        covered = fragments.covered.unsqueeze(-1)
        rgb = torch.where(covered, shaded * nmr.Lights().shade(constant), 0.3)
        return fragments.resolve(torch.cat([rgb, covered.double()], dim=-1))

    (image, grad), (wanted, wanted_grad) = (
        value_and_gradients(draw, vertices) for draw in (rendered, stacked)
    )
    assert torch.equal(image, wanted) and grad.any()
    assert_close(grad, wanted_grad, rtol=1e-12, atol=1e-12)


def test_images_say_what_was_not_asked_for():
    images = nmr.render(*square(), outputs=("depth", "alpha"), image_size=4)
    depth, alpha = images
    assert depth is images.depth is images[0] and alpha is images.alpha is images[-1]
    assert repr(images) == "Images(depth: float64 [1, 4, 4], alpha: float64 [1, 4, 4])"
    assert len(images) == 2 and not hasattr(images, "rgb")
    with pytest.raises(
        AttributeError, match=r"normals was not rendered.*outputs=\('depth', 'alpha', 'normals'\)"
    ):
        images.normals  # noqa: B018
    with pytest.raises(AttributeError, match="cannot be changed, so depth"):
        images.depth = depth
    with pytest.raises(AttributeError, match="no attribute 'colour'; it has depth, alpha"):
        images.colour  # noqa: B018


def test_flat_normals_point_at_the_viewer_and_are_those_of_the_faces():
    vertices, faces = nmr.icosphere(2)
    vertices, size = vertices.double(), dict(image_size=24)
    normals = nmr.render_normals(vertices, faces, CAMERA, anti_aliasing=False, **size)
    index = nmr.render_face_index(vertices, faces, CAMERA, **size).long()
    a, b, c = vertices[faces].unbind(1)
    outward = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    assert ((outward * a).sum(-1) > 0).all()
    assert_close(normals, torch.where((index >= 0).unsqueeze(-1), outward[index.clamp_min(0)], 0.0))


# Covers the screen, with its edges far outside: nothing but true derivatives.
LARGE = double([[-4.0, -3.0, 1.0], [5.0, -4.0, 3.0], [0.5, 6.0, 2.0]])


def test_depth_and_normals_have_true_derivatives(anti_aliasing, perspective):
    tilted = torch.cat([LARGE, LARGE[:1] * double([1.5, 1.0, 1.2])]).requires_grad_()
    faces = torch.tensor([[0, 1, 2], [0, 1, 3]])
    how, close = dict(image_size=4, anti_aliasing=anti_aliasing), dict(atol=1e-6, rtol=1e-4)
    how["camera"] = None if perspective else nmr.Orthographic([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    gradcheck(lambda v: nmr.render_depth(v, faces[:1], **how), leaf_of(LARGE), **close)
    for smooth in (False, True):
        draw = functools.partial(nmr.render_normals, faces=faces, smooth=smooth, **how)
        gradcheck(draw, tilted, **close)


@pytest.mark.parametrize("channels", [2, 6])
def test_colours_move_through_weights_only_on_request(channels):
    def rgb(vertices, colors, gradient=True):
        how = dict(image_size=3, interpolation_gradient=gradient)
        return nmr.render_rgb(vertices, torch.tensor([[0, 1, 2]]), colors=colors, **how)

    colors, cubes = uniform(3, channels), nmr.TextureCubes(uniform(1, 2, 2, 2, 3))
    gradcheck(lambda v, c: rgb(v, nmr.VertexColors(c)), (leaf_of(LARGE), leaf_of(colors)))
    for given, gradient, moves in (
        (nmr.VertexColors(colors), False, False),
        (nmr.VertexColors(colors), True, True),
        (cubes, True, False),  # as published, not even on request
    ):
        draw = functools.partial(rgb, colors=given, gradient=gradient)
        assert bool(value_and_gradients(draw, LARGE)[1].any()) == moves


def test_a_background_that_is_not_finite_stays_behind():
    mesh, size = (*nmr.icosphere(1), CAMERA), dict(image_size=16)
    white = nmr.render_rgb(*mesh, background=float("nan"), **size)
    alpha = nmr.render_silhouette(*mesh, **size)
    assert torch.equal(white[..., 0].isnan(), alpha < 1) and (white[alpha == 1] == 1).all()
