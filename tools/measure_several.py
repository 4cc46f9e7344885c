"""Measures meshes from 1, 2, 4 and 8 pictures of an object, with unknown and with known cameras.

python tools/measure_several.py --models chair.npz --half tune
"""

import itertools
import math
import time
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro

import nmr
from learn3d.data.conventions import (
    AZIMUTH_STEP_DEG,
    DISTANCE,
    ELEVATION_DEG,
    HALF_FOV_DEG,
    KATO,
    mesh_to_object,
)
from learn3d.data.masks import mask_box
from learn3d.data.poses import wrap_deg
from learn3d.networks.encoders import CENTRED_SIZE
from learn3d.pictures import Surface, draw_around, photograph, save_png, tile
from learn3d.studio.make_data.looks import natural_look
from learn3d.studio.make_data.meshes import check, fit_to_box, mesh_sources
from learn3d.studio.picture_to_mesh.fit import HALF_FOV_DEG as VIEW_HALF_FOV_DEG
from learn3d.studio.picture_to_mesh.fit import View
from learn3d.studio.picture_to_mesh.reconstruction import (
    Model,
    load_model,
    reconstruct_picture,
    reconstruct_several,
)

SIZE = 256  # pixels along each side of a picture
NEAR_DEG = 30.0  # error below which an azimuth is right
SHOWN_DEG = (30.0, 120.0, 210.0, 300.0)  # azimuths from which a sheet shows a mesh
COLUMNS = ("voxels", "best turn", "outline", "azimuth", "common turn", "seconds")


def take_pictures(
    mesh: Surface, rng: np.random.Generator, count: int, hand_held: bool
) -> tuple[list[tuple[np.ndarray, np.ndarray]], View]:
    """Pictures of a mesh in everyday colours with their masks, and the cameras of the framed pictures.

    hand_held: around the object, elevations of 5 to 40 degrees, distances of 1.6 to 3.5, tilts of
    up to 5 degrees; otherwise `count` of Kato's 24 views, one of each sector.
    """
    zero, drawn = torch.zeros(count), lambda *bounds: torch.from_numpy(rng.uniform(*bounds, count))
    if hand_held:
        azimuth_deg = 360 * (torch.arange(count) + drawn(-0.3, 0.3)) / count + rng.uniform(0, 360)
        azimuth_deg = wrap_deg(azimuth_deg)
        parts = azimuth_deg, drawn(5, 40), drawn(1.6, 3.5).log(), drawn(-5, 5)
        tangent = 0.55  # of a telephone
    else:
        sector = 24 / count
        rows = (sector * (torch.arange(count) + drawn(0, 1))).floor()
        azimuth_deg = wrap_deg(AZIMUTH_STEP_DEG * (rows + rng.integers(24)))
        parts = azimuth_deg, zero + ELEVATION_DEG, zero + math.log(DISTANCE), zero
        tangent = math.tan(math.radians(HALF_FOV_DEG))
    azimuth_deg, elevation_deg, log_distance, roll_deg = (part.float() for part in parts)
    views = View(azimuth_deg, elevation_deg, log_distance, torch.zeros(count, 2), roll_deg, zero)
    colors, lights = natural_look(mesh.vertices.numpy(), mesh.faces.numpy(), rng)
    cameras = _with_lens(views, zero + tangent).cameras()
    rgb, alpha = photograph(*mesh[:2], colors, cameras, image_size=SIZE, lights=lights)
    shares = torch.ones(count)
    for number, mask in enumerate(alpha):
        left, top, right, bottom = mask_box(mask)
        middle = torch.tensor([(left + right) / SIZE - 1, 1 - (top + bottom) / SIZE])
        views.shift[number] = -middle * tangent * log_distance[number].exp()
        shares[number] = max(right - left, bottom - top) / (SIZE * CENTRED_SIZE)
    return list(zip(rgb, alpha, strict=True)), _with_lens(views, shares * tangent)


