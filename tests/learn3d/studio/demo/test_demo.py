"""Behind the page of `learn3d demo`: pictures, masks, meshes, and its sentences."""

from __future__ import annotations

import base64
import dataclasses
import io
import socket
import time

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage

from learn3d.data.conventions import mesh_to_object
from learn3d.data.masks import keep_object
from learn3d.files.formats import read_mesh
from learn3d.pictures import Surface
from learn3d.studio.demo import picture as pictures
from learn3d.studio.picture_to_mesh import make
from learn3d.studio.picture_to_mesh.cutting import threshold_mask
from learn3d.studio.picture_to_mesh.export import export
from learn3d.studio.picture_to_mesh.fit import View
from learn3d.studio.picture_to_mesh.make import load_model
from learn3d.studio.picture_to_mesh.write import Reconstruction


@pytest.fixture
def photo() -> np.ndarray:
    """A noisy grey background with a dark ring, a pale disc inside the ring, and a dark dot."""
    colors = np.random.default_rng(0).integers(180, 200, (100, 160, 3)).astype(np.uint8)
    distance = np.hypot(*np.ogrid[-50:50, -80:80])
    colors[(distance < 30) & (distance > 15)] = (60, 30, 40)
    colors[distance <= 15] = 210
    colors[10:12, 10:12] = 0
    return colors


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
    assert np.array_equal(pictures.outline_object(pictures.Picture(photo, unknown))[0].mask, ring)
    assert np.array_equal(pictures.outline_object(pictures.Picture(photo, given))[0].mask, given)
    apart = given.copy()
    apart[60:80, 100:120] = 255
    found, left_out = pictures.outline_object(pictures.Picture(photo, apart))
    assert np.array_equal(found.mask, given) and left_out.startswith(
        "several objects of similar size"
    )
    strokes = np.zeros_like(given)
    strokes[10:20, 20:40] = 1
    given[90, 150] = 255
    (corrected, _, _), _ = pictures.outline_object(pictures.Picture(photo, given, strokes))
    assert corrected[90, 150], "a correction keeps everything"
    corrected[90] = 0
    assert np.flatnonzero(corrected.any(axis=1)).tolist() == list(range(10, 40))
    boxed, _ = pictures.outline_object(pictures.Picture(photo, unknown, None, (40, 10, 80, 80)))
    whole = ndimage.binary_fill_holes(boxed.mask > 127)  # the pale disc may be background
    assert (whole != (ring > 127)).mean() < 0.02


def test_a_picture_without_an_object_gets_a_sentence(finished_run, photo) -> None:
    sent: list[dict] = []
    models = {"my run": load_model(finished_run)}
    for value in (0, 254):
        mask = np.full(photo.shape[:2], value, np.uint8)
        pictures.make_meshes(models, pictures.Picture(photo, mask), sent.append)
        error = "No object was found. Drag a box around it."
        assert sent[-1] == {"error": error, "tool": "box"}


def test_a_doubtful_outline_is_said_and_gets_its_mesh(finished_run) -> None:
    colors = np.full((100, 120, 3), 200, np.uint8)
    colors[40:48] = (150, 30, 30)  # from side to side
    sent: list[dict] = []
    models = {"my run": load_model(finished_run)}
    picture = pictures.Picture(colors, np.full((100, 120), 255, np.uint8))
    pictures.make_meshes(models, picture, sent.append)
    shown, doubt, *steps, last = sent
    assert shown["how"] == "as all that differs from the plain background"
    assert np.unpackbits(np.frombuffer(base64.b64decode(shown["mask"]), np.uint8)).sum() == 8 * 120
    asked = "Is this the object? Its outline touches the border of the picture."
    assert doubt == {"doubt": f"{asked} If not, drag a box around it.", "tool": "box"}
    assert [step["part"] for step in steps] == [0.0, 0.3, 0.7, 0.9] and last["meshes"]


def test_a_stroke_over_nearly_all_of_an_object_is_refused() -> None:
    mask = np.zeros((100, 120), np.uint8)
    mask[30:70, 30:90] = 255
    strokes = np.full_like(mask, 2)  # background
    sent: list[dict] = []
    for last in (32, 31):
        strokes[:, 30:last] = 0
        picture = pictures.Picture(np.full((100, 120, 3), 150, np.uint8), mask, strokes)
        pictures.make_meshes({}, picture, sent.append)
        strokes[:] = 2
    (found, made), (refused,) = sent[:2], sent[2:]
    assert found["how"] == "by hand" and made == {"meshes": []}
    assert refused["error"].startswith("Almost nothing of the object is left.")


def test_a_kind_is_told_to_the_models_that_know_it(finished_run) -> None:
    model = load_model(finished_run)
    other = model._replace(config=dataclasses.replace(model.config, category="car"))
    colors = np.full((100, 120, 3), 200, np.uint8)
    colors[30:70, 30:90] = (150, 30, 30)
    picture = pictures.Picture(colors, np.full((100, 120), 255, np.uint8))
    sent: list[dict] = []
    pictures.make_meshes({"a": model, "b": other}, picture, sent.append, category="car")
    assert [made["kind"] for made in sent[-1]["meshes"]] == [None, "car"]


