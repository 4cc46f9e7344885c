"""Makes a folder of "photographs" with masks and poses.csv, to try docs/your-own-category.md without a camera.

python docs/examples/make_photo_folder.py --output photos --category chair
"""

import csv
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

import nmr
from learn3d.data.conventions import mesh_to_object
from learn3d.pictures import photograph
from learn3d.studio.shapes import make_shape

WIDTH, HEIGHT = 320, 240
FOV_DEG = 40.0  # across the width
FROM_MESH = mesh_to_object(
    front="z"
).T  # from mesh files (right-handed, front towards +z) to the object frame


def take_photo(
    vertices: np.ndarray, faces: np.ndarray, color: np.ndarray, camera: nmr.LookAt, wall: np.ndarray
):
    """A picture uint8 [240, 320, 3] of the object in front of a shaded wall, and its mask [240, 320]."""
    rgb, alpha = photograph(vertices, faces, color, camera, image_size=WIDTH)
    rows = slice((WIDTH - HEIGHT) // 2, (WIDTH + HEIGHT) // 2)
    rgb, alpha = rgb[0, rows].astype(np.float32), alpha[0, rows]
    background = wall * np.linspace(1.0, 0.6, HEIGHT)[:, None, None]
    picture = rgb - (1 - alpha[..., None] / 255) * (255 - background)  # on white so far
    return picture.clip(0, 255).round().astype(np.uint8), alpha


def main(
    output: Path = Path("photos"),
    category: str = "chair",
    objects: int = 60,
    photos: int = 4,
    seed: int = 0,
    elevation_deg: tuple[float, float] = (5.0, 45.0),
):
    """Writes OUTPUT/CATEGORY/images, masks and poses.csv: some photographs of each object from random sides."""
    make_shape(category, np.random.default_rng(seed))  # raises ValueError for an unknown category
    folder = output / category
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    with open(folder / "poses.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["file", "azimuth_deg", "elevation_deg", "distance", "fov_deg", "object"])
        for number in range(objects):
            mesh = make_shape(category, rng)
            vertices = (mesh.vertices - mesh.bounds.mean(axis=0)) / mesh.extents.max() @ FROM_MESH
            color = rng.uniform(0.3, 0.9, 3)
            for photo in range(photos):
                azimuth, elevation = rng.uniform(-180, 180), rng.uniform(*elevation_deg)
                distance = rng.uniform(2.8, 3.3)
                # in learn3d's object frame, which is left-handed
                camera = nmr.LookAt.from_angles(
                    [distance], [elevation], [azimuth], half_fov_deg=FOV_DEG / 2
                )
                picture, mask = take_photo(
                    vertices, mesh.faces, color, camera, rng.uniform(80, 230, 3)
                )
                name = f"{category}{number:03}_{photo}"
                Image.fromarray(picture).save(folder / "images" / f"{name}.jpg", quality=92)
                Image.fromarray(mask).save(folder / "masks" / f"{name}.png")
                numbers = (round(float(x), 2) for x in (azimuth, elevation, distance, FOV_DEG))
                table.writerow([f"{name}.jpg", *numbers, f"{category}{number:03}"])
    return folder


if __name__ == "__main__":
    print(f"wrote {tyro.cli(main)}")
