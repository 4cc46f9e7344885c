"""Fits predicted meshes to masks at known cameras."""

from collections.abc import Callable

import torch
from torch import Tensor

import nmr
from learn3d.data.poses import Poses
from learn3d.methods.mesh_method import MeshMethod
from learn3d.methods.method import Meshes, Method
from learn3d.studio.picture_to_mesh.fit import descend

STEPS_OF_CODES = 40
STEPS_OF_VERTICES = 40
CODE_LEARNING_RATE = 0.1  # in units of the root mean square of the codes' entries
VERTEX_LEARNING_RATE = 0.002  # in units of the object frame
WEIGHT_OF_SMOOTHNESS = 0.001  # weight of the smoothness loss, as in the proposed method


@torch.no_grad()
def refine(method: Method, images: Tensor, masks: Tensor, poses: Poses) -> Meshes:
    """Meshes of stored images uint8 [B,4,S,S], fitted to masks float32 [B,64,64] at the B cameras
    of `poses`.

    Adam minimises soft IoU loss + 0.001 smoothness over the codes, which keeps shapes plausible,
    and then over the vertices. Symmetric shapes stay symmetric. Raises ValueError if the method
    predicts voxels.
    """
    if not isinstance(method, MeshMethod):
        raise ValueError(
            "only meshes can be fitted to masks, and this run predicts voxels; leave out --refine"
        )

    def decode(codes: Tensor) -> Tensor:
        with method.autocast():
            return method.generator(codes.to(method.device, non_blocking=True)).float().cpu()

    def fitted(
        start: Tensor, shape: Callable[[Tensor], Tensor], learning_rate: float, steps: int
    ) -> Tensor:
        """The variables after some steps; `shape` computes vertices from them."""
        values = start.clone().requires_grad_()

        def loss() -> Tensor:
            vertices = shape(values)
            silhouettes = nmr.render_silhouette(
                vertices, method.faces, poses.cameras(), image_size=masks.shape[-1]
            )
            apart = nmr.losses.soft_iou_loss(silhouettes, masks)
            return apart + WEIGHT_OF_SMOOTHNESS * nmr.losses.smoothness_loss(vertices, method.edges)

        descend(loss, [values], [learning_rate], steps, last=1.0)
        return values.detach()

    codes = method.encode(images).cpu()
    symmetrized = method.generator.symmetrized
    codes = fitted(
        codes, decode, CODE_LEARNING_RATE * float(codes.square().mean().sqrt()), STEPS_OF_CODES
    )
    vertices = fitted(decode(codes), symmetrized, VERTEX_LEARNING_RATE, STEPS_OF_VERTICES)
    return Meshes(symmetrized(vertices), method.faces)
