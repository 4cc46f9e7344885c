"""Lights: against the formula written out, their gradients, bad input."""

from dataclasses import replace

import pytest
import torch
from scenes import for_threads

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


def slow_light(normal, point, eye, lamps, specular, shininess):
    """The light on white at points [..., 3], written out; lamps are (kind, color, direction or position, falloff)."""
    unit = torch.nn.functional.normalize
    view, light = unit(eye - point, dim=-1), 0
    for kind, color, place, falloff in lamps:
        towards = place - point if kind == "point" else place.expand_as(point)
        length = towards.norm(dim=-1, keepdim=True)
        ray = unit(towards, dim=-1)
        strength = 1 / (1 + falloff * length**2) if kind == "point" else length
        cosine = (normal * ray).sum(-1, keepdim=True)
        shine = ((2 * cosine * normal - ray) * view).sum(-1, keepdim=True).relu() ** shininess
        light = light + strength * color * (cosine.relu() + specular * torch.where(cosine > 0, shine, 0.0))
    return light


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("specular", [0.0, 0.7])
def test_point_lights_and_highlights_equal_the_formula(smooth, specular):
    vertices, faces = bumpy_sphere()
    fragments = nmr.render_fragments(vertices, faces, CAMERA, image_size=20)
    position = torch.tensor([[0.5, 2.0, -1.5], [-2.0, 0.3, 1.0]]).double()
    point_color, color = torch.rand(2, 3).double(), torch.rand(3).double()
    direction = torch.tensor([0.3, 0.5, -0.8]).double()
    lights = nmr.Lights(
        *(0.2, 0.6, direction, (1.0, 0.9, 0.8), color, smooth),
        position=position,
        point=[0.7, 1.5],
        point_color=point_color,
        falloff=[0.0, 0.4],
        specular=specular,
        shininess=7.5,
    )
    lamps = [("directional", 0.6 * color, direction, 0.0)]
    lamps += [("point", i * c, p, f) for i, c, p, f in zip((0.7, 1.5), point_color, position, (0.0, 0.4), strict=True)]
    seen = fragments.interpolate(vertices), fragments.normals(smooth), CAMERA.eye.view(2, 1, 1, 3)
    expected = slow_light(seen[1], seen[0], seen[2], lamps, specular, 7.5)
    expected = expected + 0.2 * torch.tensor([1.0, 0.9, 0.8], dtype=torch.float64)
    expected = torch.where(fragments.covered.unsqueeze(-1), expected, 0.0)
    torch.testing.assert_close(lights.shade(fragments), expected, rtol=1e-9, atol=1e-9)
    assert (lights.shade(fragments) - nmr.Lights(smooth=smooth).shade(fragments)).abs().max() > 0.2
    # Highlights have the colour of the light, the rest is multiplied by that of the surface.
    grey = torch.full((2, 20, 20, 1), 0.5).double()
    matt = replace(lights, specular=0.0).shade(fragments)
    torch.testing.assert_close(lights.shade(fragments, grey), expected - matt + 0.5 * matt)


def test_a_highlight_lies_where_the_mirror_direction_meets_the_eye():
    """A sphere lit from the eye shines in the middle; one that is lit from the side, half way to it."""
    vertices, faces = nmr.icosphere(4)
    camera = nmr.LookAt([0.0, 0.0, -40.0], half_fov_deg=1.6)
    for direction, x in (((0.0, 0.0, -1.0), 0.0), ((0.8, 0.0, -0.6), 5**-0.5)):
        lights = nmr.Lights(0.0, 1.0, direction, specular=1.0, shininess=400.0, smooth=True)
        fragments = nmr.render_fragments(vertices, faces, camera, image_size=128)
        shine = (lights.shade(fragments) - nmr.Lights(0.0, 1.0, direction, smooth=True).shade(fragments))[0, ..., 0]
        row, column = divmod(int(shine.argmax()), 128)
        point = fragments.interpolate(vertices)[0, row, column]
        assert shine.max() > 0.85 and abs(float(point[0]) - x) < 0.04 and abs(float(point[1])) < 0.04


