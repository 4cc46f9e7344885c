"""render and its outputs: against closed forms, the published renderer, each other; gradients; bad input."""

import dataclasses

import numpy as np
import pytest
import torch
from vectors import load_vector, vector_names

import nmr

CAMERA = nmr.LookAt.from_angles(2.732, 20.0, [0.0, 100.0], half_fov_deg=25.0)


def square(z, dtype=torch.float64):
    """Two triangles that fill [-1/2, 1/2]^2 in renderer space at the depths z of the corners."""
    xy = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]
    vertices = torch.tensor([[x, y, z_k] for (x, y), z_k in zip(xy, z, strict=True)], dtype=dtype)
    return vertices, torch.tensor([[0, 1, 2], [0, 2, 3]])


def pixel_centres(size):
    """x and y in [-1, 1] of the pixels of an image, row 0 = top."""
    centre = (2 * torch.arange(size, dtype=torch.float64) + 1 - size) / size
    return torch.meshgrid(centre, -centre, indexing="xy")


def bumpy_sphere(seed=0, dtype=torch.float64, subdivisions=2):
    vertices, faces = nmr.icosphere(subdivisions)
    noise = torch.rand(
        len(vertices), 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    return ((0.7 + 0.3 * noise) * vertices).to(dtype), faces


def relative(a, b):
    return float((a - b).norm() / b.norm())


def test_depth_and_weights_of_a_tilted_plane_in_perspective():
    """The camera-space plane Z = 3 + X, seen as x = X / Z: Z = 3 / (1 - x)."""
    points = torch.tensor([[-1.0, -1.0], [1.2, -0.9], [0.9, 1.1], [-1.1, 0.8]], dtype=torch.float64)
    z = 3 + points[:, :1]
    vertices, faces = torch.cat([points / z, z], dim=1), torch.tensor([[0, 1, 2], [2, 3, 0]])
    fragments = nmr.render_fragments(vertices, faces, image_size=40)
    x, y = pixel_centres(40)
    inside = fragments.covered[0]
    assert inside.sum() > 100
    torch.testing.assert_close(
        fragments.depth[0][inside], (3 / (1 - x))[inside], rtol=1e-10, atol=0
    )
    # Perspective-correct weights interpolate what is linear in space: the points themselves.
    at_pixels = fragments.interpolate(points)[0]
    expected = torch.stack([x, y], dim=-1) * fragments.depth[0].unsqueeze(-1)
    torch.testing.assert_close(at_pixels[inside], expected[inside], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(
        fragments.weights.sum(-1)[0][inside], torch.ones(int(inside.sum()), dtype=torch.float64)
    )
    assert not fragments.weights[0][~inside].any() and not at_pixels[~inside].any()


def test_fragments_know_front_from_back():
    vertices, faces = square([1.0, 1.0, 1.0, 1.0])
    front = nmr.render_fragments(vertices, faces, image_size=8)
    back = nmr.render_fragments(vertices, faces.flip(1), image_size=8)
    assert front.covered.any() and torch.equal(front.covered, back.covered)
    assert not front.is_back.any() and torch.equal(back.is_back, back.covered)
    assert torch.equal(front.face_index, nmr.render_face_index(vertices, faces, image_size=8))
    assert torch.equal(front.face_index, back.face_index) and back.sided_face_index.max() == 3
    # Weights are in the face's own order, whichever way round it is drawn.
    torch.testing.assert_close(front.weights, back.weights.flip(-1), rtol=1e-12, atol=1e-12)


def published_camera(v, setting):
    """The camera of a renderer_* file, its parameters as leaves, and 1, or -1 where it mirrors the world."""
    names = [
        key.removeprefix("param_")
        for key in v
        if key.startswith("param_") and v[key].dtype == np.float32
    ]
    leaves = {
        name: torch.from_numpy(np.atleast_1d(v[f"param_{name}"])).requires_grad_() for name in names
    }
    if str(v["camera_mode"]) == "projection":
        size = leaves.pop("orig_size").item()
        return (
            nmr.Pinhole(*(leaves[name] for name in ("K", "R", "t", "dist_coeffs")), orig_size=size),
            leaves,
            -1,
        )
    angle = float(setting["viewing_angle"])
    if str(v["camera_mode"]) == "look":
        return nmr.Look(leaves["eye"], leaves["camera_direction"], half_fov_deg=angle), leaves, 1
    return nmr.LookAt(leaves["eye"], half_fov_deg=angle), leaves, 1


@pytest.mark.parametrize("name", [n for n in vector_names("renderer_*") if n.count("_") == 3])
def test_published_renderer(name):
    """The whole of it: camera, lights, texture cubes, background, depth and alpha, and every gradient."""
    v = load_vector(name)
    setting = {
        key.removeprefix("renderer_"): torch.from_numpy(v[key])
        for key in v
        if key.startswith("renderer_")
    }
    vertices, textures = (
        torch.from_numpy(v[key]).requires_grad_() for key in ("vertices", "textures")
    )
    camera, leaves, side = published_camera(v, setting)
    outputs = tuple(key.removeprefix("out_") for key in v if key.startswith("out_"))
    own = "rgb" in outputs  # the published render_silhouettes and render_depth use other constants
    images = nmr.render(
        vertices,
        torch.from_numpy(v["faces"]),
        camera,
        outputs=outputs,
        colors=nmr.TextureCubes(textures),
        lights=nmr.Lights(
            setting["light_intensity_ambient"],
            setting["light_intensity_directional"],
            # The published renderer takes the normal of the far side where the camera mirrors: light from behind.
            side * setting["light_direction"],
            setting["light_color_ambient"],
            setting["light_color_directional"],
        ),
        background=setting["background_color"],
        image_size=int(setting["image_size"]),
        anti_aliasing=bool(setting["anti_aliasing"]),
        fill_back=bool(setting["fill_back"]),
        near=float(setting["near"]) if own else 0.1,
        far=float(setting["far"]) if own else 100.0,
        eps=1e-3 if own else 1e-4,
    )
    loss = 0
    for output, image in zip(outputs, images, strict=True):
        image = image.permute(0, 3, 1, 2) if output == "rgb" else image
        torch.testing.assert_close(
            image.detach(), torch.from_numpy(v[f"out_{output}"]), rtol=1e-5, atol=1e-5
        )
        loss = loss + (image * torch.from_numpy(v[f"upstream_{output}"])).sum()
    loss.backward()
    # our projection rounds otherwise, and 1 / distance amplifies
    least = 1e-4 if side > 0 else 2e-3
    for name, leaf in {"vertices": vertices, "textures": textures, **leaves}.items():
        key = f"grad_{name}"
        if key in v and (own or leaf is not textures):
            expected = torch.from_numpy(v[key])
            contracted = torch.from_numpy(v.get(f"{key}_fma", v[key]))
            assert relative(leaf.grad, expected) < max(5 * relative(contracted, expected), least), (
                key
            )


def test_background():
    vertices, faces = bumpy_sphere()
    for background, expected in [
        (0.25, torch.full((2, 3), 0.25)),
        ([0.1, 0.2, 0.3], torch.tensor([[0.1, 0.2, 0.3]]).expand(2, 3)),
        (
            torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]),
            torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]),
        ),
    ]:
        rgb = nmr.render_rgb(0.3 * vertices, faces, CAMERA, background=background, image_size=16)
        torch.testing.assert_close(rgb[:, 0, 0], expected.double())
        assert (rgb[:, 8, 8] == 1).all()  # white without colours


