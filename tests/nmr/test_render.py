"""render and its outputs: against closed forms, the published renderer, each other; gradients; bad input."""

import dataclasses
import math
from types import SimpleNamespace

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
    noise = torch.rand(len(vertices), 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return ((0.7 + 0.3 * noise) * vertices).to(dtype), faces


def relative(a, b):
    return float((a - b).norm() / b.norm())


# --- values


def test_depth_of_a_square_that_faces_the_camera():
    vertices, faces = square([2.0, 2.0, 2.0, 2.0])
    depth = nmr.render_depth(vertices, faces, image_size=16, anti_aliasing=False, far=50.0)
    x, y = pixel_centres(16)
    expected = torch.where((x.abs() < 0.5) & (y.abs() < 0.5), 2.0, 50.0).double()
    torch.testing.assert_close(depth[0], expected, rtol=1e-12, atol=0)
    # The raster of 10 x 10 has centres at 0.1, 0.3, 0.5 ...: half of the pixels around the edge at 0.45 is covered.
    anti_aliased = nmr.render_depth(vertices * vertices.new_tensor([0.9, 0.9, 1.0]), faces, image_size=5, far=50.0)
    torch.testing.assert_close(anti_aliased[0, 2], vertices.new_tensor([50.0, 26.0, 2.0, 26.0, 50.0]))


def test_depth_and_weights_of_a_tilted_plane_in_perspective():
    """The camera-space plane Z = 3 + X, seen as x = X / Z: Z = 3 / (1 - x)."""
    points = torch.tensor([[-1.0, -1.0], [1.2, -0.9], [0.9, 1.1], [-1.1, 0.8]], dtype=torch.float64)
    z = 3 + points[:, :1]
    vertices, faces = torch.cat([points / z, z], dim=1), torch.tensor([[0, 1, 2], [2, 3, 0]])
    fragments = nmr.render_fragments(vertices, faces, image_size=40)
    x, y = pixel_centres(40)
    inside = fragments.covered[0]
    assert inside.sum() > 100
    torch.testing.assert_close(fragments.depth[0][inside], (3 / (1 - x))[inside], rtol=1e-10, atol=0)
    # Perspective-correct weights interpolate what is linear in space: the points themselves.
    at_pixels = fragments.interpolate(points)[0]
    expected = torch.stack([x, y], dim=-1) * fragments.depth[0].unsqueeze(-1)
    torch.testing.assert_close(at_pixels[inside], expected[inside], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(fragments.weights.sum(-1)[0][inside], torch.ones(int(inside.sum()), dtype=torch.float64))
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
    names = [key.removeprefix("param_") for key in v if key.startswith("param_") and v[key].dtype == np.float32]
    leaves = {name: torch.from_numpy(np.atleast_1d(v[f"param_{name}"])).requires_grad_() for name in names}
    if str(v["camera_mode"]) == "projection":
        size = leaves.pop("orig_size").item()
        return nmr.Pinhole(*(leaves[name] for name in ("K", "R", "t", "dist_coeffs")), orig_size=size), leaves, -1
    angle = float(setting["viewing_angle"])
    if str(v["camera_mode"]) == "look":
        return nmr.Look(leaves["eye"], leaves["camera_direction"], half_fov_deg=angle), leaves, 1
    return nmr.LookAt(leaves["eye"], half_fov_deg=angle), leaves, 1


@pytest.mark.parametrize("name", [n for n in vector_names("renderer_*") if n.count("_") == 3])
def test_published_renderer(name):
    """The whole of it: camera, lights, texture cubes, background, depth and alpha, and every gradient."""
    v = load_vector(name)
    setting = {key.removeprefix("renderer_"): torch.from_numpy(v[key]) for key in v if key.startswith("renderer_")}
    vertices, textures = (torch.from_numpy(v[key]).requires_grad_() for key in ("vertices", "textures"))
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
        torch.testing.assert_close(image.detach(), torch.from_numpy(v[f"out_{output}"]), rtol=1e-5, atol=1e-5)
        loss = loss + (image * torch.from_numpy(v[f"upstream_{output}"])).sum()
    loss.backward()
    least = 1e-4 if side > 0 else 2e-3  # our projection rounds otherwise, and 1 / distance amplifies
    for name, leaf in {"vertices": vertices, "textures": textures, **leaves}.items():
        key = f"grad_{name}"
        if key in v and (own or leaf is not textures):
            expected, contracted = torch.from_numpy(v[key]), torch.from_numpy(v.get(f"{key}_fma", v[key]))
            assert relative(leaf.grad, expected) < max(5 * relative(contracted, expected), least), key


def test_background():
    vertices, faces = bumpy_sphere()
    for background, expected in [
        (0.25, torch.full((2, 3), 0.25)),
        ([0.1, 0.2, 0.3], torch.tensor([[0.1, 0.2, 0.3]]).expand(2, 3)),
        (torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]), torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])),
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
    for wanted in (output,), ("alpha", "depth", output), ("fragments", "normals", "depth", "rgb", "alpha"):
        leaf = vertices.clone().requires_grad_()
        image = getattr(all_outputs(leaf, faces, tuple(dict.fromkeys(wanted)), anti_aliasing), output)
        image.backward(torch.randn(image.shape, generator=torch.Generator().manual_seed(0)))
        results.append((image.detach(), leaf.grad))
    for image, grad in results[1:]:
        assert torch.equal(image, results[0][0]) and image.any()
        torch.testing.assert_close(grad, results[0][1], rtol=1e-5, atol=1e-5 * float(grad.abs().max()))


