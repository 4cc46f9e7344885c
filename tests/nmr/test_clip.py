"""Faces that cross the near plane: what is seen of them is what finer meshes show, with gradients to their corners."""

import warnings
from dataclasses import replace

import pytest
import torch

import nmr

SIZE = 48
CAMERA = nmr.LookAt([0.0, 0.0, 0.0], [0.0, -0.3, 1.0], half_fov_deg=35.0)
PINHOLE = nmr.Pinhole(
    [[40.0, 0.0, 24.0], [0.0, 40.0, 24.0], [0.0, 0.0, 1.0]],
    [[1.0, 0.0, 0.0], [0.0, -0.96, -0.28], [0.0, -0.28, 0.96]],
    [0.1, 0.0, 0.0],
    orig_size=48,
)


def floor(n, dtype=torch.float32, height=-1.0):
    """A square of 2 n^2 faces below the origin, 20 wide: the eye is above its middle."""
    steps = torch.linspace(-10, 10, n + 1, dtype=dtype)
    x, z = torch.meshgrid(steps, steps, indexing="xy")
    vertices = torch.stack([x + 0.01 * z, torch.full_like(x, height), z], dim=-1).reshape(-1, 3)
    first = (torch.arange(n).view(-1, 1) * (n + 1) + torch.arange(n)).view(-1, 1)
    return vertices, (first + torch.tensor([[0, 1, n + 2, 0, n + 2, n + 1]])).view(-1, 3)


def tilted(dtype=torch.float64):
    """Three faces with one, two and no corner behind the eye, seen from either side."""
    points = [
        [-2, -1, -1],
        [2, -1.2, -1.5],
        [0.3, -0.4, 5],
        [-2, 0.9, 4],
        [2.5, 0.6, 3],
        [0.2, 0.5, -0.7],
        [0.1, 0, 3],
    ]
    return torch.tensor(points, dtype=dtype), torch.tensor([[0, 1, 2], [3, 5, 4], [2, 3, 6]])


@pytest.mark.parametrize("camera", [CAMERA, PINHOLE], ids=["LookAt", "Pinhole"])
@pytest.mark.parametrize("image_size", [SIZE, (32, 64)])
def test_a_floor_under_the_eye_is_that_of_a_fine_mesh(camera, image_size):
    coarse, fine = floor(1), floor(150)
    options = {"image_size": image_size, "anti_aliasing": False}

    def draw(mesh):
        uv = (mesh[0][:, [0, 2]] + 10) / 20
        chequered = nmr.UVTexture(torch.eye(2).repeat(20, 20).unsqueeze(-1), uv)
        images = nmr.render(
            *mesh, camera, outputs=("rgb", "alpha", "depth"), colors=chequered, **options
        )
        fragments = nmr.render_fragments(*mesh, camera, **options)
        return *images, fragments.interpolate(mesh[0]), fragments.normals()

    (rgb, alpha, depth, points, normals), wanted = draw(coarse), draw(fine)
    assert torch.equal(alpha, wanted[1]) and 0.3 < alpha.mean() < 0.95
    assert not torch.equal(alpha, nmr.render_silhouette(*coarse, camera, clip=False, **options))
    # At the horizon, rounding of x in pixels counts for the most.
    torch.testing.assert_close(depth, wanted[2], rtol=1e-3, atol=0)
    torch.testing.assert_close(points, wanted[3], rtol=2e-3, atol=2e-3)
    torch.testing.assert_close(normals, wanted[4])
    assert (rgb - wanted[0]).abs().mean() < 2e-3
    fragments = nmr.render_fragments(*coarse, camera, **options)
    assert fragments.sided_face_index.unique().tolist() in (
        [-1, 1],
        [-1, 0, 1],
        [-1, 2, 3],
        [-1, 3],
    )
    torch.testing.assert_close(fragments.weights.sum(-1), alpha, rtol=0, atol=1e-5)


def test_without_a_camera_the_perspective_image_is_cut():
    vertices, faces = floor(1)
    seen = CAMERA.transform(vertices)[0]
    options = {"image_size": SIZE, "anti_aliasing": False}
    images = nmr.render(vertices, faces, CAMERA, outputs=("alpha", "depth"), **options)
    again = nmr.render(seen, faces, outputs=("alpha", "depth"), **options)
    assert torch.equal(images.alpha, again.alpha)
    torch.testing.assert_close(images.depth, again.depth, rtol=1e-4, atol=0)


def test_a_room_from_inside():
    # A cube of 12 faces around the eye: every pixel shows a wall, at the distance of the cube's sides.
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = torch.tensor([[side[0], side[k], side[k + 1]] for side in sides for k in (1, 2)])
    for direction in ([0.2, -0.3, 1.0], [1.0, 0.1, 0.1], [-0.4, 0.9, -0.5]):
        camera = nmr.Look([0.3, -0.2, 0.1], direction, half_fov_deg=50.0)
        fragments = nmr.render_fragments(corners, faces, camera, image_size=SIZE, near=0.05)
        points = fragments.interpolate(corners)
        # Pixels exactly between two walls may be missed by both.
        assert fragments.covered.float().mean() > 0.995
        walls = points.abs().amax(-1)[fragments.covered]
        torch.testing.assert_close(walls, torch.ones_like(walls), rtol=0, atol=1e-4)
        plain = nmr.render_fragments(corners, faces, camera, image_size=SIZE, near=0.05, clip=False)
        assert (plain.sided_face_index != fragments.sided_face_index).float().mean() > 0.05


