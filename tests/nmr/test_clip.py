"""Faces that cross the near plane: what is seen of them is what finer meshes show, with gradients to their corners."""

import functools
import warnings
from dataclasses import replace

import pytest
import torch
from scenes import assert_near, double, leaf_of, normal, same_bits, uniform, value_and_gradients
from torch.autograd import gradcheck
from torch.testing import assert_close

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
    behind = [[-2, -1, -1], [2, -1.2, -1.5], [0.3, -0.4, 5]]
    others = [[-2, 0.9, 4], [2.5, 0.6, 3], [0.2, 0.5, -0.7], [0.1, 0, 3]]
    faces = torch.tensor([[0, 1, 2], [3, 5, 4], [2, 3, 6]])
    return double(behind + others).to(dtype), faces


@pytest.mark.parametrize("camera", [CAMERA, PINHOLE], ids=["LookAt", "Pinhole"])
@pytest.mark.parametrize("image_size", [SIZE, (32, 64)])
def test_a_floor_under_the_eye_is_that_of_a_fine_mesh(camera, image_size):
    options = {"image_size": image_size, "anti_aliasing": False}

    def draw(mesh):
        uv = (mesh[0][:, [0, 2]] + 10) / 20
        chequered = nmr.UVTexture(torch.eye(2).repeat(20, 20).unsqueeze(-1), uv)
        how = dict(outputs=("rgb", "alpha", "depth", "fragments"), colors=chequered, **options)
        images = nmr.render(*mesh, camera, **how)
        return images, images.fragments.interpolate(mesh[0]), images.fragments.normals()

    (seen, points, normals), (wanted, fine_points, fine_normals) = draw(floor(1)), draw(floor(150))
    assert torch.equal(seen.alpha, wanted.alpha) and 0.3 < seen.alpha.mean() < 0.95
    unclipped = nmr.render_silhouette(*floor(1), camera, clip=False, **options)
    assert not torch.equal(seen.alpha, unclipped)
    # At the horizon, rounding of x in pixels counts for the most.
    assert_close(seen.depth, wanted.depth, rtol=1e-3, atol=0)
    assert_close(points, fine_points, rtol=2e-3, atol=2e-3)
    assert_close(normals, fine_normals)
    assert (seen.rgb - wanted.rgb).abs().mean() < 2e-3
    numbers = seen.fragments.sided_face_index.unique().tolist()
    assert numbers in ([-1, 1], [-1, 0, 1], [-1, 2, 3], [-1, 3])
    assert_close(seen.fragments.weights.sum(-1), seen.alpha, rtol=0, atol=1e-5)


def test_without_a_camera_the_perspective_image_is_cut():
    vertices, faces = floor(1)
    how = dict(outputs=("alpha", "depth"), image_size=SIZE, anti_aliasing=False)
    images = nmr.render(vertices, faces, CAMERA, **how)
    again = nmr.render(CAMERA.transform(vertices)[0], faces, **how)
    assert torch.equal(images.alpha, again.alpha)
    assert_close(images.depth, again.depth, rtol=1e-4, atol=0)


def test_one_face_is_drawn_as_its_part_in_front():
    """Cut by hand, with the same gradient by the chain rule."""
    near, camera = 0.5, nmr.LookAt([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], half_fov_deg=40.0)

    def whole(vertices, faces=((0, 1, 2),)):
        how = dict(image_size=SIZE, near=near)
        return nmr.render_silhouette(vertices, torch.tensor(faces), camera, **how)

    def parts(vertices):
        a, b, c = vertices
        ab, bc = (p + (near - p[2]) / (q[2] - p[2]) * (q - p) for p, q in ((a, b), (b, c)))
        return whole(torch.stack([ab, b, c, a, bc]), ((4, 2, 3), (4, 3, 0)))

    vertices = double([[-1.0, -1.0, 4.0], [3.0, -0.5, -2.0], [0.5, 1.0, 3.0]])
    (alpha, grad), (wanted, wanted_grad) = (
        value_and_gradients(draw, vertices) for draw in (whole, parts)
    )
    assert torch.equal(alpha, wanted) and alpha.sum() > 100
    assert_close(grad, wanted_grad, rtol=1e-9, atol=1e-9)
    assert (grad.abs().sum(-1) > 0.1).all()  # the corner behind the eye has one, too


def test_gradients_are_the_derivative(packed):
    vertices, faces = tilted()
    values, eye = uniform(7, 2, seed=1), double([[0.02, 0.03, -0.01]])

    def draw(vertices, eye):
        mesh, attributes = (vertices, faces), values
        if packed:
            mesh = [vertices, vertices[:6] + 0.03], [faces, faces[:2]]
            attributes = [values, values[:6]]
        how = dict(camera=replace(CAMERA, eye=eye), image_size=7)
        seen = nmr.render_fragments(*mesh, **how)
        depths = seen.depth.clamp_max(50), nmr.render_depth(*mesh, **how)
        return seen.weights, *depths, seen.interpolate(attributes), seen.normals()

    index = nmr.render_face_index(vertices, faces, replace(CAMERA, eye=eye), image_size=7)
    assert {0, 1, 2} <= set(index.flatten().tolist())
    gradcheck(draw, (leaf_of(vertices), leaf_of(eye)), eps=1e-7, atol=1e-4, rtol=1e-4)


