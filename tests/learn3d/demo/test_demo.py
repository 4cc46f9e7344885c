"""What is behind the page of `learn3d demo`: pictures, masks, meshes, the fit, and its sentences."""

from __future__ import annotations

import socket
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import nmr
from learn3d.data.framing import threshold_mask
from learn3d.demo import fit_tab, picture_tab
from learn3d.pictures.surfaces import Surface
from learn3d.reconstruction import input_azimuth_deg, load_model
from learn3d.runs import export as exporting
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


def test_pictures_are_laid_on_a_square(photo, tmp_path) -> None:
    Image.fromarray(photo).resize((1600, 1000)).save(tmp_path / "ring.jpg")
    picture = picture_tab.open_picture(tmp_path / "ring.jpg", 0.2)
    side = picture_tab.SIDE
    assert (picture.colors.shape, picture.mask.shape, picture.name) == ((side, side, 3), (side, side), "ring")
    assert (picture.mask > 0).mean() == pytest.approx(np.pi * (30 / 160) ** 2, rel=0.05)
    assert picture.colors[0].min() > 150, "the background goes on"
    alpha = np.zeros((40, 20), np.uint8)
    alpha[10:30, 5:15] = 255
    Image.fromarray(np.dstack([photo[:40, :20], alpha])).save(tmp_path / "alpha.png")
    mask = picture_tab.open_picture(tmp_path / "alpha.png").mask
    top, left = (side - 40) // 2, (side - 20) // 2
    assert np.array_equal(mask[top : top + 40, left : left + 20], alpha) and mask.sum() == alpha.sum()


def test_a_saved_object_keeps_its_mask(photo, tmp_path) -> None:
    Image.fromarray(photo).save(tmp_path / "ring.png")
    picture = picture_tab.open_picture(tmp_path / "ring.png", 0.2)
    (tmp_path / "saved").mkdir()
    again = picture_tab.open_picture(picture_tab.write_cutout(picture, tmp_path / "saved"))
    assert again.name == "ring" and np.array_equal(again.mask, picture.mask)
    seen = picture.mask > 0
    assert np.array_equal(again.colors[seen], picture.colors[seen]) and (again.colors[~seen] == 255).all()


def test_rembg_makes_the_mask_where_it_is_installed(photo, monkeypatch) -> None:
    def remove(image: Image.Image, *, only_mask: bool) -> Image.Image:
        assert only_mask
        return image.getchannel("R")

    monkeypatch.setitem(sys.modules, "rembg", SimpleNamespace(remove=remove))
    assert np.array_equal(picture_tab.object_mask(photo), photo[..., 0])


@pytest.mark.parametrize("content", [b"", b"no picture", b"\x89PNG\r\n\x1a\n" + bytes(99)])
def test_broken_pictures_are_one_sentence(content: bytes, tmp_path) -> None:
    (tmp_path / "broken.png").write_bytes(content)
    with pytest.raises(ValueError, match=r"broken\.png") as error:
        picture_tab.open_picture(tmp_path / "broken.png")
    assert "\n" not in str(error.value)


def test_a_picture_becomes_a_mesh(finished_run, tmp_path) -> None:
    picture = picture_tab.example("chair", 3)
    assert 0.05 < (picture.mask > 127).mean() < 0.5
    surface, azimuth = picture_tab.make_mesh(load_model(finished_run), picture)
    glb, obj = picture_tab.write_mesh(surface, tmp_path / "new", "my chair")
    meshes = [trimesh.load(path, force="mesh", process=False) for path in (glb, obj)]
    assert glb.name == "my chair.glb" and list(trimesh.load(glb).geometry) == ["my chair"]
    assert np.allclose(meshes[0].vertices, meshes[1].vertices, atol=1e-6)
    assert len(meshes[0].faces) > 100 and azimuth % 15 == 0
    for mask in (np.zeros_like(picture.mask), np.full_like(picture.mask, 255)):
        with pytest.raises(ValueError, match=r"mask is .* Correct it"):
            picture_tab.make_mesh(load_model(finished_run), picture._replace(mask=mask))


def test_generated_examples_keep_their_size() -> None:
    seen = []

    class Watched:
        method = None

        def prepare(self, colors, mask, **options):
            seen.append(options)
            raise KeyError

    for picture in (picture_tab.example("car", 3), picture_tab.example("car", 3)._replace(framed=False)):
        with pytest.raises(KeyError):
            picture_tab.make_mesh(Watched(), picture)
    assert seen == [{"crop": False}, {"crop": True}]


