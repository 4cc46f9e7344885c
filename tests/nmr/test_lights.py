"""Lights: against the formula written out, their gradients, bad input."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scenes import bumpy_sphere, double, leaf_of, square, uniform, value_and_gradients
from torch.autograd import gradcheck
from torch.testing import assert_close

import nmr

CAMERA = nmr.LookAt.from_angles(2.732, 20.0, [0.0, 100.0], half_fov_deg=25.0)
SIZE = dict(image_size=20, anti_aliasing=False)
# One face that covers the screen.
SCREEN = double([[-3.0, -3.0, 2.0], [3.0, -3.0, 2.0], [0.0, 5.0, 2.0]]), torch.tensor([[0, 1, 2]])


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
        light = light + strength * color * (
            cosine.relu() + specular * torch.where(cosine > 0, shine, 0.0)
        )
    return light


@pytest.mark.parametrize("specular", [0.0, 0.7])
def test_lights_and_highlights_equal_the_formula(smooth, specular):
    vertices, faces = bumpy_sphere()
    fragments = nmr.render_fragments(vertices, faces, CAMERA, image_size=20)
    white, falloff, point = double([1.0, 0.9, 0.8]), [0.0, 0.4], [0.7, 1.5]
    position, point_color = double([[0.5, 2.0, -1.5], [-2.0, 0.3, 1.0]]), uniform(2, 3)
    direction, color = double([0.3, 0.5, -0.8]), uniform(3, seed=1)
    lights = nmr.Lights(
        *(0.2, 0.6, direction, white, color, smooth),
        position=position,
        point=point,
        point_color=point_color,
        falloff=falloff,
        specular=specular,
        shininess=7.5,
    )
    lamps = [("directional", 0.6 * color, direction, 0.0)]
    for k in range(2):
        lamps.append(("point", point[k] * point_color[k], position[k], falloff[k]))
    normals, eye = fragments.normals(smooth), CAMERA.eye.view(2, 1, 1, 3)
    light = slow_light(normals, fragments.interpolate(vertices), eye, lamps, specular, 7.5)
    expected = torch.where(fragments.covered.unsqueeze(-1), light + 0.2 * white, 0.0)
    assert_close(lights.shade(fragments), expected, rtol=1e-9, atol=1e-9)
    assert (lights.shade(fragments) - nmr.Lights(smooth=smooth).shade(fragments)).abs().max() > 0.2
    # Highlights have the colour of the light, the rest is multiplied by that of the surface.
    grey = torch.full((2, 20, 20, 1), 0.5).double()
    matt = replace(lights, specular=0.0).shade(fragments)
    assert_close(lights.shade(fragments, grey), expected - matt + 0.5 * matt)


def test_highlights_without_a_camera_and_with_one_of_your_own():
    how = dict(lights=nmr.Lights(0.0, 1.0, (0.0, 0.0, -1.0), specular=0.5), **SIZE)
    assert torch.equal(nmr.render_rgb(*SCREEN, **how), torch.full((1, 20, 20, 3), 1.5).double())
    camera = nmr.LookAt([0.0, 0.0, -2.0])
    mine = Foreign(camera)
    with pytest.raises(ValueError, match=r"give Foreign an attribute eye, \[3\] or \[B, 3\]"):
        nmr.render_rgb(*SCREEN, mine, **how)
    mine.eye = (0.0, 0.0, -2.0)
    assert_close(*(nmr.render_rgb(*SCREEN, x, **how) for x in (mine, camera)))


@pytest.mark.parametrize("specular", [{}, dict(specular=0.6, shininess=3.5)], ids=["", "specular"])
def test_every_parameter_has_its_true_derivative(smooth, specular):
    """Of a pyramid larger than the screen, with its top in sight and the light oblique to all its sides."""
    vertices = [[-4.0, -4, 3], [4, -4, 3], [4.2, 4, 3], [-4, 4.5, 3], [0.1, 0.2, 2]]
    faces = torch.tensor([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    named = dict(
        ambient=0.3,
        directional=[0.7, 0.4],
        ambient_color=[0.9, 0.5, 0.1],
        directional_color=[[0.2, 0.6, 1.0], [0.5, 0.4, 0.3]],
        direction=[[0.1, 0.2, -0.9], [0.3, -0.1, -0.5]],
        position=[[0.5, 0.3, 0.5], [-0.4, 0.2, 0.1]],
        point=[0.7, 1.2],
        point_color=[[0.2, 0.6, 1.0], [0.5, 0.4, 0.3]],
        falloff=[0.3, 0.1],
        **specular,
    )

    def lit(vertices, colors, *values):
        fragments = nmr.render_fragments(vertices, faces, image_size=4)
        lights = nmr.Lights(smooth=smooth, **dict(zip(named, values, strict=True)))
        return lights.shade(fragments, colors)

    given = double(vertices), uniform(1, 4, 4, 3), *map(double, named.values())
    gradcheck(lit, [leaf_of(x) for x in given], atol=1e-6)


class Foreign:
    """A camera that nmr does not know."""

    def __init__(self, camera):
        self.camera, self.right_handed = camera, camera.right_handed

    def transform(self, vertices, starts=None):
        return self.camera.transform(vertices, starts)


def room_cameras(kind, count, g, right_handed):
    """Cameras at random places inside the unit sphere, which look in random directions; their eyes."""
    eye, forward = ((torch.rand(count, 3, generator=g) - 0.5) for _ in range(2))
    if kind == "look":
        return nmr.Look(eye, forward, half_fov_deg=40.0, right_handed=right_handed), eye
    if kind == "wide":
        return nmr.LookAt(eye, eye + forward, half_fov_deg=75.0, right_handed=right_handed), eye
    R = torch.linalg.qr(torch.randn(count, 3, 3, generator=g)).Q
    R = R * torch.linalg.det(R).view(-1, 1, 1)  # some other sign of the axes
    # half of the cameras mirror the world
    R = torch.where(torch.rand(count, 1, 1, generator=g) < 0.5, R, -R)
    t = -(R @ eye.unsqueeze(-1)).squeeze(-1)
    K = [[60.0, 0.0, 50.0], [0.0, 60.0, 50.0], [0.0, 0.0, 1.0]]
    return nmr.Pinhole(K, R, t, orig_size=100), eye


@pytest.mark.parametrize(
    "kind, foreign",
    [("look", False), ("wide", False), ("look", True), ("wide", True), ("pinhole", False)],
)
@pytest.mark.parametrize("right_handed", [False, True])
def test_normals_point_towards_the_viewer_inside_rooms(kind, foreign, right_handed, packed):
    g = torch.Generator().manual_seed(0)
    camera, eye = room_cameras(kind, 40, g, right_handed)
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


@pytest.mark.parametrize(
    "camera", [CAMERA, nmr.LookAt([0.0, 1.0, 2.5], right_handed=True)], ids=["left", "right"]
)
def test_own_normals_are_lit_as_those_of_the_mesh(camera):
    """Given at vertices or in pixels, from both sides of a surface with a hole."""
    vertices, faces = bumpy_sphere()
    faces, outward = faces[::2], nmr.vertex_normals(vertices, faces[::2])
    lamp = dict(position=[1.0, 2.0, -3.0], specular=0.4, harmonics=torch.rand(9, 3))
    flat = torch.tensor([0.0, 0.0, 1.0]).expand(4, 4, 3)

    def lit(**how):
        return nmr.render_rgb(vertices, faces, camera, lights=nmr.Lights(**how, **lamp), **SIZE)

    wanted = lit(smooth=True)
    for normals in (outward, nmr.VertexColors(outward), nmr.NormalMap(flat, vertices[:, :2])):
        assert_close(lit(normals=normals), wanted, rtol=1e-6, atol=1e-9)
    assert (lit(normals=outward.roll(1, 0)) - wanted).abs().max() > 0.1


def test_normal_maps_tilt_along_u_and_v():
    """A square in the plane z = 0 of a right-handed world; mirrored coordinates mirror the tilt."""
    vertices, faces = square(depth=[0.0] * 4)
    camera = nmr.Orthographic([0.0, 0.0, 3.0], right_handed=True)
    texel = torch.nn.functional.normalize(double([0.3, 0.5, 1.0]), dim=0)

    def sampled(vertices, image, uv):
        fragments = nmr.render_fragments(vertices, faces, camera, image_size=4)
        return nmr.NormalMap(image, uv), fragments

    for flip in double([[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0]]):
        uv = flip * (vertices[:, :2] + 1) / 2
        normal_map, fragments = sampled(vertices, texel.expand(2, 2, 3), uv)
        wanted = texel * torch.cat([flip, torch.ones(1)])
        assert_close(normal_map.sample(fragments), wanted.expand(1, 4, 4, 3))

    def lit(v, image):
        normals, fragments = sampled(v, image + 0.5, vertices[:, :2])
        how = dict(position=[0.5, 0.3, 2.0], specular=0.5, shininess=3.0)
        return nmr.Lights(normals=normals, **how).shade(fragments)

    inputs = vertices + 0.1 * uniform(4, 3), uniform(3, 3, 3, seed=1)
    gradcheck(lit, [leaf_of(x) for x in inputs], eps=1e-7, atol=1e-5)


def test_spherical_harmonics_are_orthonormal_and_in_their_order():
    """Integrals over the sphere, seen as the light of every single harmonic on a sphere; and the light of a lamp."""
    count = 20000
    z = (2 * torch.arange(count).double() + 1) / count - 1
    angle, radius = torch.arange(count) * 2.399963229728653, (1 - z * z).sqrt()
    n = torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=-1)
    vertices, faces = SCREEN
    fragments = nmr.render_fragments(vertices, faces.flip(1), image_size=(100, 200))
    assert fragments.is_back.all(), "clockwise: the side to which vertex_normals points is seen"
    given = SimpleNamespace(sample=lambda fragments: n.view(1, 100, 200, 3))

    def light(coefficients):
        lights = nmr.Lights(0.0, 0.0, normals=given, harmonics=coefficients)
        return lights.shade(fragments)[0].view(-1, 3)[:, 0]

    one = torch.eye(9).double()
    basis = torch.stack([light(x.view(9, 1).expand(9, 3)) for x in one])
    share = 4 * torch.pi / count  # of the sphere, for each point
    assert_close(basis @ basis.T * share, one, rtol=0, atol=1e-3)
    x, y, z = n.unbind(-1)
    polynomials = (y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y)
    for row, polynomial in zip(basis[1:], polynomials, strict=True):
        assert torch.corrcoef(torch.stack([row, polynomial]))[0, 1] > 0.9999
    # A lamp far away: relu(n . z), bands 0 to 2 of which are 1/4, 1/2 z and 5/32 (3 z^2 - 1).
    fitted = light((basis @ z.relu() * share)[:, None].expand(9, 3))
    assert_close(fitted, 0.25 + z / 2 + 5 / 32 * (3 * z * z - 1), rtol=0, atol=1e-3)
    _, grad = value_and_gradients(light, uniform(9, 3), upstream=torch.ones(count).double())
    assert_close(grad[:, 0], basis.sum(1))
    part = nmr.render_fragments(vertices * double([0.2, 0.2, 1.0]), faces, image_size=8)
    lit = nmr.Lights(harmonics=uniform(9, 3)).shade(part)
    assert torch.equal(lit.any(-1), part.covered) and not part.covered.all(), "0 on background"


OPENGL_VIEW = [
    [0.8, 0.6, 0.0, 0.0],
    [-0.6, 0.8, 0.0, 0.0],
    [0.0, 0.0, 1.0, -3.0],
    [0.0, 0.0, 0.0, 1.0],
]
CAMERAS = {
    "orthographic": nmr.Orthographic([0.5, 0.7, -3.0]),
    "right-handed": nmr.Orthographic([0.5, 0.7, -3.0], right_handed=True),
    "pytorch3d": nmr.cameras.from_pytorch3d(
        np.diag([-1.0, 1.0, -1.0]), [0, 0, 3.0], orthographic=True
    ),
    "opengl": nmr.cameras.from_opengl(OPENGL_VIEW, np.diag([1.0, 1.0, -0.1, 1.0])),
}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_normals_in_camera_space_are_those_of_the_depth(camera):
    """Where depth is f(x, y), the normal towards the viewer is (df/dx, df/dy, -1), normalised."""
    fragments = nmr.render_fragments(*bumpy_sphere(1), camera, image_size=64)

    def neighbours(image):
        """Inner pixels, then those to their right, left, top and bottom."""
        inner, low, high = slice(1, -1), slice(0, -2), slice(2, None)
        places = (inner, inner), (inner, high), (inner, low), (low, inner), (high, inner)
        return torch.stack([image[0][place] for place in places])

    index = neighbours(fragments.face_index)
    same = (index == index[0]).all(0) & (index[0] >= 0)
    _, right, left, top, bottom = neighbours(fragments.depth)
    slopes = 16 * torch.stack([right - left, top - bottom, torch.full_like(top, -1 / 16)], dim=-1)
    wanted = torch.nn.functional.normalize(slopes, dim=-1)
    normals = neighbours(fragments.normals(space="camera"))[0]
    assert same.sum() > 300
    assert_close(normals[same], wanted[same], rtol=0, atol=1e-5)


def test_a_camera_that_turns_with_the_mesh_sees_the_same_normals():
    vertices, faces = bumpy_sphere()
    how = dict(smooth=True, space="camera", **SIZE)
    images = [
        nmr.render_normals(
            vertices * double([side, 1, side]), faces, nmr.LookAt([0, 0, -3 * side]), **how
        )
        for side in (1.0, -1.0)
    ]
    assert_close(*images)
    assert (images[0][..., 2] <= 1e-2).all() and images[0][..., 2].min() < -0.9


NOTHING_TO_SEE = [[0.0, 0.0, -3.0], [0.0, 3.0, 0.0], [math.nan, 0.0, 0.0]]


@pytest.mark.filterwarnings("ignore:.*sees|.*looks along|.*is not finite")
def test_normals_in_camera_space_of_poses_that_see_nothing():
    """A pose along its up vector, and one that is not finite, leave the others as they are."""
    vertices, faces = nmr.icosphere(1)
    how = dict(space="camera", **SIZE)
    normals = nmr.render_normals(vertices, faces, nmr.LookAt(NOTHING_TO_SEE), **how)
    alone = nmr.render_normals(vertices, faces, nmr.LookAt(NOTHING_TO_SEE[0]), **how)
    assert torch.equal(normals[:1], alone) and normals.isfinite().all()
    assert (normals[2] == 0).all()


def test_settings_of_torch_do_not_change_normals_and_light():
    vertices, faces = nmr.icosphere(1)
    lights = nmr.Lights(harmonics=uniform(9, 3, seed=0).float(), smooth=True)
    camera = nmr.LookAt([1.0, 2.0, -3.0])

    def images():
        normals = nmr.render_normals(vertices, faces, camera, space="camera", smooth=True, **SIZE)
        return torch.cat([normals, nmr.render_rgb(vertices, faces, camera, lights=lights, **SIZE)])

    usual = images()
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(images(), usual)
    torch.set_default_dtype(torch.float64)
    try:
        assert torch.equal(images(), usual)
    finally:
        torch.set_default_dtype(torch.float32)


def test_harmonics_must_be_finite():
    with pytest.raises(ValueError, match="harmonics must be finite"):
        nmr.Lights(harmonics=torch.full((9, 3), math.nan))
