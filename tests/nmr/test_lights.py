"""Lights: against the formula written out, their gradients, bad input."""

import pytest
import torch

import nmr

CAMERA = nmr.LookAt.from_angles(2.732, 20.0, [0.0, 100.0], half_fov_deg=25.0)
SIZE = dict(image_size=20, anti_aliasing=False)


def bumpy_sphere(subdivisions=2):
    vertices, faces = nmr.icosphere(subdivisions)
    noise = torch.rand(len(vertices), 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return (0.7 + 0.3 * noise) * vertices, faces


def outward_normals(vertices, faces):
    a, b, c = vertices[faces].unbind(1)
    return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)


def test_flat_light_is_that_of_the_face():
    vertices, faces = bumpy_sphere()
    direction = torch.tensor([0.5, 0.7, -0.4], dtype=torch.float64)
    ambient_color, color = torch.tensor([0.9, 0.5, 0.1]).double(), torch.tensor([0.2, 0.6, 1.0]).double()
    lights = nmr.Lights(0.3, 0.8, direction, ambient_color, color)
    colors = torch.rand(len(faces), 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    rgb = nmr.render_rgb(vertices, faces, CAMERA, colors=nmr.FaceColors(colors), lights=lights, **SIZE)
    index = nmr.render_face_index(vertices, faces, CAMERA, image_size=20).long()
    cosine = (outward_normals(vertices, faces) * direction).sum(-1, keepdim=True)
    expected = colors * (0.3 * ambient_color + 0.8 * color * cosine.clamp_min(0))
    assert (cosine < 0).any() and (index >= 0).sum() > 200
    torch.testing.assert_close(rgb, torch.where((index >= 0)[..., None], expected[index.clamp_min(0)], 0.0))


def test_smooth_light_on_a_sphere():
    vertices, faces = nmr.icosphere(4)
    lights = nmr.Lights(0.0, 1.0, (0.0, 0.6, -0.8), smooth=True)
    fragments = nmr.render_fragments(vertices.double(), faces, CAMERA, image_size=24)
    points = torch.nn.functional.normalize(fragments.interpolate(vertices.double()), dim=-1)
    expected = (points @ torch.tensor([0.0, 0.6, -0.8]).double()).clamp_min(0)
    torch.testing.assert_close(lights.shade(fragments)[..., 1], expected, rtol=0, atol=1e-2)
    flat = nmr.Lights(0.0, 1.0, (0.0, 0.6, -0.8)).shade(fragments)[..., 1]
    assert (flat - expected).abs().max() > 2 * (lights.shade(fragments)[..., 1] - expected).abs().max()


def test_a_face_is_lit_on_the_side_that_is_seen():
    vertices = torch.tensor([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    lights = nmr.Lights(0.0, 1.0, (0.0, 0.0, -1.0))
    for faces in ([[0, 1, 2]], [[2, 1, 0]]):
        rgb = nmr.render_rgb(
            vertices, torch.tensor(faces), nmr.LookAt([[0, 0, -3.0], [0, 0, 3.0]]), lights=lights, **SIZE
        )
        assert rgb[0].max() == 1 and rgb[1].max() == 0


def test_several_lights_add_up():
    mesh = bumpy_sphere()
    directions = torch.tensor([[0.0, 1.0, 0.0], [0.6, 0.0, -0.8]])
    colors = torch.tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]])

    def lit(*lights):
        return nmr.render_rgb(*mesh, CAMERA, lights=nmr.Lights(*lights), **SIZE)

    both = lit(0.2, [0.3, 0.5], directions, (1.0, 1.0, 1.0), colors)
    first, second = (lit(0.1, i, d, (1.0, 1.0, 1.0), c) for i, d, c in zip([0.3, 0.5], directions, colors, strict=True))
    torch.testing.assert_close(both, first + second)
    torch.testing.assert_close(lit(0.2, [0.3, 0.5], directions[0]), lit(0.2, 0.8, directions[0]))  # numbers broadcast


def test_a_light_per_image():
    mesh = bumpy_sphere()
    ambient, directional = torch.tensor([0.1, 0.3]), torch.tensor([[0.5, 0.2], [0.1, 0.9]])
    direction, color = torch.rand(2, 2, 3) - 0.5, torch.rand(2, 2, 3)
    ambient_color = torch.rand(2, 3)
    for smooth in (False, True):
        lights = nmr.Lights(ambient, directional, direction, ambient_color, color, smooth)
        together = nmr.render_rgb(*mesh, CAMERA, lights=lights, **SIZE)
        for b in range(2):
            own = nmr.Lights(ambient[b], directional[b], direction[b], ambient_color[b], color[b], smooth)
            assert torch.equal(together[b], nmr.render_rgb(*mesh, CAMERA, lights=own, **SIZE)[b])