def test_highlights_without_a_camera_and_with_one_of_your_own():
    vertices = torch.tensor([[-3.0, -3.0, 2.0], [3.0, -3.0, 2.0], [0.0, 5.0, 2.0]])
    faces, lights = torch.tensor([[0, 1, 2]]), nmr.Lights(0.0, 1.0, (0.0, 0.0, -1.0), specular=0.5)
    assert torch.equal(nmr.render_rgb(vertices, faces, lights=lights, **SIZE), torch.full((1, 20, 20, 3), 1.5))

    class Mine:
        def transform(self, vertices, starts=None):
            return nmr.LookAt([0.0, 0.0, -2.0]).transform(vertices, starts)

    with pytest.raises(ValueError, match=r"give Mine an attribute eye, \[3\] or \[B, 3\]"):
        nmr.render_rgb(vertices, faces, Mine(), lights=lights, **SIZE)
    Mine.eye = (0.0, 0.0, -2.0)
    torch.testing.assert_close(
        nmr.render_rgb(vertices, faces, Mine(), lights=lights, **SIZE),
        nmr.render_rgb(vertices, faces, nmr.LookAt([0.0, 0.0, -2.0]), lights=lights, **SIZE),
    )


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("specular", [0.0, 0.6])
def test_point_lights_and_highlights_have_true_derivatives(smooth, specular):
    vertices = torch.tensor([[-4.0, -4, 3], [4, -4, 3], [4.2, 4, 3], [-4, 4.5, 3], [0.1, 0.2, 2]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    named = dict(
        direction=torch.tensor([0.1, 0.2, -0.9]),
        position=torch.tensor([[0.5, 0.3, 0.5], [-0.4, 0.2, 0.1]]),
        point=torch.tensor([0.7, 1.2]),
        point_color=torch.tensor([[0.2, 0.6, 1.0], [0.5, 0.4, 0.3]]),
        falloff=torch.tensor([0.3, 0.1]),
    )
    if specular:
        named |= dict(specular=torch.tensor(specular), shininess=torch.tensor(3.5))
    colors = torch.rand(1, 4, 4, 3, generator=torch.Generator().manual_seed(0))
    leaves = [x.double().requires_grad_() for x in (vertices, colors, *named.values())]

    def lit(v, colors, *values):
        fragments = nmr.render_fragments(v, faces, image_size=4)
        return nmr.Lights(smooth=smooth, **dict(zip(named, values, strict=True))).shade(fragments, colors)

    assert torch.autograd.gradcheck(lit, leaves, atol=1e-6)


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("lamps", [{}, dict(position=(0.5, 1.0, -2.0), specular=0.3)])
def test_same_bits_for_any_number_of_threads(smooth, lamps):
    vertices, faces = bumpy_sphere()
    for image_size in (24, 150):  # one block, and several

        def gradients(image_size=image_size):
            leaves = [vertices.float().requires_grad_(), torch.tensor([0.3, 0.6, -0.7]).requires_grad_()]
            lights = nmr.Lights(direction=leaves[1], smooth=smooth, **lamps)
            rgb = nmr.render_rgb(leaves[0], faces, CAMERA, lights=lights, image_size=image_size)
            return rgb, *torch.autograd.grad(rgb.square().sum(), leaves)

        results = for_threads((1, 2, 5), gradients)
        for other in results[1:]:
            assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("smooth", [False, True])
def test_packed_meshes_equal_one_by_one(smooth):
    meshes = [nmr.icosphere(1), nmr.icosphere(0)]
    lights = nmr.Lights(position=(0.5, 1.0, -2.0), specular=0.3, smooth=smooth)
    leaves = [v.clone().requires_grad_() for v, _ in meshes]
    camera = nmr.LookAt([0.0, 0.5, -3.0])
    together = nmr.render_rgb(leaves, [f for _, f in meshes], camera, lights=lights, image_size=20)
    together.square().sum().backward()
    for b, (vertices, faces) in enumerate(meshes):
        leaf = vertices.clone().requires_grad_()
        one = nmr.render_rgb(leaf, faces, camera, lights=lights, image_size=20)
        one.square().sum().backward()
        assert torch.equal(one[0], together[b]) and torch.equal(leaf.grad, leaves[b].grad)


@pytest.mark.parametrize("smooth", [False, True])
def test_opcheck(smooth):
    vertices, faces = bumpy_sphere(1)
    fragments = nmr.render_fragments(vertices, faces, CAMERA, image_size=6)
    normals = nmr.ops.normals(vertices[None], faces, None, smooth)
    torch.library.opcheck(nmr.ops.normals, (vertices[None].clone().requires_grad_(), faces, None, smooth))
    torch.library.opcheck(nmr.ops.normals_backward, (vertices[None], faces, None, smooth, normals))
    layout = torch.tensor([[0, 1, 1], [1, 1, 1], [4, 2, 1], [6, 1, 1], [9, 1, 1], *[[0, 1, 0]] * 6])
    viewer = torch.tensor([[0.0, 0, -3, 1, 1]]).double().expand(2, 5).contiguous()
    at = layout, viewer, vertices[None], faces, fragments.sided_face_index, fragments.weights.detach(), None, smooth
    leaves = [x.requires_grad_() for x in (torch.rand(2, 6, 6, 3).double(), normals.clone(), torch.rand(12).double())]
    torch.library.opcheck(nmr.ops.lit, (*leaves, *at))
    leaves = [x.detach() for x in leaves]
    torch.library.opcheck(nmr.ops.lit_backward, (*leaves, *at, torch.rand(2, 6, 6, 3).double(), [True] * 5))
    projection = CAMERA.projection()
    torch.library.opcheck(nmr.ops.viewer_of, (projection.matrix, projection.intrinsics, projection.origin, True))
    for change, words in (
        ({0: torch.rand(2, 6, 6, 2).double()}, "1 or 3 channels"),
        ({1: normals[:, 1:].contiguous()}, "normals must have shape"),
        ({2: torch.rand(11).double()}, "a parameter of lights lies outside"),
        ({3: layout[1:].contiguous()}, r"layout must have shape \[11, 3\]"),
        ({3: layout.where(layout != 9, 10)}, "outside"),
        ({4: viewer[:1]}, r"viewer must have shape \[2, 5\]"),
        ({5: vertices[None, :, :2].contiguous()}, "3 coordinates"),
    ):
        arguments = [change.get(n, x) for n, x in enumerate((*leaves, *at))]
        with pytest.raises(ValueError, match=words):
            nmr.ops.lit(*arguments)


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
        (lambda: nmr.Lights(position=torch.rand(2)), r"position must have shape \[3\].*got float32 \[2\]"),
        (lambda: nmr.Lights(position=torch.rand(2, 3), falloff=torch.rand(3)), "point, .* same number of lights"),
        (lambda: nmr.Lights(specular=torch.rand(2, 2)), r"specular must have shape \[\] or \[B\]"),
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
        (nmr.Lights(position=torch.rand(3, 1, 3)), "position"),
        (nmr.Lights(specular=torch.rand(3)), "specular"),
        (nmr.Lights(ambient=torch.rand(2), ambient_color=torch.rand(3, 3)), "ambient_color"),
        (nmr.Lights(directional_color=torch.rand(3, 2, 3), direction=torch.rand(2, 2, 3)), "directional_color"),
    ],
)
def test_lights_for_other_images(lights, name):
    with pytest.raises(ValueError, match=f"^{name} .* 3 images, but 2 are drawn"):
        nmr.render_rgb(*bumpy_sphere(), CAMERA, lights=lights, **SIZE)


