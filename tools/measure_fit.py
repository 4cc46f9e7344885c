"""Measures how well camera and shape are fitted to pictures of meshes, with the cameras treated as unknown.

python tools/measure_fit.py --models models --category chair,sofa --images 48
"""

from pathlib import Path

import numpy as np
import torch
import tyro

import nmr
from learn3d.data.conventions import KATO, mesh_to_object, view_poses
from learn3d.data.poses import wrap_deg
from learn3d.pictures import photograph
from learn3d.studio.make_data.looks import natural_look
from learn3d.studio.make_data.meshes import check, fit_to_box, mesh_sources
from learn3d.studio.picture_to_mesh.fit import fit, frame_target, predict
from learn3d.studio.picture_to_mesh.make import load_model, match_templates
from learn3d.studio.picture_to_mesh.options import DEFAULTS, FitOptions, MatchOptions, Options

COLUMNS = "outline: predicted,fitted,template,voxels: predicted,fitted,template,azimuth,kind,warned".split(
    ","
)


def main(
    models: Path,
    category: str,
    run: Path | None = None,
    images: int = 48,
    fit_options: FitOptions = DEFAULTS.fit,
    match_options: MatchOptions = DEFAULTS.match,
) -> None:
    """Print a line for each category: means over `images` pictures of the meshes in the folder models/CATEGORY.

    The meshes have y up and the front towards +z. Pictures have 256x256 pixels, everyday colours,
    and random ones of Kato's 24 cameras. Columns: IoU of mask and silhouette of the predicted
    shape, the fitted one and the template, their voxel IoUs (kato18), the share of pictures whose
    azimuth is right within 20 degrees, whose template has the right category, and with a warning.
    The model (default: the package's) must have templates.
    """
    model, options = load_model(run), Options(fit=fit_options, match=match_options)
    print(f"{'':12}", *(f"{column:>20}" for column in COLUMNS))
    for name in category.split(","):
        sources, rows = list(mesh_sources(models / name).values()), []
        for number in range(images):
            mesh, rng = check(sources[number % len(sources)]()), np.random.default_rng(number)
            vertices = torch.from_numpy(
                fit_to_box(mesh.vertices) @ mesh_to_object("y", "z").T
            ).float()
            pose = view_poses(torch.from_numpy(rng.integers(24, size=1)))
            colors, lights = natural_look(vertices.numpy(), mesh.faces, rng)
            look = {"image_size": 256, "lights": lights}
            (rgb,), (alpha,) = photograph(vertices, mesh.faces, colors, pose.cameras(), **look)
            outline = frame_target(rgb, alpha).outline()
            image = torch.from_numpy(model.prepare(rgb, alpha))
            predicted = predict(model.method, image, outline, options=options.fit)
            matched = match_templates(model, predicted, (rgb, alpha), options=options)
            template, kind, warning = matched[0]
            boxed = template._replace(
                vertices=torch.from_numpy(fit_to_box(template.vertices.numpy()))
            )
            shapes = (
                predicted.shape,
                fit(model.method, predicted, outline, options=options.fit),
                boxed,
            )
            truth = KATO.voxelize(vertices[None], torch.from_numpy(mesh.faces))
            grids = [
                KATO.voxelize(shape.vertices[None].clamp(-0.499, 0.499), shape.faces)
                for shape in shapes
            ]
            voxels = [float(nmr.metrics.voxel_iou(grid, truth)) for grid in grids]
            error_deg = wrap_deg(template.view.azimuth_deg - pose.azimuth_deg)
            right = (
                float(error_deg.abs()) < 20,
                kind == name,
                warning is not None,
            )
            rows.append((*(shape.iou for shape in shapes), *voxels, *right))
        print(f"{name:12}", *(f"{value:20.3f}" for value in np.mean(rows, axis=0)), flush=True)


if __name__ == "__main__":
    tyro.cli(main)
