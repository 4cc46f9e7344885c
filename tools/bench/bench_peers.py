"""The same work for other renderers: deodr, PyTorch3D, Open3D and Mesa (through pyrender), each if it is installed.

deodr is a differentiable 2.5-D renderer, which draws one mesh at a time on one thread.
"""

from __future__ import annotations

import importlib.util
import math
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np
import torch
from bench_work import Program, Timing, Workload, deformed_spheres, measure
from torch import Tensor

import nmr

FAR = 100.0  # nmr.render_depth's default


def has_deodr() -> bool:
    """Whether deodr is installed."""
    return importlib.util.find_spec("deodr") is not None


def deodr_mesh(faces: Tensor):
    """The faces for deodr, clockwise on the screen because nmr's world is left-handed."""
    from deodr.triangulated_mesh import TriMeshAdjacencies

    return TriMeshAdjacencies(faces.numpy().astype(np.uint32), clockwise=True)


class DeodrImages(torch.autograd.Function):
    """Images [B, S, S] of vertices in renderer space by deodr: silhouettes, or depths as colours of the vertices."""

    @staticmethod
    def forward(ctx, vertices: Tensor, size: int, mesh, output: str) -> Tensor:
        from deodr.differentiable_renderer import Scene2D

        points, ctx.size, ctx.output, ctx.scenes, images = vertices.detach().double().numpy(), size, output, [], []
        num_vertices, num_faces = points.shape[1], mesh.faces.shape[0]
        for xyz in points:
            ij = np.stack([(xyz[:, 0] + 1) * size / 2 - 0.5, (1 - xyz[:, 1]) * size / 2 - 0.5], axis=1)
            scene = Scene2D(
                faces=mesh.faces,
                faces_uv=mesh.faces,
                ij=ij,
                depths=xyz[:, 2].copy(),
                textured=np.zeros(num_faces, dtype=bool),
                uv=np.zeros((num_vertices, 2)),
                shade=np.zeros(num_vertices),
                colors=np.ones((num_vertices, 1)) if output == "alpha" else xyz[:, 2:].copy(),
                shaded=np.zeros(num_faces, dtype=bool),
                edgeflags=mesh.edge_on_silhouette(ij),
                height=size,
                width=size,
                nb_colors=1,
                texture=np.zeros((0, 0, 1)),
                background_color=np.zeros(1) if output == "alpha" else np.full(1, FAR),
                clockwise=mesh.clockwise,
                backface_culling=True,
            )
            images.append(scene.render()[0][..., 0])
            ctx.scenes.append(scene)
        return torch.from_numpy(np.stack(images)).to(vertices)

    @staticmethod
    def backward(ctx, grad: Tensor):
        result = np.zeros((len(ctx.scenes), ctx.scenes[0].ij.shape[0], 3))
        for b, scene in enumerate(ctx.scenes):
            scene.clear_gradients()
            scene.render_backward(grad[b].double().numpy()[..., None].copy())
            result[b, :, :2] = scene.ij_b * (ctx.size / 2, -ctx.size / 2)
            if ctx.output == "depth":
                result[b, :, 2] = scene.colors_b[:, 0]
        return torch.from_numpy(result).to(grad), None, None, None


def run_deodr(workload: Workload, targets: tuple[Tensor, ...]) -> Timing:
    """Time deodr on all meshes, one after the other. It draws S x S pixels; nmr draws 2S x 2S to average them."""
    (output,), mesh = workload.outputs, deodr_mesh(workload.faces)
    leaf = workload.vertices.clone().requires_grad_()
    start = time.perf_counter()
    image = DeodrImages.apply(workload.camera.transform(leaf), workload.size, mesh, output)
    forward = time.perf_counter()
    workload.loss((image,), targets).backward()
    return forward - start, time.perf_counter() - start


