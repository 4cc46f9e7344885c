"""Properties of every public function that takes tensors: clones, changes in place, threads, modes of torch."""

import functools
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from children import environment
from scenes import bumpy_sphere, for_threads, leaf_of, same_bits, uniform

import nmr
import nmr.neural_renderer as nr
import nmr.nvdiffrast.torch as dr
from nmr import cameras, losses, metrics

F32 = torch.float32
SPHERE, FACES = bumpy_sphere(1, dtype=F32)
SIZE = {"image_size": (6, 8), "anti_aliasing": False}
EYES = [[0.0, 0.5, -2.5], [0.4, 0.0, -2.0]]


def twice(x):
    """A batch of two equal items."""
    return torch.stack([x, x])


def noise(*shape, seed=0):
    return twice(uniform(*shape, seed=seed, dtype=F32))


MESH = {"vertices": twice(SPHERE), "faces": twice(FACES)}
EYE = {"eye": torch.tensor([[0.4, 0.5, -2.5]] * 2)}
UV = {"image": noise(6, 7, 3), "uv": twice(1.5 * SPHERE[:, :2]), "uv_faces": MESH["faces"]}
CLIP = {
    "pos": torch.cat([MESH["vertices"], MESH["vertices"][..., :1] + 3], dim=-1),
    "tri": FACES.int(),
}
RAST = dr.rasterize(dr.RasterizeCudaContext(), *CLIP.values(), (6, 8))
CUBES = noise(len(FACES), 2, 2, 2, 3)
CORNERS = nr.vertices_to_faces(0.5 * MESH["vertices"] + torch.tensor([0.0, 0.0, 2.0]), FACES)
K = torch.tensor([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
POSE = {"R": twice(torch.eye(3)), "t": torch.tensor([[0.1, 0.0, 3.0]] * 2)}
PINHOLE = {"K": twice(K), **POSE, "distortion": noise(5) / 10}
FOCUS = {"focal": torch.tensor([[1.5, 1.6]] * 2), "principal": torch.tensor([[0.1, 0.2]] * 2)}
MATRICES = {
    "view": twice(torch.eye(4)),
    "projection": twice(
        torch.tensor([[2.0, 0, 0, 0], [0, 2, 0, 0], [0, 0, -1, -2], [0, 0, -1, 0]])
    ),
}
PROJECTION = {
    "matrix": torch.cat([POSE["R"], POSE["t"].unsqueeze(-1)], dim=-1),
    "intrinsics": torch.tensor([[[2.0, 0.1, 0.1], [0.0, 2.0, 0.0]]] * 2),
    "distortion": PINHOLE["distortion"],
    "origin": torch.tensor([[0.1, 0.2, 0.3]] * 2),
    "extent": torch.tensor([1.5] * 2),
}
ANGLES = {"d": torch.tensor([2.5] * 2), "e": torch.tensor([30.0] * 2), "a": torch.tensor([9.0] * 2)}
EDGES = nmr.edge_table(FACES)
GRIDS = {"prediction": noise(4, 4, 4) > 0.5, "target": noise(4, 4, 4, seed=1) > 0.5}
LIGHTS = {
    "direction": torch.tensor([[[0.3, 1.0, -1.0]]] * 2),
    "position": torch.tensor([[[0.5, 1.0, -2.0]]] * 2),
    "directional_color": noise(1, 3),
    "harmonics": noise(9, 3),
    "normals": MESH["vertices"],
    "specular": torch.tensor([0.3] * 2),
}


class Upright:
    """A camera that is not one of nmr's."""

    def transform(self, vertices):
        return vertices + torch.tensor([0.0, 0.0, 3.0], device="cpu")


class Call(NamedTuple):
    function: object
    tensors: dict


def drawn(render, **how):
    """A function that draws: of vertices, faces and eyes."""

    def draw(vertices, faces, eye):
        return render(vertices, faces, nmr.LookAt(eye), **SIZE, **how)

    return Call(draw, MESH | EYE)


def colored(make, tensors, render=nmr.render_rgb, **how):
    """Colours, drawn from two sides."""

    def draw(**given):
        how_ = how | {"colors": make(**given), "background": 0.3}
        return render(MESH["vertices"], FACES, nmr.LookAt(EYES), **SIZE, **how_)

    return Call(draw, tensors)


def lit(**given):
    lights = nmr.Lights(falloff=0.1, **given)
    return nmr.render_rgb(MESH["vertices"], FACES, nmr.LookAt(EYES), lights=lights, **SIZE)


def fragments(vertices, values, rows, image):
    made = nmr.render_fragments(vertices, FACES, nmr.LookAt(EYES), **SIZE)
    parts = made.interpolate(values), made.per_face(rows), made.resolve(image)
    return *parts, made.normals(smooth=True, space="camera"), made.weights, made.depth


def seen(make, tensors):
    """A camera of these parameters: where it puts a mesh."""
    return Call(lambda **given: make(**given).for_image(6, 8).transform(MESH["vertices"]), tensors)


def opengl(**given):
    return cameras.to_opengl(cameras.Projection(*given.values()), near=0.1, far=9.0)


def texture(mode, filter_mode, tensors):
    how = dict(filter_mode=filter_mode, boundary_mode=mode)
    return Call(lambda **given: dr.texture(**given, **how), tensors)


def materials(colors, image, uv, uv_faces):
    """Of the picture, and of a colour."""
    return nmr.Materials(colors, [image, None], FACES[:, 0] % 3 - 1, uv, uv_faces)


def written(save):
    """The bytes of the files that a function writes."""

    def contents(**given):
        with tempfile.TemporaryDirectory() as folder:
            save(f"{folder}/a.obj", **given)
            content = b"".join(path.read_bytes() for path in sorted(Path(folder).iterdir()))
        return torch.tensor(list(content), device="cpu")

    return contents


def mipmap(tex):
    """Of both ways in which a texture is given its mipmaps."""
    made = dr.texture_construct_mip(tex)
    return dr.texture(tex, UV2, mip=made, mip_level_bias=BIAS), *made.levels


def peeled(pos, tri):
    with dr.DepthPeeler(dr.RasterizeCudaContext(), pos, tri, (6, 8)) as peeler:
        return *peeler.rasterize_next_layer(), *peeler.rasterize_next_layer()


def surface(vertices, faces):
    return metrics.sample_surface(vertices, faces, 20, torch.Generator("cpu").manual_seed(0))


def hashed(color, rast, pos, tri):
    made = dr.antialias_construct_topology_hash(tri)
    return dr.antialias(color, rast, pos, tri, made, 2.0), made.twins


def renderer(vertices, faces, textures, eye, background_color, light_direction):
    made = nr.Renderer((6, 8), camera_mode="look_at", background_color=background_color)
    made.eye, made.light_direction = eye, light_direction
    return made(vertices, faces, textures)


def rasterize_module(faces, textures):
    return nr.Rasterize(8, 0.1, 9.0, 1e-3, (0, 0, 0), True, True, True)(faces, textures)


UV2, BIAS = noise(4, 5, 2), 2 * noise(4, 5)
SLOPES = noise(4, 5, 4) / 4
DIRECTIONS, CUBE_SLOPES = noise(4, 5, 3) - 0.5, noise(4, 5, 6) / 4
POINTS = {"points_a": noise(9, 3), "points_b": noise(7, 3, seed=1)}
LOSSES_OF_EDGES = "smoothness_loss", "laplacian_loss", "edge_length_loss", "normal_consistency_loss"
LOSSES_OF_FACES = "inflation_loss", "volume_loss", "area_loss"

# The first word of a key is the function.
CALLS = {
    "nmr.render": drawn(
        nmr.render, lights=nmr.Lights(), outputs=("rgb", "alpha", "depth", "normals"), smooth=True
    ),
    "nmr.render local": drawn(nmr.render, outputs=("rgb", "depth", "normals"), gradient="local"),
    "nmr.render_depth": drawn(nmr.render_depth),
    "nmr.render_face_index": drawn(
        lambda *mesh, anti_aliasing, **how: nmr.render_face_index(*mesh, **how)
    ),
    "nmr.render_fragments": drawn(
        lambda *mesh, **how: (
            lambda made: (made.weights, made.depth, made.distances, made.sided_face_index)
        )(nmr.render_fragments(*mesh, **how, faces_per_pixel=2, blur_radius=0.01))
    ),
    "nmr.render_normals": drawn(nmr.render_normals, smooth=True),
    "nmr.render_normals upright": Call(
        lambda vertices, faces: nmr.render_normals(vertices, faces, Upright(), **SIZE), MESH
    ),
    "nmr.render_rgb": drawn(nmr.render_rgb),
    "nmr.render_rgb list": Call(
        lambda a, b: nmr.render_rgb(
            [a, b], [FACES, FACES[:9]], nmr.LookAt(EYES), lights=nmr.Lights(), **SIZE
        ),
        {"a": SPHERE, "b": 0.5 * SPHERE},
    ),
    "nmr.render_rgb background": Call(
        lambda behind: nmr.render_rgb(
            MESH["vertices"], FACES, nmr.LookAt(EYES), background=behind, **SIZE
        ),
        {"behind": noise(3)},
    ),
    "nmr.render_silhouette": drawn(nmr.render_silhouette),
    "nmr.render_silhouette near": drawn(nmr.render_silhouette, near=2.0),
    "nmr.render_soft": drawn(nmr.render_soft, sigma=1e-3, gamma=0.02, faces_per_pixel=3),
    "nmr.render_soft sigma": Call(
        lambda sigma, gamma: nmr.render_soft(
            SPHERE, FACES, nmr.LookAt(EYES), sigma=sigma, gamma=gamma, **SIZE
        ),
        {"sigma": torch.tensor([1e-3]), "gamma": torch.tensor([0.02])},
    ),
    "nmr.render_soft_silhouette": drawn(nmr.render_soft_silhouette, sigma=1e-3),
    "nmr.render_transparent": drawn(nmr.render_transparent, faces_per_pixel=3),
    "nmr.render_transparent opacity": Call(
        lambda opacity: nmr.render_transparent(
            SPHERE, FACES, nmr.LookAt(EYES), opacity=opacity, **SIZE
        ),
        {"opacity": torch.tensor([0.3] * 2)},
    ),
    "nmr.Fragments": Call(
        fragments,
        {
            "vertices": MESH["vertices"],
            "values": noise(len(SPHERE), 3),
            "rows": noise(len(FACES), 2),
            "image": noise(6, 8, 3),
        },
    ),
    "nmr.VertexColors": colored(nmr.VertexColors, {"colors": noise(len(SPHERE), 3)}),
    "nmr.VertexColors soft": colored(
        nmr.VertexColors, {"colors": noise(len(SPHERE), 3)}, nmr.render_soft
    ),
    "nmr.FaceColors": colored(nmr.FaceColors, {"colors": noise(len(FACES), 3)}),
    "nmr.TextureCubes": colored(nmr.TextureCubes, {"textures": CUBES}),
    "nmr.UVTexture": colored(nmr.UVTexture, UV),
    "nmr.UVTexture mipmap": colored(functools.partial(nmr.UVTexture, filter="mipmap"), UV),
    "nmr.Materials": colored(materials, {"colors": noise(2, 3)[0], **{k: UV[k][0] for k in UV}}),
    "nmr.NormalMap": Call(lambda **uv: lit(normals=nmr.NormalMap(**uv)), UV),
    "nmr.Lights": Call(lit, LIGHTS),
    "nmr.sample_texture": Call(nmr.sample_texture, {"image": UV["image"], "uv": UV2}),
    "nmr.sample_texture mipmap": Call(
        nmr.sample_texture, {"image": UV["image"], "uv": UV2, "derivatives": SLOPES}
    ),
    "nmr.LookAt": seen(
        nmr.LookAt, EYE | {"at": noise(3), "half_fov_deg": torch.tensor([30.0] * 2)}
    ),
    "nmr.Look": seen(nmr.Look, EYE | {"direction": torch.tensor([[0.0, 0.1, 1.0]] * 2)}),
    "nmr.Orthographic": seen(nmr.Orthographic, EYE | {"scale": torch.tensor([0.7] * 2)}),
    "nmr.Pinhole": seen(
        lambda **given: nmr.Pinhole(*given.values(), orig_size=(480, 640)), PINHOLE
    ),
    "nmr.face_normals": Call(nmr.face_normals, MESH),
    "nmr.vertex_normals": Call(nmr.vertex_normals, MESH),
    "nmr.save_obj": Call(
        written(
            lambda path, vertices, faces, **given: nmr.save_obj(
                path, vertices, faces, materials(**given)
            )
        ),
        {"vertices": SPHERE, "faces": FACES, "colors": noise(2, 3)[0]} | {k: UV[k][0] for k in UV},
    ),
    "nmr.edge_table": Call(nmr.edge_table, {"faces": FACES}),
    "nmr.unique_edges": Call(nmr.unique_edges, {"faces": FACES}),
    "nmr.voxelize": Call(
        lambda vertices, faces: nmr.voxelize(0.4 * vertices + 0.5, faces, 6), MESH
    ),
    "losses.soft_iou_loss": Call(
        losses.soft_iou_loss, {"prediction": noise(4, 4), "target": noise(4, 4, seed=1)}
    ),
    **{
        f"losses.{name}": Call(
            getattr(losses, name), {"vertices": MESH["vertices"], "edges": EDGES}
        )
        for name in LOSSES_OF_EDGES
    },
    **{f"losses.{name}": Call(getattr(losses, name), MESH) for name in LOSSES_OF_FACES},
    "metrics.sample_surface": Call(surface, MESH),
    "metrics.chamfer_distance": Call(metrics.chamfer_distance, POINTS),
    "metrics.f_score": Call(
        lambda points_a, points_b: metrics.f_score(points_a, points_b, 0.2), POINTS
    ),
    "metrics.voxel_iou": Call(metrics.voxel_iou, GRIDS),
    "metrics.voxel_precision_recall": Call(metrics.voxel_precision_recall, GRIDS),
    "cameras.Projection": seen(cameras.Projection, PROJECTION),
    "cameras.cat": Call(
        lambda eye, points: cameras.cat([nmr.LookAt(eye)[0], nmr.LookAt(eye[1])]).unproject(points),
        EYE | {"points": noise(4, 3)},
    ),
    "cameras.from_opencv": seen(
        lambda **given: cameras.from_opencv(*given.values(), height=480, width=640), PINHOLE
    ),
    "cameras.to_opencv": Call(
        lambda **given: cameras.to_opencv(
            nmr.Pinhole(*given.values(), orig_size=(480, 640)), height=480, width=640
        ),
        PINHOLE,
    ),
    "cameras.from_opengl": seen(cameras.from_opengl, MATRICES),
    "cameras.to_opengl": Call(
        opengl, {name: PROJECTION[name] for name in ("matrix", "intrinsics")}
    ),
    "cameras.from_pytorch3d": seen(
        lambda **given: cameras.from_pytorch3d(*given.values()), POSE | FOCUS
    ),
    "cameras.from_pytorch3d_fov": seen(
        lambda **given: cameras.from_pytorch3d_fov(*given.values()),
        POSE | {"fov": torch.tensor([50.0] * 2)},
    ),
    "cameras.to_pytorch3d": Call(lambda eye: cameras.to_pytorch3d(nmr.LookAt(eye))["R"], EYE),
    "cameras.points_from_angles": Call(lambda d, e, a: cameras.points_from_angles(d, e, a), ANGLES),
    "dr.rasterize": Call(
        lambda pos, tri: dr.rasterize(dr.RasterizeCudaContext(), pos, tri, (6, 8)), CLIP
    ),
    "dr.DepthPeeler": Call(peeled, CLIP),
    "dr.interpolate": Call(
        lambda attr, rast, tri, rast_db: dr.interpolate(attr, rast, tri, rast_db, "all"),
        {"attr": noise(len(SPHERE), 3), "rast": RAST[0], "tri": CLIP["tri"], "rast_db": RAST[1]},
    ),
    "dr.texture linear": texture("wrap", "linear", {"tex": UV["image"], "uv": UV2}),
    "dr.texture nearest": texture("clamp", "nearest", {"tex": UV["image"], "uv": UV2}),
    "dr.texture zero": texture("zero", "linear", {"tex": UV["image"], "uv": UV2}),
    "dr.texture mipmap": texture(
        "wrap",
        "linear-mipmap-linear",
        {"tex": UV["image"], "uv": UV2, "uv_da": SLOPES, "mip_level_bias": BIAS},
    ),
    "dr.texture cube": texture(
        "cube",
        "linear-mipmap-nearest",
        {"tex": noise(6, 5, 5, 3), "uv": DIRECTIONS, "uv_da": CUBE_SLOPES},
    ),
    "dr.texture_construct_mip": Call(mipmap, {"tex": UV["image"]}),
    "dr.antialias": Call(
        lambda color, rast, pos, tri: dr.antialias(color, rast, pos, tri),
        {"color": noise(6, 8, 3), "rast": RAST[0], **CLIP},
    ),
    "dr.antialias_construct_topology_hash": Call(
        hashed, {"color": noise(6, 8, 3), "rast": RAST[0], **CLIP}
    ),
    "nr.Mesh": Call(
        lambda textures: nr.Mesh(SPHERE, FACES, textures).get_batch(2)[2], {"textures": CUBES[0]}
    ),
    "nr.Renderer": Call(
        renderer,
        {
            **MESH,
            "textures": CUBES,
            **EYE,
            "background_color": noise(3),
            "light_direction": torch.tensor([[0.1, 1.0, -1.0]] * 2),
        },
    ),
    "nr.Rasterize": Call(rasterize_module, {"faces": CORNERS, "textures": CUBES}),
    "nr.rasterize": Call(
        lambda faces, textures: nr.rasterize(faces, textures, 8, False),
        {"faces": CORNERS, "textures": CUBES},
    ),
    "nr.rasterize_rgbad": Call(
        lambda faces, textures: nr.rasterize_rgbad(faces, textures, 8).values(),
        {"faces": CORNERS, "textures": CUBES},
    ),
    "nr.rasterize_silhouettes": Call(
        lambda faces: nr.rasterize_silhouettes(faces, 8), {"faces": CORNERS}
    ),
    "nr.rasterize_depth": Call(lambda faces: nr.rasterize_depth(faces, 8), {"faces": CORNERS}),
    "nr.vertices_to_faces": Call(nr.vertices_to_faces, MESH),
    "nr.lighting": Call(
        lambda faces, textures, direction: nr.lighting(faces, textures, direction=direction),
        {"faces": CORNERS, "textures": CUBES, "direction": torch.tensor([[0.1, 1.0, -1.0]] * 2)},
    ),
    "nr.save_obj": Call(
        written(nr.save_obj), {"vertices": SPHERE, "faces": FACES, "textures": CUBES[0]}
    ),
    "nr.look": Call(
        lambda vertices, eye: nr.look(vertices, eye, (0, 0.1, 1)),
        {"vertices": MESH["vertices"], **EYE},
    ),
    "nr.look_at": Call(nr.look_at, {"vertices": MESH["vertices"], **EYE}),
    "nr.perspective": Call(
        nr.perspective, {"vertices": MESH["vertices"] + 3, "angle": torch.tensor([20.0] * 2)}
    ),
    "nr.projection": Call(
        lambda vertices, **given: nr.projection(vertices, *given.values(), 640),
        {"vertices": MESH["vertices"], **PINHOLE},
    ),
    "nr.get_points_from_angles": Call(lambda d, e, a: nr.get_points_from_angles(d, e, a), ANGLES),
}
WITHOUT_TENSORS = {
    *("nmr.Camera", "nmr.Colors", "nmr.Images", "nmr.icosphere"),
    *("nmr.load_gltf", "nmr.load_obj"),
    *("cameras.Camera", "cameras.ProjectingCamera", "metrics.SurfacePoints"),
    *("dr.RasterizeCudaContext", "dr.RasterizeGLContext", "dr.get_log_level", "dr.set_log_level"),
    *("nr.install_as", "nr.load_obj"),
}
EACH = pytest.mark.parametrize("name", CALLS)


def test_the_table_has_every_public_function():
    modules = {"nmr": nmr, "cameras": cameras, "losses": losses, "metrics": metrics}
    modules |= {"dr": dr, "nr": nr}
    public = {
        f"{name}.{member}"
        for name, module in modules.items()
        for member in module.__all__
        if callable(getattr(module, member))
    }
    again = {f"cameras.{name}" for name in cameras.__all__ if hasattr(nmr, name)}
    rows = {name.split()[0] for name in CALLS}
    assert rows | WITHOUT_TENSORS == public - (again - rows - WITHOUT_TENSORS)
    assert not rows & WITHOUT_TENSORS


def results_of(call, tensors):
    results = call.function(**tensors)
    results = [results] if isinstance(results, torch.Tensor) else results
    return [x for x in results if x is not None]


def loss_of(results):
    """Every number with a weight of its own."""
    real = [x for x in results if x.is_floating_point()]
    weights = (uniform(1, *x.shape, seed=9)[0].to(x.dtype) for x in real)
    return sum((x * weight).sum() for x, weight in zip(real, weights, strict=True))


def gradients_of(results, behind):
    """Those of `behind`, if some of the results have one."""
    loss = loss_of(results) if behind else None
    if not isinstance(loss, torch.Tensor) or not loss.requires_grad:
        return [torch.zeros_like(x) for x in behind]
    return list(torch.autograd.grad(loss, behind, allow_unused=True, materialize_grads=True))


def outcome(call, tensors, behind=()):
    """The results and gradients."""
    results = results_of(call, tensors)
    grads = gradients_of(results, behind)
    return [x.detach().as_subclass(torch.Tensor) for x in results + grads]


class Scaled(torch.autograd.Function):
    """Grows, and has a gradient of its own."""

    @staticmethod
    def forward(ctx, x, shape):
        ctx.shape = x.shape
        return x.expand(shape)

    @staticmethod
    def backward(ctx, grad):
        return 10 * grad.sum_to_size(ctx.shape), None


class Other(torch.Tensor):
    pass


def hooked(x):
    x.register_hook(lambda grad: 2 * grad)
    return x


def same(x):
    """One item for the whole batch, if the items are equal."""
    return x[:1] if x.ndim and len(x) > 1 and (x == x[:1]).all() else x


# From the values to the tensor that gradients start from, and from that to the one that is passed.
DISGUISES = {
    "expanded": (same, lambda root, x: root.expand(x.shape)),
    "expanded leaf": (lambda x: same(x).expand(x.shape), lambda root, x: root),
    "function": (same, lambda root, x: Scaled.apply(root, x.shape)),
    "hook": (same, lambda root, x: hooked(root.expand(x.shape))),
    "gaps": (lambda x: torch.stack([x, x], dim=-1), lambda root, x: root[..., 1]),
    "turned": (
        lambda x: x.permute(*reversed(range(x.ndim))).contiguous(),
        lambda root, x: root.permute(*reversed(range(x.ndim))),
    ),
    "subclass": (lambda x: x, lambda root, x: root.as_subclass(Other)),
}


def near(results, wanted):
    """Up to the order of a sum."""
    return all(
        torch.allclose(a, b, rtol=1e-5, atol=1e-6 * float(b.detach().abs().max()), equal_nan=True)
        if b.is_floating_point() and b.numel()
        else torch.equal(a, b)
        for a, b in zip(results, wanted, strict=True)
    )


@EACH
def test_a_clone_changes_nothing(name):
    """The value, also without a gradient; the gradient of the tensor that is given, and of what lies behind it."""
    call = CALLS[name]
    for argument, x in call.tensors.items():
        for disguise, (start, pass_on) in DISGUISES.items():
            real = x.is_floating_point()
            if not real and disguise in ("function", "hook"):
                continue
            root = start(x).detach()
            if disguise != "expanded leaf":  # whose clone would not be expanded
                root = root.clone()
            root.requires_grad_(real)
            given = pass_on(root, x)
            copy = given.as_subclass(torch.Tensor).clone(memory_format=torch.contiguous_format)
            behind = [given, root] if real else []
            wanted = outcome(call, call.tensors | {argument: copy}, behind)
            got = outcome(call, call.tensors | {argument: given}, behind)
            where = f"{name}, {argument}, {disguise}"
            assert torch.equal(given.as_subclass(torch.Tensor), x), where
            without = outcome(call, call.tensors | {argument: given.detach()})
            assert near(got, wanted), where
            assert near(without, wanted[: len(without)]), f"{where}, without a gradient"


@EACH
def test_a_change_in_place_is_seen(name):
    """A gradient after one is an error, or that of the values that were given."""
    call = CALLS[name]
    for argument, x in call.tensors.items():
        if not x.is_floating_point():
            continue
        root = leaf_of(x)
        wanted = outcome(call, call.tensors | {argument: root}, [root])
        given = root * 1
        results = results_of(call, call.tensors | {argument: given})
        given.mul_(0)
        try:
            grads = gradients_of(results, [root])
        except RuntimeError as error:
            assert "modified by an inplace operation" in str(error)
        else:
            assert near(grads, wanted[-1:]), argument


@EACH
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_an_upstream_gradient_that_is_not_finite_is_seen_in_its_image_alone(name, bad):
    """Of every result: a gradient scaler must see it, and the other images must not."""
    tensors = {
        k: leaf_of(x) if x.is_floating_point() else x for k, x in CALLS[name].tensors.items()
    }
    behind = [x for x in tensors.values() if x.requires_grad]
    for result in results_of(CALLS[name], tensors):
        if not result.requires_grad or result.ndim == 0:
            continue

        def grads(factor, result=result):
            upstream = torch.ones_like(result)
            upstream[0] *= factor
            return torch.autograd.grad(
                result, behind, upstream, True, allow_unused=True, materialize_grads=True
            )

        healthy, spoiled = grads(1), grads(bad)
        reached = any(x.any() for x in healthy)
        assert not reached or not all(x.isfinite().all() for x in spoiled)
        for x, a, b in zip(behind, healthy, spoiled, strict=True):
            # a tensor of equal items has one for each image
            assert len(same(x)) == len(x) or torch.equal(a[1], b[1])


@EACH
def test_torch_func_has_the_same_gradient(name):
    call = CALLS[name]
    for argument, x in call.tensors.items():
        root = leaf_of(x) if x.is_floating_point() else x
        results = results_of(call, call.tensors | {argument: root})
        loss = loss_of(results)
        if isinstance(loss, torch.Tensor) and loss.requires_grad:
            grad = torch.func.grad(
                lambda x, argument=argument: loss_of(results_of(call, call.tensors | {argument: x}))
            )
            assert near([grad(x)], gradients_of(results, [root])), argument


def everything():
    """Results and gradients of all functions."""
    found = {}
    for name, call in CALLS.items():
        given = {k: leaf_of(x) if x.is_floating_point() else x for k, x in call.tensors.items()}
        behind = [x for x in given.values() if x.requires_grad]
        found[name] = outcome(call, given, behind)
    return found


def test_any_number_of_threads_and_several_python_threads_at_once():
    wanted, *others = for_threads((1, 2, 5), everything)
    for name, results in wanted.items():
        assert all(same_bits(found[name], results) for found in others), name
    with ThreadPoolExecutor(4) as pool:
        for found in [future.result() for future in [pool.submit(everything) for _ in range(4)]]:
            for name, results in found.items():
                assert same_bits(results, wanted[name]), name


MODES = {
    "inference": torch.inference_mode,
    "meta": functools.partial(torch.device, "meta"),
}


def values_under(mode):
    """The values under a mode, then everything outside of it."""
    with MODES[mode]():
        # a Parameter that Mesh makes, and indices made by the test, are on the default device
        values = {name: outcome(call, call.tensors) for name, call in CALLS.items()}
    return {name: [x.clone() for x in found] for name, found in values.items()}, everything()


@pytest.mark.parametrize("mode", MODES)
def test_a_first_call_under_a_mode_changes_nothing(mode, tmp_path):
    """In a new process: nothing that a function keeps for later belongs to inference mode, or to a default device."""
    made = tmp_path / "made.pt"
    code = (
        "import sys, torch\n"
        "sys.path.insert(0, sys.argv[1])\n"
        "import test_public\n"
        "torch.save(test_public.values_under(sys.argv[2]), sys.argv[3])"
    )
    command = [sys.executable, "-c", code, str(Path(__file__).parent), mode, str(made)]
    ended = subprocess.run(
        command, env=environment(), cwd=tmp_path, capture_output=True, text=True, timeout=600
    )
    assert ended.returncode == 0, ended.stderr
    values, found = torch.load(made)
    for name, wanted in everything().items():
        assert same_bits(found[name], wanted), name
        assert near(values[name], wanted[: len(values[name])]), name