def test_grey_colours_take_the_colour_of_light():
    mesh = bumpy_sphere()
    grey = nmr.VertexColors(torch.full((162, 1), 0.5))
    lights = nmr.Lights(1.0, 0.0, ambient_color=(0.2, 0.4, 0.6))
    rgb = nmr.render_rgb(*mesh, CAMERA, colors=grey, lights=lights, **SIZE)
    torch.testing.assert_close(rgb[0, 10, 10], torch.tensor([0.1, 0.2, 0.3]).double(), rtol=1e-6, atol=0)


@pytest.mark.parametrize("smooth", [False, True])
def test_everything_has_true_derivatives(smooth):
    """Of a pyramid larger than the screen, with its top in sight and the light oblique to all its sides."""
    vertices = torch.tensor([[-4.0, -4, 3], [4, -4, 3], [4.2, 4, 3], [-4, 4.5, 3], [0.1, 0.2, 2]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    parameters = [
        torch.tensor(0.3),
        torch.tensor([0.7, 0.4]),
        torch.tensor([[0.1, 0.2, -0.9], [0.3, -0.1, -0.5]]),
        torch.tensor([0.9, 0.5, 0.1]),
        torch.tensor([[0.2, 0.6, 1.0], [0.5, 0.4, 0.3]]),
    ]
    leaves = [x.double().requires_grad_() for x in (vertices, *parameters)]

    def shaded(v, *values):
        fragments = nmr.render_fragments(v, faces, image_size=4)
        return nmr.Lights(*values, smooth=smooth).shade(fragments)

    assert shaded(*leaves).shape == (1, 4, 4, 3)
    assert torch.autograd.gradcheck(shaded, leaves, atol=1e-6)
    # Through render_rgb the parameters have the same derivatives; vertices have NMR's in addition.
    fixed = vertices.detach()
    assert torch.autograd.gradcheck(
        lambda *values: nmr.render_rgb(fixed, faces, lights=nmr.Lights(*values, smooth=smooth), image_size=3),
        leaves[1:],
    )


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: nmr.Lights(ambient=(0.1, [0.2])), r"ambient must be \[\] or \[B\], got tuple"),
        (lambda: nmr.Lights(ambient=torch.zeros(1, 1)), r"ambient must have shape \[\] or \[B\], got float32 \[1, 1\]"),
        (lambda: nmr.Lights(directional=torch.zeros(1, 1, 1)), r"directional must have shape \[\], \[L\] or \[B, L\]"),
        (lambda: nmr.Lights(direction=(0.0, 1.0)), r"direction must have shape \[3\].*got float64 \[2\]"),
        (lambda: nmr.Lights(direction=torch.zeros(3).long()), r"direction must be .* of floats, got int64 \[3\]"),
        (lambda: nmr.Lights(ambient_color=0.5), r"ambient_color must have shape \[3\] or \[B, 3\]"),
        (lambda: nmr.Lights(direction=torch.zeros(0, 3)), r"got float32 \[0, 3\]"),
        (lambda: nmr.Lights(directional_color="white"), r"directional_color must be \[3\].*, got str"),
        (lambda: nmr.Lights(directional=[0.5, 0.5], direction=torch.rand(3, 3)), "same number of lights"),
    ],
)
def test_errors_say_what_was_wanted(make, words):
    with pytest.raises((TypeError, ValueError), match=words):
        make()


def test_tensors_in_a_list_keep_their_gradient():
    strength = torch.tensor(0.5, requires_grad=True)
    lights = nmr.Lights(0.0, [strength, 0.2], [(0.0, 0.0, -1.0)] * 2)
    nmr.render_rgb(*bumpy_sphere(), CAMERA, lights=lights, **SIZE).sum().backward()
    assert strength.grad > 0


@pytest.mark.parametrize(
    "lights, name",
    [
        (nmr.Lights(ambient=torch.rand(3)), "ambient"),
        (nmr.Lights(directional=torch.rand(3, 1)), "directional"),
        (nmr.Lights(direction=torch.rand(3, 1, 3)), "direction"),
        (nmr.Lights(ambient=torch.rand(2), ambient_color=torch.rand(3, 3)), "ambient_color"),
        (nmr.Lights(directional_color=torch.rand(3, 2, 3), direction=torch.rand(2, 2, 3)), "directional_color"),
    ],
)
def test_lights_for_other_images(lights, name):
    with pytest.raises(ValueError, match=f"^{name} .* 3 images, but 2 are drawn"):
        nmr.render_rgb(*bumpy_sphere(), CAMERA, lights=lights, **SIZE)
