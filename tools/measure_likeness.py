"""Measures the likeness of meshes to cut-out pictures, each of which is the only one of its object.

python tools/measure_likeness.py --pictures cutouts --sheet likeness.png
"""

import itertools
import time
from pathlib import Path

import numpy as np
import tyro

from learn3d.data.framing import read_photo
from learn3d.data.masks import keep_object
from learn3d.pictures import draw_around, save_png, tile
from learn3d.studio.picture_to_mesh.fit import frame_target
from learn3d.studio.picture_to_mesh.make import load_model, reconstruct_picture
from learn3d.studio.picture_to_mesh.options import DEFAULTS, Options

SIDE = 192  # side of each picture of a sheet, in pixels
TURNS_DEG = (0.0, 40.0, 130.0, 220.0)  # from the picture's side, from which a sheet shows a mesh


def main(
    pictures: Path,
    run: Path | None = None,
    sheet: Path | None = None,
    blind: bool = False,
    options: Options = DEFAULTS,
) -> None:
    """Print outline IoU, processor seconds and kind for each PNG file with transparency, and the means.

    A mesh is doubted if its picture resembles no kind that the model knows. sheet: PNG file with each picture beside
    its mesh, for the eye; blind: without the picture, so that somebody says what a mesh shows
    before seeing what it should show.
    """
    model, rows, values = load_model(run), [], []
    for path in sorted(pictures.glob("*.png")):
        colors, mask = read_photo(path)
        mask = keep_object(mask)[0]
        start = time.process_time()
        made = reconstruct_picture(model, colors, mask, options=options)
        values.append((made.silhouette_iou, time.process_time() - start, made.warning is not None))
        doubt = " (doubted)" * (made.warning is not None)
        print(
            f"{path.stem:40} {values[-1][0]:6.3f} {values[-1][1]:6.2f} {made.kind}{doubt}",
            flush=True,
        )
        pixels = frame_target(colors, mask).pixels[:3].movedim(0, -1)
        framed = (255 * pixels).round().byte().numpy()
        turned = [made.azimuth_deg - turn for turn in TURNS_DEG]
        drawn = draw_around(made.surface, turned, image_size=SIDE)
        rows.append([*([] if blind else [framed]), *drawn])
    iou, seconds, doubted = np.mean(values, axis=0)
    print(f"{len(values)} pictures: outline {iou:.3f}, {seconds:.2f} s, doubted {doubted:.2f}")
    if sheet:
        half = (len(rows) + 1) // 2  # two pictures in each row of the sheet
        pairs = [list(itertools.chain(*rows[k::half])) for k in range(half)]
        save_png(sheet, tile(pairs, tile_size=SIDE))


if __name__ == "__main__":
    tyro.cli(main)
