"""Lists of meshes of different sizes: the same bits as one by one, for every output and gradient; bad lists."""

import pytest
import torch

import nmr

OUTPUTS = ("rgb", "alpha", "depth", "normals")
SIZE = dict(image_size=24)


def sphere(subdivisions, seed, scale):
    vertices, faces = nmr.icosphere(subdivisions)
    noise = torch.rand(len(vertices), 1, generator=torch.Generator().manual_seed(seed))
    return scale * (0.6 + 0.4 * noise) * vertices, faces


MESHES = [sphere(2, 0, 0.9), sphere(1, 1, 0.6), sphere(3, 2, 0.8)]
VERTICES, FACES = [v for v, _ in MESHES], [f for _, f in MESHES]
EYES = torch.tensor([[0.0, 0.5, -2.5], [1.5, 0.0, -2.0], [-1.0, 1.0, 2.0]])


def uniform(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def colors_of(kind):
    """Per mesh the values, and how to make colours of values (of one mesh, or lists of all)."""
    if kind == "vertices":
        return [uniform(len(v), 3) for v in VERTICES], nmr.VertexColors
    if kind == "faces":
        return [uniform(len(f), 3) for f in FACES], nmr.FaceColors
    if kind == "cubes":
        return [uniform(len(f), 3, 3, 3, 3) for f in FACES], nmr.TextureCubes
    images = [uniform(8, 6 + 2 * n, 3) for n in range(3)]  # of several sizes

    def textured(values):
        if isinstance(values, list):
            uv = [image.new_tensor(uniform(50, 2).tolist()) for image in images]
            return nmr.UVTexture(values, uv, [f % 50 for f in FACES])
        n = [image.shape for image in images].index(values.shape)
        return nmr.UVTexture(values, uniform(50, 2), FACES[n] % 50)

    return images, textured


def gradients(images, leaves):
    sum(
        (image * torch.randn(image.shape[1:], generator=torch.Generator().manual_seed(n))).sum()
        for n, image in enumerate(images)
    ).backward()
    return [leaf.grad for leaf in leaves]


@pytest.mark.parametrize("kind", ["vertices", "faces", "cubes", "uv"])
def test_a_list_equals_its_meshes_one_by_one(kind):
    values, make = colors_of(kind)
    setting = dict(
        outputs=OUTPUTS, lights=nmr.Lights(smooth=True), smooth_normals=True, interpolation_gradient=True, **SIZE
    )
    vertices, colors = ([x.clone().requires_grad_() for x in part] for part in (VERTICES, values))
    together = nmr.render(vertices, FACES, nmr.LookAt(EYES), colors=make(colors), **setting)
    assert together.rgb.shape == (3, 24, 24, 3) and together.alpha.flatten(1).any(1).all()
    grads = gradients(together, [*vertices, *colors])
    for b in range(3):
        mesh, color = VERTICES[b].clone().requires_grad_(), values[b].clone().requires_grad_()
        alone = nmr.render(mesh, FACES[b], nmr.LookAt(EYES[b]), colors=make(color), **setting)
        for one, all_of_them in zip(alone, together, strict=True):
            assert torch.equal(one[0], all_of_them[b])
        grad_mesh, grad_color = gradients(alone, [mesh, color])
        assert torch.equal(grad_mesh, grads[b]) and grad_mesh.any()
        assert torch.equal(grad_color, grads[3 + b]) and grad_color.any()


@pytest.mark.parametrize("smooth", [False, True])
def test_lights_per_image(smooth):
    parameters = [uniform(3), uniform(3, 2), uniform(3, 2, 3) - 0.5, uniform(3, 3), uniform(3, 2, 3)]
    parameters = [x.requires_grad_() for x in parameters]
    together = nmr.render_rgb(VERTICES, FACES, nmr.LookAt(EYES), lights=nmr.Lights(*parameters, smooth), **SIZE)
    grads = torch.autograd.grad(together.square().sum(), parameters)
    for b in range(3):
        own = [x[b].detach().requires_grad_() for x in parameters]
        alone = nmr.render_rgb(VERTICES[b], FACES[b], nmr.LookAt(EYES[b]), lights=nmr.Lights(*own, smooth), **SIZE)
        assert torch.equal(alone[0], together[b])
        for grad, own_grad in zip(grads, torch.autograd.grad(alone.square().sum(), own), strict=True):
            torch.testing.assert_close(grad[b], own_grad, rtol=1e-4, atol=1e-4)


def test_each_function_takes_lists():
    camera = nmr.LookAt(EYES)
    images = nmr.render(VERTICES, FACES, camera, outputs=(*OUTPUTS, "fragments"), **SIZE)
    assert torch.equal(nmr.render_silhouette(VERTICES, FACES, camera, **SIZE), images.alpha)
    assert torch.equal(nmr.render_depth(VERTICES, FACES, camera, **SIZE), images.depth)
    assert torch.equal(nmr.render_normals(VERTICES, FACES, camera, **SIZE), images.normals)
    assert torch.equal(nmr.render_rgb(VERTICES, FACES, camera, **SIZE), images.rgb)
    index = nmr.render_face_index(VERTICES, FACES, camera, image_size=48)
    assert torch.equal(index, images.fragments.face_index)
    assert all(int(index[b].max()) < len(FACES[b]) and int(index[b].max()) > len(FACES[b]) // 2 for b in range(3))


def test_meshes_of_one_size_as_a_list_equal_a_batch():
    vertices = torch.stack([VERTICES[0], 0.7 * VERTICES[0]])
    faces, camera = FACES[0], nmr.LookAt(EYES[:2])
    colors = uniform(2, len(faces), 3)
    results = []
    for v, f, c in (
        (vertices, faces, colors),
        (list(vertices), [faces, faces], list(colors)),
        (tuple(vertices), faces, tuple(colors)),
        (vertices, [faces, faces], list(colors)),
        (list(vertices), torch.stack([faces, faces]), list(colors)),
    ):
        images = nmr.render(
            v, f, camera, outputs=OUTPUTS, colors=nmr.FaceColors(c), lights=nmr.Lights(), background=0.5, **SIZE
        )
        results.append(list(images))
    for images in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(images, results[0], strict=True))


def test_values_of_a_batch_may_be_lists():
    vertices = torch.stack([VERTICES[0], 0.7 * VERTICES[0]])
    image, uv, uv_faces = uniform(2, 4, 4, 3), uniform(2, 50, 2), torch.stack([FACES[0] % 50, FACES[0] % 49])
    stacked, lists = (
        nmr.render_rgb(vertices, FACES[0], nmr.LookAt(EYES[:2]), colors=nmr.UVTexture(*values), **SIZE)
        for values in ((image, uv, uv_faces), (list(image), list(uv), list(uv_faces)))
    )
    assert torch.equal(stacked, lists) and stacked.any()


def test_a_list_of_one_grows_to_the_cameras_batch():
    one = nmr.render_silhouette([VERTICES[0]], [FACES[0]], nmr.LookAt(EYES), **SIZE)
    assert torch.equal(one, nmr.render_silhouette(VERTICES[0], FACES[0], nmr.LookAt(EYES), **SIZE))


def test_one_camera_and_no_camera():
    for camera in (nmr.LookAt(EYES[0]), None):
        meshes = VERTICES if camera else [0.5 * v + torch.tensor([0.0, 0.0, 2.0]) for v in VERTICES]
        alpha = nmr.render_silhouette(meshes, FACES, camera, **SIZE)
        for b in range(3):
            assert torch.equal(alpha[b], nmr.render_silhouette(meshes[b], FACES[b], camera, **SIZE)[0])


def test_an_empty_mesh_among_others():
    meshes, faces = [VERTICES[1], torch.zeros(0, 3), VERTICES[0]], [FACES[1], torch.zeros(0, 3).long(), FACES[0]]
    camera = nmr.LookAt(EYES)
    images = nmr.render(meshes, faces, camera, outputs=OUTPUTS, lights=nmr.Lights(smooth=True), **SIZE)
    assert not images.alpha[1].any() and images.alpha[0].any()
    assert torch.equal(
        images.rgb[2],
        nmr.render_rgb(meshes[2], faces[2], nmr.LookAt(EYES[2]), lights=nmr.Lights(smooth=True), **SIZE)[0],
    )


def test_one_image_for_a_list_of_meshes():
    image, uv = uniform(8, 8, 3), [v[:, :2].contiguous() for v in VERTICES]
    shared = nmr.render_rgb(VERTICES, FACES, nmr.LookAt(EYES), colors=nmr.UVTexture(image, uv), **SIZE)
    copies = nmr.render_rgb(VERTICES, FACES, nmr.LookAt(EYES), colors=nmr.UVTexture([image] * 3, uv), **SIZE)
    assert torch.equal(shared, copies) and shared.any()


class Plain:
    def transform(self, vertices):
        return vertices


class Short:
    def transform(self, vertices, starts=None):
        return vertices[1:]


@pytest.mark.parametrize(
    "vertices, faces, camera, error, words",
    [
        (VERTICES, FACES[:2], None, ValueError, "faces for each.*got vertices of 3 meshes and faces of 2"),
        ([], [], None, ValueError, "at least one mesh.*got vertices of 0 meshes"),
        (VERTICES, 5, None, ValueError, "got vertices of 3 meshes and faces int"),
        ([VERTICES[0], 3.0], FACES[:2], None, TypeError, "tensors .V_b, 3., it holds float; use torch.as_tensor"),
        (
            [VERTICES[0][None]] * 2,
            FACES[:2],
            None,
            ValueError,
            r"must hold tensors \[V_b, 3\], it holds float32 \[1, 162",
        ),
        ([VERTICES[0], VERTICES[1].double()], FACES[:2], None, ValueError, "one dtype and device"),
        (VERTICES, [FACES[0], FACES[1], FACES[2][None]], None, ValueError, r"must hold tensors \[F_b, 3\]|batch size"),
        (VERTICES, [FACES[0], FACES[1].float(), FACES[2]], None, TypeError, r"call faces.long\(\)"),
        (VERTICES, [FACES[1], FACES[0], FACES[2]], None, ValueError, "but a mesh has 42 vertices"),
        (VERTICES, FACES, Plain(), TypeError, r"Plain.transform must take \(vertices \[N, 3\], starts"),
        (VERTICES, FACES, Short(), ValueError, r"packed vertices float32 \[846, 3\], .* got float32 \[845, 3\]"),
        (VERTICES, FACES, nmr.LookAt(EYES[:2]), ValueError, "3 meshes"),
    ],
)
def test_errors_say_what_was_wanted(vertices, faces, camera, error, words):
    with pytest.raises(error, match=words):
        nmr.render_silhouette(vertices, faces, camera, image_size=4)


@pytest.mark.parametrize(
    "colors, words",
    [
        (nmr.VertexColors(uniform(846, 3)), "colors must be a list of 3 tensors.*got float32"),
        (nmr.VertexColors([uniform(162, 3)] * 2), "of 3 tensors.*got 2"),
        (
            nmr.VertexColors([uniform(162, 3)] * 3),
            r"one row per vertex .*\[162, 42, 642\].* got \[162, 162",
        ),
        (nmr.FaceColors([uniform(162, 3)] * 3), r"one row per face .*\[320, 80, 1280\]"),
        (
            nmr.UVTexture([uniform(4, 4, 3)] * 2, [v[:, :2] for v in VERTICES]),
            "image must be .*3 images.* got 2",
        ),
        (
            nmr.UVTexture(uniform(4, 4, 3), [v[:, :2] for v in VERTICES], [FACES[0]] * 3),
            r"uv_faces must have one row .*\[320, 80, 1280\].* got \[320, 320, 320\]",
        ),
    ],
)
def test_errors_of_colours(colors, words):
    with pytest.raises(ValueError, match=words):
        nmr.render_rgb(VERTICES, FACES, nmr.LookAt(EYES), colors=colors, image_size=4)
