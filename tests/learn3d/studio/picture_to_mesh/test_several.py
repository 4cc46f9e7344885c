"""Several pictures of one object become one mesh, and pictures of other things are left out."""

from __future__ import annotations

import pytest
import torch

import nmr
from learn3d.pictures import photograph
from learn3d.studio.picture_to_mesh.reconstruction import load_model, reconstruct_several
from learn3d.studio.picture_to_mesh.templates import template


def test_three_pictures_become_one_mesh_without_a_wrong_one() -> None:
    model = load_model(None)
    pictures = []
    for category, azimuth_deg in (
        ("chair", 30.0),
        ("chair", 120.0),
        ("airplane", 40.0),
        ("chair", -60.0),
    ):
        vertices, faces = template(
            category, int(model.templates.numbers[model.categories.index(category), 8])
        )
        camera = nmr.LookAt.from_angles(2.7, 20.0, [azimuth_deg], half_fov_deg=15.0)
        colors, mask = photograph(vertices, faces, (0.2, 0.5, 0.3), camera, image_size=128)
        pictures.append((colors[0], mask[0]))
    found = reconstruct_several(model, pictures)
    assert found.used == [0, 1, 3] and list(found.left_out) == [2]
    assert found.made.kind == "chair" and found.made.silhouette_iou > 0.75
    assert (
        torch.isfinite(found.made.surface.vertices).all() and found.made.surface.texture is not None
    )
    with pytest.raises(ValueError, match="2 to 8 pictures, got 1"):
        reconstruct_several(model, pictures[:1])
