"""Spheres that become generated objects: meshes fitted to 24 silhouettes each, as a moving picture.

python docs/examples/draw_fitting.py --output pictures
"""

from pathlib import Path

import numpy as np
import torch
import tyro

import nmr
from learn3d.pictures import Surface, draw_surface, save_gif, tile
from learn3d.studio.shapes import make_shape

OBJECTS = {
    "airplane": 3,
    "car": 3,
    "chair": 6,
    "lamp": 3,
    "sofa": 3,
    "table": 3,
}  # category: seed of the generator


def fit(masks: torch.Tensor, cameras: nmr.LookAt, steps: int) -> list[torch.Tensor]:
    """The vertices float [2562, 3] of an icosphere before the first step and after each, fitted to masks [B, S, S]."""
    sphere, faces = nmr.icosphere(4)
    edges, neighbours = nmr.edge_table(faces), torch.zeros(len(sphere), len(sphere))
    neighbours[edges[:, :2], edges[:, :2].flip(1)] = 1
    # Adam optimises (1 + 5 L) vertices with the graph Laplacian L, so neighbours move together (see fit_silhouette.py).
    stiffness = torch.eye(len(sphere)) + 5 * (neighbours.sum(1).diag() - neighbours)
    softness = torch.linalg.inv(stiffness)
    shape = (stiffness @ (0.3 * sphere)).requires_grad_()
    optimizer = torch.optim.Adam([shape], lr=0.02)
    shapes = []
    for step in range(steps + 1):
        vertices = softness @ shape
        shapes.append(vertices.detach())
        optimizer.param_groups[0]["lr"] = 0.02 * (1 - 0.9 * step / steps)
        images = nmr.render_silhouette(vertices, faces, cameras, image_size=masks.shape[1])
        smooth = 3e-4 * 0.1 ** (step / steps) * nmr.losses.smoothness_loss(vertices, edges)
        optimizer.zero_grad()
        (nmr.losses.soft_iou_loss(images, masks) + smooth).backward()
        optimizer.step()
    return shapes


def main(output: Path, frames: int = 40, size: int = 120, steps: int = 300) -> dict[str, float]:
    """Write fitting.gif: objects, and below them the meshes during the fit. Returns the outlines' IoU by category.

    output: folder for it, made if needed.
    frames: pictures; the fit takes the first half of them.
    size: side of each picture in pixels.
    steps: of Adam, for each object.
    """
    elevations, azimuths = [-20.0, 30.0] * 12, [15.0 * k for k in range(24)]
    views = nmr.LookAt.from_angles(
        2.732, elevations, azimuths, half_fov_deg=13.0, right_handed=True
    )
    turn = [150.0 + 360.0 * frame / frames for frame in range(frames)]
    cameras = [
        nmr.LookAt.from_angles(2.732, 25.0, [azimuth], half_fov_deg=13.0, right_handed=True)
        for azimuth in turn
    ]
    # slowly at first
    shown = [min(steps, round(steps * (2 * frame / frames) ** 2)) for frame in range(frames)]
    sphere_faces, columns, ious = nmr.icosphere(4)[1], [], {}
    for category, seed in OBJECTS.items():
        mesh = make_shape(category, np.random.default_rng([seed, 0, 0]))
        vertices = torch.as_tensor(np.asarray(mesh.vertices), dtype=torch.float32)
        faces = torch.as_tensor(np.asarray(mesh.faces))
        masks = nmr.render_silhouette(vertices, faces, views, image_size=96)
        shapes = fit(masks, views, steps)
        drawn = nmr.render_silhouette(shapes[-1], sphere_faces, views, image_size=96)
        ious[category] = 1 - nmr.losses.soft_iou_loss(drawn, masks).item()
        pairs = zip(shown, cameras, strict=True)
        fitted = [
            draw_surface(Surface(shapes[k], sphere_faces), [view], image_size=size)[0]
            for k, view in pairs
        ]
        columns.append((draw_surface(Surface(vertices, faces), cameras, image_size=size), fitted))
    sheets = [
        tile(
            [[column[row][frame] for column in columns] for row in (0, 1)],
            list(OBJECTS),
            tile_size=size,
        )
        for frame in range(frames)
    ]
    output.mkdir(parents=True, exist_ok=True)
    save_gif(output / "fitting.gif", np.stack(sheets), frames_per_second=12)
    return ious


if __name__ == "__main__":
    for name, iou in tyro.cli(main).items():
        print(f"{name}: IoU of the silhouettes {iou:.3f}")