def _with_lens(views: View, tangent: torch.Tensor) -> View:
    """The views with lenses of half fields of view with the tangents [N], at the same places."""
    wider = tangent.atan().rad2deg() / VIEW_HALF_FOV_DEG
    nearer = tangent / math.tan(math.radians(VIEW_HALF_FOV_DEG))
    return views._replace(log_distance=views.log_distance + nearer.log(), perspective=wider.log())


def measure(
    model: Model, mesh: Surface, rng: np.random.Generator, count: int, known: bool, hand_held: bool
) -> tuple[list[float], Surface]:
    """The values of `COLUMNS` for a mesh in the object frame, and the surface that is made."""
    pictures, views = take_pictures(mesh, rng, count, hand_held)
    start = time.process_time()
    if count == 1:
        made = reconstruct_picture(model, *pictures[0])
        azimuths_deg, used = [made.azimuth_deg], [0]
    else:
        found = reconstruct_several(model, pictures, known=views if known else None)
        made, azimuths_deg, used = found.made, found.azimuths_deg, found.used
    seconds = time.process_time() - start
    truth = KATO.voxelize(mesh.vertices[None], mesh.faces)
    ious = []
    for turn in range(4):
        cos, sin = [(1, 0), (0, 1), (-1, 0), (0, -1)][turn]
        matrix = torch.tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]], dtype=torch.float32)
        turned = (made.surface.vertices @ matrix).clamp(-0.499, 0.499)
        grid = KATO.voxelize(turned[None], made.surface.faces)
        ious.append(float(nmr.metrics.voxel_iou(grid, truth)))
    errors = wrap_deg(torch.tensor(azimuths_deg) - views.azimuth_deg[used])
    apart = wrap_deg(errors[:, None] - errors).abs()  # each picture's error is tried as the turn
    right, common = int((errors.abs() < NEAR_DEG).sum()), int((apart < NEAR_DEG).sum(0).max())
    row = [ious[0], max(ious), made.silhouette_iou, right / count, common / count, seconds]
    return row, made.surface


def main(
    models: Path,
    half: Literal["tune", "test"] = "tune",
    objects: int = 8,
    counts: tuple[int, ...] = (1, 2, 4, 8),
    cameras: tuple[Literal["unknown", "known"], ...] = ("unknown", "known"),
    hand_held: bool = False,
    sheet: Path | None = None,
) -> None:
    """Print a line of means over meshes for each number of pictures.

    models: a folder of meshes or a mesh pack, of which one half is used; y is up, the front
    towards +z. Columns: voxel IoU (kato18) as it is and after the best quarter turn, outline IoU,
    shares of azimuths that are right within 30 degrees as they are and after the best common turn,
    processor seconds. hand_held: see `take_pictures`. sheet: PNG file with the true and the made
    meshes of the largest number of pictures.
    """
    model, rows = load_model(None), []
    sources = list(mesh_sources(models).values())
    order = np.random.default_rng(0).permutation(len(sources))[half == "test" :: 2][:objects]
    print(f"{'pictures':>8} {'cameras':>8}", *(f"{column:>11}" for column in COLUMNS))
    for count, kind in itertools.product(counts, cameras):
        if count == 1 and kind == "known":
            continue
        values = []
        for number in order.tolist():
            read = check(sources[number]())
            vertices = fit_to_box(read.vertices) @ mesh_to_object("y", "z").T
            mesh = Surface(torch.from_numpy(vertices).float(), torch.from_numpy(read.faces))
            rng = np.random.default_rng([number, count])
            row, surface = measure(model, mesh, rng, count, kind == "known", hand_held)
            values.append(row)
            if sheet and count == max(counts):
                pair = [draw_around(each, SHOWN_DEG, image_size=160) for each in (mesh, surface)]
                rows.append([*pair[0], *pair[1]])
        print(f"{count:8} {kind:>8}", *(f"{v:11.3f}" for v in np.mean(values, axis=0)), flush=True)
    if sheet:
        save_png(sheet, tile(rows, tile_size=160))


if __name__ == "__main__":
    tyro.cli(main)
