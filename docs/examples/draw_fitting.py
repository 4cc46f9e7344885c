"""Spheres that become generated objects: meshes fitted to 24 silhouettes each, as a moving picture.

python docs/examples/draw_fitting.py --output pictures
"""

from pathlib import Path

import numpy as np
import torch
import tyro

import nmr
from learn3d.pictures.sheets import save_gif, tile
from learn3d.pictures.surfaces import Surface, draw_surface
from learn3d.shapes import make_shape

CATEGORIES = ("airplane", "car", "chair", "lamp", "sofa", "table")


def fit(masks: torch.Tensor, cameras: nmr.LookAt, steps: int) -> list[torch.Tensor]:
    """The vertices float [2562, 3] of an icosphere before the first step and after each, fitted to masks [B, S, S]."""
    sphere, faces = nmr.icosphere(4)
    shape, edges = (0.3 * sphere).requires_grad_(), nmr.edge_table(faces)
    optimizer = torch.optim.Adam([shape], lr=0.01)
    shapes = [shape.detach().clone()]
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = 0.01 * (1 - 0.9 * step / steps)
        images = nmr.render_silhouette(shape, faces, cameras, image_size=masks.shape[1])
        smooth = 3e-4 * 0.1 ** (step / steps) * nmr.losses.smoothness_loss(shape, edges)
        optimizer.zero_grad()
        (nmr.losses.soft_iou_loss(images, masks) + smooth).backward()
        optimizer.step()
        shapes.append(shape.detach().clone())
    return shapes


def main(output: Path, frames: int = 40, size: int = 120, steps: int = 300) -> dict[str, float]:
    """Write fitting.gif: above the objects, below the meshes while they are fitted; everything turns.

    Returns the IoU of the silhouettes by category.

    output: folder for it, made if needed.
    frames: pictures; the fit takes the first half of them.
    size: side of each picture in pixels.
    steps: of Adam, for each object.
    """
    views = nmr.LookAt.from_angles(2.732, [-20.0, 30.0] * 12, [15.0 * k for k in range(24)], half_fov_deg=13.0)
    turn = [30.0 - 360.0 * frame / frames for frame in range(frames)]
    columns, ious = [], {}
    for category in CATEGORIES:
        mesh = make_shape(category, np.random.default_rng([3, 0, 0]))
        vertices = torch.as_tensor(np.asarray(mesh.vertices) * (1, 1, -1), dtype=torch.float32)  # left-handed
        faces = torch.as_tensor(np.asarray(mesh.faces))
        masks = nmr.render_silhouette(vertices, faces, views, image_size=96)
        shapes = fit(masks, views, steps)
        sphere_faces = nmr.icosphere(4)[1]
        with torch.no_grad():
            drawn = nmr.render_silhouette(shapes[-1], sphere_faces, views, image_size=96)
        ious[category] = 1 - nmr.losses.soft_iou_loss(drawn, masks).item()
        rows = ([], [])
        for frame, azimuth in enumerate(turn):
            camera = nmr.LookAt.from_angles(2.732, 25.0, [azimuth], half_fov_deg=13.0)
            shape = shapes[min(steps, round(steps * (2 * frame / frames) ** 2))]  # slowly at first
            for row, surface in zip(rows, (Surface(vertices, faces), Surface(shape, sphere_faces)), strict=True):
                row.append(draw_surface(surface, [camera], image_size=size)[0])
        columns.append(rows)
    sheets = [
        tile([[column[row][frame] for column in columns] for row in (0, 1)], CATEGORIES, tile_size=size)
        for frame in range(frames)
    ]
    output.mkdir(parents=True, exist_ok=True)
    save_gif(output / "fitting.gif", np.stack(sheets), frames_per_second=12)
    return ious


if __name__ == "__main__":
    for name, iou in tyro.cli(main).items():
        print(f"{name}: IoU of the silhouettes {iou:.3f}")