def check_same(name: str, ours: Tensor, theirs: Tensor) -> None:
    """Stop if the images differ, as the comparison would mean nothing. Edges may: the median over the object counts."""
    background = FAR if ours.max() > 1 else 0.0
    difference = (ours - theirs)[(ours != background) | (theirs != background)].abs().median()
    if not difference < 5e-3:  # pyrender's depth is that of a sample beside the centre
        raise SystemExit(f"nmr and {name} draw different images (median difference {float(difference):.1e})")


def deodr_programs(
    workload: Workload, targets: tuple[Tensor, ...], processes: int, stack: ExitStack
) -> dict[str, Program]:
    """deodr in one process, and in several that share the batch if it is large enough. `stack` ends the processes."""
    with torch.no_grad():
        vertices, mesh = workload.camera.transform(workload.vertices), deodr_mesh(workload.faces)
        theirs = DeodrImages.apply(vertices, workload.size, mesh, workload.outputs[0])
        check_same("deodr", workload.images(workload.vertices)[0], theirs)
    programs: dict[str, Program] = {"deodr, 1 process": lambda: run_deodr(workload, targets)}
    if not 1 < processes <= len(workload.vertices):
        return programs
    pool = stack.enter_context(ProcessPoolExecutor(processes, get_context("spawn"), torch.set_num_threads, (1,)))
    parts = [slice(which, None, processes) for which in range(processes)]
    tasks = [(workload.part(some), tuple(target[some] for target in targets)) for some in parts]

    def run_parts() -> Timing:
        times = list(pool.map(run_deodr, *zip(*tasks, strict=True)))
        return tuple(map(max, zip(*times, strict=True)))  # the slowest process counts

    return programs | {f"deodr, {processes} processes": run_parts}


@dataclass(frozen=True)
class Comparison:
    """One row of the table: `ours` and `theirs` draw images of the same vertices [1, V, 3]."""

    title: str
    peer: str
    vertices: Tensor
    ours: Callable[[Tensor], Tensor]
    theirs: Callable[[Tensor], Tensor]
    gradient: bool = True

    def time(self, draw: Callable[[Tensor], Tensor]) -> Timing:
        leaf = self.vertices.clone().requires_grad_(self.gradient)
        start = time.perf_counter()
        image = draw(leaf)
        forward = time.perf_counter()
        if self.gradient:
            (image - 0.5).square().mean().backward()
        return forward - start, time.perf_counter() - start

    def check(self) -> None:
        with torch.no_grad():
            check_same(f"{self.peer} ({self.title})", self.ours(self.vertices), self.theirs(self.vertices))


def against_deodr(work: Workload) -> Comparison:
    mesh, transform = deodr_mesh(work.faces), work.camera.transform
    return Comparison(
        f"silhouette with gradient, {work.faces_and_size}",
        "deodr",
        work.vertices,
        lambda v: nmr.render_silhouette(transform(v), work.faces, image_size=work.size, anti_aliasing=False),
        lambda v: DeodrImages.apply(transform(v), work.size, mesh, "alpha"),
    )


def against_pytorch3d(work: Workload) -> Comparison:
    """PyTorch3D's soft silhouettes. Vertices are in renderer space; PyTorch3D's x axis points to the left."""
    from pytorch3d.renderer.mesh.rasterize_meshes import rasterize_meshes
    from pytorch3d.structures import Meshes

    sigma, faces_per_pixel = 1e-4, 50
    blur, flip = math.log(1 / 1e-4 - 1) * sigma, torch.tensor([-1.0, 1.0, 1.0])

    def theirs(vertices: Tensor) -> Tensor:
        meshes = Meshes(vertices * flip, work.faces.expand(len(vertices), -1, -1))
        found, _, _, distances = rasterize_meshes(meshes, work.size, blur, faces_per_pixel)
        return 1 - (1 - torch.sigmoid(-distances / sigma) * (found >= 0)).prod(-1)

    return Comparison(
        f"soft silhouette with gradient, {work.faces_and_size}",
        "PyTorch3D",
        work.camera.transform(work.vertices),
        lambda v: nmr.render_soft_silhouette(v, work.faces, sigma=sigma, image_size=work.size),
        theirs,
    )


