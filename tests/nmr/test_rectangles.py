"""Images of height x width through the public functions.

A wide image holds the square one as its middle, a tall scene is the transpose of a wide one, and calibrated cameras put
points where OpenCV says.
"""

import math

import numpy as np
import pytest
import torch

import nmr
import nmr.neural_renderer as nr

SIZE = 32  # of the square in the middle
WIDE, TALL = (SIZE, 2 * SIZE), (2 * SIZE, SIZE)
MIDDLE = slice(SIZE // 2, 3 * SIZE // 2)
EYE = [1.0, 0.9, -2.2]
CAMERAS = {
    "look_at": nmr.LookAt(EYE, half_fov_deg=22.0),
    "look": nmr.Look(EYE, [-1.0, -0.9, 2.2], half_fov_deg=22.0),
    "orthographic": nmr.Orthographic(EYE, scale=0.9),
    "two poses": nmr.LookAt.from_angles(2.6, [20.0, -30.0], [10.0, 200.0], half_fov_deg=22.0),
}


def mesh(dtype=torch.float64):
    """A lumpy sphere of radius 0.6 to 0.9, and uneven numbers for colours: [V, 3], [F, 3], a function of a shape."""
    vertices, faces = nmr.icosphere(1)
    generator = torch.Generator().manual_seed(1)

    def numbers(*shape):
        return torch.rand(*shape, generator=generator, dtype=dtype)

    return vertices.to(dtype) * (0.6 + 0.3 * numbers(len(vertices), 1)), faces, numbers


def middle_of(image, size):
    """The square in the middle of ``[B, h, w, ...]``."""
    start = [(side - SIZE) // 2 for side in size]
    return image[:, start[0] : start[0] + SIZE, start[1] : start[1] + SIZE]


def outside_of(image, size):
    """Its pixels beside the middle, as a vector."""
    beside = torch.ones(size, dtype=torch.bool)
    middle_of(beside[None], size)[...] = False
    return image[:, beside]


def padded(gradient, size):
    """The gradient of an image whose middle has this one, and 0 elsewhere."""
    image = gradient.new_zeros(gradient.shape[0], *size, *gradient.shape[3:])
    middle_of(image, size)[...] = gradient
    return image


def close(actual, expected, scale=1e-6):
    scale *= max(1.0, expected.abs().max().item())
    torch.testing.assert_close(actual, expected, atol=scale, rtol=1e-6)


def colors(kind, faces, numbers):
    """A kind of colours and its parameters."""
    count = int(faces.max()) + 1
    if kind == "white":
        return None, []
    if kind == "vertex":
        values = numbers(count, 3).requires_grad_()
        return nmr.VertexColors(values), [values]
    if kind == "face":
        values = numbers(len(faces), 3).requires_grad_()
        return nmr.FaceColors(values), [values]
    if kind == "cubes":
        values = numbers(len(faces), 3, 3, 3, 3).requires_grad_()
        return nmr.TextureCubes(values), [values]
    image, uv = numbers(9, 14, 3).requires_grad_(), numbers(count, 2).requires_grad_()
    return nmr.UVTexture(image, uv, faces), [image, uv]


COLORS = ("white", "vertex", "face", "cubes", "uv")


@pytest.mark.parametrize("size", [WIDE, TALL])
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("anti_aliasing", [True, False])
def test_the_middle_is_the_square_image(camera, size, anti_aliasing):
    vertices, faces, numbers = mesh()
    outputs = ("rgb", "alpha", "depth", "normals", "fragments")
    settings = dict(outputs=outputs, lights=nmr.Lights(smooth=True), anti_aliasing=anti_aliasing)
    settings["colors"], _ = colors("vertex", faces, numbers)
    square = nmr.render(vertices, faces, CAMERAS[camera], image_size=SIZE, **settings)
    wide = nmr.render(vertices, faces, CAMERAS[camera], image_size=size, **settings)
    assert 0.2 < square.alpha.mean() < 0.9
    for name in ("rgb", "alpha", "depth", "normals"):
        image, expected = getattr(wide, name), getattr(square, name)
        assert image.shape[1:3] == size
        close(middle_of(image, size), expected)
    assert (outside_of(wide.depth, size) == 100).all() and not outside_of(wide.alpha, size).any()
    scale = 2 if anti_aliasing else 1
    assert (
        wide.fragments.sided_face_index.shape[1:]
        == wide.fragments.weights.shape[1:3]
        == (scale * size[0], scale * size[1])
    )
    cut = wide.fragments.sided_face_index.unflatten(2, (-1, scale)).unflatten(1, (-1, scale)).transpose(2, 3)
    uncut = square.fragments.sided_face_index.unflatten(2, (-1, scale)).unflatten(1, (-1, scale)).transpose(2, 3)
    assert torch.equal(middle_of(cut, size), uncut)


@pytest.mark.parametrize("size", [WIDE, TALL])
@pytest.mark.parametrize("gradient", ["nmr", "local"])
@pytest.mark.parametrize("camera", CAMERAS)
def test_gradients_of_silhouettes_in_the_middle(camera, gradient, size):
    vertices, faces, _ = mesh()
    results = []
    for shape in ((SIZE, SIZE), size):
        leaf = vertices.clone().requires_grad_()
        settings = dict(image_size=shape, eps=1e-12, gradient=gradient)  # eps is a length in the image
        alpha = nmr.render_silhouette(leaf, faces, CAMERAS[camera], **settings)
        upstream = torch.randn(len(alpha), SIZE, SIZE, generator=torch.Generator().manual_seed(2), dtype=alpha.dtype)
        alpha.backward(upstream if shape == (SIZE, SIZE) else padded(upstream, size))
        results.append(leaf.grad)
    assert results[0].any()
    close(results[1], results[0], 1e-5)


@pytest.mark.parametrize("size", [WIDE, TALL])
@pytest.mark.parametrize("kind", COLORS)
@pytest.mark.parametrize("lit", [False, True])
def test_colours_and_their_gradients_in_the_middle(kind, lit, size):
    results = []
    for shape in ((SIZE, SIZE), size):
        vertices, faces, numbers = mesh()
        chosen, parameters = colors(kind, faces, numbers)
        background = numbers(3).requires_grad_()
        ambient = numbers(3).requires_grad_()
        lights = nmr.Lights(ambient_color=ambient, directional=0.7, direction=[0.3, 1.0, -0.5]) if lit else None
        leaves = [vertices.requires_grad_(), background, *parameters, *([ambient] if lit else [])]
        settings = dict(colors=chosen, lights=lights, background=background, eps=1e-12, interpolation_gradient=True)
        image = nmr.render_rgb(vertices, faces, CAMERAS["look_at"], image_size=shape, **settings)
        upstream = numbers(1, SIZE, SIZE, 3) - 0.5
        image.backward(upstream if shape == (SIZE, SIZE) else padded(upstream, size))
        results.append((middle_of(image.detach(), shape), *(leaf.grad for leaf in leaves)))
    for actual, expected in zip(results[1], results[0], strict=True):
        assert expected.any()
        close(actual, expected, 1e-5)


@pytest.mark.parametrize("size", [WIDE, TALL])
@pytest.mark.parametrize("output", ["depth", "normals"])
def test_gradients_of_depth_and_normals_in_the_middle(output, size):
    results = []
    for shape in ((SIZE, SIZE), size):
        vertices, faces, numbers = mesh()
        draw = nmr.render_depth if output == "depth" else nmr.render_normals
        image = draw(vertices.requires_grad_(), faces, CAMERAS["look_at"], image_size=shape)
        upstream = numbers(*(1, SIZE, SIZE, 3)[: image.ndim]) - 0.5
        image.backward(upstream if shape == (SIZE, SIZE) else padded(upstream, size))
        results.append(vertices.grad)
    assert results[0].any()
    close(results[1], results[0], 1e-5)


@pytest.mark.parametrize("size", [WIDE, TALL])
def test_a_floor_under_the_eye_is_clipped(size):
    """It fills the lower half of any image, whatever lies behind the eye; the middle is the square image."""
    camera = nmr.Look([0.0, 1.0, 0.0], [0.0, 0.0, 1.0], half_fov_deg=40.0)
    floor = torch.tensor([[-90.0, 0, -90], [90, 0, -80], [85, 0, 90], [-80, 0, 85]], dtype=torch.float64)
    faces, results = torch.tensor([[0, 1, 2], [0, 2, 3]]), []
    for shape in ((SIZE, SIZE), size):
        leaf = floor.clone().requires_grad_()
        depth = nmr.render_depth(leaf, faces, camera, image_size=shape, anti_aliasing=False)
        index = nmr.render_face_index(leaf, faces, camera, image_size=shape)
        half = shape[0] // 2
        assert (index[:, half + 1 :] >= 0).all() and (index[:, :half] == -1).all()
        middle = middle_of(depth, shape)
        (middle * torch.linspace(-1, 1, SIZE, dtype=torch.float64)).sum().backward()
        results.append((middle.detach(), middle_of(index, shape), leaf.grad))
    for actual, expected in zip(results[1], results[0], strict=True):
        close(actual.double(), expected.double(), 1e-5)
    assert results[0][2].any()


def across(vertices):
    """Coordinates in renderer space of the transposed picture: rows become columns."""
    return vertices[..., [1, 0, 2]] * vertices.new_tensor([-1, -1, 1])


@pytest.mark.parametrize("size", [(23, 41), (12, 40), (64, 9)])
@pytest.mark.parametrize("anti_aliasing", [True, False])
def test_swapped_scenes_are_transposes(size, anti_aliasing):
    """In renderer space, so that nothing but the raster is at work; all outputs, with gradients, in odd sizes."""
    vertices, faces, numbers = mesh()
    vertices = vertices * vertices.new_tensor([0.8, 0.7, 0.3]) + vertices.new_tensor([0.15, -0.1, 2.0])
    values, background = numbers(len(vertices), 3), numbers(3)
    outputs, results = ("rgb", "alpha", "depth"), []
    weights = [numbers(1, *size, 3), numbers(1, *size) - 0.5, numbers(1, *size) - 0.5]
    for shape in (size, size[::-1]):
        leaf = (vertices.clone() if shape == size else across(vertices)).requires_grad_()
        tint = values.clone().requires_grad_()
        winding = faces if shape == size else faces.flip(-1)  # the transposed picture is a mirror image
        settings = dict(colors=nmr.VertexColors(tint), background=background, anti_aliasing=anti_aliasing)
        images = nmr.render(leaf, winding, outputs=outputs, image_size=shape, eps=1e-12, fill_back=False, **settings)
        images = [image if shape == size else image.transpose(1, 2) for image in images]
        sum((image * weight).sum() for image, weight in zip(images, weights, strict=True)).backward()
        results.append((*(image.detach() for image in images), leaf.grad, tint.grad))
    assert 0.1 < results[0][1].mean() < 0.9
    *images, grad, tint = results[1]
    for actual, expected in zip((*images, across(grad), tint), results[0], strict=True):
        assert expected.any()
        close(actual, expected, 1e-5)


@pytest.mark.parametrize("gradient", ["nmr", "local"])
@pytest.mark.parametrize("size", [(23, 41), (12, 40), (64, 9)])
def test_gradients_of_silhouettes_of_swapped_scenes(size, gradient):
    vertices, faces, numbers = mesh()
    vertices = vertices * vertices.new_tensor([0.8, 0.7, 0.3]) + vertices.new_tensor([0.15, -0.1, 2.0])
    upstream, results = numbers(1, *size) - 0.5, []
    for shape in (size, size[::-1]):
        leaf = (vertices.clone() if shape == size else across(vertices)).requires_grad_()
        alpha = nmr.render_silhouette(leaf, faces, image_size=shape, eps=1e-12, gradient=gradient)
        alpha.backward(upstream if shape == size else upstream.transpose(1, 2))
        results.append((alpha.detach(), leaf.grad))
    assert torch.equal(results[1][0].transpose(1, 2), results[0][0])
    assert results[0][1].any()
    close(across(results[1][1]), results[0][1], 1e-5)


@pytest.mark.parametrize("size", [(32, 64), (64, 32), (31, 97), (97, 31), (40, 41)])
@pytest.mark.parametrize("camera", ["look_at", "look", "orthographic"])
def test_pixels_are_square(camera, size):
    """A sphere looks round, and the field of view belongs to the shorter side."""
    vertices, faces = nmr.icosphere(4)
    camera = {
        "look_at": nmr.LookAt([0.0, 0.0, -3.0], half_fov_deg=30.0),
        "look": nmr.Look([0.0, 0.0, -3.0], half_fov_deg=30.0),
        "orthographic": nmr.Orthographic([0.0, 0.0, -3.0], scale=math.tan(math.asin(1 / 3)) / math.tan(math.pi / 6)),
    }[camera]
    alpha = nmr.render_silhouette(vertices, faces, camera, image_size=size)[0]
    width = min(size) * math.tan(math.asin(1 / 3)) / math.tan(math.pi / 6)
    radius = (alpha.sum() / math.pi).sqrt()
    assert abs(2 * radius - width) < 0.15
    assert abs(alpha.sum(0).max() - width) <= 1 and abs(alpha.sum(1).max() - width) <= 1
    y, x = (torch.arange(side) + 0.5 for side in size)
    assert abs((alpha.sum(0) * x).sum() / alpha.sum() - size[1] / 2) < 0.05
    assert abs((alpha.sum(1) * y).sum() / alpha.sum() - size[0] / 2) < 0.05


def calibrated():
    """OpenCV's camera of an image of 480 x 640, with distortion, and where it sees some points: K, R, t, d, v, uv."""
    rng = np.random.default_rng(0)
    K = np.array([[520.0, 0, 310.5], [0, 500.0, 251.25], [0, 0, 1]])
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    R, t, d = turn * np.linalg.det(turn), np.array([0.1, -0.2, 4.0]), np.array([0.1, -0.05, 0.003, -0.002, 0.01])
    v = rng.uniform(-1, 1, (40, 3)) * [1.2, 1.2, 0.6]
    c = v @ R.T + t
    x, y = c[:, 0] / c[:, 2], c[:, 1] / c[:, 2]
    r2 = x * x + y * y
    radial = 1 + d[0] * r2 + d[1] * r2**2 + d[4] * r2**3
    u = K[0, 0] * (x * radial + 2 * d[2] * x * y + d[3] * (r2 + 2 * x * x)) + K[0, 2]
    w = K[1, 1] * (y * radial + d[2] * (r2 + 2 * y * y) + 2 * d[3] * x * y) + K[1, 2]
    return K, R, t, d, v, np.stack([u, w], axis=-1)


@pytest.mark.parametrize("size", [(48, 64), (480, 640), (24, 64), 64])
@pytest.mark.parametrize("convention", ["pinhole", "opencv"])
def test_calibrated_cameras_land_where_opencv_says(size, convention):
    """Small triangles around points: the pixel under each is drawn. An image of another shape is stretched."""
    K, R, t, d, points, uv = calibrated()
    if convention == "pinhole":
        camera = nmr.Pinhole(K, R, t, d, orig_size=(480, 640))
    else:  # counts from the centre of the first pixel
        camera, uv = nmr.cameras.from_opencv(K, R, t, d, height=480, width=640), uv + 0.5
    height, width = (size, size) if isinstance(size, int) else size
    inside = (uv > 1).all(1) & (uv < [639, 479]).all(1)
    assert inside.sum() > 20
    for point, (u, v) in zip(points[inside], uv[inside], strict=True):
        # A triangle in the plane that the camera sees head-on; a pixel's centre is at most 0.71 pixels from the point.
        reach = 1.5 * max(640 / width, 480 / height) * 4.6 / 500
        corners = point + reach * (np.array([[0, 2, 0], [-1.8, -1, 0], [1.8, -1, 0]]) @ R)
        vertices = torch.tensor(corners)
        alpha = nmr.render_silhouette(vertices, torch.tensor([[0, 1, 2]]), camera, image_size=size, anti_aliasing=False)
        assert alpha.shape == (1, height, width)
        row, column = int(v * height / 480), int(u * width / 640)
        assert alpha[0, row, column] == 1
        centre = (alpha[0].nonzero().double() + 0.5).mean(0)
        wanted = torch.tensor([v * height / 480, u * width / 640])
        assert (centre - wanted).abs().max() < 1.5


@pytest.mark.parametrize("camera", ["look_at", "orthographic"])
@pytest.mark.parametrize("size", [(48, 64), (64, 48)])
def test_converted_cameras_keep_every_vertex_on_its_pixel(camera, size):
    """To another library for an image of this shape, and back."""
    vertices, faces, _ = mesh()
    given = CAMERAS[camera]
    expected = nmr.render_silhouette(vertices, faces, given, image_size=size)
    near_and_far = dict(near=0.1, far=10.0)
    back = {
        "opengl": nmr.cameras.from_opengl(*nmr.cameras.to_opengl(given, **near_and_far, image_size=size)),
        "pytorch3d": pytorch3d(nmr.cameras.to_pytorch3d(given, image_size=size), camera),
        "pytorch3d in pixels": pytorch3d(nmr.cameras.to_pytorch3d(given, image_size=size, in_ndc=False), camera),
    }
    if camera == "look_at":
        height, width = size
        converted = nmr.cameras.to_opencv(given, height=height, width=width)
        assert torch.allclose(converted[0][:, 0, 0], converted[0][:, 1, 1])  # pixels are square
        back["opencv"] = nmr.cameras.from_opencv(*converted, height=height, width=width)
    for name, one in back.items():
        image = nmr.render_silhouette(vertices, faces, one, image_size=size)
        assert (image - expected).abs().mean() < 1e-3, name


def pytorch3d(arguments, camera):
    R, T, focal, centre = (arguments[key] for key in ("R", "T", "focal_length", "principal_point"))
    size = tuple(arguments["image_size"][0].tolist())
    settings = dict(in_ndc=arguments["in_ndc"], image_size=size, orthographic=camera == "orthographic")
    return nmr.cameras.from_pytorch3d(R, T, focal, centre, **settings)


@pytest.mark.parametrize("size", [WIDE, TALL])
def test_ndc_of_pytorch3d_belongs_to_the_shorter_side(size):
    """Without an image_size of its own, a converted camera takes that of the image."""
    vertices, faces, _ = mesh()
    R, T = torch.diag(torch.tensor([-1.0, 1.0, -1.0])), [0.1, 0.0, 2.7]
    for camera in (
        nmr.cameras.from_pytorch3d_fov(R, T, fov=60.0),
        nmr.cameras.from_pytorch3d(R, T, focal_length=1.7, principal_point=0.1),
    ):
        square = nmr.render_silhouette(vertices, faces, camera, image_size=SIZE)
        wide = nmr.render_silhouette(vertices, faces, camera, image_size=size)
        assert square.any() and torch.equal(middle_of(wide, size), square)
    sized = nmr.cameras.from_pytorch3d(R, T, focal_length=1.7, principal_point=0.1, image_size=size)
    assert torch.equal(nmr.render_silhouette(vertices, faces, sized, image_size=size), wide)


@pytest.mark.parametrize("size", [(24, 40), (40, 24)])
def test_lists_of_meshes_have_the_bits_of_each_mesh(size):
    first, second = mesh(torch.float32), nmr.icosphere(2)
    vertices, faces = [first[0], 0.6 * second[0]], [first[1], second[1]]
    tints = [first[2](len(v), 3) for v in vertices]
    camera, outputs = nmr.LookAt(EYE, half_fov_deg=25.0), ("rgb", "alpha", "depth", "normals")

    def draw(vertices, faces, tints):
        leaves = [v.clone().requires_grad_() for v in vertices]
        one = len(leaves) == 1
        colors = nmr.VertexColors(tints[0] if one else tints)
        given = (leaves[0], faces[0]) if one else (leaves, faces)
        images = nmr.render(*given, camera, outputs=outputs, colors=colors, lights=nmr.Lights(), image_size=size)
        sum((image * image.detach().cos()).sum() for image in images).backward()
        return images, [leaf.grad for leaf in leaves]

    images, grads = draw(vertices, faces, tints)
    for b in range(2):
        alone, grad = draw(vertices[b : b + 1], faces[b : b + 1], tints[b : b + 1])
        for together, one in zip(images, alone, strict=True):
            assert together.shape[1:3] == size and torch.equal(together[b], one[0])
        assert torch.equal(grads[b], grad[0])
    alphas = nmr.render_silhouette(vertices, faces, camera, image_size=size)
    assert torch.equal(alphas, images.alpha)


@pytest.mark.parametrize("size", [(24, 40), [24, 40], np.array([24, 40]), torch.tensor([24, 40])])
def test_every_function_takes_height_and_width(size):
    vertices, faces, _ = mesh(torch.float32)
    camera, shape = CAMERAS["two poses"], (2, 24, 40)
    assert nmr.render_silhouette(vertices, faces, camera, image_size=size).shape == shape
    assert nmr.render_depth(vertices, faces, camera, image_size=size).shape == shape
    assert nmr.render_rgb(vertices, faces, camera, image_size=size).shape == (*shape, 3)
    assert nmr.render_normals(vertices, faces, camera, image_size=size).shape == (*shape, 3)
    assert nmr.render_face_index(vertices, faces, camera, image_size=size).shape == shape
    fragments = nmr.render_fragments(vertices, faces, camera, image_size=size)
    assert fragments.sided_face_index.shape == fragments.depth.shape == shape and fragments.weights.shape == (*shape, 3)
    assert torch.equal(fragments.face_index, nmr.render_face_index(vertices, faces, camera, image_size=size))
    twice = nmr.render_fragments(vertices, faces, camera, image_size=size, anti_aliasing=True)
    assert twice.sided_face_index.shape == (2, 48, 80)
    assert twice.resolve(twice.interpolate(vertices)).shape == (*shape, 3)
    assert fragments.per_face(torch.ones(len(faces), 5)).shape == (*shape, 5)


@pytest.mark.parametrize("size", [(1, 64), (64, 1), (1, 1), (3, 8192), (8192, 3)])
def test_extreme_shapes(size):
    """Everything is drawn and has gradients; the object covers the same part of the image."""
    vertices = torch.tensor([[-0.8, -0.9, 2.0], [0.9, -0.8, 2.0], [0.0, 0.9, 3.0]]) * torch.tensor([1.2, 1.2, 1])
    vertices, faces = vertices.requires_grad_(), torch.tensor([[0, 1, 2]])
    images = nmr.render(vertices, faces, outputs=("rgb", "alpha", "depth"), image_size=size)
    assert images.alpha.shape == (1, *size) and 0.2 < images.alpha.mean() < 0.9
    (images.rgb.sum() + images.depth.sum()).backward()
    assert vertices.grad.isfinite().all() and vertices.grad.any()
    for gradient in ("nmr", "local"):
        leaf = vertices.detach().requires_grad_()
        nmr.render_silhouette(leaf, faces, image_size=size, gradient=gradient).sum().backward()
        assert leaf.grad.isfinite().all()


def test_compiled_functions_draw_the_same():
    vertices, faces, _ = mesh(torch.float32)

    def loss(leaf):
        return nmr.render_silhouette(leaf, faces, CAMERAS["look_at"], image_size=(24, 40)).square().sum()

    grads = []
    for function in (loss, torch.compile(loss, fullgraph=True, backend="aot_eager")):
        leaf = vertices.clone().requires_grad_()
        function(leaf).backward()
        grads.append(leaf.grad)
    assert grads[0].any() and torch.equal(*grads)


@pytest.mark.parametrize("threads", [2, 5])
def test_bits_do_not_depend_on_threads_or_batch(threads):
    vertices, faces, numbers = mesh(torch.float32)
    vertices = torch.stack([vertices, 0.7 * vertices, vertices.flip(0)])
    upstream = numbers(3, 20, 52) - 0.5

    def draw(batch, count):
        before = torch.get_num_threads()
        torch.set_num_threads(count)
        leaf = vertices[batch].clone().requires_grad_()
        images = nmr.render(leaf, faces, CAMERAS["look_at"], outputs=("rgb", "alpha", "depth"), image_size=(20, 52))
        loss = (images.alpha * upstream[batch]).sum() + images.depth.sum()
        loss.backward()
        torch.set_num_threads(before)
        return *(image.detach() for image in images), leaf.grad

    together, alone = draw(slice(None), threads), [draw(slice(b, b + 1), 1) for b in range(3)]
    for image, *ones in zip(together, *alone, strict=True):
        assert torch.equal(image, torch.cat(ones))


@pytest.mark.parametrize(
    ("size", "error", "message"),
    [
        ((8, 9, 10), ValueError, r"a pair \(height, width\), got \(8, 9, 10\)"),
        ((), ValueError, "a pair"),
        ((0, 8), ValueError, "image_size must lie in 1..8192, got 0"),
        ((8, 8193), ValueError, "image_size must lie in 1..8192, got 8193"),
        ((8, 9.5), TypeError, "image_size must be an integer"),
        ((8, True), TypeError, "image_size must be an integer"),
        ("8x9", TypeError, r"image_size must be an integer or a pair \(height, width\), got str"),
    ],
)
def test_errors(size, error, message):
    with pytest.raises(error, match=message):
        nmr.render_silhouette(*nmr.icosphere(0), image_size=size)


# --- the interface of neural_renderer


def sphere(batch=2):
    vertices, faces = nmr.icosphere(1)
    return vertices.expand(batch, -1, -1), faces.expand(batch, -1, -1)


@pytest.mark.parametrize("size", [(16, 32), [16, 32], np.array([16, 32]), torch.tensor([16, 32])])
@pytest.mark.parametrize("mode", ["look", "look_at"])
@pytest.mark.parametrize("perspective", [True, False])
def test_wide_images_show_more_at_the_sides(size, mode, perspective):
    vertices, faces = sphere()
    vertices, textures = vertices * 0.7 + torch.tensor([0.3, -0.2, 0]), torch.rand(2, 80, 2, 2, 2, 3)
    renderer = nr.Renderer(camera_mode=mode, image_size=16, perspective=perspective)
    square = renderer(vertices, faces, textures)
    renderer.image_size = size
    for image, wide in zip(square, renderer(vertices, faces, textures), strict=True):
        assert wide.shape[-2:] == (16, 32)
        torch.testing.assert_close(wide[..., 8:24], image, atol=1e-5, rtol=1e-5)
    assert renderer.render_silhouettes(vertices, faces).shape == renderer.render_depth(vertices, faces).shape


def test_tall_images_of_calibrated_cameras_are_stretched():
    vertices, faces = sphere()
    K = torch.tensor([[20.0, 0, 8], [0, 20, 16], [0, 0, 1]])
    camera = dict(K=K, R=torch.eye(3), t=torch.tensor([0, 0, 4.0]), orig_size=(32, 16))
    tall = nr.Renderer((32, 16), **camera).render_silhouettes(vertices, faces)
    square = nr.Renderer(16, **camera).render_silhouettes(vertices, faces)
    assert tall.shape == (2, 32, 16)
    # A sphere is round: 2 * 20 * tan(asin(1 / 4)) = 10.3 pixels, half of it in the rows of the square.
    for image, rows in ((tall[0], 10), (square[0], 5)):
        assert abs(image.sum(0).max() - rows) < 0.6 and abs(image.sum(1).max() - 10) < 0.6


def triangles(batch=2, ts=2):
    generator = torch.Generator().manual_seed(0)
    corners = torch.rand(batch, 9, 3, 3, generator=generator) * 2 - 1
    corners[..., 2] = corners[..., 2] * 0.4 + 2
    return corners, torch.rand(batch, 9, ts, ts, ts, 3, generator=generator)


def test_height_and_width_of_rasters():
    corners, textures = triangles()
    images = nr.rasterize_rgbad(corners, textures, (6, 8))
    assert [tuple(image.shape) for image in images.values()] == [(2, 3, 6, 8), (2, 6, 8), (2, 6, 8)]
    for size in ([6, 8], np.array([6, 8]), torch.tensor([6, 8])):
        assert torch.equal(nr.rasterize(corners, textures, size), images["rgb"])
        assert torch.equal(nr.rasterize_silhouettes(corners, size), images["alpha"])
        assert torch.equal(nr.rasterize_depth(corners, size), images["depth"])
    transposed = corners[..., [1, 0, 2]].flip(2) * torch.tensor([-1, -1, 1])
    tall = nr.rasterize_silhouettes(transposed, (8, 6))
    assert images["alpha"].any() and torch.equal(tall.transpose(1, 2), images["alpha"])
    rgb, alpha, depth = nr.Rasterize((6, 8), 0.1, 100, 1e-4, (0, 0, 0), True, True, True)(corners, textures)
    assert rgb.shape == (2, 6, 8, 3) and alpha.shape == depth.shape == (2, 6, 8)
