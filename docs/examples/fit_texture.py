"""Finds the texture of a vase from pictures of it. The error of every pixel gives a gradient to the texels it shows.

python docs/examples/fit_texture.py --output pictures
"""

import math
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
import tyro
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

import nmr


def vase(rows: int = 32, columns: int = 48) -> tuple[Tensor, Tensor, Tensor]:
    """A surface of revolution: vertices [V, 3], faces [F, 3] and uv [V, 2]; the first and last column coincide."""
    v, u = torch.meshgrid(torch.linspace(0, 1, rows), torch.linspace(0, 1, columns), indexing="ij")
    radius, angle = 0.30 + 0.16 * (2.2 * math.pi * v - 0.6).sin() - 0.05 * v, 2 * math.pi * u
    # Seen from outside, u runs to the right: a viewer in front of +z has x to the right and y up.
    vertices = torch.stack(
        [radius * angle.sin(), 1.3 * (v - 0.5), radius * angle.cos()], dim=-1
    ).view(-1, 3)
    a = (torch.arange(rows - 1)[:, None] * columns + torch.arange(columns - 1)).view(-1, 1)
    faces = torch.cat(
        [a + torch.tensor([0, columns + 1, columns]), a + torch.tensor([0, 1, columns + 1])]
    )
    return vertices, faces, torch.stack([u, v], dim=-1).view(-1, 2)


def painting(height: int, width: int) -> Tensor:
    """The texture to be found, [H, W, 3]; row 0 is its top."""
    image = Image.new("RGB", (width, height), "#f3e9d2")
    draw = ImageDraw.Draw(image)
    for row, color in ((0, "#1f4e5f"), (2, "#d1495b"), (13, "#edae49"), (14, "#1f4e5f")):
        draw.rectangle([0, row * height // 16, width, (row + 1) * height // 16 - 1], fill=color)
    font = ImageFont.load_default(height // 5)
    for k, word in enumerate(("NEURAL", "MESH", "RENDER")):
        draw.text(
            ((k + 0.5) * width / 3, height * 0.5), word, fill="#1f4e5f", font=font, anchor="mm"
        )
    return torch.from_numpy(np.array(image)).float() / 255


def main(
    output: Path = Path("output"), steps: int = 60, views: int = 12, size: int = 128
) -> tuple[float, float]:
    """Writes OUTPUT/fit_texture.png: unused views of the vase, of the result, and both textures.

    Returns the mean error of the colours in these views, before and after.
    """
    vertices, faces, uv = vase()
    lights = nmr.Lights(0.7, 0.4, [0.4, 0.5, 0.8], smooth=True)

    def photograph(texture: Tensor, elevation_deg: list[float], azimuth_deg: list[float]) -> Tensor:
        camera = nmr.LookAt.from_angles(
            3.0, elevation_deg, azimuth_deg, half_fov_deg=14.2, right_handed=True
        )
        colors = nmr.UVTexture(texture, uv, wrap="clamp")
        return nmr.render_rgb(
            vertices, faces, camera, colors=colors, lights=lights, background=1.0, image_size=size
        )

    azimuths = [180 - 360 / views * k for k in range(views)]
    elevations = [(5.0, 40.0)[k % 2] for k in range(views)]
    truth = painting(3 * size // 4, 2 * size)
    pictures = photograph(truth, elevations, azimuths)
    unseen = [20.0] * 4, [120.0, 30.0, -60.0, -150.0]
    wanted = photograph(truth, *unseen)

    texture = torch.full_like(truth, 0.5).requires_grad_()
    optimizer = torch.optim.Adam([texture], lr=0.1)
    before = (photograph(texture.detach(), *unseen) - wanted).abs().mean().item()
    for step in range(steps):
        some = [(3 * step + k * views // 3) % views for k in range(3)]
        optimizer.zero_grad()
        images = photograph(texture, [elevations[k] for k in some], [azimuths[k] for k in some])
        (images - pictures[some]).square().sum().backward()
        optimizer.step()
    found = photograph(texture.detach(), *unseen)

    output.mkdir(parents=True, exist_ok=True)
    rows = [torch.cat(list(row), dim=1) for row in (wanted, found, (truth, texture.detach()))]
    imageio.imwrite(
        output / "fit_texture.png", (torch.cat(rows).clamp(0, 1) * 255).round().byte().numpy()
    )
    return before, (found - wanted).abs().mean().item()


if __name__ == "__main__":
    print("mean error in unused views: {:.4f} before, {:.4f} after".format(*tyro.cli(main)))