def test_the_side_of_the_input_is_found() -> None:
    vertices, faces = nmr.icosphere(3)
    bumps = torch.stack([torch.tensor(bump) for bump in ([1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0])])
    towards = (vertices @ bumps.T).clamp(min=0) ** 8
    surface = Surface(0.25 * vertices + towards * torch.tensor([0.3, 0.2, 0.15]) @ bumps, faces)
    for azimuth in (0.0, 45.0, 210.0):
        camera = nmr.LookAt.from_angles(2.732, 30.0, [azimuth], half_fov_deg=15.0)
        mask = (nmr.render_silhouette(surface.vertices, faces, camera, image_size=128)[0] * 255).byte().numpy()
        assert input_azimuth_deg(surface, mask) == azimuth


def test_the_fit_makes_the_silhouettes_agree() -> None:
    rows, columns = np.ogrid[:200, :200]
    disc = (255 * (np.hypot(rows - 120, columns - 90) < 50)).astype(np.uint8)
    bar = np.zeros((200, 200), np.uint8)
    bar[70:170, 60:160] = 255
    moments = list(fit_tab.fit({"front": disc, "side": bar, "top": np.zeros_like(bar)}, steps=60))
    assert moments[0].iou < 0.8 and moments[-1].iou > 0.93
    assert [moment.step for moment in moments] == [*range(0, 60, 8), 60]
    surface = moments[-1].surface
    images = fit_tab.silhouettes(surface.vertices, surface.faces, ["front", "top"])
    assert 0.15 < float(images[0].mean()) < 0.25, "a disc on the right side of the right size"
    low, high = surface.vertices.amin(0), surface.vertices.amax(0)
    assert torch.allclose(low, torch.tensor([-0.6, -0.7, -0.4]), atol=0.1)
    assert torch.allclose(high, torch.tensor([0.4, 0.3, 0.6]), atol=0.1)
    assert moments[-1].picture.dtype == np.uint8 and moments[-1].picture.shape[2] == 3


def test_examples_of_silhouettes_agree_in_their_sizes() -> None:
    masks = fit_tab.example_silhouettes("car", 1)
    rows = {side: np.flatnonzero((mask > 127).any(axis=1)) for side, mask in masks.items()}
    columns = {side: np.flatnonzero((mask > 127).any(axis=0)) for side, mask in masks.items()}
    assert np.abs(rows["front"][[0, -1]] - rows["side"][[0, -1]]).max() <= 1
    assert np.abs(columns["front"][[0, -1]] - columns["top"][[0, -1]]).max() <= 1
    assert len(columns["side"]) > len(columns["front"]), "a car is longer than wide"


def test_one_silhouette_is_not_enough() -> None:
    one = np.full((8, 8), 255, np.uint8)
    with pytest.raises(ValueError, match="two sides"):
        next(fit_tab.fit({"front": one, "side": np.zeros_like(one), "top": None}))


def test_the_packages_own_model_is_the_default(finished_run, tmp_path, monkeypatch, command) -> None:
    monkeypatch.setattr(exporting, "SMALL_MODEL", tmp_path / "small.safetensors")
    picture = picture_tab.example("car", 1)
    Image.fromarray(np.dstack([picture.colors, picture.mask])).save(tmp_path / "car.png")
    words = ("reconstruct", tmp_path / "car.png", "--output", tmp_path / "out", "--frames", 2, "--image-size", 32)
    assert command(*words)[::2] == (1, f"error: {exporting.NO_SMALL_MODEL}\n")
    export(finished_run, tmp_path / "small.safetensors")
    status, out, _ = command(*words)
    assert status == 0 and "car.glb" in out
    with Image.open(tmp_path / "out" / "car.png") as strip:
        assert strip.width == 8 * 196 + 4, "input, mask and six views"


def test_a_page_that_cannot_be_opened_is_one_sentence(tmp_path, command) -> None:
    pytest.importorskip("gradio", reason="needs the extra demo")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        status, _, said = command("demo", "--port", port, "--no-browser")
    assert status == 1 and said.startswith(f"error: cannot open a page at 127.0.0.1:{port} (") and said.count("\n") == 1
    status, _, said = command("demo", "--port", 0, "--no-browser", "--run", tmp_path / "none")
    assert status == 1 and "there is no checkpoint" in said and said.count("\n") == 1
