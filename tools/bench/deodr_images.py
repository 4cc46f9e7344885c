"""Images by deodr, a differentiable 2.5-D renderer that draws one mesh at a time on one thread."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

import nmr

FAR = 100.0  # depth of the background, the default of nmr.render


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


def deodr(faces: Tensor, camera: nmr.LookAt, size: int, output: str) -> Callable[[Tensor], Tensor]:
    """A function that draws vertices [B, V, 3] in world space, without anti-aliasing."""
    from deodr.triangulated_mesh import TriMeshAdjacencies

    mesh = TriMeshAdjacencies(faces.numpy().astype(np.uint32), clockwise=True)  # nmr's world is left-handed
    return lambda vertices: DeodrImages.apply(camera.transform(vertices), size, mesh, output)