def all_outputs(leaf, faces, wanted, anti_aliasing):
    return nmr.render(
        leaf,
        faces,
        CAMERA,
        outputs=wanted,
        colors=nmr.VertexColors((leaf.detach() + 1) / 2),
        lights=nmr.Lights(),
        background=0.3,
        image_size=20,
        anti_aliasing=anti_aliasing,
    )


@pytest.mark.parametrize("anti_aliasing", [False, True])
@pytest.mark.parametrize("output", ["rgb", "alpha", "depth", "normals"])
def test_outputs_together_equal_outputs_alone(output, anti_aliasing):
    vertices, faces = bumpy_sphere(dtype=torch.float32)
    results = []
    for wanted in (
        (output,),
        ("alpha", "depth", output),
        ("fragments", "normals", "depth", "rgb", "alpha"),
    ):
        leaf = vertices.clone().requires_grad_()
        image = getattr(
            all_outputs(leaf, faces, tuple(dict.fromkeys(wanted)), anti_aliasing), output
        )
        image.backward(torch.randn(image.shape, generator=torch.Generator().manual_seed(0)))
        results.append((image.detach(), leaf.grad))
    for image, grad in results[1:]:
        assert torch.equal(image, results[0][0]) and image.any()
        torch.testing.assert_close(
            grad, results[0][1], rtol=1e-5, atol=1e-5 * float(grad.abs().max())
        )