def test_faces_keep_their_numbers_and_sides():
    vertices, faces = tilted(torch.float32)
    seen, flipped, front = (
        nmr.render_fragments(vertices, f, CAMERA, image_size=SIZE, fill_back=fill_back)
        for f, fill_back in ((faces, True), (faces.flip(1), True), (faces, False))
    )
    assert seen.face_index.unique().tolist() == [-1, 0, 1, 2]
    assert torch.equal(seen.is_back, seen.sided_face_index >= 3)
    assert torch.equal(flipped.is_back, seen.covered & ~seen.is_back)
    assert torch.equal(flipped.face_index, seen.face_index)
    assert 0 < front.covered.sum() < seen.covered.sum() and not front.is_back.any()


def test_scenes_in_front_of_the_plane_keep_their_bits():
    vertices, faces = nmr.icosphere(2)
    camera = nmr.LookAt([[0.0, 0.0, -3.0], [1.0, 2.0, -2.0]])

    def draw(vertices, clip):
        how = dict(outputs=("rgb", "alpha", "depth", "normals"), image_size=SIZE, clip=clip)
        images = nmr.render(vertices, faces, camera, **how)
        return torch.cat([x.view(2, SIZE, SIZE, -1) for x in images], dim=-1)

    results = (
        value_and_gradients(functools.partial(draw, clip=clip), vertices) for clip in (False, True)
    )
    assert same_bits(*results)


def test_a_camera_of_ones_own():
    class Shift:  # takes batches only
        def transform(self, vertices):
            return CAMERA.transform(vertices)

    vertices, faces = tilted(torch.float32)
    batch = torch.stack([vertices, vertices + torch.tensor([0.0, 0.0, 4.0]), 0.8 * vertices])

    def draw(vertices, camera):
        images = nmr.render(vertices, faces, camera, outputs=("alpha", "depth"), image_size=SIZE)
        return torch.stack([*images])

    own, wanted = (
        value_and_gradients(functools.partial(draw, camera=camera), batch)
        for camera in (Shift(), CAMERA)
    )
    assert_near(own, wanted, 1e-5)


def test_a_corner_in_the_plane_of_the_eye():
    vertices = double([[-1.0, -0.5, 0.0], [1.0, -0.5, 0.0], [0.0, -0.2, 3.0]])
    how = dict(faces=torch.tensor([[0, 1, 2]]))
    how["camera"] = nmr.LookAt([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], half_fov_deg=45.0)
    assert not nmr.render_silhouette(vertices, image_size=SIZE, clip=False, **how).any()
    fragments = nmr.render_fragments(vertices, image_size=SIZE, **how)
    assert fragments.covered.sum() > 100
    depth = fragments.interpolate(vertices)[..., 2]
    assert_close(depth, fragments.depth * fragments.covered % 100)
    draw = functools.partial(nmr.render_depth, image_size=7, **how)
    gradcheck(draw, leaf_of(vertices), eps=1e-7, atol=1e-4, rtol=1e-4)


def test_near_zero():
    """It is the limit of small ones, and what it draws of a face does not depend on the others."""
    small = 5e-4 * torch.tensor([[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [0.0, 1.0, 1.0]])
    face, (vertices, faces) = torch.tensor([[0, 1, 2]]), floor(1)

    def alpha(vertices, faces, near=0.0):
        return nmr.render_silhouette(vertices, faces, CAMERA, image_size=SIZE, near=near)

    zero = alpha(vertices, faces)
    assert torch.equal(zero, alpha(*floor(150)))
    tiny = [alpha(vertices, faces, near) for near in (1e-6, 1e-7, 1e-12)]
    assert torch.equal(tiny[0], tiny[1]) and torch.equal(tiny[0], tiny[2])
    assert (tiny[0] >= zero).all()
    assert not alpha(small, face).any() and alpha(small, face, near=1e-6).any()
    joint = torch.cat([vertices, small]), torch.cat([faces, face + len(vertices)])
    assert torch.equal(alpha(*joint), zero)


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
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    faces = torch.tensor(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]]
    )
    far_away = torch.tensor([[-9.0, -9.0, 4.0], [9.0, -9.0, 4.0], [0.0, 9.0, 4.0]])
    more = torch.cat([faces, torch.tensor([[8, 9, 10]])])
    for seed in range(40):
        sizes, turn = uniform(3, seed=seed), torch.linalg.qr(normal(3, 3, seed=seed)).Q
        vertices = ((corners * sizes) @ turn).float()
        near = 1.01 * float(camera.transform(vertices)[..., 2].max())
        how = {"camera": camera, "image_size": SIZE, "near": near}
        for function, background in ((nmr.render_silhouette, 0), (nmr.render_depth, 100)):
            draw = functools.partial(function, faces=faces, **how)
            image, grad = value_and_gradients(draw, vertices)
            assert (image == background).all() and not grad.any()
        both = nmr.render_fragments(
            [torch.cat([vertices, far_away]), vertices], [more, faces], **how
        )
        assert both.face_index.unique().tolist() == [-1, 8] and not both.covered[1].any()
        assert both.weights.min() >= 0 and both.weights.max() <= 1
