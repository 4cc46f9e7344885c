"""The projection module of PrGAN: against its definition, and against the renderer's cameras."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from shapenet_files import box_mesh, cell_centres, inside

import nmr
from learn3d.networks.voxel_gan import ViewCircle, project

SIZE = 12
TAU = 0.5


@pytest.mark.parametrize("views", [ViewCircle(), ViewCircle(count=3, elevation_deg=-10)])
def test_samples_lie_on_the_rays_of_the_pixels(views: ViewCircle) -> None:
    """The camera sees all samples of a pixel at its centre; they are a pixel apart, and as many on either side."""
    azimuth, width = float(views.azimuth_deg(torch.tensor(1))), views.half_width
    points = views.sample_points(azimuth, SIZE).double()
    eye = nmr.cameras.points_from_angles(views.distance, views.elevation_deg, [azimuth])
    camera = nmr.Orthographic(eye, scale=1 / width)
    x, y, _ = camera.transform(points.reshape(1, -1, 3)).reshape(points.shape).unbind(3)
    centres = (torch.arange(SIZE, dtype=torch.float64) + 0.5) / SIZE * 2 - 1
    assert (x - centres[:, None]).abs().max() < 1e-5
    assert (y + centres[:, None, None]).abs().max() < 1e-5
    assert (points.diff(dim=2).norm(dim=3) - 2 * width / SIZE).abs().max() < 1e-6
    from_eye = -(points.mean(2) - eye) @ eye[0] / views.distance
    assert (from_eye - views.distance).abs().max() < 1e-5


@pytest.mark.parametrize("views", [ViewCircle(), ViewCircle(count=3)])
def test_projection_and_gradient_are_those_of_grid_sample(views: ViewCircle) -> None:
    ids = torch.tensor([23, 6, 0, 13, 6]) % views.count
    density = (
        0.3 * torch.rand(5, SIZE, SIZE, SIZE, generator=torch.Generator().manual_seed(1))
    ).requires_grad_()
    points = torch.stack([views.sample_points(float(views.azimuth_deg(k)), SIZE) for k in ids])
    samples = F.grid_sample(density[:, None], 2 * points.flip(-1), align_corners=False)[:, 0]
    wanted = 1 - torch.exp(-TAU * samples.sum(3) * 2 * views.half_width)
    image = project(density, ids, views, TAU)
    assert torch.allclose(image, wanted, atol=1e-5)
    weights = torch.rand_like(image)
    (ours,) = torch.autograd.grad((image * weights).sum(), density)
    (theirs,) = torch.autograd.grad((wanted * weights).sum(), density)
    assert theirs.abs().max() > 0.01
    assert torch.allclose(ours, theirs, atol=1e-5)


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
