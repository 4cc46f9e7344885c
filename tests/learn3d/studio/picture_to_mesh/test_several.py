"""Several pictures of one object become one mesh, and pictures of other things are left out."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh

import nmr
from learn3d.pictures import photograph
from learn3d.studio.picture_to_mesh.fit import Prediction, frame_view
from learn3d.studio.picture_to_mesh.reconstruction import load_model, reconstruct_several
from learn3d.studio.picture_to_mesh.several import find_strangers
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


def test_thin_legs_are_whole_if_cameras_are_known() -> None:
    corners = [(x, z) for x in (-0.2, 0.2) for z in (-0.2, 0.2)]
    boxes = [((0.5, 0.05, 0.5), (0, 0, 0)), ((0.5, 0.3, 0.05), (0, 0.35, 0.2))]
    boxes += [((0.03, 0.5, 0.03), (x, -0.25, z)) for x, z in corners]
    boxes += [((0.03, 0.4, 0.03), (x, 0.2, 0.2)) for x in (-0.2, 0.2)]
    stool = trimesh.util.concatenate(
        [trimesh.creation.box(size).apply_translation(place) for size, place in boxes]
    )
    vertices, faces = torch.tensor(stool.vertices).float(), torch.tensor(stool.faces)
    views = frame_view(vertices, torch.tensor([20.0, 115.0, -165.0, -70.0]), torch.full((4,), 25.0))
    pictures = []
    for number in range(4):
        view = views.select(torch.tensor([number]))
        (rgb,), (alpha,) = photograph(
            view.place(vertices[None])[0], faces, (0.2, 0.5, 0.3), view.cameras(), image_size=256
        )
        pictures.append((rgb, alpha))
    found = reconstruct_several(load_model(None), pictures, category="chair", known=views)
    assert found.used == [0, 1, 2, 3] and found.made.silhouette_iou > 0.85
    points = found.made.surface.vertices
    for x, z in corners:
        for y in (-0.1, -0.2, -0.3, -0.4, -0.48):
            assert (points - torch.tensor([x, y, z])).norm(dim=1).min() < 0.06


def test_a_picture_with_another_code_and_other_colours_is_a_stranger() -> None:
    def look(cosine: float, color: tuple[int, int, int]) -> tuple[Prediction, np.ndarray]:
        code = torch.tensor([[cosine, math.sqrt(1 - cosine**2)]])
        picture = np.zeros((4, 32, 32), np.uint8)
        picture[:, 8:24, 8:24] = np.array([*color, 255], np.uint8)[:, None, None]
        return Prediction(code, None, None), picture

    red, darker, blue = (180, 40, 40), (150, 35, 30), (40, 40, 180)
    alike = [look(1.0, red), look(0.95, darker), look(0.9, red)]
    for more, strangers in (
        ([], []),
        ([look(0.7, darker)], []),
        ([look(0.7, blue)], [3]),
        ([look(-0.5, red)], [3]),
        ([look(0.7, blue), look(-0.5, red)], [3, 4]),
    ):
        assert find_strangers(*zip(*alike, *more, strict=True)) == strangers
    assert find_strangers(*zip(look(1.0, red), look(-0.5, blue), strict=True)) == []
