"""Lights: against the formula written out, their gradients, bad input."""

from dataclasses import replace

import pytest
import torch

import nmr

CAMERA = nmr.LookAt.from_angles(2.732, 20.0, [0.0, 100.0], half_fov_deg=25.0)
SIZE = dict(image_size=20, anti_aliasing=False)


def bumpy_sphere(subdivisions=2):
    vertices, faces = nmr.icosphere(subdivisions)
    noise = torch.rand(
        len(vertices), 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    return (0.7 + 0.3 * noise) * vertices, faces


def outward_normals(vertices, faces):
    a, b, c = vertices[faces].unbind(1)
    return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)


def test_flat_light_is_that_of_the_face():
    vertices, faces = bumpy_sphere()
    direction = torch.tensor([0.5, 0.7, -0.4], dtype=torch.float64)
    ambient_color = torch.tensor([0.9, 0.5, 0.1]).double()
    color = torch.tensor([0.2, 0.6, 1.0]).double()
    lights = nmr.Lights(0.3, 0.8, direction, ambient_color, color)
    colors = torch.rand(
        len(faces), 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    rgb = nmr.render_rgb(
        vertices, faces, CAMERA, colors=nmr.FaceColors(colors), lights=lights, **SIZE
    )
    index = nmr.render_face_index(vertices, faces, CAMERA, image_size=20).long()
    cosine = (outward_normals(vertices, faces) * direction).sum(-1, keepdim=True)
    expected = colors * (0.3 * ambient_color + 0.8 * color * cosine.clamp_min(0))
    assert (cosine < 0).any() and (index >= 0).sum() > 200
    torch.testing.assert_close(
        rgb, torch.where((index >= 0)[..., None], expected[index.clamp_min(0)], 0.0)
    )


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
    lamps += [
        ("point", i * c, p, f)
        for i, c, p, f in zip((0.7, 1.5), point_color, position, (0.0, 0.4), strict=True)
    ]
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


def test_highlights_without_a_camera_and_with_one_of_your_own():
    vertices = torch.tensor([[-3.0, -3.0, 2.0], [3.0, -3.0, 2.0], [0.0, 5.0, 2.0]])
    faces, lights = torch.tensor([[0, 1, 2]]), nmr.Lights(0.0, 1.0, (0.0, 0.0, -1.0), specular=0.5)
    assert torch.equal(
        nmr.render_rgb(vertices, faces, lights=lights, **SIZE), torch.full((1, 20, 20, 3), 1.5)
    )

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
def test_every_parameter_has_its_true_derivative(smooth, specular):
    """Of a pyramid larger than the screen, with its top in sight and the light oblique to all its sides."""
    vertices = torch.tensor(
        [[-4.0, -4, 3], [4, -4, 3], [4.2, 4, 3], [-4, 4.5, 3], [0.1, 0.2, 2]], dtype=torch.float64
    )
    faces = torch.tensor([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    named = dict(
        ambient=torch.tensor(0.3),
        directional=torch.tensor([0.7, 0.4]),
        ambient_color=torch.tensor([0.9, 0.5, 0.1]),
        directional_color=torch.tensor([[0.2, 0.6, 1.0], [0.5, 0.4, 0.3]]),
        direction=torch.tensor([[0.1, 0.2, -0.9], [0.3, -0.1, -0.5]]),
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
        return nmr.Lights(smooth=smooth, **dict(zip(named, values, strict=True))).shade(
            fragments, colors
        )

    assert torch.autograd.gradcheck(lit, leaves, atol=1e-6)


def test_tensors_in_a_list_keep_their_gradient():
    strength = torch.tensor(0.5, requires_grad=True)
    lights = nmr.Lights(0.0, [strength, 0.2], [(0.0, 0.0, -1.0)] * 2)
    nmr.render_rgb(*bumpy_sphere(), CAMERA, lights=lights, **SIZE).sum().backward()
    assert strength.grad > 0


class Foreign:
    """A camera that nmr does not know."""

    eye = (0.1, 0.0, -2.0)  # for highlights

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
@pytest.mark.parametrize("packed", [False, True])
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


def test_small_and_large_meshes_have_unit_normals():
    vertices, faces = bumpy_sphere()
    expected = -nmr.face_normals(vertices, faces)
    for dtype, scale in ((torch.float32, 1e-17), (torch.float32, 1e11), (torch.float64, 1e-140)):
        for smooth in (False, True):
            normals = nmr.ops.normals((scale * vertices).to(dtype)[None], faces, None, smooth)[0]
            assert ((normals.norm(dim=-1) - 1).abs() < 1e-5).all()
            if not smooth:
                torch.testing.assert_close(normals.double(), expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    "camera", [CAMERA, nmr.LookAt([0.0, 1.0, 2.5], right_handed=True)], ids=["left", "right"]
)
def test_own_normals_are_lit_as_those_of_the_mesh(camera):
    """Given at vertices or in pixels, from both sides of a surface with a hole."""
    vertices, faces = bumpy_sphere()
    faces, outward = faces[::2], nmr.vertex_normals(vertices, faces[::2])
    lamp = dict(position=[1.0, 2.0, -3.0], specular=0.4, harmonics=torch.rand(9, 3))
    flat = torch.tensor([0.0, 0.0, 1.0]).expand(4, 4, 3)
    wanted = nmr.render_rgb(vertices, faces, camera, lights=nmr.Lights(smooth=True, **lamp), **SIZE)
    for normals in (outward, nmr.VertexColors(outward), nmr.NormalMap(flat, vertices[:, :2])):
        own = nmr.render_rgb(
            vertices, faces, camera, lights=nmr.Lights(normals=normals, **lamp), **SIZE
        )
        torch.testing.assert_close(own, wanted, rtol=1e-6, atol=1e-9)
    tilted = nmr.render_rgb(
        vertices, faces, camera, lights=nmr.Lights(normals=outward.roll(1, 0), **lamp), **SIZE
    )
    assert (tilted - wanted).abs().max() > 0.1


def test_normal_maps_tilt_along_u_and_v():
    """A square in the plane z = 0 of a right-handed world; mirrored coordinates mirror the tilt."""
    vertices = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    camera = nmr.Orthographic([0.0, 0.0, 3.0], right_handed=True)
    fragments = nmr.render_fragments(vertices, faces, camera, image_size=4)
    texel = torch.nn.functional.normalize(torch.tensor([0.3, 0.5, 1.0], dtype=torch.float64), dim=0)
    for flip in (torch.tensor([1.0, 1.0]), torch.tensor([-1.0, 1.0]), torch.tensor([1.0, -1.0])):
        uv = flip * (vertices[:, :2] + 1) / 2
        normals = nmr.NormalMap(texel.expand(2, 2, 3), uv).sample(fragments)
        wanted = texel * torch.cat([flip, torch.ones(1)])
        torch.testing.assert_close(normals, wanted.expand_as(normals).to(normals))
    leaves = [
        x.clone().requires_grad_()
        for x in (vertices + 0.1 * torch.rand(4, 3), torch.rand(3, 3, 3).double())
    ]

    def lit(v, image):
        fragments = nmr.render_fragments(v, faces, camera, image_size=4)
        normals = nmr.NormalMap(image + 0.5, vertices[:, :2])
        return nmr.Lights(
            normals=normals, position=[0.5, 0.3, 2.0], specular=0.5, shininess=3.0
        ).shade(fragments)

    assert torch.autograd.gradcheck(lit, leaves, eps=1e-7, atol=1e-5)


def test_spherical_harmonics_are_orthonormal_and_in_their_order():
    """Integrals over the sphere, seen as the light of every single harmonic on a sphere; and the light of a lamp."""
    count = 20000
    z = (2 * torch.arange(count, dtype=torch.float64) + 1) / count - 1
    angle, radius = torch.arange(count) * 2.399963229728653, (1 - z * z).sqrt()
    n = torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=-1)
    vertices = torch.tensor(
        [[-3.0, -3.0, 2.0], [3.0, -3.0, 2.0], [0.0, 5.0, 2.0]], dtype=torch.float64
    )
    fragments = nmr.render_fragments(vertices, torch.tensor([[0, 2, 1]]), image_size=(100, 200))

    class Given:
        def sample(self, fragments):
            return n.view(1, 100, 200, 3)

    assert fragments.is_back.all(), "clockwise: the side to which vertex_normals points is seen"

    def light(coefficients):
        lights = nmr.Lights(0.0, 0.0, normals=Given(), harmonics=coefficients)
        return lights.shade(fragments)[0].view(-1, 3)[:, 0]

    one = torch.eye(9, dtype=torch.float64).unsqueeze(-1).expand(9, 9, 3)
    basis = torch.stack([light(x) for x in one])
    products = basis @ basis.T * (4 * torch.pi / count)
    torch.testing.assert_close(products, torch.eye(9, dtype=torch.float64), rtol=0, atol=1e-3)
    x, y, z = n.unbind(-1)
    for row, polynomial in zip(
        basis[1:], (y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y), strict=True
    ):
        assert torch.corrcoef(torch.stack([row, polynomial]))[0, 1] > 0.9999
    # A lamp far away: relu(n . z), bands 0 to 2 of which are 1/4, 1/2 z and 5/32 (3 z^2 - 1).
    lamp = z.relu()
    fitted = light((basis @ lamp * (4 * torch.pi / count))[:, None].expand(9, 3))
    torch.testing.assert_close(fitted, 0.25 + z / 2 + 5 / 32 * (3 * z * z - 1), rtol=0, atol=1e-3)
    leaf = torch.rand(9, 3, dtype=torch.float64, requires_grad=True)
    (grad,) = torch.autograd.grad(light(leaf).sum(), leaf)
    torch.testing.assert_close(grad[:, 0], basis.sum(1))


ANGLED = [[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]
CAMERAS = {
    "orthographic": nmr.Orthographic([0.5, 0.7, -3.0]),
    "right-handed": nmr.Orthographic([0.5, 0.7, -3.0], right_handed=True),
    "pytorch3d": nmr.cameras.from_pytorch3d(
        torch.diag(torch.tensor([-1.0, 1.0, -1.0])), [0, 0, 3.0], orthographic=True
    ),
    "opengl": nmr.cameras.from_opengl(
        torch.cat(
            [
                torch.cat([torch.tensor(ANGLED), torch.tensor([[0.0], [0], [-3]])], 1),
                torch.eye(4)[3:],
            ]
        ),
        torch.diag(torch.tensor([1.0, 1.0, -0.1, 1.0])),
    ),
}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_normals_in_camera_space_are_those_of_the_depth(camera):
    """Where depth is f(x, y), the normal towards the viewer is (df/dx, df/dy, -1), normalised."""
    vertices, faces = bumpy_sphere(1)
    fragments = nmr.render_fragments(vertices, faces, camera, image_size=64)
    normals = fragments.normals(space="camera")[0]
    depth = fragments.depth[0]
    index = fragments.face_index[0]
    same = (
        (index[1:-1, 1:-1] >= 0)
        & (index[1:-1, 2:] == index[1:-1, :-2])
        & (index[2:, 1:-1] == index[:-2, 1:-1])
    )
    same &= index[1:-1, 2:] == index[1:-1, 1:-1]
    same &= index[2:, 1:-1] == index[1:-1, 1:-1]
    slope_x = 16 * (depth[1:-1, 2:] - depth[1:-1, :-2])
    slope_y = 16 * (depth[:-2, 1:-1] - depth[2:, 1:-1])
    wanted = torch.nn.functional.normalize(
        torch.stack([slope_x, slope_y, -torch.ones_like(slope_x)], -1), dim=-1
    )
    assert same.sum() > 300
    torch.testing.assert_close(normals[1:-1, 1:-1][same], wanted[same], rtol=0, atol=1e-5)


def test_a_camera_that_turns_with_the_mesh_sees_the_same_normals():
    vertices, faces = bumpy_sphere()
    images = []
    for eye in ([0.0, 0.0, -3.0], [0.0, 0.0, 3.0]):
        turned = vertices * torch.tensor([1.0, 1.0, 1.0] if eye[2] < 0 else [-1.0, 1.0, -1.0])
        images.append(
            nmr.render_normals(turned, faces, nmr.LookAt(eye), smooth=True, space="camera", **SIZE)
        )
    torch.testing.assert_close(*images)
    assert (images[0][..., 2] <= 1e-2).all() and images[0][..., 2].min() < -0.9