def test_each_output_has_a_function_of_its_own():
    vertices, faces = bumpy_sphere()
    size = dict(image_size=16)
    images = nmr.render(
        vertices, faces, CAMERA, outputs=("rgb", "alpha", "depth", "normals", "fragments"), **size
    )
    assert torch.equal(
        nmr.render(vertices, faces, CAMERA, outputs="depth", **size).depth, images.depth
    )
    assert torch.equal(images.rgb, nmr.render_rgb(vertices, faces, CAMERA, **size))
    assert torch.equal(images.alpha, nmr.render_silhouette(vertices, faces, CAMERA, **size))
    assert torch.equal(images.depth, nmr.render_depth(vertices, faces, CAMERA, **size))
    assert torch.equal(images.normals, nmr.render_normals(vertices, faces, CAMERA, **size))
    fragments = nmr.render_fragments(vertices, faces, CAMERA, anti_aliasing=True, **size)
    assert torch.equal(
        images.fragments.sided_face_index, fragments.sided_face_index
    ) and fragments.sided_face_index.shape == (2, 32, 32)
    assert torch.equal(images.fragments.weights, fragments.weights)


def test_rgb_and_alpha_decide_together():
    """One resolve of the stacked channels, as the published render does: not the sum of two."""
    vertices, faces = bumpy_sphere()
    leaves = [vertices.clone().requires_grad_() for _ in range(2)]
    images = all_outputs(leaves[0], faces, ("rgb", "alpha"), True)
    fragments = all_outputs(leaves[1], faces, ("fragments",), True).fragments
    constant = dataclasses.replace(fragments, weights=fragments.weights.detach())
    shaded = nmr.VertexColors((vertices + 1) / 2).sample(constant) * nmr.Lights().shade(constant)
    covered = fragments.covered.unsqueeze(-1)
    stacked = fragments.resolve(
        torch.cat([torch.where(covered, shaded, 0.3), covered.double()], dim=-1)
    )
    upstream = torch.randn(
        stacked.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    torch.autograd.backward([images.rgb, images.alpha], [upstream[..., :3], upstream[..., 3]])
    stacked.backward(upstream)
    assert torch.equal(images.rgb, stacked[..., :3]) and torch.equal(images.alpha, stacked[..., 3])
    torch.testing.assert_close(leaves[0].grad, leaves[1].grad, rtol=1e-12, atol=1e-12)
    assert leaves[0].grad.any()


def test_images_say_what_was_not_asked_for():
    images = nmr.render(*square([1.0] * 4), outputs=("depth", "alpha"), image_size=4)
    depth, alpha = images
    assert depth is images.depth and alpha is images.alpha and not hasattr(images, "rgb")
    assert repr(images) == "Images(depth: float64 [1, 4, 4], alpha: float64 [1, 4, 4])"
    assert len(images) == 2 and images[0] is images.depth and images[-1] is images.alpha
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
    vertices = vertices.double()
    normals = nmr.render_normals(vertices, faces, CAMERA, image_size=24, anti_aliasing=False)
    index = nmr.render_face_index(vertices, faces, CAMERA, image_size=24)
    a, b, c = vertices[faces].unbind(1)
    outward = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    assert ((outward * a).sum(-1) > 0).all()
    expected = torch.where((index >= 0).unsqueeze(-1), outward[index.clamp_min(0).long()], 0.0)
    torch.testing.assert_close(normals, expected)


@pytest.mark.parametrize("smooth", [False, True])
def test_normals_point_at_the_viewer_in_a_right_handed_world_too(smooth):
    K = [[1.5, 0.0, 0.5], [0.0, 1.5, 0.5], [0.0, 0.0, 1.0]]
    t = [0.0, 0.0, 3.0]
    sides = torch.tensor([-1.0, 1.0, 1.0])
    # y of a calibrated camera points down: a rotation by 180 degrees about z sees y up, and x to the left.
    right_handed = nmr.Pinhole(K, torch.diag(torch.tensor([-1.0, -1.0, 1.0])), t, orig_size=1)
    left_handed = nmr.Pinhole(K, torch.diag(torch.tensor([1.0, -1.0, 1.0])), t, orig_size=1)
    vertices, faces = bumpy_sphere()
    plain = nmr.render_normals(vertices, faces, left_handed, image_size=16, smooth=smooth)
    mirrored = nmr.render_normals(
        vertices * sides, faces, right_handed, image_size=16, smooth=smooth
    )
    assert (plain[..., 2] < 0).sum() > 50 and not (plain[..., 2] > 0.1).any()
    torch.testing.assert_close(mirrored * sides, plain)


def one_large_face(dtype=torch.float64):
    """Covers the screen, with its edges far outside: nothing but true derivatives."""
    vertices = torch.tensor([[-4.0, -3.0, 1.0], [5.0, -4.0, 3.0], [0.5, 6.0, 2.0]], dtype=dtype)
    return vertices, torch.tensor([[0, 1, 2]])


def gradcheck(function, *inputs):
    inputs = [x.detach().clone().requires_grad_() for x in inputs]
    assert all(x.dtype == torch.float64 for x in inputs)
    return torch.autograd.gradcheck(function, inputs, eps=1e-6, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("anti_aliasing", [False, True])
def test_depth_and_normals_have_true_derivatives(anti_aliasing):
    vertices, faces = one_large_face()
    setting = dict(image_size=4, anti_aliasing=anti_aliasing)
    assert gradcheck(lambda v: nmr.render_depth(v, faces, **setting), vertices)
    tilted = torch.cat([vertices, vertices[:1] * torch.tensor([1.5, 1.0, 1.2])])
    faces = torch.tensor([[0, 1, 2], [0, 1, 3]])
    for smooth in (False, True):
        assert gradcheck(
            lambda v, s=smooth: nmr.render_normals(v, faces, smooth=s, **setting), tilted
        )


def test_colours_move_through_weights_only_on_request():
    vertices, faces = one_large_face()
    colors = torch.rand(3, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def rgb(v, c, gradient=True):
        return nmr.render_rgb(
            v, faces, colors=nmr.VertexColors(c), image_size=3, interpolation_gradient=gradient
        )

    assert gradcheck(rgb, vertices, colors)
    leaf = vertices.clone().requires_grad_()
    rgb(leaf, colors, False).square().sum().backward()
    assert leaf.grad is None or not leaf.grad.any()
    rgb(leaf, colors, True).square().sum().backward()
    assert leaf.grad.any()
    # as published, not even on request
    cubes = nmr.TextureCubes(torch.rand(1, 2, 2, 2, 3, dtype=torch.float64))
    image = nmr.render_rgb(leaf, faces, colors=cubes, image_size=3, interpolation_gradient=True)
    assert not torch.autograd.grad(image.square().sum(), leaf)[0].any()


def test_a_background_that_is_not_finite_stays_behind():
    vertices, faces = nmr.icosphere(1)
    white = nmr.render_rgb(vertices, faces, CAMERA, background=float("nan"), image_size=16)
    alpha = nmr.render_silhouette(vertices, faces, CAMERA, image_size=16)
    assert torch.equal(white[..., 0].isnan(), alpha < 1) and (white[alpha == 1] == 1).all()
