"""Measures how well camera and shape are fitted to the images of a data set, with the cameras treated as unknown.

python tools/measure_fit.py --data data --category chair,sofa --images 20
"""

from pathlib import Path

import numpy as np
import torch
import tyro

import nmr
from learn3d.data.layouts import Layout, load_dataset
from learn3d.data.poses import wrap_deg
from learn3d.fitting.fit import fit
from learn3d.networks.encoders import centre
from learn3d.pictures.surfaces import azimuths_deg
from learn3d.reconstruction import load_model, recognize

COLUMNS = ("predicted", "code fitted", "vertices fitted", "voxels predicted", "voxels fitted", "azimuth", "warned")


def main(data: Path, category: str, layout: Layout = "kato", run: Path | None = None, images: int = 20) -> None:
    """Print a line for each category: means over `images` test images, spread evenly over objects and views.

    Columns: three IoUs of mask and silhouette, two voxel IoUs (kato18), the share of images whose azimuth is right
    within 20 degrees, the share with a warning.
    """
    model = load_model(run)
    print(f"{'':12}", *(f"{column:>16}" for column in COLUMNS))
    for name in category.split(","):
        dataset = load_dataset(layout, data, name, "test")
        rows = []
        for index in np.linspace(0, len(dataset) - 1, images).round().astype(int):
            batch = dataset.batch(torch.tensor([index]))
            (image,), mask = batch.images, centre(batch.masks[:, None])[0, 0]
            fitted = fit(model.method, image, mask)
            code = model.method.encode(batch.images)
            ious = [
                float(nmr.metrics.voxel_iou(dataset.voxelize(shape, model.method.faces), batch.voxels))
                for shape in (model.method.decode(code).vertices, fitted.vertices[None].clamp(-0.499, 0.499))
            ]
            error_deg = wrap_deg(fitted.view.azimuth_deg - azimuths_deg(batch.poses))
            warned = recognize(model, image)[1] is not None
            row = (fitted.predicted_iou, fitted.code_iou, fitted.iou, *ious, float(error_deg.abs()) < 20, warned)
            rows.append(row)
        print(f"{name:12}", *(f"{value:16.3f}" for value in np.mean(rows, axis=0)), flush=True)


if __name__ == "__main__":
    tyro.cli(main)
