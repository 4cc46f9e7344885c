"""Fits predicted shapes to the masks of their images at known cameras: first the codes, then the vertices."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

import nmr
from learn3d.data.poses import Poses
from learn3d.methods.method import MeshMethod
from learn3d.methods.surfaces import Meshes

CODE_STEPS, VERTEX_STEPS = 40, 40
CODE_LEARNING_RATE = 0.1  # in units of the root mean square of the codes' entries
VERTEX_LEARNING_RATE = 0.002  # in units of the object frame
SMOOTHNESS = 0.001  # weight of the smoothness loss, as in the proposed method


def refine(method: MeshMethod, images: Tensor, masks: Tensor, poses: Poses) -> Meshes:
    """Meshes of stored images uint8 [B,4,S,S], fitted to masks float32 [B,64,64] at the B cameras of `poses`.

    Adam minimises soft IoU loss + 0.001 smoothness over the codes, which keeps shapes plausible, and then over the
    vertices. Symmetric shapes stay symmetric. Raises ValueError if the method predicts voxels.
    """
    if not isinstance(method, MeshMethod):
        raise ValueError("only meshes can be fitted to masks, and this run predicts voxels; leave out --refine")

    def decode(codes: Tensor) -> Tensor:
        with method.autocast():
            return method.generator(codes.to(method.device, non_blocking=True))

    def loss(vertices: Tensor) -> Tensor:
        vertices = vertices.float().cpu()
        silhouettes = nmr.render_silhouette(vertices, method.faces, poses.cameras(), image_size=masks.shape[-1])
        fit = nmr.losses.soft_iou_loss(silhouettes, masks)
        return fit + SMOOTHNESS * nmr.losses.smoothness_loss(vertices, method.edges)

    with torch.no_grad():
        codes = method.encode(images).float().cpu()
    learning_rate = CODE_LEARNING_RATE * float(codes.square().mean().sqrt())
    codes = _descend(lambda codes: loss(decode(codes)), codes, learning_rate, CODE_STEPS)
    with torch.no_grad():
        vertices = decode(codes).float().cpu()
    symmetrized = method.generator.symmetrized
    vertices = _descend(lambda vertices: loss(symmetrized(vertices)), vertices, VERTEX_LEARNING_RATE, VERTEX_STEPS)
    return Meshes(symmetrized(vertices), method.faces)


@torch.enable_grad()
def _descend(loss: Callable[[Tensor], Tensor], start: Tensor, learning_rate: float, steps: int) -> Tensor:
    values = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([values], lr=learning_rate)
    for _ in range(steps):
        (values.grad,) = torch.autograd.grad(loss(values), values)
        optimizer.step()
    return values.detach()
