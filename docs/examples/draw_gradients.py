"""Draws the three gradients of edges that a colour image can have: where a loss pulls the vertices of a mesh.

python docs/examples/draw_gradients.py --output pictures
"""

from pathlib import Path

import imageio.v3 as imageio
import torch
import tyro
from torch import Tensor

import nmr


def two_balls() -> tuple[Tensor, Tensor, Tensor]:
    """A yellow ball in front of a blue one."""
    ball, faces = nmr.icosphere(4)
    vertices = torch.cat(
        [0.45 * ball + torch.tensor([-0.2, -0.1, 0.6]), 0.7 * ball + torch.tensor([0.3, 0.1, -0.6])]
    )
    colors = torch.tensor([[0.95, 0.75, 0.2], [0.25, 0.45, 0.8]]).repeat_interleave(len(ball), 0)
    return vertices, torch.cat([faces, faces + len(ball)]), colors


def pulls(grad: Tensor) -> Tensor:
    """Colours of vertices: orange if descent moves one to the right, blue if to the left, white if it stays."""
    step = -grad[:, 0] / grad[:, 0].abs().max().clamp_min(1e-12)
    step = step.sign() * step.abs() ** 0.4
    white = torch.ones(3)
    orange = torch.tensor([0.9, 0.35, 0.0])
    blue = torch.tensor([0.0, 0.3, 0.85])
    return (
        white
        + step.clamp_min(0)[:, None] * (orange - white)
        - step.clamp_max(0)[:, None] * (blue - white)
    )


def main(output: Path = Path("output"), image_size: int = 192) -> dict[str, int]:
    """Writes OUTPUT/gradients.png: image, target, and the pulls of "nmr", "local" and "none".

    Returns the number of vertices that each gradient moves.
    """
    vertices, faces, colors = two_balls()
    camera = nmr.LookAt([0.0, 0.0, 4.0], half_fov_deg=15.0, right_handed=True)
    front = (torch.arange(len(vertices)) < len(vertices) // 2)[:, None]
    grey = nmr.Lights(0.75, [0.35], [[-0.4, 0.6, 0.7]])

    def draw(vertices: Tensor, colors: Tensor, **options) -> Tensor:
        settings = {"background": 0.9, "image_size": image_size, **options}
        return nmr.render_rgb(vertices, faces, camera, colors=nmr.VertexColors(colors), **settings)[
            0
        ]

    target = draw(vertices + front * torch.tensor([0.15, 0.0, 0.0]), colors)
    panels, moved = [draw(vertices, colors), target], {}
    for gradient in ("nmr", "local", "none"):
        leaf, seen = vertices.clone().requires_grad_(), colors.clone().requires_grad_()
        (draw(leaf, seen, gradient=gradient) - target).square().sum().backward()
        grad = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        moved[gradient] = int(grad.any(1).sum())
        panels.append(draw(vertices, pulls(grad), lights=grey))
    output.mkdir(parents=True, exist_ok=True)
    picture = torch.cat([panel.detach() for panel in panels], dim=1).clamp(0, 1)
    imageio.imwrite(output / "gradients.png", (picture * 255).round().to(torch.uint8).numpy())
    return moved


if __name__ == "__main__":
    tyro.cli(main)
