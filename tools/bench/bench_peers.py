"""Other programs for the same work: deodr."""

from __future__ import annotations

import importlib.util
import multiprocessing
import time

import numpy as np
import torch
from bench_work import Program, Timing, Workload
from torch import Tensor

import nmr

FAR = 100.0  # nmr.render_depth's default

# --- deodr: a 2.5-D renderer with derivatives, one mesh at a time on one thread


def has_deodr() -> bool:
    return importlib.util.find_spec("deodr") is not None


def deodr_mesh(faces: Tensor):
    from deodr.triangulated_mesh import TriMeshAdjacencies

    return TriMeshAdjacencies(
        faces.numpy().astype(np.uint32), clockwise=True
    )  # on the screen: the world is left-handed


class DeodrImages(torch.autograd.Function):
    """Vertices in renderer space to images ``[B, S, S]``: silhouettes, or depths as a colour of the vertices."""

    @staticmethod
    def forward(ctx, vertices: Tensor, size: int, mesh, output: str) -> Tensor:
        from deodr.differentiable_renderer import Scene2D

        points, ctx.size, ctx.output, ctx.scenes, images = vertices.detach().double().numpy(), size, output, [], []
        num_vertices, num_faces = points.shape[1], mesh.faces.shape[0]
        zeros, no_faces = np.zeros((num_vertices, 2)), np.zeros(num_faces, dtype=bool)
        for xyz in points:
            ij = np.stack([(xyz[:, 0] + 1) * size / 2 - 0.5, (1 - xyz[:, 1]) * size / 2 - 0.5], axis=1)
            scene = Scene2D(
                faces=mesh.faces,
                faces_uv=mesh.faces,
                ij=ij,
                depths=xyz[:, 2].copy(),
                textured=no_faces,
                uv=zeros,
                shade=np.zeros(num_vertices),
                colors=np.ones((num_vertices, 1)) if output == "alpha" else xyz[:, 2:].copy(),
                shaded=no_faces,
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
            result[b, :, 0] = scene.ij_b[:, 0] * ctx.size / 2
            result[b, :, 1] = -scene.ij_b[:, 1] * ctx.size / 2
            if ctx.output == "depth":
                result[b, :, 2] = scene.colors_b[:, 0]
        return torch.from_numpy(result).to(grad), None, None, None


def run_deodr(workload: Workload, targets: tuple[Tensor, ...], mesh) -> Timing:
    """At the size of the image, which is less than we draw: ours has the inner resolution of its anti-aliasing."""
    (output,) = workload.outputs
    leaf = workload.vertices.clone().requires_grad_()
    start = time.perf_counter()
    image = DeodrImages.apply(workload.camera.transform(leaf), workload.size, mesh, output)
    forward = time.perf_counter()
    workload.loss((image,), targets).backward()
    return forward - start, time.perf_counter() - start


def deodr_process(connection, workload: Workload, targets: tuple[Tensor, ...]) -> None:
    """Serves a part of the batch: renders whenever it gets True, ends when it gets False."""
    torch.set_num_threads(1)
    mesh = deodr_mesh(workload.faces)
    while connection.recv():
        connection.send(run_deodr(workload, targets, mesh))


class DeodrProcesses:
    """deodr with the batch shared among processes; the slowest one counts."""

    def __init__(self, workload: Workload, targets: tuple[Tensor, ...], count: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.connections, self.processes = [], []
        for which in range(count):
            ours, theirs = context.Pipe()
            arguments = (theirs, workload.part(which, count), tuple(t[which::count] for t in targets))
            self.processes.append(context.Process(target=deodr_process, args=arguments, daemon=True))
            self.processes[-1].start()
            self.connections.append(ours)

    def __call__(self) -> Timing:
        for connection in self.connections:
            connection.send(True)
        results = [connection.recv() for connection in self.connections]
        return max(r[0] for r in results), max(r[1] for r in results)

    def close(self) -> None:
        for connection, process in zip(self.connections, self.processes, strict=True):
            connection.send(False)
            process.join()


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
    workload: Workload, targets: tuple[Tensor, ...], num_processes: int
) -> tuple[dict[str, Program], DeodrProcesses | None]:
    """deodr in one process, and in several."""
    mesh = deodr_mesh(workload.faces)
    print(f"images of nmr and deodr agree {check_same_image(workload, mesh)}")
    programs: dict[str, Program] = {"deodr, 1 process": lambda: run_deodr(workload, targets, mesh)}
    if not 1 < num_processes <= len(workload.vertices):
        return programs, None
    processes = DeodrProcesses(workload, targets, num_processes)
    return programs | {f"deodr, {num_processes} processes": processes}, processes
