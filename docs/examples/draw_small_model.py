"""Draws what the small model of the package makes of pictures of generated objects that it has not seen.

python docs/examples/draw_small_model.py --output pictures
"""

from pathlib import Path

import numpy as np
import torch
import tyro

import nmr
from learn3d.make_data.shapes import CATEGORIES, make_shape
from learn3d.pictures.sheets import save_png, tile
from learn3d.pictures.studio import photograph
from learn3d.pictures.surfaces import Surface, draw_around
from learn3d.reconstruction import load_model, reconstruct

SIDE = 120  # of each small picture, in pixels
TURNS = (0, 60, 120)  # degrees from the camera's side


def main(output: Path = Path("output"), azimuth: float = 40.0, elevation: float = 20.0, seed: int = 7) -> Path:
    """Writes OUTPUT/small-model.png. Rows: one object of each category; columns: its picture, the mesh, the truth.

    The first object of each category with this seed is taken, whatever comes out (the model was trained with seed 0).
    """
    model = load_model(None)
    sides = [azimuth - turn for turn in TURNS]
    rows = []
    for category in CATEGORIES:
        shape = make_shape(category, np.random.default_rng([seed, 0, 0]))
        truth = Surface(torch.tensor(shape.vertices, dtype=torch.float32), torch.tensor(shape.faces))
        camera = nmr.LookAt.from_angles(2.732, elevation, [azimuth], half_fov_deg=15.0)
        colors, masks = photograph(*truth[:2], (0.35, 0.5, 0.65), camera, image_size=256)
        [mesh] = reconstruct(model.method, model.prepare(colors[0], masks[0])[None])
        drawn = [draw_around(surface, sides, elevation_deg=elevation, image_size=SIDE) for surface in (mesh, truth)]
        rows.append([colors[0], *drawn[0], *drawn[1]])
    turned = [f"turned by {turn}°" for turn in TURNS[1:]]
    titles = ["picture", "mesh", *turned, "truth", *turned]
    output.mkdir(parents=True, exist_ok=True)
    save_png(output / "small-model.png", tile(rows, titles, tile_size=SIDE, row_titles=CATEGORIES))
    return output / "small-model.png"


if __name__ == "__main__":
    print(tyro.cli(main))
