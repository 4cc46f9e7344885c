"""Draws what the small model of the package makes of pictures of generated objects that it has not seen.

python docs/examples/draw_small_model.py --output pictures
"""

from pathlib import Path

import numpy as np
import torch
import tyro

import nmr
from learn3d.data.conventions import mesh_to_object
from learn3d.pictures import Surface, draw_around, photograph, save_png, tile
from learn3d.studio.make_data.looks import PALETTES, natural_look
from learn3d.studio.picture_to_mesh.make import load_model, reconstruct_picture
from learn3d.studio.picture_to_mesh.write import export_mesh
from learn3d.studio.shapes import CATEGORIES, make_shape

SIDE = 140  # of each small picture, in pixels
TURNS = (0, 60, 120)  # degrees from the camera's side


def main(
    output: Path = Path("output"), azimuth: float = 40.0, elevation: float = 20.0, seed: int = 7
) -> Path:
    """Writes OUTPUT/small-model.png. Rows: one object of each category; columns: its picture, the mesh, the truth.

    Beside it the pictures without their background, and the meshes in colour: chair.png, chair.glb and so on.
    The first object of each category with this seed is taken, whatever comes out (the model was trained with seed 0).
    """
    model = load_model(None)
    output.mkdir(parents=True, exist_ok=True)
    rows = []
    for category in CATEGORIES:
        rng = np.random.default_rng([seed, 0, 0])
        shape = make_shape(category, rng)
        vertices = shape.vertices @ mesh_to_object("y", "z").T
        truth = Surface(torch.tensor(vertices, dtype=torch.float32), torch.tensor(shape.faces))
        paint, _ = natural_look(vertices, shape.faces, rng, PALETTES[category])
        # in learn3d's object frame, which is left-handed
        camera = nmr.LookAt.from_angles(2.732, elevation, [azimuth], half_fov_deg=15.0)
        colors, masks = photograph(*truth[:2], paint, camera, image_size=256)
        made = reconstruct_picture(model, colors[0], masks[0])
        save_png(output / f"{category}.png", np.dstack([colors[0], masks[0]]))
        export_mesh(output / f"{category}.glb", made.surface)
        drawn = [
            draw_around(
                surface, [start - turn for turn in TURNS], elevation_deg=elevation, image_size=SIDE
            )
            for surface, start in ((made.surface, made.azimuth_deg), (truth, azimuth))
        ]
        rows.append([colors[0], *drawn[0], *drawn[1]])
    turned = [f"turned by {turn}°" for turn in TURNS[1:]]
    titles = ["picture", "mesh", *turned, "truth", *turned]
    save_png(output / "small-model.png", tile(rows, titles, tile_size=SIDE, row_titles=CATEGORIES))
    return output / "small-model.png"


if __name__ == "__main__":
    print(tyro.cli(main))
