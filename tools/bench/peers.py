"""Measure nmr beside deodr, PyTorch3D, Open3D and Mesa (through pyrender), each if it is installed, one thread each.

Prints the machine and a table in Markdown: medians in milliseconds, with the backward pass for the
two renderers that have one, and how each is installed. Renderers for GPUs are quoted. Stops if
images differ. PYOPENGL_PLATFORM=egl takes EGL instead of OSMesa.
"""

import math
import os
import platform
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import tyro
from bench import FAR, Work, check_same, deodr, spheres, time_by_turns, time_passes
from torch import Tensor

import nmr
from learn3d.device import keep_freed_memory

Draw = Callable[[Tensor], Tensor]  # images [1, S, S] of vertices [1, V, 3] in world space


def pytorch3d_soft(work: Work) -> tuple[Draw, Draw]:
    """Soft silhouettes by nmr and by PyTorch3D, whose x axis points to the left."""
    from pytorch3d.renderer.mesh.rasterize_meshes import rasterize_meshes
    from pytorch3d.structures import Meshes

    sigma, faces_per_pixel = 1e-4, 50
    blur, flip = math.log(1 / 1e-4 - 1) * sigma, torch.tensor([-1.0, 1.0, 1.0])

    def ours(vertices: Tensor) -> Tensor:
        return nmr.render_soft_silhouette(
            vertices, work.faces, work.camera, sigma=sigma, image_size=work.size
        )

    def theirs(vertices: Tensor) -> Tensor:
        meshes = Meshes(
            work.camera.transform(vertices) * flip, work.faces.expand(len(vertices), -1, -1)
        )
        found, _, _, distances = rasterize_meshes(meshes, work.size, blur, faces_per_pixel)
        return 1 - (1 - torch.sigmoid(-distances / sigma) * (found >= 0)).prod(-1)

    return ours, theirs


def in_camera(work: Work) -> tuple[np.ndarray, float]:
    """Vertices in camera axes (x right, y up, z away), and the tangent of half the field of view."""
    tangent = math.tan(math.radians(float(work.camera.half_fov_deg)))
    points = work.camera.transform(work.vertices)[0].double()
    points[:, :2] *= points[:, 2:] * tangent
    return points.float().numpy(), tangent


def open3d_rays(work: Work) -> tuple[Draw, Draw]:
    """Depth by nmr and by Open3D's ray caster, whose bounding boxes are built before the measurement."""
    import open3d

    points, tangent = in_camera(work)
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(points, work.faces.numpy().astype(np.uint32))
    centres = ((np.arange(work.size) + 0.5) * 2 / work.size - 1) * tangent
    rays = np.zeros((work.size, work.size, 6), dtype=np.float32)
    rays[..., 3], rays[..., 4], rays[..., 5] = centres[None], -centres[:, None], 1

    def theirs(_: Tensor) -> Tensor:
        hits = scene.cast_rays(open3d.core.Tensor(rays), nthreads=1)["t_hit"]
        return torch.from_numpy(hits.numpy()).clamp(max=FAR)[None]

    return work.draw, theirs


def mesa(work: Work) -> tuple[Draw, Draw]:
    """Depth by nmr and by Mesa behind pyrender. The mesh is uploaded before the measurement."""
    os.environ.setdefault("PYOPENGL_PLATFORM", "osmesa")
    import pyrender

    points, tangent = in_camera(work)
    mesh = pyrender.Primitive(
        positions=points * np.float32([1, 1, -1]), indices=work.faces.flip(1).numpy()
    )
    scene = pyrender.Scene()
    scene.add(pyrender.Mesh([mesh]))
    scene.add(
        pyrender.PerspectiveCamera(2 * math.atan(tangent), znear=0.1, zfar=FAR, aspectRatio=1.0)
    )
    renderer = pyrender.OffscreenRenderer(work.size, work.size)

    def theirs(_: Tensor) -> Tensor:
        depth = torch.from_numpy(
            renderer.render(scene, flags=pyrender.RenderFlags.DEPTH_ONLY).copy()
        )
        return torch.where(depth > 0, depth, FAR)[None]

    return work.draw, theirs


class Peer(NamedTuple):
    """Another renderer that runs on the CPU."""

    make: Callable[[Work], tuple[Draw, Draw]]  # nmr and the peer, which draw the same
    options: dict[str, Any]  # of `spheres`
    install: str


PEERS = {
    "deodr": Peer(
        lambda work: (work.draw, deodr(work)), {"subdivisions": 3, "size": 256}, "pip install deodr"
    ),
    "PyTorch3D": Peer(
        pytorch3d_soft,
        {"subdivisions": 3, "size": 64},
        "FORCE_CUDA=0 pip install --no-build-isolation git+https://github.com/facebookresearch/pytorch3d",
    ),
    "Open3D": Peer(
        open3d_rays, {"subdivisions": 4, "size": 512, "output": "depth"}, "pip install open3d"
    ),
    "Mesa": Peer(
        mesa,
        {"subdivisions": 4, "size": 512, "output": "depth"},
        "apt install libosmesa6; pip install pyrender",
    ),
}
# Renderers that are not measured here: W1 of bench.py with 128 meshes, from vertices to gradients.
QUOTED = {
    "neural_renderer 1.1.3": ("16.0", "pip install neural_renderer_pytorch, which compiles CUDA"),
    "nvdiffrast 0.4": ("3.5", "from github.com/NVlabs/nvdiffrast, with CUDA"),
}
SOURCE = "one NVIDIA H200, measured on 2026-11-20"


def processor() -> str:
    """The name of the processor, as Linux knows it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def main(repeats: int = 15) -> None:
    print(f"{processor()}, torch {torch.__version__}, load {os.getloadavg()[0]:.1f}\n")
    print("| renderer | draws | faces | pixels | gradients | threads | ms | nmr, ms | | install |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name, (make, options, install) in PEERS.items():
        work = spheres(batch=1, anti_aliasing=False, **options)
        gradients = work.output == "alpha"
        size = f"{len(work.faces):,} | {work.size}x{work.size}"
        row = f"| {name} | {work.output} | {size} | {'vertices' if gradients else 'no'} | 1"
        try:
            ours, theirs = make(work)
        except Exception as error:  # libraries behind bindings fail in their own ways
            why = f"{type(error).__name__}: {str(error).splitlines()[0]}"
            print(f"{row} | not measured ({why}) | | | `{install}` |")
            continue
        check_same(name, ours(work.vertices), theirs(work.vertices))
        then = (lambda images: (images - 0.5).square().mean().backward()) if gradients else id
        run = partial(time_passes, 1, gradients=gradients)
        programs = {
            which: partial(run, draw, then, work.vertices)
            for which, draw in (("a", theirs), ("b", ours))
        }
        a, b = (
            1e3 * float(np.median([total for _, total in times]))
            for times in time_by_turns(programs, repeats)
        )
        print(f"{row} | {a:.1f} | {b:.1f} | {a / b:.1f}x | `{install}` |", flush=True)
    for name, (time, install) in QUOTED.items():
        size = "alpha, 128 meshes | 1,280 | 64x64, 2x2 anti-aliased | vertices | GPU"
        print(f"| {name} | {size} | {time} ({SOURCE}) | | | {install} |")


if __name__ == "__main__":
    keep_freed_memory()
    tyro.cli(main, description=__doc__)
