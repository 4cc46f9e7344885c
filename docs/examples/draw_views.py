"""Draws a knot from several views: texture with light, depth and normals, in one pass.

python docs/examples/draw_views.py --output pictures
"""

import math
from pathlib import Path

import imageio.v3 as imageio
import torch
import tyro
from torch import Tensor

import nmr


def grid_faces(rows: int, columns: int, closed: bool) -> Tensor:
    """Two triangles for each cell of a grid of points; closed: the last row and column connect to the first."""
    height, width = (rows, columns) if closed else (rows + 1, columns + 1)
    i, j = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    a, b = i * width + j, (i + 1) % height * width + j
    c, d = (i + 1) % height * width + (j + 1) % width, i * width + (j + 1) % width
    return torch.stack([a, b, c, a, c, d], dim=-1).view(-1, 3)


def trefoil(
    rows: int = 240, columns: int = 32, radius: float = 0.13
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A knotted tube: vertices [V, 3], faces [F, 3], uv [T, 2] and uv_faces [F, 3]; the texture has a seam."""
    t = torch.arange(rows)[:, None] * (2 * math.pi / rows)
    curve = (
        torch.cat(
            [t.sin() + 2 * (2 * t).sin(), t.cos() - 2 * (2 * t).cos(), -1.2 * (3 * t).sin()], dim=1
        )
        / 4
    )
    along = torch.nn.functional.normalize(curve.roll(-1, 0) - curve.roll(1, 0), dim=1)
    side = torch.nn.functional.normalize(torch.linalg.cross(along, curve), dim=1)
    out = torch.linalg.cross(side, along)
    angle = (torch.arange(columns) * (2 * math.pi / columns))[:, None]
    vertices = curve[:, None] + radius * (angle.cos() * side[:, None] + angle.sin() * out[:, None])
    v, u = torch.meshgrid(
        torch.linspace(0, 1, rows + 1), torch.linspace(0, 1, columns + 1), indexing="ij"
    )
    uv = torch.stack([u, v], dim=-1).view(-1, 2)
    return (
        vertices.view(-1, 3),
        grid_faces(rows, columns, True),
        uv,
        grid_faces(rows, columns, False),
    )


def ribbons(size: int = 256) -> Tensor:
    """A texture [H, W, 3] of ribbons around the tube; row 0 is its top."""
    v, u = torch.meshgrid(torch.linspace(1, 0, 4 * size), torch.linspace(0, 1, size), indexing="ij")
    palette = torch.tensor(
        [[0.93, 0.35, 0.25], [0.98, 0.86, 0.62], [0.16, 0.45, 0.55], [0.95, 0.95, 0.9]]
    )
    return palette[((u * 4 + v * 24) % 4).long()]


def main(output: Path = Path("output"), views: int = 4, image_size: int = 180) -> Path:
    """Writes OUTPUT/views.png: one column per view; rows: colours, depth, normals."""
    vertices, faces, uv, uv_faces = trefoil()
    azimuths = [160 - 180 / views * k for k in range(views)]
    camera = nmr.LookAt.from_angles(3.0, 25.0, azimuths, half_fov_deg=17.0, right_handed=True)
    eyes = torch.nn.functional.normalize(camera.eye.float(), dim=1)
    above = torch.tensor([0.0, 1.0, 0.0]).expand_as(eyes)
    near, far = 2.1, 3.9
    images = nmr.render(
        vertices,
        faces,
        camera,
        outputs=("rgb", "alpha", "depth", "normals"),
        colors=nmr.UVTexture(ribbons(), uv, uv_faces),
        lights=nmr.Lights(
            0.35, [0.45, 0.3], torch.stack([eyes, above], dim=1), smooth=True
        ),  # first: at the eye
        background=1.0,
        image_size=image_size,
        near=near,
        far=far,
        smooth=True,
    )
    alpha = images.alpha[..., None]
    # background: white
    depth = ((images.depth - near) / (far - near))[..., None].expand_as(images.rgb)
    normals = (images.normals + alpha) / 2 + (1 - alpha)  # from [-1, 1] to [0, 1], on white
    rows = [torch.cat(list(row), dim=1) for row in (images.rgb, depth, normals)]
    picture = (torch.cat(rows).clamp(0, 1) * 255).round().byte()
    output.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(output / "views.png", picture.numpy())
    return output / "views.png"


if __name__ == "__main__":
    print(tyro.cli(main))
