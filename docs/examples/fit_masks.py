"""Fits a mesh to masks of your own: image files, and for each the matrices K, R and t of its camera (OpenCV, COLMAP).

python docs/examples/fit_masks.py --folder my_masks --start ring.obj --output fitted

my_masks/cameras.json is a list of {"mask": FILE, "K": 3x3, "R": 3x3, "t": 3}: a point x of the world is seen at the
pixel K (R x + t). Without --folder one is made, of a ring seen from twelve sides. A fit keeps the holes of the mesh
that it starts from: a sphere never becomes a ring.
"""

import json
from pathlib import Path

import numpy as np
import torch
import trimesh
import tyro
from PIL import Image
from torch import Tensor

import nmr


def make_folder(folder: Path, sides: int = 12, height: int = 90, width: int = 120) -> None:
    """Masks of a ring and cameras.json; an example of what is read below."""
    ring = trimesh.creation.torus(0.35, 0.12)
    ring.apply_transform(trimesh.transformations.euler_matrix(1.0, 0.0, 0.5))
    vertices, faces = torch.tensor(ring.vertices, dtype=torch.float32), torch.tensor(ring.faces)
    folder.mkdir(parents=True, exist_ok=True)
    cameras = []
    for side in range(sides):
        angle, up = 2 * np.pi * side / sides, 0.6 * (-1) ** side
        eye = np.array([2.5 * np.cos(angle), up, 2.5 * np.sin(angle)])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0, 1, 0]) / np.linalg.norm(np.cross(forward, [0, 1, 0]))
        # OpenCV's axes: x right, y down, z forward
        R = np.stack([right, np.cross(forward, right), forward])
        camera = {
            "mask": f"{side:02}.png",
            "K": [[200, 0, width / 2], [0, 200, height / 2], [0, 0, 1]],
        }
        cameras.append(camera | {"R": R.tolist(), "t": (-R @ eye).tolist()})
        view = nmr.cameras.from_opencv(
            camera["K"], R.tolist(), cameras[-1]["t"], height=height, width=width
        )
        mask = nmr.render_silhouette(vertices, faces, view, image_size=(height, width))[0]
        Image.fromarray((255 * mask).round().byte().numpy()).save(folder / camera["mask"])
    (folder / "cameras.json").write_text(json.dumps(cameras))


def read_folder(folder: Path) -> tuple[Tensor, nmr.Pinhole]:
    """Masks float32 [B, H, W] in [0, 1], all of one size, and their B cameras."""
    cameras = json.loads((folder / "cameras.json").read_text())
    masks = np.stack(
        [np.asarray(Image.open(folder / camera["mask"]).convert("L")) for camera in cameras]
    )
    K, R, t = (
        torch.tensor([camera[name] for camera in cameras], dtype=torch.float32)
        for name in ("K", "R", "t")
    )
    # COLMAP counts pixels from the corner of the first, OpenCV from its middle: for COLMAP add pixel_center=0.5.
    camera = nmr.cameras.from_opencv(K, R, t, height=masks.shape[1], width=masks.shape[2])
    return torch.from_numpy(masks).float() / 255, camera


def main(
    folder: Path | None = None,
    start: Path | None = None,
    output: Path = Path("output"),
    steps: int = 200,
):
    """Writes OUTPUT/fit_masks.glb, and the masks above those of the result; returns the IoU of the silhouettes."""
    output.mkdir(parents=True, exist_ok=True)
    if folder is None:
        make_folder(folder := output / "masks")
    masks, camera = read_folder(folder)
    mesh = trimesh.load(start, force="mesh") if start else trimesh.creation.torus(0.3, 0.1)
    shape = torch.tensor(mesh.vertices, dtype=torch.float32).requires_grad_()
    faces = torch.tensor(mesh.faces)
    edges, optimizer = nmr.edge_table(faces), torch.optim.Adam([shape], lr=0.01)
    for _ in range(steps + 1):
        images = nmr.render_silhouette(shape, faces, camera, image_size=tuple(masks.shape[1:]))
        loss = nmr.losses.soft_iou_loss(images, masks)
        smooth = 3e-4 * nmr.losses.smoothness_loss(shape, edges) + nmr.losses.laplacian_loss(
            shape, edges
        )
        optimizer.zero_grad()
        (loss + smooth).backward()
        optimizer.step()
    rows = [torch.cat(list(x.detach()), dim=1) for x in (masks, images)]
    Image.fromarray((255 * torch.cat(rows)).round().byte().numpy()).save(output / "fit_masks.png")
    trimesh.Trimesh(shape.detach().numpy(), faces.numpy()).export(output / "fit_masks.glb")
    return 1 - loss.item()


if __name__ == "__main__":
    print(f"IoU of the silhouettes: {tyro.cli(main):.3f}")
