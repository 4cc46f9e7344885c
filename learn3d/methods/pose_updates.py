"""Reweights the candidate poses of the training images by the shapes of the model in training.

The shape that the model predicts from an image is rendered at all candidate poses of the image.
As all images share the networks, the shape of an image with a wrong pose is still predicted in
the frame of the others, so its IoU with the mask is best at the right pose.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

import nmr
from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.methods.mesh_method import MeshMethod

SIZE = 32  # side of the compared masks and renderings, in pixels
TEMPERATURE = 0.02  # temperature of the softmax over 1 - IoU
_IMAGES = 128  # images whose poses are reweighted at a time
_CELL_DEG = 15  # width of the cells of azimuth whose frequency is kept
_LEAST_PRIOR = 0.01  # probability of candidates that the table leaves out
_ROUNDS = 20  # rounds of scaling to these frequencies


def update_steps(iterations: int, count: int) -> tuple[int, ...]:
    """The steps of a run after which poses are reweighted: 1/2, 1/4, ... of its length."""
    return tuple(iterations >> k for k in range(count, 0, -1) if iterations >> k)


@torch.no_grad()
def update_poses(method: MeshMethod, dataset: ViewDataset) -> float:
    """Reweight the candidates of all images. Returns the share of changed best poses.

    The weights are softmax(IoU / TEMPERATURE + log p + b) over the candidates, with masks and
    renderings of SIZE pixels. p is the candidate's probability in the table, at least
    _LEAST_PRIOR. b is a number for each 15 degrees of azimuth, chosen so that each such cell
    keeps its frequency in the table.
    """
    candidates = dataset.candidates
    logits = []
    count = candidates.weights.shape[1]
    with method.in_use():
        for rows in torch.arange(len(dataset)).split(_IMAGES):
            batch = dataset.batch(rows, voxels=False)
            shapes = method.decode(method.encode(batch.images))
            poses = candidates.poses[(rows[:, None] * count + torch.arange(count)).flatten()]
            vertices = shapes.vertices.repeat_interleave(count, 0)
            silhouettes = nmr.render_silhouette(
                vertices, shapes.faces, poses.cameras(), image_size=SIZE
            )
            masks = F.avg_pool2d(batch.masks[:, None], MASK_SIZE // SIZE).expand(-1, count, -1, -1)
            silhouettes = silhouettes.view(masks.shape)
            common = (silhouettes * masks).sum((2, 3))
            logits.append(
                common / ((silhouettes + masks).sum((2, 3)) - common).clamp_min(1e-6) / TEMPERATURE
            )
    prior = torch.from_numpy(candidates.prior)
    logits = torch.cat(logits) + prior.clamp_min(_LEAST_PRIOR).log()
    weights = _with_marginal(logits, candidates.poses.azimuth_deg.view(prior.shape), prior)
    return candidates.reweight(weights.numpy())


def _with_marginal(logits: Tensor, azimuth_deg: Tensor, prior: Tensor) -> Tensor:
    """Softmax of logits [M, C] plus a number for each cell of azimuths, which gives the cell its
    share in `prior`.
    """
    cells = 360 // _CELL_DEG
    cell = ((azimuth_deg / _CELL_DEG).round().long() % cells).flatten()
    wanted = torch.bincount(cell, prior.flatten(), minlength=cells).clamp_min(1e-6)
    weights = logits.softmax(1)
    shift = torch.zeros(cells, dtype=torch.float64)
    for _ in range(_ROUNDS):
        shift += (
            wanted / torch.bincount(cell, weights.flatten(), minlength=cells).clamp_min(1e-6)
        ).log()
        weights = (logits + shift[cell].float().view(logits.shape)).softmax(1)
    return weights
