"""Finds shape, texture and light of a vase together, from photographs of it taken around it.

The photographs are drawn with a lamp near the vase and a shiny glaze; the fit starts from a grey cylinder, with the
lamp at the camera's side. The mesh moves by NMR's edge gradient and by its shading, the rest by true derivatives.

python docs/examples/fit_lit_vase.py --output pictures
"""

import math
from pathlib import Path

import imageio.v3 as imageio
import torch
import tyro
from torch import Tensor

import nmr

ROWS, COLUMNS = 24, 40


def turned(radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A surface of revolution with these radii [ROWS]: vertices [V, 3], faces [F, 3], uv [V, 2]."""
    v, u = torch.meshgrid(torch.linspace(0, 1, ROWS), torch.linspace(0, 1, COLUMNS), indexing="ij")
    r, angle = radius.unsqueeze(1), 2 * math.pi * u
    vertices = torch.stack([r * angle.sin(), 1.3 * (v - 0.5), r * angle.cos()], dim=-1).view(-1, 3)
    a = (torch.arange(ROWS - 1)[:, None] * COLUMNS + torch.arange(COLUMNS - 1)).view(-1, 1)
    faces = torch.cat(
        [a + torch.tensor([0, COLUMNS + 1, COLUMNS]), a + torch.tensor([0, 1, COLUMNS + 1])]
    )
    return vertices, faces, torch.stack([u, v], dim=-1).view(-1, 2)


def glaze(size: int) -> Tensor:
    """The texture to be found: bands and dots, [size, 2 size, 3]."""
    y, x = torch.meshgrid(
        torch.arange(size) / size, torch.arange(2 * size) / (2 * size), indexing="ij"
    )
    dots = ((12 * x % 1 - 0.5) ** 2 + (8 * y % 1 - 0.5) ** 2 < 0.09).unsqueeze(-1)
    bands = (torch.sin(6 * math.pi * y + torch.sin(4 * math.pi * x)) > 0).unsqueeze(-1)
    blue, cream, red = torch.tensor([[0.15, 0.3, 0.5], [0.85, 0.8, 0.65], [0.75, 0.25, 0.2]])
    return torch.where(dots, red, torch.where(bands, blue, cream))


def main(
    output: Path = Path("output"), steps: int = 150, views: int = 12, size: int = 96
) -> tuple[float, float]:
    """Writes OUTPUT/fit_lit_vase.png: photographs from unused sides, the first guess, and what was found.

    Returns the mean error of the colours in these views, before and after.
    """
    v = torch.linspace(0, 1, ROWS)

    def photographs(
        radius: Tensor, texture: Tensor, lamp: Tensor, shine: Tensor, azimuths: list[float]
    ) -> Tensor:
        vertices, faces, uv = turned(radius)
        camera = nmr.LookAt.from_angles(3.0, 25.0, azimuths, half_fov_deg=15.0, right_handed=True)
        colors = nmr.UVTexture(texture, uv, wrap="clamp", filter="mipmap")
        lights = nmr.Lights(
            0.35, 0.0, smooth=True, position=lamp, point=0.9, specular=shine, shininess=12.0
        )
        return nmr.render_rgb(
            vertices, faces, camera, colors=colors, lights=lights, background=1.0, image_size=size
        )

    truth = 0.30 + 0.14 * (2.2 * math.pi * v - 0.6).sin() - 0.05 * v, glaze(size // 2)
    truth = *truth, torch.tensor([0.8, 1.4, 1.2]), torch.tensor(0.35)
    azimuths, unseen = [180 - 360 / views * k for k in range(views)], [165.0, 75.0, -15.0, -105.0]
    pictures, wanted = photographs(*truth, azimuths), photographs(*truth, unseen)

    guess = (
        torch.full((ROWS,), 0.3),
        torch.full_like(truth[1], 0.5),
        torch.tensor([0.0, 1.0, 2.0]),
        torch.tensor(0.1),
    )
    rates = 0.004, 0.03, 0.03, 0.01
    found = [x.clone().requires_grad_() for x in guess]
    optimizer = torch.optim.Adam(
        [{"params": x, "lr": lr} for x, lr in zip(found, rates, strict=True)]
    )
    for step in range(steps):
        some = [(5 * step + k * views // 4) % views for k in range(4)]
        optimizer.zero_grad()
        (photographs(*found, [azimuths[k] for k in some]) - pictures[some]).square().mean(
            0
        ).sum().backward()
        optimizer.step()

    with torch.no_grad():
        first, last = photographs(*guess, unseen), photographs(*found, unseen)
    output.mkdir(parents=True, exist_ok=True)
    rows = torch.cat([torch.cat(list(images), dim=1) for images in (wanted, first, last)])
    imageio.imwrite(output / "fit_lit_vase.png", (rows.clamp(0, 1) * 255).round().byte().numpy())
    return (first - wanted).abs().mean().item(), (last - wanted).abs().mean().item()


if __name__ == "__main__":
    print("mean error in unused views: {:.4f} before, {:.4f} after".format(*tyro.cli(main)))
