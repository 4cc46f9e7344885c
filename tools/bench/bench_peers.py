"""deodr for the same work: a 2.5-D renderer with derivatives, one mesh at a time on one thread."""

from __future__ import annotations

import importlib.util
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context

import numpy as np
import torch
from bench_work import Program, Timing, Workload
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
