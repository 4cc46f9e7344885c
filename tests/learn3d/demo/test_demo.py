"""Behind the page of `learn3d demo`: pictures, masks, meshes, and its sentences."""

from __future__ import annotations

import socket

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import nmr
from learn3d import reconstruction
from learn3d.data.framing import threshold_mask
from learn3d.demo import picture as pictures
from learn3d.pictures.surfaces import Surface
from learn3d.reconstruction import input_azimuth_deg, load_model
from learn3d.runs.export import export


@pytest.fixture
def photo() -> np.ndarray:
    """A grey, noisy background with a dark ring and a dark speck."""
    colors = np.random.default_rng(0).integers(180, 200, (100, 160, 3)).astype(np.uint8)
    rows, columns = np.ogrid[:100, :160]
    distance = np.hypot(rows - 50, columns - 80)
    colors[(distance < 30) & (distance > 15)] = (60, 30, 40)
    colors[10:12, 10:12] = 0
    return colors


def test_the_mask_is_the_largest_region_without_holes(photo) -> None:
    mask = threshold_mask(photo, 0.2)
    rows, columns = np.ogrid[:100, :160]
    assert mask.dtype == np.uint8 and set(np.unique(mask)) == {0, 255}
    assert np.array_equal(mask > 0, np.hypot(rows - 50, columns - 80) < 30)
    assert not threshold_mask(photo, 0.9).any()


def test_pictures_are_laid_on_a_square_and_keep_their_mask(photo, tmp_path) -> None:
    Image.fromarray(photo).resize((1600, 1000)).save(tmp_path / "ring.jpg")
    picture, side = pictures.open_picture(tmp_path / "ring.jpg", 0.2), pictures.SIDE
    assert (picture.colors.shape, picture.mask.shape, picture.name) == ((side, side, 3), (side, side), "ring")
    assert (picture.mask > 0).mean() == pytest.approx(np.pi * (30 / 160) ** 2, rel=0.05)
    assert picture.colors[0].min() > 150, "the background goes on"
    again = pictures.open_picture(pictures.write_cutout(picture, tmp_path))
    seen = picture.mask > 0
    assert again.name == "ring" and np.array_equal(again.mask, picture.mask)
    assert np.array_equal(again.colors[seen], picture.colors[seen]) and (again.colors[~seen] == 255).all()


def test_a_picture_becomes_a_mesh(finished_run, tmp_path) -> None:
    picture = pictures.example("chair", 3)
    assert 0.05 < (picture.mask > 127).mean() < 0.5
    made = pictures.make_mesh(load_model(finished_run), picture)
    glb, obj = pictures.write_mesh(made.surface, tmp_path / "new", "my chair")
    meshes = [trimesh.load(path, force="mesh", process=False) for path in (glb, obj)]
    assert glb.name == "my chair.glb" and list(trimesh.load(glb).geometry) == ["my chair"]
    assert np.allclose(meshes[0].vertices, meshes[1].vertices, atol=1e-6)
    assert len(meshes[0].faces) > 100 and 0 < made.silhouette_iou <= 1
    assert len(made.surface.colors.unique(dim=0)) > 20, "in the picture's colours"
    for mask in (np.zeros_like(picture.mask), np.full_like(picture.mask, 255)):
        with pytest.raises(ValueError, match="no object was found in the picture; correct the outline"):
            pictures.make_mesh(load_model(finished_run), picture._replace(mask=mask))


def test_generated_examples_keep_their_size(finished_run, monkeypatch) -> None:
    model, crops = load_model(finished_run), []
    prepare = type(model).prepare
    monkeypatch.setattr(type(model), "prepare", lambda *given, crop: crops.append(crop) or prepare(*given, crop=crop))
    for framed in (True, False):
        pictures.make_mesh(model, pictures.example("car", 3)._replace(framed=framed))
    assert crops == [False, True]


def test_the_side_of_the_input_is_found() -> None:
    vertices, faces = nmr.icosphere(3)
    bumps = torch.stack([torch.tensor(bump) for bump in ([1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0])])
    towards = (vertices @ bumps.T).clamp(min=0) ** 8
    surface = Surface(0.25 * vertices + towards * torch.tensor([0.3, 0.2, 0.15]) @ bumps, faces)
    for azimuth in (0.0, 45.0, 210.0):
        camera = nmr.LookAt.from_angles(2.732, 30.0, [azimuth], half_fov_deg=15.0)
        mask = (nmr.render_silhouette(surface.vertices, faces, camera, image_size=128)[0] * 255).byte().numpy()
        assert input_azimuth_deg(surface, mask) == azimuth


def test_the_packages_own_model_is_the_default(finished_run, tmp_path, monkeypatch, command) -> None:
    monkeypatch.setattr(reconstruction, "SMALL_MODEL", tmp_path / "small.safetensors")
    picture = pictures.example("car", 1)
    Image.fromarray(np.dstack([picture.colors, picture.mask])).save(tmp_path / "car.png")
    words = ("reconstruct", tmp_path / "car.png", "--output", tmp_path / "out")
    status, _, error = command(*words)
    assert status == 1 and f"error: there is no checkpoint {tmp_path / 'small.safetensors'}" in error
    export(finished_run, tmp_path / "small.safetensors")
    status, out, _ = command(*words)
    assert status == 0 and "car.glb" in out
    with Image.open(tmp_path / "out" / "car.png") as strip:
        assert strip.width == 8 * 196 + 4, "input, mask and six views"


def test_a_page_that_cannot_be_opened_is_one_sentence(finished_run, tmp_path, command) -> None:
    pytest.importorskip("gradio", reason="needs the extra demo")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        status, _, said = command("demo", "--port", port, "--no-browser", "--run", finished_run)
    assert (status, said) == (1, f"error: cannot open a page at 127.0.0.1:{port}; give another --port or --host\n")
    status, _, said = command("demo", "--port", 0, "--no-browser", "--run", tmp_path / "none")
    assert status == 1 and "there is no checkpoint" in said and said.count("\n") == 1