def test_each_output_has_a_function_of_its_own():
    vertices, faces = bumpy_sphere()
    size = dict(image_size=16)
    images = nmr.render(vertices, faces, CAMERA, outputs=("rgb", "alpha", "depth", "normals", "fragments"), **size)
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
    stacked = fragments.resolve(torch.cat([torch.where(covered, shaded, 0.3), covered.double()], dim=-1))
    upstream = torch.randn(stacked.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
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
    with pytest.raises(AttributeError, match=r"normals was not rendered.*outputs=\('depth', 'alpha', 'normals'\)"):
        images.normals  # noqa: B018
    with pytest.raises(AttributeError, match="cannot be changed, so depth"):
        images.depth = depth
    with pytest.raises(AttributeError, match="no attribute 'colour'; it has depth, alpha"):
        images.colour  # noqa: B018


def test_same_bits_for_any_number_of_threads():
    vertices, faces = bumpy_sphere(dtype=torch.float32, subdivisions=3)
    uv, image = vertices[:, :2] * 1.5, torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0))
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            leaves = [x.clone().requires_grad_() for x in (vertices, image, uv)]
            images = nmr.render(
                leaves[0],
                faces,
                CAMERA,
                outputs=("rgb", "alpha", "depth", "normals"),
                colors=nmr.UVTexture(leaves[1], leaves[2]),
                lights=nmr.Lights(smooth=True),
                image_size=48,
                smooth_normals=True,
                interpolation_gradient=True,
            )
            sum((x - 0.4).square().sum() for x in images).backward()
            results.append([*(x.detach() for x in images), *(x.grad for x in leaves)])
    finally:
        torch.set_num_threads(before)
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))


# --- normals


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


def test_smooth_normals_of_a_sphere_are_its_points():
    vertices, faces = nmr.icosphere(3)
    fragments = nmr.render_fragments(vertices.double(), faces, CAMERA, image_size=24)
    normals, points = fragments.normals(smooth=True), fragments.interpolate(vertices.double())
    points = torch.nn.functional.normalize(points, dim=-1)
    assert fragments.covered.any() and (normals - points).norm(dim=-1).max() < 2e-2
    torch.testing.assert_close(normals.norm(dim=-1), fragments.covered.double())


