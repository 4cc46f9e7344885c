"""The projection module of PrGAN: sums along rows of voxels, and the renderer's cameras."""

from __future__ import annotations

import math

import numpy as np
import torch
from shapenet_files import box_mesh, cell_centres, inside

import nmr
from learn3d.networks.voxel_gan import ViewCircle, project

SIZE = 12
TAU = 0.5


def test_a_pixel_has_the_density_along_its_ray() -> None:
    """If pixels are as wide as voxels, seen from the side, it is 1 - exp(-tau * sum of a row of voxels)."""
    views = ViewCircle(
        count=2, elevation_deg=0.0, distance=1.0, half_fov_deg=math.degrees(math.atan(0.5))
    )
    density = 0.3 * torch.rand(2, SIZE, SIZE, SIZE, generator=torch.Generator().manual_seed(1))
    front = 1 - torch.exp(-TAU * density.sum(3)).transpose(1, 2).flip(
        1
    )  # rows: y downwards, columns: x
    image = project(density, torch.tensor([0, 1]), views, TAU)
    torch.testing.assert_close(image, torch.stack([front[0], front[1].flip(1)]))


# low and high corners; no two views of the three together are alike, and no mirror image is
BOXES = np.array(
    [
        [[-0.5, -0.4, -0.3], [0.1, -0.1, 0.4]],
        [[-0.5, -0.1, -0.3], [-0.2, 0.4, 0.0]],
        [[0.1, -0.4, 0.1], [0.5, 0.1, 0.4]],
    ]
)


def iou(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    a, b = a > 0.5, b > 0.5
    return (a & b).sum((1, 2)) / (a | b).sum((1, 2))


def test_views_are_those_of_katos_cameras() -> None:
    vertices, faces = map(torch.from_numpy, box_mesh(BOXES))
    ids, views = torch.tensor([1, 7, 13, 19, 20]), ViewCircle()
    cameras = nmr.LookAt.from_angles(2.732, 30.0, -15.0 * ids, half_fov_deg=15.0)
    parallel = nmr.Orthographic(cameras.eye, scale=1 / views.half_width)
    masks, exact = (
        nmr.render_silhouette(vertices.float(), faces, c, image_size=64)
        for c in (cameras, parallel)
    )
    occupied = torch.from_numpy(inside(cell_centres(64), BOXES))
    density = occupied.float().expand(5, -1, -1, -1) / TAU
    image = project(density, ids, views, TAU)
    assert iou(image, exact).min() > 0.95
    assert iou(image, masks).min() > 0.75
    # azimuths of the other sign
    assert iou(project(density, (24 - ids) % 24, views, TAU), masks).max() < 0.72
    assert iou(image.flip(1), masks).max() < 0.6
