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
from learn3d.fitting.fit import fit, predict
from learn3d.fitting.templates import fit_template
from learn3d.make_data.meshes import fit_to_box
from learn3d.networks.encoders import centre
from learn3d.pictures.surfaces import azimuths_deg
from learn3d.reconstruction import load_model, recognize

COLUMNS = "outline: predicted,fitted,template,voxels: predicted,fitted,template,azimuth,kind,warned".split(",")


def main(data: Path, category: str, layout: Layout = "kato", run: Path | None = None, images: int = 20) -> None:
    """Print a line for each category: means over `images` test images, spread evenly over objects and views.

    Columns: IoU of mask and silhouette of the predicted shape, the fitted one and the template, their voxel IoUs
    (kato18), the share of images whose azimuth is right within 20 degrees, whose template has the right category, and
    with a warning. The model (default: the package's) must have templates.
    """
    model = load_model(run)
    print(f"{'':12}", *(f"{column:>20}" for column in COLUMNS))
    for name in category.split(","):
        dataset, rows = load_dataset(layout, data, name, "test"), []
        for index in np.linspace(0, len(dataset) - 1, images).round().astype(int):
            batch = dataset.batch(torch.tensor([index]))
            (image,), mask = batch.images, centre(batch.masks[:, None])[0, 0]
            predicted = predict(model.method, image, mask)
            template, kind = fit_template(model.templates, model.categories, predicted, mask)
            boxed = template._replace(vertices=torch.from_numpy(fit_to_box(template.vertices.numpy())))
            shapes = (predicted.shape, fit(model.method, predicted, mask), boxed)
            voxelize = dataset.convention.voxelize
            grids = [voxelize(shape.vertices[None].clamp(-0.499, 0.499), shape.faces) for shape in shapes]
            voxels = [float(nmr.metrics.voxel_iou(grid, batch.voxels)) for grid in grids]
            error_deg = wrap_deg(template.view.azimuth_deg - azimuths_deg(batch.poses))
            right = float(error_deg.abs()) < 20, kind == name, recognize(model, predicted.code[0])[1] is not None
            rows.append((*(shape.iou for shape in shapes), *voxels, *right))
        print(f"{name:12}", *(f"{value:20.3f}" for value in np.mean(rows, axis=0)), flush=True)


if __name__ == "__main__":
    tyro.cli(main)