def test_one_face_is_drawn_as_its_part_in_front():
    # Cut by hand, with the same gradient by the chain rule.
    vertices = torch.tensor([[-1.0, -1.0, 4.0], [3.0, -0.5, -2.0], [0.5, 1.0, 3.0]])
    faces = torch.tensor([[0, 1, 2]])
    vertices, near = vertices.double().requires_grad_(), 0.5
    eye = nmr.LookAt([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], half_fov_deg=40.0)
    a, b, c = vertices

    def at_near(p, q):
        return p + (near - p[2]) / (q[2] - p[2]) * (q - p)

    parts = torch.stack([at_near(a, b), b, c, a, at_near(b, c)])
    target = torch.rand(
        1, SIZE, SIZE, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    grads = []
    for points, triangles in ((vertices, faces), (parts, torch.tensor([[4, 2, 3], [4, 3, 0]]))):
        alpha = nmr.render_silhouette(points, triangles, eye, image_size=SIZE, near=near)
        loss = (alpha - target).square().sum()
        grads.append((alpha, *torch.autograd.grad(loss, vertices)))
    assert torch.equal(grads[0][0], grads[1][0]) and grads[0][0].sum() > 100
    torch.testing.assert_close(grads[0][1], grads[1][1], rtol=1e-9, atol=1e-9)
    assert (grads[0][1].abs().sum(-1) > 0.1).all()  # the corner behind the eye has one, too


@pytest.mark.parametrize("packed", [False, True])
def test_gradients_are_the_derivative(packed):
    vertices, faces = tilted()
    values = torch.rand(7, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    camera = replace(CAMERA, eye=torch.tensor([[0.02, 0.03, -0.01]], dtype=torch.float64))

    def draw(vertices, eye):
        meshes = (
            ([vertices, vertices[:6] + 0.03], [faces, faces[:2]]) if packed else (vertices, faces)
        )
        seen = nmr.render_fragments(*meshes, replace(camera, eye=eye), image_size=7)
        depth = nmr.render_depth(*meshes, replace(camera, eye=eye), image_size=7)
        attributes = [values, values[:6]] if packed else values
        return (
            seen.weights,
            seen.depth.clamp_max(50),
            depth,
            seen.interpolate(attributes),
            seen.normals(),
        )

    covered = nmr.render_fragments(vertices, faces, camera, image_size=7)
    assert {0, 1, 2} <= {
        face_index % 3 for face_index in covered.sided_face_index[covered.covered].tolist()
    }
    vertices.requires_grad_(), camera.eye.requires_grad_()
    assert torch.autograd.gradcheck(draw, (vertices, camera.eye), eps=1e-7, atol=1e-4, rtol=1e-4)


def test_faces_keep_their_numbers_and_sides():
    vertices, faces = tilted(torch.float32)
    face_index = nmr.render_fragments(vertices, faces, CAMERA, image_size=SIZE).sided_face_index
    seen = nmr.render_face_index(vertices, faces, CAMERA, image_size=SIZE)
    assert seen.unique().tolist() == [-1, 0, 1, 2] and torch.equal(
        seen, torch.where(face_index >= 3, face_index - 3, face_index)
    )
    flipped = nmr.render_fragments(vertices, faces.flip(1), CAMERA, image_size=SIZE)
    assert torch.equal(flipped.is_back, (face_index >= 0) & (face_index < 3)) and torch.equal(
        flipped.face_index, seen
    )
    front = nmr.render_fragments(
        vertices, faces, CAMERA, image_size=SIZE, fill_back=False
    ).sided_face_index
    assert 0 < (front >= 0).sum() < (face_index >= 0).sum() and front.max() < 3


def test_scenes_in_front_of_the_plane_keep_their_bits():
    vertices, faces = nmr.icosphere(2)
    vertices = vertices.repeat(2, 1, 1).requires_grad_()
    camera = nmr.LookAt([[0.0, 0.0, -3.0], [1.0, 2.0, -2.0]])
    results = []
    for clip in (False, True):
        outputs = ("rgb", "alpha", "depth", "normals")
        images = nmr.render(vertices, faces, camera, outputs=outputs, image_size=SIZE, clip=clip)
        loss = sum(
            (image * torch.linspace(-1, 1, image.numel()).view(image.shape)).sum()
            for image in images
        )
        results.append([*images, *torch.autograd.grad(loss, vertices)])
    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b)


def test_a_camera_of_ones_own():
    class Shift:  # takes batches only
        def transform(self, vertices):
            return CAMERA.transform(vertices)

    vertices, faces = tilted(torch.float32)
    vertices = torch.stack(
        [vertices, vertices + torch.tensor([0.0, 0.0, 4.0]), 0.8 * vertices]
    ).requires_grad_()
    results = []
    for camera in (CAMERA, Shift()):
        alpha, depth = nmr.render(
            vertices, faces, camera, outputs=("alpha", "depth"), image_size=SIZE
        )
        results.append((alpha, depth, *torch.autograd.grad((alpha * depth).sum(), vertices)))
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5 * float(b.detach().abs().max()))


