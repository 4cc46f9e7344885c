"""The K nearest faces at each pixel."""

import pytest
import reference
import torch
from scenes import leaf_of, random_soup, uniform
from torch.autograd import gradcheck
from torch.testing import assert_close

import nmr

NEAR, FAR = 0.1, 100.0


def slow_layers(vertices, faces, size, layers, fill_back):
    """Draws the faces of one mesh one by one; sorts those at each pixel by depth, then by number. Row 0 = top."""
    face_indices, depths = [], []
    for number, face in enumerate(reference.with_back_faces(faces, fill_back)):
        index = reference.face_index(vertices, face[None], size, False, NEAR, FAR)
        depths.append(reference.fragments(vertices, face[None], index, FAR)[1])
        face_indices.append(torch.where(index < 0, -1, number))
    depth, order = torch.stack(depths, -1).sort(dim=-1, stable=True)
    face_index = torch.stack(face_indices, -1).gather(-1, order)
    return face_index[..., :layers].flip(0), depth[..., :layers].flip(0)


@pytest.mark.parametrize("seed", range(3))
def test_equals_the_slow_definition(seed, fill_back):
    vertices, faces = random_soup(seed, 1)
    how = dict(image_size=20, fill_back=fill_back, faces_per_pixel=5, clip=False)
    fragments = nmr.render_fragments(vertices, faces, **how)
    face_index, depth = slow_layers(vertices[0], faces, 20, 5, fill_back)
    assert torch.equal(fragments.sided_face_index[0].long(), face_index)
    assert (face_index[..., 1] >= 0).any()
    assert_close(fragments.depth[0], depth, rtol=1e-9, atol=0)


def test_of_equally_near_faces_the_first_comes_first():
    vertices = torch.tensor([[-0.9, -0.9, 2.0], [0.9, -0.9, 2.0], [0.0, 0.9, 2.0]])
    faces = torch.tensor([[0, 1, 2], [1, 2, 0], [2, 1, 0], [0, 1, 2]])
    fragments = nmr.render_fragments(vertices, faces, image_size=8, faces_per_pixel=6)
    # Faces 0, 1, 3 from their fronts, then 2 (4 + 2) from its back, where the depths have the same bits.
    assert fragments.sided_face_index[0, 5, 4].tolist() == [0, 1, 3, 6, -1, -1]


def test_a_sphere_has_two_surfaces():
    vertices, faces = nmr.icosphere(4)
    camera = nmr.LookAt([0.0, 0.0, -3.0], half_fov_deg=25.0)
    layers = nmr.render_fragments(vertices, faces, camera, image_size=32, faces_per_pixel=4)
    covered = layers.covered
    assert covered[..., 2:].sum((0, 1, 2)).max() <= 2  # where an edge is hit exactly
    both, points = covered[..., 1], layers.interpolate(vertices)
    thickness = (layers.depth[..., 1] - layers.depth[..., 0])[both]
    assert 1.9 < thickness.max() <= 2 and thickness.min() >= 0
    assert ((points.norm(dim=-1)[covered] - 1).abs() < 3e-3).all()
    towards = (layers.normals(smooth=True) * points).sum(-1)[both]
    assert (towards[:, 0] > 0.95).all() and (towards[:, 1] < -0.95).all()
    numbers = layers.per_face(torch.arange(len(faces)).float().unsqueeze(-1)).squeeze(-1)
    assert torch.equal(numbers[covered], layers.face_index[covered].float())


def test_gradients_are_the_derivative():
    vertices, faces = random_soup(1, 1)
    values = uniform(vertices.shape[1], 2, seed=1)

    def draw(vertices):
        layers = nmr.render_fragments(vertices, faces[:8], image_size=6, faces_per_pixel=3)
        return layers.weights, layers.depth, layers.interpolate(values)

    gradcheck(draw, leaf_of(vertices), eps=1e-7, atol=1e-5, rtol=1e-5)


def test_layers_that_no_pixel_needs_change_no_bit():
    """The largest number of surfaces in a pixel decides the work, not faces_per_pixel."""
    vertices, faces = random_soup(3)
    colors = nmr.VertexColors(uniform(*vertices.shape, seed=4).to(vertices))
    how = dict(colors=colors, background=0.25, image_size=16)

    def drawn(draw, layers):
        leaf = leaf_of(vertices)
        images = draw(leaf, faces, faces_per_pixel=layers, **how)
        both = torch.cat([images.rgb, images.alpha.unsqueeze(-1)], dim=-1)
        return both, *torch.autograd.grad((both * both).sum(), leaf)

    for draw in (
        lambda *args, **how: nmr.render_transparent(*args, opacity=0.3, **how),
        lambda *args, **how: nmr.render_soft(*args, sigma=1e-3, gamma=1e-2, **how),
    ):
        few, many = drawn(draw, 12), drawn(draw, 40)
        assert all(torch.equal(a, b) for a, b in zip(few, many, strict=True))