def _depth(work: Workload, peer: str, theirs: Callable[[], Tensor]) -> Comparison:
    def ours(vertices: Tensor) -> Tensor:
        return nmr.render_depth(vertices, work.faces, work.camera, image_size=work.size, anti_aliasing=False)

    title = f"depth, {work.faces_and_size}"
    return Comparison(title, peer, work.vertices, ours, lambda vertices: theirs(), gradient=False)


def _in_camera(work: Workload) -> tuple[np.ndarray, float]:
    """Vertices in camera axes (x right, y up, z away), and the tangent of half the field of view."""
    tangent = math.tan(math.radians(float(work.camera.half_fov_deg)))
    points = work.camera.transform(work.vertices)[0].double()
    points[:, :2] *= points[:, 2:] * tangent
    return points.float().numpy(), tangent


def against_open3d(work: Workload) -> Comparison:
    """Open3D's ray caster. Its bounding boxes are built before the measurement."""
    import open3d

    points, tangent = _in_camera(work)
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(points, work.faces.numpy().astype(np.uint32))
    centres = ((np.arange(work.size) + 0.5) * 2 / work.size - 1) * tangent
    rays = np.zeros((work.size, work.size, 6), dtype=np.float32)
    rays[..., 3], rays[..., 4], rays[..., 5] = centres[None], -centres[:, None], 1

    def theirs() -> Tensor:
        hits = scene.cast_rays(open3d.core.Tensor(rays), nthreads=torch.get_num_threads())["t_hit"]
        return torch.from_numpy(hits.numpy()).clamp(max=FAR)[None]

    return _depth(work, "Open3D", theirs)


def against_osmesa(work: Workload) -> Comparison:
    """Mesa behind pyrender: OSMesa, or EGL with PYOPENGL_PLATFORM=egl. The mesh is uploaded before the measurement."""
    os.environ.setdefault("PYOPENGL_PLATFORM", "osmesa")
    import pyrender

    points, tangent = _in_camera(work)
    mesh = pyrender.Primitive(positions=points * np.float32([1, 1, -1]), indices=work.faces.flip(1).numpy())
    scene = pyrender.Scene()
    scene.add(pyrender.Mesh([mesh]))
    scene.add(pyrender.PerspectiveCamera(2 * math.atan(tangent), znear=0.1, zfar=FAR, aspectRatio=1.0))
    renderer = pyrender.OffscreenRenderer(work.size, work.size)

    def theirs() -> Tensor:
        depth = torch.from_numpy(renderer.render(scene, flags=pyrender.RenderFlags.DEPTH_ONLY).copy())
        return torch.where(depth > 0, depth, FAR)[None]

    return _depth(work, "Mesa", theirs)


# Each peer with the subdivisions of its sphere and the size of its images.
PEERS = ((against_deodr, 3, 256), (against_pytorch3d, 3, 64), (against_open3d, 4, 512), (against_osmesa, 4, 512))


def print_table(repeats: int, size: int | None = None) -> None:
    """Print a table in Markdown: a row per installed peer, one thread each."""
    torch.set_num_threads(1)
    print("| one thread, milliseconds | peer | nmr | |\n|---|---|---|---|")
    for against, subdivisions, pixels in PEERS:
        try:
            row = against(deformed_spheres(1, subdivisions, size or pixels, anti_aliasing=False))
        except Exception as error:  # libraries behind bindings fail in their own ways
            print(f"| ({against.__name__}: {type(error).__name__}, {str(error).splitlines()[0]}) | | | |")
            continue
        row.check()
        times = measure({"theirs": partial(row.time, row.theirs), "ours": partial(row.time, row.ours)}, repeats)
        theirs, ours = (times[name][1] for name in ("theirs", "ours"))
        print(f"| {row.title} | {row.peer} {theirs:.1f} | {ours:.1f} | {theirs / ours:.1f} times |", flush=True)
