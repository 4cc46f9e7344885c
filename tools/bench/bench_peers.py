"""Other renderers for the same work: deodr, PyTorch3D, Open3D and OSMesa, each if it is installed.

deodr is a 2.5-D renderer with derivatives, for one mesh at a time on one thread. OSMesa is called by pyrender.
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
    return importlib.util.find_spec("deodr") is not None


def deodr_mesh(faces: Tensor):
    """deodr's mesh, clockwise on the screen: the world is left-handed."""
    from deodr.triangulated_mesh import TriMeshAdjacencies

    return TriMeshAdjacencies(faces.numpy().astype(np.uint32), clockwise=True)


class DeodrImages(torch.autograd.Function):
    """Vertices in renderer space to images ``[B, S, S]``: silhouettes, or depths as a colour of the vertices."""

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
    """At the size of the image, which is less than we draw: ours has the inner resolution of its anti-aliasing."""
    (output,), mesh = workload.outputs, deodr_mesh(workload.faces)
    leaf = workload.vertices.clone().requires_grad_()
    start = time.perf_counter()
    image = DeodrImages.apply(workload.camera.transform(leaf), workload.size, mesh, output)
    forward = time.perf_counter()
    workload.loss((image,), targets).backward()
    return forward - start, time.perf_counter() - start


def check_same_image(workload: Workload, mesh) -> str:
    """Both programs must draw the same thing, or the comparison means nothing."""
    (output,), size = workload.outputs, workload.size
    with torch.no_grad():
        vertices = workload.camera.transform(workload.vertices)
        theirs = DeodrImages.apply(vertices, size, mesh, output)
        if output == "alpha":
            ours = nmr.render_silhouette(vertices, workload.faces, image_size=size)
            overlap = 1 - float(nmr.losses.soft_iou_loss(ours, theirs))
            agree, how = overlap >= 0.9, f"to a soft IoU of {overlap:.4f}"
        else:
            ours = nmr.render_depth(vertices, workload.faces, image_size=size, anti_aliasing=False)
            both = (ours < FAR) & (theirs < ours.where(ours < FAR, ours.new_zeros(())).max())
            difference = float((ours - theirs)[both].abs().median())
            agree, how = difference < 1e-3, f"to {difference:.1e} in depth (median over covered pixels)"
    if not agree:
        raise SystemExit(f"nmr and deodr draw different images (they agree {how}): the comparison is invalid")
    return how


def deodr_programs(
    workload: Workload, targets: tuple[Tensor, ...], processes: int, stack: ExitStack
) -> dict[str, Program]:
    """deodr in one process, and in several that share the batch, if it is large enough; they end with `stack`."""
    print(f"images of nmr and deodr agree {check_same_image(workload, deodr_mesh(workload.faces))}")
    programs: dict[str, Program] = {"deodr, 1 process": lambda: run_deodr(workload, targets)}
    if not 1 < processes <= len(workload.vertices):
        return programs
    pool = stack.enter_context(ProcessPoolExecutor(processes, get_context("spawn"), torch.set_num_threads, (1,)))
    parts = [slice(which, None, processes) for which in range(processes)]
    tasks = [(workload.part(some), tuple(target[some] for target in targets)) for some in parts]

    def run_parts() -> Timing:
        times = list(pool.map(run_deodr, *zip(*tasks, strict=True)))
        return max(forward for forward, _ in times), max(total for _, total in times)  # the slowest counts

    return programs | {f"deodr, {processes} processes": run_parts}


@dataclass(frozen=True)
class Comparison:
    """One row of the table: ``ours`` and ``theirs`` draw images of the same vertices ``[1, V, 3]``."""

    title: str
    peer: str
    vertices: Tensor
    ours: Callable[[Tensor], Tensor]
    theirs: Callable[[Tensor], Tensor]
    gradient: bool = True

    def run(self, draw: Callable[[Tensor], Tensor]) -> Timing:
        leaf = self.vertices.clone().requires_grad_(self.gradient)
        start = time.perf_counter()
        image = draw(leaf)
        forward = time.perf_counter()
        if self.gradient:
            (image - 0.5).square().mean().backward()
        return forward - start, time.perf_counter() - start

    def check(self) -> None:
        with torch.no_grad():
            ours, theirs = self.ours(self.vertices), self.theirs(self.vertices)
        background = FAR if ours.max() > 1 else 0.0
        wrong = (ours - theirs)[(ours != background) | (theirs != background)].abs().median()
        if not wrong < 5e-3:  # pyrender's depth is that of a sample beside the centre
            raise SystemExit(f"{self.title}: nmr and {self.peer} draw different images (median {float(wrong):.1e})")


def against_deodr(work: Workload) -> Comparison:
    mesh, place = deodr_mesh(work.faces), work.camera.transform
    return Comparison(
        f"silhouette with gradient, {work.faces_and_size}",
        "deodr",
        work.vertices,
        lambda v: nmr.render_silhouette(place(v), work.faces, image_size=work.size, anti_aliasing=False),
        lambda v: DeodrImages.apply(place(v), work.size, mesh, "alpha"),
    )


def against_pytorch3d(work: Workload) -> Comparison:
    """The vertices are in renderer space; PyTorch3D's x points to the left."""
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
    how = dict(image_size=work.size, anti_aliasing=False)
    title = f"depth, {work.faces_and_size}"
    ours = lambda v: nmr.render_depth(v, work.faces, work.camera, **how)  # noqa: E731
    return Comparison(title, peer, work.vertices, ours, lambda v: theirs(), gradient=False)


def _in_camera(work: Workload) -> tuple[np.ndarray, float]:
    """Vertices in camera axes (x right, y up, z away), and the tangent of half the field of view."""
    tangent = math.tan(math.radians(float(work.camera.half_fov_deg)))
    points = work.camera.transform(work.vertices)[0].double()
    points[:, :2] *= points[:, 2:] * tangent
    return points.float().numpy(), tangent


def against_open3d(work: Workload) -> Comparison:
    """Open3D's ray caster; the mesh and its tree of boxes are kept."""
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
    """OSMesa behind pyrender (or Mesa's EGL, with PYOPENGL_PLATFORM=egl); the mesh is kept."""
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


# Each with the subdivisions of its sphere and the size of its images.
PEERS = ((against_deodr, 3, 256), (against_pytorch3d, 3, 64), (against_open3d, 4, 512), (against_osmesa, 4, 512))


def print_table(repeats: int, size: int | None = None) -> None:
    """A table in Markdown of those peers that are installed, one thread each."""
    torch.set_num_threads(1)
    print("| one thread, milliseconds | peer | nmr | |\n|---|---|---|---|")
    for against, subdivisions, pixels in PEERS:
        try:
            row = against(deformed_spheres(1, subdivisions, size or pixels, anti_aliasing=False))
        except Exception as error:  # libraries behind bindings fail in their own ways
            print(f"| ({against.__name__}: {type(error).__name__}, {str(error).splitlines()[0]}) | | | |")
            continue
        row.check()
        times = measure({"theirs": partial(row.run, row.theirs), "ours": partial(row.run, row.ours)}, repeats)
        theirs, ours = (times[name][1] for name in ("theirs", "ours"))
        print(f"| {row.title} | {row.peer} {theirs:.1f} | {ours:.1f} | {theirs / ours:.1f} times |", flush=True)