# --- normals


class Foreign:
    """A camera that nmr does not know."""

    eye = (0.1, 0.0, -2.0)  # for highlights

    def __init__(self, camera):
        self.camera = camera

    def transform(self, vertices, starts=None):
        return self.camera.transform(vertices, starts)


def room_cameras(kind, count, g):
    """Cameras at random places inside the unit sphere, which look in random directions; their eyes."""
    eye, forward = ((torch.rand(count, 3, generator=g) - 0.5) for _ in range(2))
    if kind == "look":
        return nmr.Look(eye, forward, half_fov_deg=40.0), eye
    if kind == "wide":
        return nmr.LookAt(eye, eye + forward, half_fov_deg=75.0), eye
    R = torch.linalg.qr(torch.randn(count, 3, 3, generator=g)).Q
    R = R * torch.linalg.det(R).view(-1, 1, 1)  # some other sign of the axes
    R = torch.where(torch.rand(count, 1, 1, generator=g) < 0.5, R, -R)  # half of the cameras mirror the world
    t = -(R @ eye.unsqueeze(-1)).squeeze(-1)
    K = [[60.0, 0.0, 50.0], [0.0, 60.0, 50.0], [0.0, 0.0, 1.0]]
    return nmr.Pinhole(K, R, t, orig_size=100), eye


