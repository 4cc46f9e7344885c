"""Fits predicted meshes to masks at known cameras."""

from collections.abc import Callable

import torch
from torch import Tensor

import nmr
from learn3d.data.poses import Poses
from learn3d.methods.mesh_method import MeshMethod
from learn3d.methods.method import Meshes, Method
from learn3d.studio.picture_to_mesh.fit import descend
from learn3d.studio.picture_to_mesh.options import KNOWN_CAMERAS, FitOptions


@torch.no_grad()
def refine(
    method: Method,
    images: Tensor,
    masks: Tensor,
    poses: Poses,
    options: FitOptions = KNOWN_CAMERAS,
) -> Meshes:
    """Meshes of stored images uint8 [B,4,S,S], fitted to masks float32 [B,64,64] at the B cameras
    of `poses`.

    Adam minimises soft IoU loss and smoothness over the codes, which keeps shapes plausible,
    and then over the vertices. Symmetric shapes stay symmetric. Raises ValueError if the method
    predicts voxels.
    """
    if not isinstance(method, MeshMethod):
        raise ValueError(
            "only meshes can be fitted to masks, and this run predicts voxels; leave out --refine"
        )

    def fitted(
        start: Tensor, shape: Callable[[Tensor], Tensor], learning_rate: float, steps: int
    ) -> Tensor:
        """The variables after some steps; `shape` computes vertices from them."""
        values = start.clone().requires_grad_()

        def loss() -> Tensor:
            vertices = shape(values)
            apart = nmr.losses.soft_iou_loss(method.render(vertices, poses), masks)
            return apart + options.smoothness * nmr.losses.smoothness_loss(vertices, method.edges)

        descend(loss, [values], [learning_rate], steps, last=1.0)
        return values.detach()

    codes = method.encode(images)
    decode, symmetrized = method.generator, method.generator.symmetrized
    rate = options.code_rate * float(codes.square().mean().sqrt())
    codes = fitted(codes, decode, rate, options.code_steps)
    vertices = fitted(decode(codes), symmetrized, options.vertex_rate, options.vertex_steps)
    return Meshes(symmetrized(vertices), method.faces)
