"""Finds the camera of a silhouette: eight guesses around a chair move until they see the same silhouette.

python docs/examples/find_camera.py --output pictures
"""

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
import tyro
from torch import Tensor

import nmr
from learn3d.studio.shapes import make_shape


def main(
    output: Path = Path("output"), steps: int = 120, image_size: int = 160, seed: int = 2
) -> tuple[float, float]:
    """Writes OUTPUT/find_camera.gif and .png: what each guess sees, in front of the target silhouette (orange).

    Returns the distance of the best guess from the true camera, before and after; the chair has length 1.
    """
    chair = make_shape("chair", np.random.default_rng(seed))
    vertices = torch.tensor(chair.vertices, dtype=torch.float32)
    faces = torch.tensor(chair.faces)
    colors = nmr.FaceColors(torch.tensor([0.4, 0.62, 0.9]).expand(len(faces), 3))

    def silhouettes(eyes: Tensor) -> Tensor:
        return nmr.render_silhouette(
            vertices,
            faces,
            nmr.LookAt(eyes, half_fov_deg=13.0, right_handed=True),
            image_size=image_size,
        )

    def draw(eyes: Tensor) -> Tensor:
        """The images of eight guesses, in two rows: uint8 [height, width, 3]."""
        camera = nmr.LookAt(eyes, half_fov_deg=13.0, right_handed=True)
        # at the camera
        lights = nmr.Lights(0.4, 0.7, torch.nn.functional.normalize(eyes, dim=1).unsqueeze(1))
        rgb, alpha = nmr.render(
            vertices,
            faces,
            camera,
            outputs=("rgb", "alpha"),
            colors=colors,
            lights=lights,
            image_size=image_size,
        )
        behind = 1 - target[..., None] * torch.tensor([0.02, 0.35, 0.7])
        tiles = rgb + (1 - alpha[..., None]) * behind
        sheet = torch.cat([torch.cat(list(row), dim=1) for row in tiles.split(4)])
        return (sheet.clamp(0, 1) * 255).round().byte()

    true_eye = nmr.cameras.points_from_angles(2.8, 35.0, 25.0).float()
    target = silhouettes(true_eye)
    guesses = nmr.cameras.points_from_angles(
        3.3, 15.0, [180.0 - 45.0 * k for k in range(8)]
    ).float()
    eyes = guesses.clone().requires_grad_()
    optimizer = torch.optim.Adam([eyes], lr=0.05)
    frames = []
    for step in range(steps + 1):
        images = silhouettes(eyes)
        errors = (images - target).square().mean((1, 2))
        if step % (1 + (steps - 1) // 40) == 0:
            frames.append(draw(eyes.detach()))
        optimizer.zero_grad()
        errors.sum().backward()
        optimizer.step()

    output.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(output / "find_camera.png", torch.cat([frames[0], frames[-1]]).numpy())
    imageio.imwrite(
        output / "find_camera.gif",
        torch.stack(frames).numpy(),
        duration=[80] * (len(frames) - 1) + [1500],
        loop=0,
    )
    best = errors.argmin()
    return tuple((x[best] - true_eye).norm().item() for x in (guesses, eyes))


if __name__ == "__main__":
    print(
        "distance of the best guess from the true camera: {:.2f} before, {:.4f} after".format(
            *tyro.cli(main)
        )
    )