@pytest.mark.parametrize("kind", ["look", "wide", "pinhole"])
@pytest.mark.parametrize("foreign", [False, True])
@pytest.mark.parametrize("packed", [False, True])
def test_normals_point_towards_the_viewer_inside_rooms(kind, foreign, packed):
    g = torch.Generator().manual_seed(0)
    camera, eye = room_cameras(kind, 40, g)
    vertices, faces = nmr.icosphere(2)
    meshes = vertices * torch.tensor([1.0, 0.8, 1.2]), faces
    if packed:
        meshes = [meshes[0]] * 40, [faces[n % 2 :] for n in range(40)]
    camera = Foreign(camera) if foreign else camera
    fragments = nmr.render_fragments(*meshes, camera, image_size=12, near=0.01)
    for smooth in (False, True):
        normals = fragments.normals(smooth)
        points = fragments.interpolate(meshes[0])
        facing = (normals * (eye.view(40, 1, 1, 3) - points)).sum(-1)
        assert fragments.covered.float().mean() > 0.95
        assert (facing[fragments.covered] > (-0.05 if smooth else 0)).all()


def test_normals_of_any_mesh_are_numbers():
    """Huge, tiny and NaN coordinates: images, and the gradients of normals and lights, are never NaN."""
    g = torch.Generator().manual_seed(0)
    odd = torch.tensor(
        [0.0, 1.0, -1.0, 1e-45, 1e-38, 1e-30, 1e-20, 1e11, -1e11, 1e19, 1e30, 3e38, torch.inf, torch.nan]
    )
    lights = nmr.Lights(position=(0.3, 0.2, -2.0), falloff=0.5, specular=0.5, smooth=True)
    cameras = None, nmr.LookAt([0.0, 0.0, -2.0]), Foreign(nmr.LookAt([0.1, 0.0, -2.0]))
    drawn = 0
    for n in range(240):
        vertices = 1.5 * torch.randn(4, 7, 3, generator=g) * 10.0 ** (-8 * (n % 5 == 4))
        vertices[..., 2] += 1.0
        choose = torch.rand(vertices.shape, generator=g) < 0.2
        vertices[choose] = odd[torch.randint(0, len(odd), (int(choose.sum()),), generator=g)]
        faces = torch.randint(0, 7, (6, 3), generator=g)
        leaf = (vertices if n % 2 else vertices.double()).requires_grad_()
        fragments = nmr.render_fragments(leaf, faces, cameras[n % 3], image_size=8)
        drawn += int(fragments.covered.any())
        for image in (fragments.normals(False), fragments.normals(True), lights.shade(fragments)):
            assert image.isfinite().all()
            (grad,) = torch.autograd.grad(
                image, leaf, torch.randn(image.shape, generator=g).to(image), retain_graph=True
            )
            assert not grad.isnan().any()
    assert drawn > 150


def test_small_and_large_meshes_have_unit_normals():
    vertices, faces = bumpy_sphere()
    expected = -nmr.face_normals(vertices, faces)
    for dtype, scale in ((torch.float32, 1e-17), (torch.float32, 1e11), (torch.float64, 1e-140)):
        for smooth in (False, True):
            normals = nmr.ops.normals((scale * vertices).to(dtype)[None], faces, None, smooth)[0]
            assert ((normals.norm(dim=-1) - 1).abs() < 1e-5).all()
            if not smooth:
                torch.testing.assert_close(normals.double(), expected, rtol=0, atol=1e-4)