@pytest.mark.parametrize("smooth", [False, True])
def test_normals_point_at_the_viewer_in_a_right_handed_world_too(smooth):
    K, t, sides = [[1.5, 0.0, 0.5], [0.0, 1.5, 0.5], [0.0, 0.0, 1.0]], [0.0, 0.0, 3.0], torch.tensor([-1.0, 1.0, 1.0])
    # y of a calibrated camera points down: a rotation by 180 degrees about z sees y up, and x to the left.
    right_handed = nmr.Pinhole(K, torch.diag(torch.tensor([-1.0, -1.0, 1.0])), t, orig_size=1)
    left_handed = nmr.Pinhole(K, torch.diag(torch.tensor([1.0, -1.0, 1.0])), t, orig_size=1)
    vertices, faces = bumpy_sphere()
    plain = nmr.render_normals(vertices, faces, left_handed, image_size=16, smooth=smooth)
    mirrored = nmr.render_normals(vertices * sides, faces, right_handed, image_size=16, smooth=smooth)
    assert (plain[..., 2] < 0).sum() > 50 and not (plain[..., 2] > 0.1).any()
    torch.testing.assert_close(mirrored * sides, plain)


def test_normals_with_faces_per_image_and_one_set_of_vertices():
    vertices, faces = bumpy_sphere()
    both = torch.stack([faces, faces.flip(0)])
    for smooth in (False, True):
        own = nmr.render_normals(vertices, both, CAMERA, image_size=12, smooth=smooth)
        torch.testing.assert_close(own, nmr.render_normals(vertices, faces, CAMERA, image_size=12, smooth=smooth))


# --- gradients


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
        assert gradcheck(lambda v, s=smooth: nmr.render_normals(v, faces, smooth=s, **setting), tilted)


def test_weights_and_depth_of_fragments_have_true_derivatives():
    vertices, faces = one_large_face()

    def both(v):
        fragments = nmr.render_fragments(v, faces, image_size=3)
        return fragments.weights, fragments.depth

    assert gradcheck(both, vertices)


def test_depth_moves_the_camera():
    vertices, faces = one_large_face()
    vertices = vertices * torch.tensor([4.0, 4.0, 1.0])
    eye = torch.tensor([0.3, 0.2, -2.0], dtype=torch.float64)
    at = torch.tensor([0.1, 0.0, 1.0], dtype=torch.float64)
    assert gradcheck(lambda e, a: nmr.render_depth(vertices, faces, nmr.LookAt(e, a), image_size=3), eye, at)


def test_depth_moves_a_calibrated_camera():
    vertices, faces = one_large_face()
    K = torch.tensor([[1.1, 0.0, 1.0], [0.0, 0.9, 1.1], [0.0, 0.0, 1.0]], dtype=torch.float64)
    R = torch.linalg.matrix_exp(torch.tensor([[0.0, 0.1, -0.2], [-0.1, 0.0, 0.1], [0.2, -0.1, 0.0]]).double())
    t, dist_coeffs = torch.tensor([0.1, 0.2, 1.0]).double(), torch.tensor([0.01, 0.001, 0.01, -0.01, 1e-4]).double()
    assert gradcheck(
        lambda *p: nmr.render_depth(vertices, faces, nmr.Pinhole(*p, orig_size=2), image_size=3), K, R, t, dist_coeffs
    )


