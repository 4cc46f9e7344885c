"""Draws three pictures: a room from inside, a wide image, and soft silhouettes.

python docs/examples/draw_surfaces.py --output pictures
"""

from pathlib import Path

import imageio.v3 as imageio
import torch
import tyro
from torch import Tensor

import nmr


def room() -> tuple[Tensor, Tensor, Tensor]:
    """A box of 12 faces around the origin with a ball in it, and colours of the faces."""
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3) * torch.tensor([2.0, 1.0, 2.5])
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = torch.tensor([[side[0], side[k], side[k + 1]] for side in sides for k in (1, 2)])
    shades = [
        [0.9, 0.6, 0.5],
        [0.5, 0.7, 0.9],
        [0.6, 0.5, 0.4],
        [1.0, 1.0, 0.95],
        [0.8, 0.8, 0.7],
        [0.7, 0.85, 0.7],
    ]
    ball, ball_faces = nmr.icosphere(3)
    vertices = torch.cat([corners, 0.4 * ball + torch.tensor([0.5, -0.6, -1.2])])
    colors = torch.cat(
        [
            torch.tensor(shades).repeat_interleave(2, 0),
            torch.tensor([[0.95, 0.8, 0.3]]).expand(1280, 3),
        ]
    )
    return vertices, torch.cat([faces, 8 + ball_faces]), colors


def main(output: Path = Path("output"), image_size: int = 256) -> None:
    """Writes OUTPUT/room.png, wide.png and soft.png."""
    output.mkdir(parents=True, exist_ok=True)

    def write(name: str, image: Tensor) -> None:
        imageio.imwrite(output / name, (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy())

    # Every wall reaches behind the eye: it is cut at the near plane.
    vertices, faces, colors = room()
    lights = nmr.Lights(0.6, [0.4, 0.2], [[0.3, 1.0, 0.4], [-0.8, 0.2, 0.6]])
    inside = {"colors": nmr.FaceColors(colors), "lights": lights}
    camera = nmr.Look([-0.4, 0.1, 0.6], [0.25, -0.15, -1.0], half_fov_deg=40.0, right_handed=True)
    write("room.png", nmr.render_rgb(vertices, faces, camera, image_size=image_size, **inside)[0])

    # The same view, twice as wide: pixels are square, and more is seen to the left and to the right.
    write(
        "wide.png",
        nmr.render_rgb(vertices, faces, camera, image_size=(image_size, 2 * image_size), **inside)[
            0
        ],
    )

    # From sharp to soft.
    ball, ball_faces = nmr.icosphere(2)
    camera = nmr.LookAt([0.0, 0.0, 3.0], half_fov_deg=30.0, right_handed=True)
    sizes = {"image_size": image_size // 2}
    soft = [
        nmr.render_soft_silhouette(ball, ball_faces, camera, sigma=s, **sizes)[0]
        for s in (1e-5, 1e-3, 1e-2, 3e-2)
    ]
    write("soft.png", 1 - torch.cat(soft, dim=1))


if __name__ == "__main__":
    tyro.cli(main)
