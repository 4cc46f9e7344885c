"""A sheet to check estimated azimuths by eye: prototypes, and images in columns of azimuths."""

import numpy as np
import torch

from learn3d.data.poses import LookAtPoses
from learn3d.pictures import Surface, draw_surface, natural_colors, orbit, tile
from learn3d.studio.poses.views import EstimatedViews

COLUMNS = 12  # azimuths on the sheet, at most
PROTOTYPES, IMAGE_ROWS = 6, 8  # rows of prototypes, and of images, at most
PICTURE_SIZE = 64  # side of a picture in pixels


def draw_pose_sheet(views: EstimatedViews, offset_deg: float = 0.0) -> np.ndarray:
    """Uint8 [H, W, 3]: frequent prototypes, and below each azimuth images with that estimate.

    offset_deg: added to the azimuths of images and prototypes, as by `PoseTable.turned`.
    """
    directions, heights, distance, half_fov = views.candidates
    result = views.result
    count = min(COLUMNS, len(directions))
    azimuths = directions[torch.linspace(0, len(directions), count + 1)[:-1].long()]
    middle = heights[len(heights) // 2 :][:1]
    cameras = orbit(
        LookAtPoses(torch.full((1,), -offset_deg), middle, distance, half_fov), azimuths.tolist()
    )
    order = result.weights.argsort(descending=True)[:PROTOTYPES]
    rows = [
        list(
            draw_surface(
                Surface(result.prototypes[m], result.faces), cameras, image_size=PICTURE_SIZE
            )
        )
        for m in order
    ]
    places = [(dataset, i) for dataset in views.datasets for i in range(len(dataset))]
    found = torch.from_numpy(views.table.azimuth_deg[:, 0])[views.shown] + offset_deg
    columns = []
    for azimuth in azimuths:
        near = torch.nonzero(torch.remainder(found - azimuth + 180 / count, 360) < 360 / count)[
            :, 0
        ]
        chosen = near[torch.linspace(0, len(near) - 1, min(IMAGE_ROWS, len(near))).long()]
        pictures = []
        for row in views.shown[chosen].tolist():
            dataset, index = places[row]
            pictures.append(
                natural_colors(dataset.images[np.array([index])], inverted=dataset.inverted)[0]
            )
        columns.append(pictures + [None] * (IMAGE_ROWS - len(pictures)))
    names = [f"prototype, {float(result.weights[m]):.0%}" for m in order] + [
        "images",
        *[""] * (IMAGE_ROWS - 1),
    ]
    titles = [f"{azimuth:g}°" for azimuth in azimuths.tolist()]
    return tile(
        [*rows, *map(list, zip(*columns, strict=True))],
        titles,
        tile_size=PICTURE_SIZE,
        row_titles=names,
        rules=(len(rows),),
    )
