"""Draws the pictures of the API pages: each function of nmr on one chair.

python docs/draw_api.py --output pictures
"""

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
import tyro
from torch import Tensor

import nmr
from learn3d.studio.shapes import make_shape

SIZE = 160


def chair() -> tuple[Tensor, Tensor]:
    mesh = make_shape("chair", np.random.default_rng(2))
    return torch.tensor(mesh.vertices, dtype=torch.float32), torch.tensor(mesh.faces)


def gray(values: Tensor) -> Tensor:
    return values[..., None].expand(*values.shape, 3)


def index_colors(face_index: Tensor) -> Tensor:
    """A colour for each face, white for the background."""
    palette = torch.rand(997, 3, generator=torch.Generator().manual_seed(0)) * 0.8
    return torch.where(face_index[..., None] < 0, 1.0, palette[face_index.long() % 997])


def draw_balls() -> dict[str, Tensor]:
    """The kinds of colours, and of lights, each on a sphere."""
    vertices, faces = nmr.icosphere(3)
    camera = nmr.LookAt.from_angles(2.732, 25.0, 40.0, half_fov_deg=23.0)
    squares = ((torch.arange(16)[:, None] + torch.arange(32)) % 2).float()[..., None].expand(
        -1, -1, 3
    ) * 0.6 + 0.3
    u = (torch.atan2(vertices[:, 0], vertices[:, 2]) / (2 * torch.pi)) % 1
    uv = torch.stack([u, vertices[:, 1].clamp(-1, 1).asin() / torch.pi + 0.5], dim=1)
    uv = uv[faces]  # three corners for each face: the texture has a seam
    uv[..., 0] += ((uv[..., :1] < 0.5) & (uv[..., 0].amax(1) > 0.75)[:, None, None])[..., 0]
    kinds = {
        "VertexColors": nmr.VertexColors((vertices + 1) / 2),
        "FaceColors": nmr.FaceColors(index_colors(torch.arange(len(faces)))),
        "UVTexture": nmr.UVTexture(
            squares, uv.view(-1, 2), torch.arange(3 * len(faces)).view(-1, 3), wrap="repeat"
        ),
    }
    lights = {
        "flat": nmr.Lights(0.3, 0.7, [0.3, 0.9, 0.4]),
        "smooth": nmr.Lights(0.3, 0.7, [0.3, 0.9, 0.4], smooth=True),
        "specular": nmr.Lights(0.3, 0.6, [0.3, 0.9, 0.4], smooth=True, specular=0.6, shininess=20),
    }

    def draw(**look) -> Tensor:
        return nmr.render_rgb(
            0.95 * vertices, faces, camera, background=1.0, image_size=SIZE, **look
        )

    return {
        "colors": torch.cat([draw(colors=colors) for colors in kinds.values()]),
        "lights": torch.cat([draw(lights=light) for light in lights.values()]),
    }


def main(output: Path = Path("output")) -> None:
    """Writes OUTPUT/<function>.png: views side by side."""
    vertices, faces = chair()
    camera = nmr.LookAt.from_angles(
        2.732, 25.0, [40.0, 150.0], half_fov_deg=12.0, right_handed=True
    )
    lights = nmr.Lights(0.45, [0.5, 0.25], [[0.3, 0.9, 0.4], [-0.7, 0.1, 0.6]])
    colors = nmr.VertexColors((vertices * 1.2 + 0.55).clamp(0.1, 0.95))
    mesh, square = (vertices, faces, camera), {"image_size": SIZE}
    look = {"colors": colors, "lights": lights, "background": 1.0} | square
    near, far = 2.3, 3.2
    normals = nmr.render(*mesh, outputs=("normals", "alpha"), **square)
    # [1, x, y]: seen along z
    voxels = nmr.voxelize(vertices + 0.5, faces).flip(-1).sum(-1).clamp(max=12) / 12
    side = voxels[0].T.flip(0).repeat_interleave(SIZE // 32, 0).repeat_interleave(SIZE // 32, 1)
    light = {"lights": lights, "background": 1.0}
    spheres = [nmr.icosphere(level) for level in (1, 3)]
    balls = [
        nmr.render_rgb(
            *ball, nmr.LookAt.from_angles(2.732, 25.0, 40.0, half_fov_deg=23.0), **light, **square
        )
        for ball in spheres
    ]
    pictures = {
        "render_silhouette": gray(1 - nmr.render_silhouette(*mesh, **square)),
        "render_soft_silhouette": gray(1 - nmr.render_soft_silhouette(*mesh, sigma=2e-4, **square)),
        "render_soft": nmr.render_soft(*mesh, sigma=2e-4, **look).rgb,
        "render_transparent": nmr.render_transparent(*mesh, opacity=0.4, **look).rgb,
        "render_rgb": nmr.render_rgb(*mesh, **look),
        "render_depth": gray(
            (nmr.render_depth(*mesh, near=near, far=far, **square) - near) / (far - near)
        ),
        "render_normals": (normals.normals + 1) / 2 * normals.alpha[..., None]
        + (1 - normals.alpha[..., None]),
        "render_face_index": index_colors(nmr.render_face_index(*mesh, **square)),
        "icosphere": torch.cat(balls),
        "voxelize": torch.stack([nmr.render_rgb(*mesh, **look)[0], gray(1 - side)]),
    }
    angles = {"elevation_deg": [0.0, 0.0, 30.0, 60.0], "azimuth_deg": [0.0, 45.0, 45.0, 45.0]}
    cameras = nmr.LookAt.from_angles(2.732, **angles, half_fov_deg=12.0, right_handed=True)
    pictures |= draw_balls() | {"look_at": nmr.render_rgb(vertices, faces, cameras, **look)}
    output.mkdir(parents=True, exist_ok=True)
    for name, views in pictures.items():
        picture = (torch.cat(list(views), dim=1).clamp(0, 1) * 255).round().byte()
        imageio.imwrite(output / f"{name}.png", picture.numpy())


if __name__ == "__main__":
    tyro.cli(main)
