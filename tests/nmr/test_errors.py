"""Every error of the public functions is provoked once: what was wanted, what came, and what to do."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import nmr
import nmr.neural_renderer as nr
from nmr import cameras, losses, metrics
from nmr.neural_renderer.save_obj import create_texture_image

V, F = nmr.icosphere(1)  # 42 vertices, 80 faces
LISTS = dict(vertices=[V, V[:12], V], faces=[F, F[:5] % 12, F])
EYE, I3, I4 = [0.0, 0.0, -3.0], np.eye(3), np.eye(4)
LOOK = nmr.LookAt(EYE)
PINHOLE = nmr.Pinhole(I3, I3, EYE, [0.1] * 5, orig_size=4)
SKEWED = nmr.Pinhole(I3 + np.eye(3, k=1), I3, EYE, orig_size=4)
FRUSTUM = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -3, -2], [0, 0, -1, 0]])
STARTS = torch.tensor([[0, 0], [30, 0], [42, 0]])
TABLE = nmr.edge_table(F)
IMAGE, UV, CUBES = torch.rand(4, 4, 3), torch.rand(42, 2), torch.rand(2, 80, 2, 2, 2, 3)
BATCH, FACES = V.expand(2, -1, -1), F.expand(2, -1, -1)
CORNERS = torch.rand(2, 80, 3, 3)
ONES = torch.ones(1, 3)
WITHOUT_ROWS = nmr.UVTexture(IMAGE, UV[:5])
GRID = torch.zeros(2, 4, 4, 4, dtype=torch.bool)


def of(value):
    """A camera or colours that return this value."""
    return SimpleNamespace(sample=lambda fragments: value, transform=lambda vertices: value)


class Shifted:
    """A camera without an eye."""

    def transform(self, vertices):
        return vertices + torch.tensor([0.0, 0.0, 3.0])


def render(vertices=V, faces=F, camera=LOOK, **how):
    return nmr.render(vertices, faces, camera, **{"image_size": 4, **how})


def rgb(colors, vertices=V, faces=F, **how):
    return nmr.render_rgb(vertices, faces, LOOK, colors=colors, image_size=4, **how)


def lists(**how):
    return nmr.render_silhouette(**{**LISTS, "image_size": 4, **how})


def fragments(**how):
    return nmr.render_fragments(V, F, LOOK, image_size=4, **how)


def save(faces, vertices=V, **how):
    nmr.save_obj("no folder/is not written.obj", vertices, faces, **how)


def entry(matrix, row, column, value=1.0):
    matrix = matrix.copy()
    matrix[row, column] = value
    return matrix


def raster(**how):
    return nr.rasterize(**{"faces": CORNERS, "textures": CUBES, "image_size": 8, **how})


def lighting(**how):
    return nr.lighting(**{"faces": CORNERS, "textures": CUBES, **how})


def renderer(**how):
    return nr.Renderer(8, **{"camera_mode": "look_at", **how})


TYPES = [
    # meshes
    (
        "vertices must be a float tensor .* got list; use torch.as_tensor",
        lambda: nmr.face_normals([V], F),
    ),
    (
        r"vertices must be float32 or float64, got float16 .*call vertices.float\(\)",
        lambda: render(V.half()),
    ),
    (
        "faces must be an integer tensor .* got ndarray; use torch.as_tensor",
        lambda: render(faces=F.numpy()),
    ),
    (r"integer tensor.*got float32 .* call faces.long\(\)", lambda: render(faces=F.float())),
    (
        r"must hold tensors \[V_b, 3\], it holds float; use torch.as_tensor",
        lambda: lists(vertices=[V, 3.0, V]),
    ),
    # settings
    ("image_size must be an integer", lambda: render(image_size=(8, 9.5))),
    (
        r"image_size must be an integer or a pair \(height, width\), got str",
        lambda: render(image_size="8x9"),
    ),
    ("near must be a number, got NoneType", lambda: render(near=None)),
    (r"far must be a number, got float32 \[2\]", lambda: render(far=torch.ones(2))),
    ("anti_aliasing must be True or False, got 'no'", lambda: render(anti_aliasing="no")),
    (
        r"sigma must be a number or a tensor \[\], got str",
        lambda: nmr.render_soft_silhouette(V, F, sigma="wide"),
    ),
    ("near must be a number, got '0.1'", lambda: render(near="0.1")),
    ("interpolation_gradient must be True or", lambda: render(interpolation_gradient="no")),
    ("smooth must be True or False, got 'no'", lambda: fragments().normals(smooth="no")),
    ("smooth must be True or False, got 'flat'", lambda: nmr.Lights(smooth="flat")),
    ("right_handed must be True or", lambda: nmr.LookAt(EYE, right_handed="left")),
    (r"eps has no gradient here", lambda: render(eps=torch.tensor(1e-3, requires_grad=True))),
    ("normals must be a float tensor .* got float", lambda: nmr.Lights(normals=0.5)),
    ("ordinary tensor, got one of layout torch.sparse_coo", lambda: render(V.to_sparse())),
    ("ordinary tensor, got one without values", lambda: render(V.to("meta"))),
    ("subdivisions must be an integer, got float", lambda: nmr.icosphere(2.5)),
    # cameras
    (r"camera must have a method transform\(vertices\)", lambda: render(camera="front")),
    ("got list; nmr.cameras.cat joins", lambda: render(camera=[nmr.LookAt([0.0, 0.0, -2.0])])),
    (r"got the class LookAt; create one: LookAt\(\.\.\.\)", lambda: render(camera=nmr.LookAt)),
    (
        r"SimpleNamespace.transform must take \(vertices \[N, 3\], starts",
        lambda: lists(camera=of(V)),
    ),
    (r"eye must be numbers of shape \[3\] or \[B, 3\], got str: ", lambda: nmr.LookAt("front")),
    ("of real numbers, got complex64", lambda: nmr.LookAt(torch.zeros(3, dtype=torch.cfloat))),
    (
        r"elevation_deg must be a number or \[B\], got str",
        lambda: nmr.LookAt.from_angles(2.0, "up", 0.0),
    ),
    (
        "camera must be one of nmr's .* got str",
        lambda: cameras.to_opencv("camera", height=4, width=4),
    ),
    # colours and light
    (
        r"colors must be nmr.VertexColors.*got float32 \[4, 3\]; nmr.VertexColors\(x\)",
        lambda: rgb(torch.rand(4, 3)),
    ),
    ("lights must be nmr.Lights, got float", lambda: rgb(None, lights=0.5)),
    (
        r"colors must be a float tensor \[V, C\].*the list holds list",
        lambda: nmr.VertexColors([[0.0]]),
    ),
    ("got str; use torch.as_tensor", lambda: nmr.VertexColors("red")),
    (r"got uint8 \[42, 3\]; divide 0..255 by 255", lambda: nmr.VertexColors(V.byte())),
    ("uv_faces must be .* got int", lambda: nmr.UVTexture(IMAGE, UV, 3)),
    (r"ambient must be \[\] or \[B\], got tuple", lambda: nmr.Lights(ambient=(0.1, [0.2]))),
    (
        r"direction must be .* of floats, got int64 \[3\]",
        lambda: nmr.Lights(direction=torch.zeros(3).long()),
    ),
    (
        "image must be a tensor of torch.float32",
        lambda: fragments().resolve(torch.zeros(1, 4, 4, 3).double()),
    ),
    ("near must be a number, got 'a'", lambda: cameras.to_opengl(LOOK, near="a", far=1.0)),
    ("aspect_ratio must be", lambda: cameras.from_pytorch3d_fov(I3, EYE, aspect_ratio="a")),
    # files
    (r"faces must be integers, got float32 \[80, 3\]", lambda: save(F + 0.6)),
    (r"vertices must be float32 or float64, got int64", lambda: save(F, V.long())),
    ("got NormalMap", lambda: save(F, colors=nmr.NormalMap(IMAGE, UV))),
    # losses and metrics
    ("prediction and target must be tensors", lambda: losses.soft_iou_loss([0.0], ONES)),
    ("prediction a float tensor, got uint8", lambda: losses.soft_iou_loss(ONES.byte(), ONES)),
    (
        r"float32 or float64 tensors .*int64 \[42, 3\]",
        lambda: metrics.chamfer_distance(V.long(), V),
    ),
    (
        r"must be bool tensors .*float32.*threshold first",
        lambda: metrics.voxel_iou(GRID, GRID.float()),
    ),
    # neural_renderer
    (r"faces must be float32 or float64, .*faces.float\(\)", lambda: raster(faces=CORNERS.long())),
    ("color_ambient must be numbers", lambda: lighting(color_ambient="white")),
    ("textures must be a float tensor", lambda: lighting(textures=CUBES.int())),
    (r"Mesh.fromobj\(filename\) reads a file", lambda: nr.Mesh("a.obj", 4)),
]

VALUES = [
    # meshes
    (r"vertices must have shape \[B, V, 3\].*float32 \[2, 4\]", lambda: render(torch.zeros(2, 4))),
    (r"faces must have shape \[F, 3\]", lambda: render(faces=F[:, :2])),
    ("batch size of the vertices, 1", lambda: render(faces=FACES)),
    ("faces refer to vertex 42, but a mesh has 42 vertices", lambda: render(faces=F + 1)),
    ("faces refer to vertex -1", lambda: render(faces=F - 1)),
    ("faces for each.*got vertices of 3 meshes and faces of 2", lambda: lists(faces=[F, F])),
    ("at least one mesh.*got vertices of 0 meshes", lambda: lists(vertices=[], faces=[])),
    (
        r"must hold tensors \[V_b, 3\], it holds float32 \[1, 42",
        lambda: lists(vertices=[V[None]] * 3),
    ),
    ("one dtype and device", lambda: lists(vertices=[V, V.double(), V])),
    (r"must hold tensors \[F_b, 3\]", lambda: lists(faces=[F, F, F[None]])),
    ("but a mesh has 12 vertices", lambda: lists(faces=[F, F, F])),
    (r"subdivisions must lie in 0\.\.7", lambda: nmr.icosphere(12)),
    (r"3 of 120 edges do not: edge .* has 1.*fill_holes", lambda: nmr.edge_table(F[:-1])),
    (
        r"at most two faces, but .* has .*extra faces",
        lambda: nmr.edge_table(torch.cat([F, F]), open_mesh=True),
    ),
    (
        r"edge \(0, 0\) has 2 face\(s\); remove the extra",
        lambda: nmr.edge_table(torch.tensor([[0, 0, 1], [0, 0, 1]])),
    ),
    ("faces of one mesh", lambda: nmr.unique_edges(F[None])),
    # settings
    (r"a pair \(height, width\), got \(8, 9, 10\)", lambda: render(image_size=(8, 9, 10))),
    ("image_size must lie in 1..8192, got 8193", lambda: render(image_size=(8, 8193))),
    (
        r"near < far <= 8.507e\+37 \(for torch.float32\), got near=2.0, far=1.0",
        lambda: render(near=2.0, far=1.0),
    ),
    ("near and far must be finite", lambda: render(V.double(), far=math.inf)),
    ("eps must be positive in torch.float32", lambda: render(eps=1e-60)),
    ("gradient must be 'nmr' or 'local' or 'none', got ", lambda: render(gradient="soft")),
    (
        r"outputs must be .*\('rgb', .*got 'silhouette'; the silhouette is \"alpha\"",
        lambda: render(outputs="silhouette"),
    ),
    ("different names", lambda: render(outputs=("rgb", "rgb"))),
    (
        r"background must be a number, \[3\] or \[1, 3\], got .*\[2\]",
        lambda: rgb(None, background=[0.0, 1.0]),
    ),
    (
        r"got float32 \[1, 4, 4, 3\].*add \(1 - alpha\)",
        lambda: rgb(None, background=torch.rand(1, 4, 4, 3)),
    ),
    (
        "background_eps must be finite and 0 or more, got nan",
        lambda: nmr.render_soft(V, F, background_eps=math.nan),
    ),
    ("sigma must be positive", lambda: nmr.render_soft_silhouette(V, F, sigma=0.0)),
    ("dist_eps must lie between", lambda: nmr.render_soft_silhouette(V, F, dist_eps=0.5)),
    ("faces_per_pixel", lambda: fragments(faces_per_pixel=1025)),
    ("size must lie in 1", lambda: nmr.voxelize(V, F, 0)),
    (
        r"opacity must lie in \[0, 1\], got colours",
        lambda: nmr.render_transparent(V, F, LOOK, opacity=nmr.FaceColors(2 * V.new_ones(80, 1))),
    ),
    (
        r"fov must lie between 0 and 180 degrees, got \[0.0\]",
        lambda: cameras.from_pytorch3d_fov(I3, EYE, 0.0),
    ),
    # files
    (r"\. is not a regular file", lambda: nmr.load_gltf(".")),
    ("faces refer to vertex 42, but a mesh has 42 vertices", lambda: save(F + 1)),
    ("faces refer to vertex -1", lambda: save(F - 1)),
    ("vertices must be finite", lambda: save(F, V / 0)),
    ("uv_faces refer to row 41, but uv has 5 rows", lambda: save(F, colors=WITHOUT_ROWS)),
    (
        "definition must be 'kato18' or 'kato19', got 'kato20'",
        lambda: nmr.voxelize(V, F, definition="kato20"),
    ),
    # cameras
    (
        r"transform must return vertices float32 \[B, 42, 3\], .* got str",
        lambda: render(camera=of("x")),
    ),
    (r"transform must .*, got float32 \[1, 40, 3\]", lambda: render(camera=of(V[None, 2:]))),
    (r"eye must have shape \[3\] or \[B, 3\], got \[2\]", lambda: nmr.LookAt([0.0, 1.0])),
    ("must lie between 0 and 90 degrees, got 90.0", lambda: nmr.LookAt(EYE, half_fov_deg=90.0)),
    (r"must have shape \[\] or \[B\], got", lambda: nmr.LookAt(EYE, half_fov_deg=torch.ones(2, 1))),
    ("scale must lie between 0 and infinity, got -1.0", lambda: nmr.Orthographic(EYE, scale=-1.0)),
    (
        r"one length, got shapes \[2\], \[\], \[3\]",
        lambda: nmr.LookAt.from_angles([1, 2], 0, [0, 1, 2]),
    ),
    (r"got eye \[2, 3\], at \[3, 3\]", lambda: nmr.LookAt(torch.rand(2, 3), torch.rand(3, 3))),
    ("one pose each, or one for all", lambda: nmr.LookAt(torch.rand(3, 3)).transform(V, STARTS)),
    (r"must be packed \[N, 3\], got", lambda: LOOK.transform(V[None], STARTS)),
    (r"int64 tensor \[B \+ 1, 2\], got int32", lambda: LOOK.transform(V, STARTS.int())),
    (r"must ascend from \(0, 0\) to \(41, 0\)", lambda: LOOK.transform(V[1:], STARTS)),
    (
        r"K must have shape \[3, 3\] or \[B, 3, 3\]",
        lambda: nmr.Pinhole(I3[:2], I3, EYE, orig_size=2),
    ),
    (
        r"orig_size must be positive numbers \(height, width\)",
        lambda: nmr.Pinhole(I3, I3, EYE, orig_size=(0, 5)),
    ),
    (
        r"matrix must be a tensor of shape \[B, 3, 4\], got float32 \[42, 3\]",
        lambda: cameras.Projection(V, V),
    ),
    (
        "height and width must be positive",
        lambda: cameras.from_opencv(I3, I3, EYE, height=0, width=4),
    ),
    (
        r"got shape \[12\]; .* 12 and 14",
        lambda: cameras.from_opencv(I3, I3, EYE, [0.1] * 12, height=4, width=4),
    ),
    (
        "k4 of a fisheye, got shape",
        lambda: cameras.from_opencv(I3, I3, EYE, [0.1] * 5, height=4, width=4, fisheye=True),
    ),
    (
        "last row of K must be",
        lambda: cameras.from_opencv(entry(I3, 2, 0, 320.0), I3, EYE, height=4, width=4),
    ),
    ("shininess must be 0 or more", lambda: nmr.Lights(specular=0.5, shininess=-3.0)),
    ("directional must be finite", lambda: nmr.Lights(0.5, math.nan)),
    ("no orthographic camera", lambda: cameras.to_opencv(nmr.Orthographic(EYE), height=4, width=4)),
    (
        r"last row of view must be \(0, 0, 0, 1\)",
        lambda: cameras.from_opengl(entry(I4, 3, 0), FRUSTUM),
    ),
    ("last row of projection must be", lambda: cameras.from_opengl(I4, FRUSTUM.T)),
    (r"projection\[0:2, 3\] must be 0", lambda: cameras.from_opengl(I4, entry(FRUSTUM, 0, 3))),
    (r"projection\[0:2, 2\] must be 0", lambda: cameras.from_opengl(I4, entry(I4, 1, 2))),
    ("0 <= near < far, got near=1.0, far=1.0", lambda: cameras.to_opengl(LOOK, near=1, far=1)),
    ("OpenGL has no lens distortion", lambda: cameras.to_opengl(PINHOLE, near=1, far=2)),
    (
        r"focal_length must be a number .*, got \[2, 3\]",
        lambda: cameras.from_pytorch3d(I3, EYE, torch.ones(2, 3)),
    ),
    (r"image_size=\(height, width\) is needed", lambda: cameras.to_pytorch3d(LOOK, in_ndc=False)),
    ("cannot express the skew", lambda: cameras.to_pytorch3d(SKEWED)),
    # colours and light
    (r"colors.sample must return a tensor \[1, 8, 8, 'C'\], got str", lambda: rgb(of("red"))),
    (r"3 channels \(or 1\), got 2", lambda: rgb(of(torch.rand(1, 8, 8, 2)), lights=nmr.Lights())),
    (r"\[V, C\] or \[B, V, C\].*got float32 \[4\]", lambda: nmr.VertexColors(torch.zeros(4))),
    (r"the list holds float32 \[42, 3\] and float32 \[42, 2\]", lambda: nmr.VertexColors([V, UV])),
    ("at least one channel", lambda: nmr.VertexColors([V[:, :0]])),
    (r"cubes .* of one size ts >= 2", lambda: nmr.TextureCubes(torch.zeros(2, 4, 4, 2, 3))),
    ("image must have texels", lambda: nmr.UVTexture(IMAGE[:0], UV)),
    (r"uv must have shape \[T, 2\]", lambda: nmr.UVTexture(IMAGE, V)),
    ("wrap must be .*got 'tile'", lambda: nmr.UVTexture(IMAGE, UV, wrap="tile")),
    ("filter must be .*, got 2", lambda: nmr.UVTexture(IMAGE, UV, filter=2)),
    ("colors must have one row per vertex .42., got", lambda: rgb(nmr.VertexColors(V[:5]))),
    (
        "colors must have batch size 1 or 2",
        lambda: rgb(nmr.VertexColors(V.expand(3, -1, -1)), BATCH),
    ),
    ("colors must have one row per face .80", lambda: rgb(nmr.FaceColors(V))),
    ("image must be .* got 3", lambda: rgb(nmr.UVTexture(IMAGE.expand(3, -1, -1, -1), UV))),
    ("uv_faces must have one row per face .80", lambda: rgb(nmr.UVTexture(IMAGE, UV, F[:3]))),
    ("uv_faces refer to row 41, but uv has 5 rows", lambda: nmr.UVTexture(IMAGE, UV[:5], F)),
    ("uv_faces is -1 .*; nmr.Materials draws", lambda: nmr.UVTexture(IMAGE, UV, F - 1)),
    (
        "colors must have one size, as the meshes do",
        lambda: rgb(nmr.VertexColors([V, V[:5]]), BATCH),
    ),
    ("colors must be a list of 3 tensors.*got float32", lambda: rgb(nmr.VertexColors(V), **LISTS)),
    ("of 3 tensors.*got 2", lambda: rgb(nmr.VertexColors([V, V]), **LISTS)),
    (
        r"one row per vertex .*\[42, 12, 42\].* got \[42, 42, 42\]",
        lambda: rgb(nmr.VertexColors([V] * 3), **LISTS),
    ),
    (
        r"uv_faces .* \[80, 5, 80\].* got",
        lambda: rgb(nmr.UVTexture(IMAGE, [UV] * 3, [F] * 3), **LISTS),
    ),
    (
        r"direction must have shape \[3\].*got float64 \[2\]",
        lambda: nmr.Lights(direction=(0.0, 1.0)),
    ),
    (
        "same number of lights",
        lambda: nmr.Lights(directional=[0.5, 0.5], direction=torch.rand(3, 3)),
    ),
    (
        "^ambient .* 3 images, but 1 are drawn",
        lambda: rgb(None, lights=nmr.Lights(ambient=torch.rand(3))),
    ),
    (r"attribute eye, \[3\]", lambda: render(camera=Shifted(), lights=nmr.Lights(specular=0.5))),
    (r"image must have shape \[1, 4, 4, 'C'\]", lambda: fragments().resolve(torch.zeros(1, 4, 4))),
    (r"layer\(0\)", lambda: fragments(faces_per_pixel=2).layer(1).resolve(torch.zeros(1, 4, 4, 3))),
    (r"harmonics must have shape \[9, 3\]", lambda: nmr.Lights(harmonics=torch.rand(3, 9))),
    (
        "^harmonics .* 3 images, but 1",
        lambda: rgb(None, lights=nmr.Lights(harmonics=torch.rand(3, 9, 3))),
    ),
    ("normals must have 3 coordinates", lambda: nmr.Lights(normals=V[:, :2])),
    (
        r"normals.sample must return .* got .* 1\]",
        lambda: rgb(None, lights=nmr.Lights(normals=nmr.VertexColors(V[:, :1]))),
    ),
    ("image of normals must have 3 channels", lambda: nmr.NormalMap(IMAGE[..., :2], UV)),
    ("space must be 'world' or 'camera'", lambda: fragments().normals(space="view")),
    (
        "camera space need .*, not Shifted",
        lambda: nmr.render_normals(V, F, Shifted(), space="camera", image_size=4),
    ),
    ("blur_radius must be 0 or more", lambda: fragments(blur_radius=-1.0)),
    (
        r"sigma must be a number or a tensor \[\], got",
        lambda: nmr.render_soft(V, F, sigma=torch.ones(2)),
    ),
    (r"opacity must lie in \[0, 1\], got 2", lambda: nmr.render_transparent(V, F, opacity=2.0)),
    (
        r"opacity must be a number, \[\] or \[1\]",
        lambda: nmr.render_transparent(V, F, opacity=torch.rand(3)),
    ),
    (
        "opacity must have one channel",
        lambda: nmr.render_transparent(V, F, opacity=nmr.VertexColors(V)),
    ),
    # losses and metrics
    (
        r"same shape \[B, \.\.\.\] with B >= 1, got float32",
        lambda: losses.soft_iou_loss(ONES, ONES[:, :2]),
    ),
    (
        "values from 0 to 255; divide a mask",
        lambda: losses.soft_iou_loss(ONES, torch.tensor([[0, 255, 9]])),
    ),
    (
        r"edges must be .*made by nmr.edge_table.*\[120, 3\]",
        lambda: losses.smoothness_loss(V, TABLE[:, :3]),
    ),
    (
        r"edges .*nmr.unique_edges\(faces\) or .*int64 \[120, 3\]",
        lambda: losses.laplacian_loss(V, TABLE[:, :3]),
    ),
    ("edges refer to vertex 42, but a mesh has 42", lambda: losses.laplacian_loss(V, TABLE + 1)),
    ("at least one mesh", lambda: losses.volume_loss(BATCH[:0], F)),
    ("at least one edge", lambda: losses.normal_consistency_loss(V, TABLE[:0])),
    ("finite length >= 0, got -1; leave it out", lambda: losses.edge_length_loss(V, TABLE, -1)),
    ("finite area above 0, mesh 1", lambda: metrics.sample_surface(torch.stack([V, 0 * V]), F, 9)),
    ("count must lie in", lambda: metrics.sample_surface(V, F, 0)),
    ("form must be 'squared' or 'l1', got 'l2'", lambda: metrics.chamfer_distance(V, V, "l2")),
    (
        r"at least one point each, got float32 \[42, 3\] and",
        lambda: metrics.chamfer_distance(V, V[:0]),
    ),
    ("must be finite", lambda: metrics.f_score(V, V * math.nan, 0.1)),
    ("threshold must be a distance above 0", lambda: metrics.f_score(V, V, 0)),
    (r"same shape \[B, \.\.\.\]", lambda: metrics.voxel_precision_recall(GRID, GRID[:1])),
    # neural_renderer
    (r"use vertices\[None\]", lambda: renderer().render_silhouettes(V, FACES)),
    ("with fractions", lambda: nr.vertices_to_faces(BATCH, FACES + 0.5)),
    ("faces refer to vertex 42", lambda: nr.vertices_to_faces(BATCH, FACES + 1)),
    ("RGB images need textures", lambda: renderer()(BATCH, FACES)),
    (
        "mode must be None, 'rgb', .* got 'normals'",
        lambda: renderer()(BATCH, FACES, mode="normals"),
    ),
    ("K, R and t; missing: R, t;", lambda: nr.Renderer(K=I3).render_depth(BATCH, FACES)),
    ("camera_mode must be", lambda: renderer(camera_mode="orthographic")),
    ("faces must be corners", lambda: raster(faces=CORNERS[0])),
    ("textures must have the batch size", lambda: raster(textures=CUBES[:, :9])),
    ("textures must have shape", lambda: raster(textures=CUBES[..., 0])),
    (r"\[3\] or \[2, 3\], got \[4, 3\]", lambda: lighting(color_directional=torch.rand(4, 3))),
    ("must end in .obj", lambda: nr.save_obj("a.ply", V, F)),
    (r"vertices must be those of one mesh.*take \[0\]", lambda: nr.save_obj("a.obj", BATCH, F)),
    ("textures must be those of one mesh", lambda: nr.save_obj("a.obj", V, F, CUBES)),
    ("one per face, 80", lambda: nr.save_obj("a.obj", V, F, CUBES[0, :3])),
    ("texture_size_out must be at least 2", lambda: create_texture_image(CUBES[0], 1)),
    (
        "texture_wrapping must be one of REPEAT",
        lambda: nr.load_obj("a.obj", texture_wrapping="WRAP"),
    ),
]


@pytest.mark.parametrize("words, call", TYPES)
def test_type_errors(words, call):
    with pytest.raises(TypeError, match=words):
        call()


@pytest.mark.parametrize("words, call", VALUES)
def test_value_errors(words, call):
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize("layers, k", [(1, 0), (2, 2)])
def test_layers_that_there_are_not(layers, k):
    with pytest.raises(IndexError, match="faces_per_pixel"):
        fragments(faces_per_pixel=layers).layer(k)


def test_light_for_other_images():
    drawing = renderer()
    drawing.light_direction, drawing.eye = torch.rand(2, 3), torch.rand(3, 3)
    with pytest.raises(ValueError, match="light for 2 images, but 3 are drawn"):
        drawing(BATCH[:1], FACES[:1], CUBES[:1])
    drawing.eye = None
    with pytest.raises(ValueError, match=r"camera_mode='look_at' needs an eye; set renderer\.eye"):
        drawing.render_silhouettes(BATCH, FACES)


@pytest.mark.parametrize(
    ("words", "call"),
    [
        (
            "eye of a LookAt is not finite: its image is empty",
            lambda: nmr.LookAt([0.0, math.nan, 1.0]),
        ),
        (
            "t of a Pinhole is not finite",
            lambda: nmr.Pinhole(I3, I3, [0.0, 0.0, math.inf], orig_size=8),
        ),
        ("or at its own place", lambda: nmr.LookAt([[0.0, 1.0, 2.0], [0.0, 0.0, 0.0]])),
        ("up vector", lambda: nmr.LookAt([0.0, 3.0, 0.0])),
        ("up vector", lambda: nmr.LookAt.from_angles(3.0, 90.0, 0.0)),
        ("up vector", lambda: nr.look_at(V[None], [0.0, 3.0, 0.0])),
        (
            r"if it is \[C, H, W\], give image.permute",
            lambda: nmr.UVTexture(torch.rand(3, 8, 8), UV),
        ),
    ],
)
def test_warnings(words, call):
    with pytest.warns(UserWarning, match=words) as said:
        call()
    assert said[0].filename == __file__
