"""Deforms a sphere until its silhouettes match those of an airplane, seen from sixteen sides.

python docs/examples/fit_silhouette.py --output pictures
"""

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
import tyro
from torch import Tensor

import nmr
from learn3d.studio.shapes import make_shape

LIGHTS = nmr.Lights(0.45, [0.5, 0.25], [[0.3, 0.9, 0.4], [-0.7, -0.1, 0.6]])


def draw(
    vertices: Tensor, faces: Tensor, azimuths_deg: list[float], color: list[float], size: int = 192
) -> Tensor:
    """Pictures of the mesh from several sides, next to each other: uint8 [height, width, 3]."""
    camera = nmr.LookAt.from_angles(2.732, 25.0, azimuths_deg, half_fov_deg=12.0, right_handed=True)
    colors = nmr.FaceColors(torch.tensor(color).expand(len(faces), 3))
    images = nmr.render_rgb(
        vertices, faces, camera, colors=colors, lights=LIGHTS, background=1.0, image_size=size
    )
    images = images[:, size // 6 : -size // 6]  # airplanes are flat
    return (torch.cat(list(images), dim=1).clamp(0, 1) * 255).round().byte()


def main(
    output: Path = Path("output"), steps: int = 200, image_size: int = 96, seed: int = 5
) -> tuple[float, float]:
    """Writes OUTPUT/fit_silhouette.gif (the progress) and fit_silhouette.png (the target; below it the result).

    Returns 1 - IoU of the silhouettes, before and after.
    """
    airplane = make_shape("airplane", np.random.default_rng(seed))
    goal = torch.tensor(airplane.vertices, dtype=torch.float32)
    goal_faces = torch.tensor(airplane.faces)
    camera = nmr.LookAt.from_angles(
        2.732,
        [-30.0, 30.0] * 8,
        [22.5 * k for k in range(16)],
        half_fov_deg=12.0,
        right_handed=True,
    )
    target = nmr.render_silhouette(goal, goal_faces, camera, image_size=image_size)

    sphere, faces = nmr.icosphere(3)
    edges = nmr.edge_table(faces)
    # The variable is (1 + 10 L) vertices, where L is the Laplacian. A gradient at one vertex then moves the region
    # around it, and the surface stays smooth (Nicolet et al. 2021, Large Steps in Inverse Rendering of Geometry).
    neighbours = torch.zeros(len(sphere), len(sphere))
    neighbours[edges[:, :2], edges[:, :2].flip(1)] = 1
    stiffness = torch.eye(len(sphere)) + 10 * (torch.diag(neighbours.sum(1)) - neighbours)
    softness = torch.linalg.inv(stiffness)
    shape = (stiffness @ (0.25 * sphere)).requires_grad_()
    optimizer = torch.optim.Adam([shape], lr=0.02)
    gray, blue = [0.7, 0.7, 0.7], [0.4, 0.62, 0.9]
    losses, frames = [], []
    for step in range(steps + 1):
        vertices = softness @ shape
        images = nmr.render_silhouette(vertices, faces, camera, image_size=image_size)
        losses.append(nmr.losses.soft_iou_loss(images, target))
        if step % (1 + (steps - 1) // 40) == 0:
            side = [240 - 120 * step / steps]
            pair = draw(goal, goal_faces, side, gray), draw(vertices.detach(), faces, side, blue)
            frames.append(torch.cat(pair, dim=1))
        optimizer.zero_grad()
        (losses[-1] + 3e-4 * nmr.losses.smoothness_loss(vertices, edges)).backward()
        optimizer.step()

    sides = [315.0, 225.0, 150.0, 80.0]
    comparison = torch.cat(
        [draw(goal, goal_faces, sides, gray), draw(vertices.detach(), faces, sides, blue)]
    )
    output.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(output / "fit_silhouette.png", comparison.numpy())
    imageio.imwrite(
        output / "fit_silhouette.gif",
        torch.stack(frames).numpy(),
        duration=[80] * (len(frames) - 1) + [1500],
        loop=0,
    )
    return losses[0].item(), losses[-1].item()


if __name__ == "__main__":
    print("1 - IoU of the silhouettes: {:.3f} before, {:.3f} after".format(*tyro.cli(main)))
