"""Measures how much meshes look like their pictures.

python tools/measure_likeness.py --pictures strangers/report --sheet likeness.png
"""

import itertools
import time
from pathlib import Path

import numpy as np
import torch
import tyro

from learn3d.pictures import draw_around, draw_surface, save_png, tile
from learn3d.studio.picture_to_mesh.fit import frame_target
from learn3d.studio.picture_to_mesh.make import load_model, reconstruct_picture
from learn3d.studio.picture_to_mesh.options import DEFAULTS, Options
from learn3d.studio.picture_to_mesh.read import Photo, read_picture
from learn3d.studio.picture_to_mesh.write import Reconstruction

SIDE = 128  # side of each picture of a sheet, in pixels
PAIRS = 6  # pictures in a row of the sheet


def draw(photo: Photo, made: Reconstruction, blind: bool) -> list[np.ndarray]:
    """The framed picture (unless blind), the mesh from the picture's camera, and from 60 degrees beside it."""
    pixels = frame_target(photo.colors, photo.mask).pixels[:3].movedim(0, -1)
    (own,) = draw_surface(made.surface, [made.view.cameras()], image_size=SIDE)
    (beside,) = draw_around(made.surface, [made.azimuth_deg - 60], image_size=SIDE)
    return [*([] if blind else [(255 * pixels).round().byte().numpy()]), own, beside]


def main(
    pictures: Path,
    run: Path | None = None,
    sheet: Path | None = None,
    blind: bool = False,
    smooth: bool = False,
    options: Options = DEFAULTS,
) -> None:
    """Print outline IoU, processor seconds, kind and doubts for each PNG file, and the means.

    The kinds of files named like those of draw_strangers.py are counted. sheet: PNG file with each
    picture beside its mesh, for the eye; blind: without the picture, so that somebody says what a
    mesh shows before seeing what it should show. smooth: inflate the outlines instead.
    """
    torch.set_num_threads(1)
    model, shown, values, right = load_model(run), [], [], []
    for path in sorted(pictures.rglob("*.png")):
        start = time.process_time()
        try:
            photo = read_picture(path, options=options.cut)
        except ValueError as error:
            print(error)
            continue
        made = reconstruct_picture(model, photo.colors, photo.mask, smooth=smooth, options=options)
        values.append((made.silhouette_iou, time.process_time() - start))
        doubts = ", ".join(filter(None, (photo.doubt, made.warning and "other thing")))
        wanted = path.stem.split("-")[1:2]
        right.append((wanted == ["other"], wanted == [made.kind], bool(doubts)))
        iou, seconds = values[-1]
        print(f"{path.stem[:46]:46} {iou:6.3f} {seconds:6.2f} {made.kind} {doubts}", flush=True)
        shown.append(draw(photo, made, blind))
    print(f"{len(values)} pictures: outline {np.mean([iou for iou, _ in values]):.3f}", end=", ")
    print(f"{np.mean([seconds for _, seconds in values]):.2f} s")
    other, same, doubted = np.array(right).T
    known = (
        f"{np.sum(~other)} of known kinds: {np.sum(same)} right, {np.sum(~other & doubted)} doubted"
    )
    print(f"{known}, {np.sum(~other & ~same & ~doubted)} wrong without a word")
    print(f"{np.sum(other)} other things: {np.sum(other & doubted)} doubted")
    if sheet:
        rows = [list(itertools.chain(*shown[k : k + PAIRS])) for k in range(0, len(shown), PAIRS)]
        save_png(sheet, tile(rows, tile_size=SIDE))


if __name__ == "__main__":
    tyro.cli(main)
