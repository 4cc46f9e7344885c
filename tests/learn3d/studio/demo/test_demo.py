"""Behind the page of `learn3d demo`: pictures, masks, meshes, and its sentences."""

from __future__ import annotations

import base64
import io
import socket

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy import ndimage

import nmr
from learn3d.data.conventions import mesh_to_object
from learn3d.data.masks import keep_object
from learn3d.data.poses import wrap_deg
from learn3d.pictures import Surface
from learn3d.studio.demo import picture as pictures
from learn3d.studio.picture_to_mesh import reconstruction
from learn3d.studio.picture_to_mesh.cutting import threshold_mask
from learn3d.studio.picture_to_mesh.export import export
from learn3d.studio.picture_to_mesh.reconstruction import input_azimuth_deg, load_model
from learn3d.studio.shapes import make_shape


@pytest.fixture
def photo() -> np.ndarray:
    """A noisy grey background with a dark ring, a pale disc inside the ring, and a dark dot."""
    colors = np.random.default_rng(0).integers(180, 200, (100, 160, 3)).astype(np.uint8)
    distance = np.hypot(*np.ogrid[-50:50, -80:80])
    colors[(distance < 30) & (distance > 15)] = (60, 30, 40)
    colors[distance <= 15] = 210
    colors[10:12, 10:12] = 0
    return colors


def test_the_mask_is_the_largest_region_and_only_the_background_makes_holes(photo) -> None:
    mask, left_out = keep_object(threshold_mask(photo, 0.2))
    assert mask.dtype == np.uint8 and set(np.unique(mask)) == {0, 255}
    assert np.array_equal(mask > 0, np.hypot(*np.ogrid[-50:50, -80:80]) < 30)
    assert left_out is None and not threshold_mask(photo, 0.9).any()
    photo[45:55, 75:85] = photo[:10, :10]
    assert (keep_object(threshold_mask(photo, 0.05))[0] == 0)[45:55, 75:85].all(), (
        "the background is seen"
    )
    photo[5:40, 5:40] = 0
    assert keep_object(threshold_mask(photo, 0.2))[1], "a second thing"


def test_pixels_are_unpacked_as_the_page_packs_them() -> None:
    given = np.random.default_rng(0).integers(0, 256, (3, 5, 4)).astype(np.uint8)
    picture = pictures.unpack(given.tobytes(), 5, 3)
    assert (
        np.array_equal(np.dstack([picture.colors, picture.mask]), given) and picture.strokes is None
    )
    strokes = np.arange(15, dtype=np.uint8).reshape(3, 5)
    picture = pictures.unpack(given.tobytes() + strokes.tobytes(), 5, 3)
    assert np.array_equal(np.dstack([picture.colors, picture.mask]), given) and np.array_equal(
        picture.strokes, strokes
    )


def test_the_object_is_given_or_found_or_corrected(photo) -> None:
    unknown, given = np.full((100, 160), 255, np.uint8), np.zeros((100, 160), np.uint8)
    given[20:40, 20:40] = 200
    ring, _ = keep_object(threshold_mask(photo))
    assert np.array_equal(pictures.find_object(pictures.Picture(photo, unknown))[0].mask, ring)
    assert np.array_equal(pictures.find_object(pictures.Picture(photo, given))[0].mask, given)
    apart = given.copy()
    apart[60:80, 100:120] = 255
    found, left_out = pictures.find_object(pictures.Picture(photo, apart))
    assert np.array_equal(found.mask, given) and left_out.startswith(
        "several objects of similar size"
    )
    strokes = np.zeros_like(given)
    strokes[10:20, 20:40] = 1
    given[90, 150] = 255
    (corrected, _, _), _ = pictures.find_object(pictures.Picture(photo, given, strokes))
    assert corrected[90, 150], "a correction keeps everything"
    corrected[90] = 0
    assert np.flatnonzero(corrected.any(axis=1)).tolist() == list(range(10, 40))
    boxed, _ = pictures.find_object(pictures.Picture(photo, unknown, None, (40, 10, 80, 80)))
    whole = ndimage.binary_fill_holes(boxed.mask > 127)  # the pale disc may be background
    assert (whole != (ring > 127)).mean() < 0.02