def test_a_corner_in_the_plane_of_the_eye():
    vertices = torch.tensor(
        [[-1.0, -0.5, 0.0], [1.0, -0.5, 0.0], [0.0, -0.2, 3.0]], dtype=torch.float64
    )
    camera = nmr.LookAt([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], half_fov_deg=45.0)
    faces = torch.tensor([[0, 1, 2]])
    assert nmr.render_silhouette(vertices, faces, camera, image_size=SIZE, clip=False).sum() == 0
    fragments = nmr.render_fragments(vertices, faces, camera, image_size=SIZE)
    assert fragments.covered.sum() > 100
    torch.testing.assert_close(
        fragments.interpolate(vertices)[..., 2], fragments.depth * fragments.covered % 100
    )

    def depth(vertices):
        return nmr.render_depth(vertices, faces, camera, image_size=7)

    assert torch.autograd.gradcheck(
        depth, vertices.requires_grad_(), eps=1e-7, atol=1e-4, rtol=1e-4
    )


def test_near_zero():
    vertices, faces = floor(1)
    alpha = nmr.render_silhouette(vertices, faces, CAMERA, image_size=SIZE, near=0.0)
    assert torch.equal(alpha, nmr.render_silhouette(*floor(150), CAMERA, image_size=SIZE, near=0.0))
    tiny = [
        nmr.render_silhouette(vertices, faces, CAMERA, image_size=SIZE, near=near)
        for near in (1e-6, 1e-7, 1e-12)
    ]
    assert (
        torch.equal(tiny[0], tiny[1]) and torch.equal(tiny[0], tiny[2]) and (tiny[0] >= alpha).all()
    )


@pytest.mark.parametrize(
    ("near", "dtype", "warned"),
    [(1e-4, torch.float32, True), (0.05, torch.float32, False), (1e-4, torch.float64, False)],
)
def test_a_near_too_small_for_float32_is_warned_of(near, dtype, warned):
    vertices, faces = nmr.icosphere(1)
    how = dict(camera=nmr.Look([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]), image_size=8, near=near)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        nmr.render_silhouette(2 * vertices.to(dtype), faces, **how)
    assert [str(w.message)[:24] for w in caught] == ["faces are cut at depth 0"] * warned
    assert all(w.filename == __file__ for w in caught)


@pytest.mark.parametrize("camera", [CAMERA, nmr.Orthographic([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])])
def test_what_is_nearer_than_near_is_never_drawn(camera):
    corners = torch.tensor(
        [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]
    )
    faces = torch.tensor(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]]
    )
    far_away = torch.tensor([[-9.0, -9.0, 4.0], [9.0, -9.0, 4.0], [0.0, 9.0, 4.0]])
    for seed in range(40):
        generator = torch.Generator().manual_seed(seed)
        turn = torch.linalg.qr(torch.randn(3, 3, generator=generator)).Q
        vertices = ((corners * torch.rand(3, generator=generator)) @ turn).requires_grad_()
        near = 1.01 * float(camera.transform(vertices)[..., 2].max())
        how = {"image_size": SIZE, "near": near}
        alone = nmr.render(vertices, faces, camera, outputs=("alpha", "depth", "fragments"), **how)
        assert not alone.alpha.any() and (alone.depth == 100).all()
        (grad,) = torch.autograd.grad(alone.depth.sum() + alone.alpha.sum(), vertices)
        assert not grad.any()
        both = nmr.render_fragments(
            [torch.cat([vertices, far_away]), vertices],
            [torch.cat([faces, torch.tensor([[8, 9, 10]])]), faces],
            camera,
            **how,
        )
        assert both.face_index.unique().tolist() == [-1, 8] and not both.covered[1].any()
        assert both.weights.min() >= 0 and both.weights.max() <= 1


def test_near_zero_draws_the_same_whatever_other_faces_do():
    small = torch.tensor([[-5e-4, -5e-4, 5e-4], [5e-4, -5e-4, 5e-4], [0.0, 5e-4, 5e-4]])
    vertices, faces = floor(1)
    how = {"image_size": SIZE, "near": 0.0}
    assert not nmr.render_silhouette(small, torch.tensor([[0, 1, 2]]), CAMERA, **how).any()
    joint = (
        torch.cat([vertices, small]),
        torch.cat([faces, torch.tensor([[0, 1, 2]]) + len(vertices)]),
    )
    assert torch.equal(
        nmr.render_silhouette(*joint, CAMERA, **how),
        nmr.render_silhouette(vertices, faces, CAMERA, **how),
    )
