"""Fits meshes of different sizes in one batch: a list of meshes replaces the tensor, without padding.

python docs/examples/fit_packed.py --output pictures
"""

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
import tyro
from torch import Tensor

import nmr
from learn3d.studio.shapes import make_shape

VIEWS = 8
SHAPES = (("car", 3), ("lamp", 3))  # category, seed


def draw(vertices: list[Tensor], faces: list[Tensor], color: list[float]) -> Tensor:
    """The meshes next to each other: uint8 [height, width, 3]."""
    colors = nmr.FaceColors([torch.tensor(color).expand(len(f), 3) for f in faces])
    lights = nmr.Lights(0.45, [0.5, 0.25], [[0.3, 0.9, 0.4], [-0.7, -0.1, 0.6]])
    camera = nmr.LookAt.from_angles(2.732, 25.0, 140.0, half_fov_deg=12.0, right_handed=True)
    images = nmr.render_rgb(
        vertices, faces, camera, colors=colors, lights=lights, background=1.0, image_size=192
    )
    return (torch.cat(list(images), dim=1).clamp(0, 1) * 255).round().byte()


def main(
    output: Path = Path("output"), steps: int = 250, image_size: int = 64
) -> tuple[float, float]:
    """Writes OUTPUT/fit_packed.png: targets above; below the results, from spheres of 162 and 642 vertices.

    Returns 1 - IoU of the silhouettes, before and after.
    """
    goals = [make_shape(category, np.random.default_rng(seed)) for category, seed in SHAPES]
    goal_vertices = [torch.tensor(g.vertices, dtype=torch.float32) for g in goals]
    goal_faces = [torch.tensor(g.faces) for g in goals]
    # One pose per image: all views of the first mesh, then all views of the second.
    azimuths = [360 / VIEWS * k for k in range(VIEWS)] * len(goals)
    camera = nmr.LookAt.from_angles(
        2.732, [0.0, 35.0] * (len(azimuths) // 2), azimuths, half_fov_deg=12.0, right_handed=True
    )

    def silhouettes(vertices: list[Tensor], faces: list[Tensor]) -> Tensor:
        vertices, faces = (
            [x for x in meshes for _ in range(VIEWS)] for meshes in (vertices, faces)
        )
        return nmr.render_silhouette(vertices, faces, camera, image_size=image_size)

    targets = silhouettes(goal_vertices, goal_faces)
    spheres, faces = zip(*(nmr.icosphere(n) for n in (2, 3)), strict=True)
    edges = [nmr.edge_table(f) for f in faces]
    vertices = [(0.3 * sphere).requires_grad_() for sphere in spheres]
    optimizer = torch.optim.Adam(vertices, lr=0.005)
    losses = []
    for _ in range(steps):
        losses.append(nmr.losses.soft_iou_loss(silhouettes(vertices, faces), targets))
        smooth = sum(nmr.losses.laplacian_loss(v, e) for v, e in zip(vertices, edges, strict=True))
        flat = sum(nmr.losses.smoothness_loss(v, e) for v, e in zip(vertices, edges, strict=True))
        optimizer.zero_grad()
        (losses[-1] + 0.5 * smooth + 3e-3 * flat).backward()
        optimizer.step()

    rows = [
        draw(goal_vertices, goal_faces, [0.7, 0.7, 0.7]),
        draw([v.detach() for v in vertices], list(faces), [0.4, 0.62, 0.9]),
    ]
    output.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(output / "fit_packed.png", torch.cat(rows).numpy())
    return losses[0].item(), losses[-1].item()


if __name__ == "__main__":
    print("1 - IoU of the silhouettes: {:.3f} before, {:.3f} after".format(*tyro.cli(main)))