def test_a_picture_gets_its_mesh_step_by_step_or_a_sentence(finished_run) -> None:
    with Image.open(io.BytesIO(pictures.example("chair"))) as image:
        colors, alpha = np.split(np.asarray(image), [3], axis=2)
    assert 0.2 < (alpha > 127).mean() < 0.7
    sent: list[dict] = []
    models = {"my run": load_model(finished_run)}
    pictures.make_meshes(models, [pictures.Picture(colors.copy(), alpha[..., 0])], sent.append)
    assert (
        "mask" in sent[0]
        and sent[0]["left_out"] is None
        and [each["part"] for each in sent[1:-1]] == [0.0, 0.3, 0.7, 0.9]
    )
    (result,) = sent[-1]["meshes"]
    glb = base64.b64decode(result["glb"])
    assert result["label"] == "my run" and b"COLOR_0" in glb
    assert len(trimesh.load(io.BytesIO(glb), "glb", force="mesh").faces) > 100
    for mask in (np.zeros_like(alpha[..., 0]), np.full_like(alpha[..., 0], 254)):
        pictures.make_meshes(models, [pictures.Picture(colors, mask)], sent.append)
        error = "No object was found. Drag a box around it."
        assert sent[-1] == {"error": error, "tool": "box"}


def test_a_doubtful_outline_is_shown_and_a_box_is_asked_for(finished_run) -> None:
    colors = np.full((100, 120, 3), 200, np.uint8)
    colors[40:48] = (150, 30, 30)  # from side to side
    unknown = np.full((100, 120), 255, np.uint8)
    sent: list[dict] = []
    models = {"my run": load_model(finished_run)}
    pictures.make_meshes(models, [pictures.Picture(colors, unknown)], sent.append)
    shown, error = sent
    assert shown["how"] == "as all that differs from the plain background"
    assert np.unpackbits(np.frombuffer(base64.b64decode(shown["mask"]), np.uint8)).sum() == 8 * 120
    asked = "Is this the object? Its outline touches 2 sides of the picture. Drag a box around it."
    assert error == {"error": asked, "tool": "box"}


def test_the_side_of_the_input_is_found() -> None:
    mesh = make_shape("chair", np.random.default_rng(6))
    vertices = torch.from_numpy(mesh.vertices @ mesh_to_object("y", "z").T).float()
    faces = torch.from_numpy(mesh.faces)
    for azimuth in (0.0, 45.0, 210.0):
        camera = nmr.LookAt.from_angles(2.732, 30.0, [azimuth], half_fov_deg=15.0)
        mask = (
            (nmr.render_silhouette(vertices, faces, camera, image_size=128)[0] * 255).byte().numpy()
        )
        assert (
            abs(wrap_deg(torch.tensor(input_azimuth_deg(Surface(vertices, faces), mask) - azimuth)))
            < 5
        )


def test_the_packages_own_model_is_the_default(
    finished_run, tmp_path, monkeypatch, command
) -> None:
    monkeypatch.setattr(reconstruction, "SMALL_MODEL", tmp_path / "small.safetensors")
    (tmp_path / "car.png").write_bytes(pictures.example("car"))
    words = ("reconstruct", tmp_path / "car.png", "--output", tmp_path / "out")
    status, _, error = command(*words)
    assert (
        status == 1 and f"error: there is no checkpoint {tmp_path / 'small.safetensors'}" in error
    )
    export(finished_run, tmp_path / "small.safetensors")
    status, out, _ = command(*words)
    assert status == 0 and "car.glb" in out
    with Image.open(tmp_path / "out" / "car.png") as strip:
        assert strip.width == 8 * 196 + 4, "input, mask and six views"


def test_a_page_that_cannot_be_opened_is_one_sentence(finished_run, tmp_path, command) -> None:
    pytest.importorskip("uvicorn", reason="needs the extra demo")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        status, _, said = command("demo", "--port", port, "--no-browser", "--run", finished_run)
    assert (status, said) == (
        1,
        f"error: cannot open a page at 127.0.0.1:{port}; give another --port or --host\n",
    )
    status, _, said = command("demo", "--port", 0, "--no-browser", "--run", tmp_path / "none")
    assert status == 1 and "there is no checkpoint" in said and said.count("\n") == 1