def test_an_empty_shape_hides_no_mesh_of_another_model(finished_run, monkeypatch) -> None:
    model, original = load_model(finished_run), pictures.reconstruct_guesses
    empty = model._replace(object_size=0.5)
    nothing = Surface(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64))

    def guess(model, *picture, **options):
        for made in original(model, *picture, **options):
            yield made._replace(surface=nothing) if model is empty else made

    monkeypatch.setattr(pictures, "reconstruct_guesses", guess)
    colors = np.full((100, 120, 3), 200, np.uint8)
    colors[30:70, 30:90] = (150, 30, 30)
    picture = pictures.Picture(colors, np.full((100, 120), 255, np.uint8))
    sent: list[dict] = []
    pictures.make_meshes({"a": empty, "b": model}, picture, sent.append)
    assert [made["label"] for made in sent[-1]["meshes"]] == ["b"]
    doubt = "An empty shape was made of this picture by a."
    assert sent[-2] == {"doubt": doubt}
    pictures.make_meshes({"a": empty}, picture, sent.append)
    assert sent[-1] == {"error": f"{doubt} Try another one."}


def test_the_camera_of_a_mesh_is_that_of_its_picture() -> None:
    """A point of the mesh is seen where the camera of the fit sees the same point of the object."""
    vertices = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)) / 4
    view = View(
        *torch.tensor([[40.0], [25.0], [1.5]]), torch.tensor([[0.1, -0.2]]), torch.tensor([9.0])
    )
    made = Reconstruction(Surface(vertices, torch.zeros(0, 3)), None, 40.0, view=view)
    camera = pictures._camera(made)
    yaw, pitch = camera["yaw"], camera["pitch"]
    towards = np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)
    assert np.allclose(camera["axes"][2], towards, atol=1e-6), "the page turns it from there"
    points = vertices.numpy() @ mesh_to_object() @ np.transpose(camera["axes"])
    near = camera["focus"] / (camera["distance"] - points[:, 2])
    x, y, _ = view.cameras().transform(vertices)[0].unbind(1)
    for axis, wanted in enumerate((x, y)):
        assert np.allclose(2 * near * (points[:, axis] + camera["shift"][axis]), wanted, atol=1e-4)


def test_pictures_full_of_holes_cost_at_most_three_times_as_much() -> None:
    """No template fits them, so other cameras are tried; the holes themselves cost next to nothing."""
    models = {"small model": load_model(None)}
    with Image.open(io.BytesIO(pictures.example("chair"))) as image:
        colors, alpha = np.split(np.asarray(image), [3], axis=2)
    y, x = np.indices((512, 512))
    middle = (np.abs(x - 256) < 230) & (np.abs(y - 256) < 230)
    masks = [
        (x // 8 + y // 8) % 2 == 0,
        np.abs(np.hypot(x - 256, y - 256) - 200) < 3,
        middle & ~((x % 2 == 0) & (y % 2 == 0)),
        np.random.default_rng(0).random((512, 512)) < 0.6,
    ]
    ordinary = pictures.Picture(np.ascontiguousarray(colors), alpha[..., 0].copy())
    unknown = np.full((512, 512), 255, np.uint8)
    holes = [
        pictures.Picture(
            np.where(mask[..., None], np.uint8(30), np.full(3, 200, np.uint8)), unknown
        )
        for mask in masks
    ]
    seconds = []
    for picture in (ordinary, ordinary, *holes):  # the first time is longer
        start = time.process_time()
        pictures.make_meshes(models, picture, lambda _: None)
        seconds.append(time.process_time() - start)
    assert max(seconds[2:]) < 3 * seconds[1], seconds


def test_the_packages_own_model_is_the_default(
    finished_run, tmp_path, monkeypatch, command
) -> None:
    monkeypatch.setattr(make, "SMALL_MODEL", tmp_path / "small.safetensors")
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


def test_the_packages_own_model_obeys_what_is_known_of_a_picture(tmp_path, command) -> None:
    (tmp_path / "car.png").write_bytes(pictures.example("car"))
    words = ("reconstruct", tmp_path / "car.png", "--output")
    status, _, said = command(*words, tmp_path / "two", "--guesses", 2, "--category", "sofa")
    assert status == 0 and "car: category sofa, sofa\n" in said
    first, second = (read_mesh(tmp_path / "two" / name) for name in ("car.glb", "car-2.glb"))
    assert (
        first.vertices.shape != second.vertices.shape or (first.vertices != second.vertices).any()
    )
    status, _, said = command(*words, tmp_path / "smooth", "--smooth", "--format", "obj")
    smooth = read_mesh(tmp_path / "smooth" / "car.obj")
    assert status == 0 and "category" not in said and len(smooth.faces) > 500


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