def test_colours_move_through_weights_only_on_request():
    vertices, faces = one_large_face()
    colors = torch.rand(3, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def rgb(v, c, gradient=True):
        return nmr.render_rgb(v, faces, colors=nmr.VertexColors(c), image_size=3, interpolation_gradient=gradient)

    assert gradcheck(rgb, vertices, colors)
    leaf = vertices.clone().requires_grad_()
    rgb(leaf, colors, False).square().sum().backward()
    assert leaf.grad is None or not leaf.grad.any()
    rgb(leaf, colors, True).square().sum().backward()
    assert leaf.grad.any()


def test_a_background_that_is_not_finite_stays_behind():
    vertices, faces = nmr.icosphere(1)
    white = nmr.render_rgb(vertices, faces, CAMERA, background=float("nan"), image_size=16)
    alpha = nmr.render_silhouette(vertices, faces, CAMERA, image_size=16)
    assert torch.equal(white[..., 0].isnan(), alpha < 1) and (white[alpha == 1] == 1).all()


def test_a_picture_as_background_is_told_how():
    vertices, faces = nmr.icosphere(1)
    with pytest.raises(ValueError, match=r"add \(1 - alpha\)\[..., None\] \* picture"):
        nmr.render_rgb(vertices, faces, CAMERA, background=torch.rand(1, 16, 16, 3), image_size=16)


def test_background_gradient_is_the_uncovered_share():
    vertices, faces = bumpy_sphere()
    background = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    images = nmr.render(vertices, faces, CAMERA, outputs=("rgb", "alpha"), background=background, image_size=16)
    images.rgb.sum().backward()
    torch.testing.assert_close(background.grad, (1 - images.alpha).sum((1, 2))[:, None].expand(2, 3))


def test_gradient_descent_finds_the_depth():
    vertices, faces = square([2.0, 2.5, 3.0, 2.2])
    target = nmr.render_depth(vertices, faces, image_size=16, far=10.0)
    z = torch.full((4, 1), 1.5, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([z], lr=0.05)
    for _ in range(200):
        optimizer.zero_grad()
        depth = nmr.render_depth(torch.cat([vertices[:, :2], z], 1), faces, image_size=16, far=10.0)
        (depth - target).square().mean().backward()
        optimizer.step()
    torch.testing.assert_close(z[:, 0], vertices[:, 2], rtol=0, atol=0.05)


@pytest.mark.parametrize("output", ["rgb", "alpha", "depth"])
def test_second_derivatives_are_refused(output):
    vertices, faces = bumpy_sphere()
    leaf = vertices.clone().requires_grad_()
    image = getattr(all_outputs(leaf, faces, (output,), True), output)
    (grad,) = torch.autograd.grad(image.square().sum(), leaf, create_graph=True)
    with pytest.raises(RuntimeError, match="no second derivative"):
        grad.square().sum().backward()


def test_vertices_that_are_not_finite_spoil_nothing():
    vertices, faces = bumpy_sphere()
    bad = torch.tensor([[math.nan, 0.0, 0.0], [math.inf, 0.0, 0.0]], dtype=torch.float64)
    extra = torch.tensor([[0, 1, len(vertices) + k] for k in range(2)])
    grads = []
    for v, f in ((vertices, faces), (torch.cat([vertices, bad]), torch.cat([faces, extra]))):
        leaf = v.clone().requires_grad_()
        images = nmr.render(
            leaf, f, CAMERA, outputs=("rgb", "alpha", "depth", "normals"), lights=nmr.Lights(), image_size=24
        )
        sum(x.sum() for x in images).backward()
        assert all(x.isfinite().all() for x in images)
        grads.append(leaf.grad)
    assert grads[0].any() and torch.equal(grads[1][:-2], grads[0]) and not grads[1][-2:].any()


@pytest.mark.parametrize("batch, num_vertices, num_faces", [(0, 15, 5), (2, 15, 0), (2, 0, 0)])
def test_empty_batches_and_meshes(batch, num_vertices, num_faces):
    vertices, faces = (
        torch.zeros(batch, num_vertices, 3, requires_grad=True),
        torch.zeros(num_faces, 3, dtype=torch.long),
    )
    outputs = ("rgb", "alpha", "depth", "normals", "fragments")
    colors = nmr.FaceColors(torch.rand(num_faces, 3, requires_grad=True))
    camera, lights = nmr.LookAt([0.0, 0.0, -3.0]), nmr.Lights()
    images = nmr.render(vertices, faces, camera, outputs=outputs, colors=colors, lights=lights, image_size=8, far=9.0)
    (images.rgb.sum() + images.alpha.sum() + images.depth.sum() + images.normals.sum()).backward()
    assert images.rgb.shape == (batch, 8, 8, 3) and not images.rgb.any() and (images.depth == 9).all()
    assert images.fragments.face_index.shape == (batch, 16, 16) and not vertices.grad.any()
    if num_faces:
        own = SimpleNamespace(transform=camera.transform)
        assert nmr.render_normals(vertices, faces[None], own, image_size=8).shape == (batch, 8, 8, 3)


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("size", [1e-4, 1e4])
def test_normals_and_light_do_not_depend_on_the_unit_of_length(size, smooth):
    """The published renderer's normals are shorter where the cross product of a face's sides is below 1e-5."""
    vertices, faces = nmr.icosphere(2)
    setting = dict(image_size=16, near=1e-6, far=1e6, outputs=("normals", "rgb"), smooth_normals=smooth)
    setting["lights"] = nmr.Lights(0.2, 0.8, [0.3, 0.5, -0.8], smooth=smooth)
    expected = nmr.render(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), **setting)
    images = nmr.render(vertices * size, faces, nmr.LookAt([0.0, 0.0, -3.0 * size]), **setting)
    for image, wanted in zip(images, expected, strict=True):
        torch.testing.assert_close(image, wanted, atol=1e-4, rtol=1e-4)


# --- torch


def test_compile_fullgraph():
    vertices, faces = bumpy_sphere(dtype=torch.float32, subdivisions=1)

    def loss(v):
        colors, lights = nmr.VertexColors((v.detach() + 1) / 2), nmr.Lights(smooth=True)
        rgb, alpha, depth = nmr.render(v, faces, CAMERA, colors=colors, lights=lights, image_size=16)
        return rgb.square().mean() + alpha.mean() + 0.01 * depth.mean()

    eager, compiled = vertices.clone().requires_grad_(), vertices.clone().requires_grad_()
    loss(eager).backward()
    torch.compile(loss, fullgraph=True, backend="aot_eager")(compiled).backward()
    torch.testing.assert_close(compiled.grad, eager.grad, rtol=1e-4, atol=1e-6)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_tensors_are_staged_through_the_host():
    vertices, faces = bumpy_sphere(dtype=torch.float32)
    vertices = CAMERA.transform(vertices)  # on the host: a GPU rounds otherwise
    results = []
    for device in ("cpu", "cuda"):
        leaf = vertices.to(device).requires_grad_()
        colors, lights = nmr.VertexColors(torch.rand(162, 3, generator=torch.Generator().manual_seed(0))), nmr.Lights()
        images = nmr.render(
            leaf, faces, outputs=("rgb", "alpha", "depth", "normals"), colors=colors, lights=lights, image_size=16
        )
        sum(x.square().sum() for x in images).backward()
        assert all(x.device.type == device for x in (*images, leaf.grad))
        results.append([*images, leaf.grad])
    for cpu, gpu in zip(*results, strict=True):
        torch.testing.assert_close(gpu.cpu(), cpu, rtol=1e-4, atol=1e-5)


# --- errors


class Constant:
    def __init__(self, value):
        self.value = value

    def sample(self, fragments):
        return self.value

    def transform(self, vertices):
        return self.value


@pytest.mark.parametrize(
    "change, error, words",
    [
        (dict(outputs=()), ValueError, r"outputs must be .*\('rgb', "),
        (dict(outputs="rgb"), ValueError, "outputs must be a tuple .*got 'rgb'"),
        (dict(outputs=("rgb", "rgb")), ValueError, "different names"),
        (dict(outputs=("colour",)), ValueError, "got .'colour'"),
        (dict(colors=torch.rand(4, 3)), TypeError, r"colors must be nmr.VertexColors.*got float32 \[4, 3\]"),
        (dict(colors=Constant("red")), ValueError, r"colors.sample must return a tensor \[1, 8, 8, 'C'\], got str"),
        (dict(colors=Constant(torch.rand(1, 8, 8))), ValueError, r"\[1, 8, 8, 'C'\], got float32 \[1, 8, 8\]"),
        (dict(lights=0.5), TypeError, "lights must be nmr.Lights, got float"),
        (
            dict(colors=Constant(torch.rand(1, 8, 8, 2)), lights=nmr.Lights()),
            ValueError,
            r"3 channels \(or 1\), got 2",
        ),
        (dict(background=[0.0, 1.0]), ValueError, r"background must be a number, \[3\] or \[1, 3\], got .*\[2\]"),
        (dict(background=torch.zeros(2, 3)), ValueError, r"got float64 \[2, 3\]"),
        (dict(outputs=None), ValueError, "outputs must be a tuple .*got None"),
        (dict(outputs={"rgb", "alpha"}), ValueError, "outputs must be a tuple .*got {"),
        (dict(camera=Constant("x")), ValueError, r"transform must return vertices float64 \[B, 4, 3\], .* got str"),
        (
            dict(camera=Constant(torch.rand(1, 3, 3).double())),
            ValueError,
            r"transform must .*, got float64 \[1, 3, 3\]",
        ),
        (dict(camera=Constant(torch.rand(1, 4, 3))), ValueError, r"vertices float64 .*, got float32 \[1, 4, 3\]"),
        (dict(camera=nmr.LookAt), TypeError, r"got the class LookAt; create one: LookAt\(\.\.\.\)"),
        (dict(image_size=0), ValueError, "image_size must lie in 1"),
        (dict(near=2.0, far=1.0), ValueError, "near < far"),
        (dict(near="close"), TypeError, "near must be a number, got str"),
        (dict(far=None), TypeError, "far must be a number, got NoneType"),
        (dict(far=torch.ones(2)), TypeError, r"far must be a number, got float32 \[2\]"),
        (dict(eps=None), TypeError, "eps must be a number, got NoneType"),
        (dict(eps=0.0), ValueError, "eps must be positive"),
    ],
)
def test_errors_say_what_was_wanted(change, error, words):
    with pytest.raises(error, match=words):
        nmr.render(*square([1.0] * 4), **{"image_size": 4, **change})


@pytest.mark.parametrize(
    "call, error, words",
    [
        (lambda f: f.resolve(torch.zeros(1, 8, 8, 3)), TypeError, "image must be a tensor of torch.float64"),
        (lambda f: f.resolve(torch.zeros(1, 8, 8).double()), ValueError, r"image must have shape \[1, 8, 8, 'C'\]"),
        (lambda f: f.interpolate(torch.rand(4, 3).long()), TypeError, r"attributes must be a float tensor \[V, C\]"),
        (lambda f: f.interpolate(torch.rand(5, 3)), ValueError, "attributes must have one row per vertex .4"),
        (lambda f: f.interpolate(torch.rand(3, 4, 3)), ValueError, "attributes must have batch size 1"),
        (lambda f: f.interpolate([torch.rand(4, 3), torch.rand(5, 3)]), ValueError, "attributes must have one size"),
        (lambda f: f.interpolate([torch.rand(4, 3), 1]), TypeError, "the list holds int"),
        (
            lambda f: f.interpolate([torch.rand(4, 3), torch.rand(4, 2)]),
            ValueError,
            r"\[4, 3\] and float32 \[4, 2\]",
        ),
        (lambda f: f.interpolate(torch.rand(4)), ValueError, r"\[V, C\] or \[B, V, C\]"),
        (
            lambda f: f.interpolate(torch.rand(4, 3), torch.zeros(3, 3).long()),
            ValueError,
            "one row per face .2",
        ),
        (lambda f: f.interpolate(torch.rand(4, 3), [3, 4]), TypeError, r"corners must be an integer tensor \[F, 3\]"),
        (lambda f: f.interpolate(torch.rand(1, 3), torch.ones(2, 3).long()), ValueError, "refer to"),
        (lambda f: f.per_face(torch.rand(3, 1)), ValueError, "values must have one row per face .2"),
    ],
)
def test_errors_of_fragments(call, error, words):
    fragments = nmr.render_fragments(*square([1.0] * 4), image_size=8)
    with pytest.raises(error, match=words):
        call(fragments)
