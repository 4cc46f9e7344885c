"""Images into the data set's form, and meshes into files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image, ImageDraw

import nmr
from learn3d.data.conventions import mesh_to_object
from learn3d.data.crops import Crops
from learn3d.data.poses import wrap_deg
from learn3d.pictures import Surface
from learn3d.studio.picture_to_mesh.make import input_azimuth_deg, load_model, reconstruct
from learn3d.studio.picture_to_mesh.read import is_uncoloured, prepare_image, read_picture
from learn3d.studio.picture_to_mesh.reconstruction import (
    check_files,
    reconstruct_dataset,
    reconstruct_files,
)
from learn3d.studio.picture_to_mesh.write import export_mesh
from learn3d.studio.shapes import make_shape


def written_files(*arguments: Any, **options: Any) -> list[Path]:
    return list(reconstruct_files(*arguments, **options))


def test_data_set_image_survives_the_way_out_and_back(tiny_set) -> None:
    stored = tiny_set.images[3]
    again = prepare_image(255 - stored[:3].transpose(1, 2, 0), stored[3], crop=False)
    assert np.array_equal(again, stored)


def test_a_plain_background_is_cut_away(finished_run, tmp_path, short_turntables, capsys) -> None:
    picture = np.full((120, 160, 3), 240, np.uint8)
    picture[30:90, 50:110] = (180, 40, 30)
    Image.fromarray(picture).save(tmp_path / "box.png")
    written = written_files(finished_run, tmp_path / "out", [tmp_path / "box.png"])
    assert len(trimesh.load(written[0], force="mesh").faces) > 100
    Image.fromarray(np.full((40, 40, 3), 9, np.uint8)).save(tmp_path / "plain.png")
    with pytest.raises(
        ValueError, match=r"plain.png: no object was found .* Give --box or --masks"
    ):
        read_picture(tmp_path / "plain.png")
    picture[40:80, 120:150] = 0
    Image.fromarray(picture).save(tmp_path / "two.png")
    sentences = {
        "box.png": "differs from the plain background; if",
        "two.png": "one part away from the object, 33% of its size",
    }
    for name, said in sentences.items():
        mask = read_picture(tmp_path / name).mask
        assert mask[30:90, 50:110].all()
        assert mask.sum() == 255 * 60 * 60
        assert said in capsys.readouterr().err


def test_a_doubtful_outline_is_said_beside_the_mesh(
    finished_run, tmp_path, short_turntables, capsys
) -> None:
    colors = np.full((100, 120, 3), 200, np.uint8)
    colors[40:60] = (150, 30, 30)  # from side to side
    Image.fromarray(colors).save(tmp_path / "band.png")
    paths = written_files(finished_run, tmp_path / "out", [tmp_path / "band.png"])
    said = capsys.readouterr().err
    assert (
        paths[0].is_file()
        and "warning: band: its outline touches the border of the picture" in said
    )


@pytest.mark.parametrize("edge", [0, 2, 9])
@pytest.mark.parametrize("top", [0, 14])
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_a_frame_around_a_picture_is_no_object(edge: int, top: int, suffix, tmp_path) -> None:
    picture = np.full((160, 200, 3), 255, np.uint8)
    picture[50:110, 60:150] = (180, 40, 30)
    y, x = np.mgrid[:160, :200]
    disc = np.hypot(y - 40, x - 100) < 25
    picture[disc] = (40, 90, 160)
    wide = ((edge + top, edge), (edge, edge), (0, 0))
    framed = np.pad(picture, wide, constant_values=70)
    Image.fromarray(framed).save(tmp_path / f"framed.{suffix}")
    mask = read_picture(tmp_path / f"framed.{suffix}").mask > 127
    inside = np.pad((picture < 250).any(2), wide[:2])
    assert (mask != inside).mean() < (0.002 if suffix == "png" else 0.01)


@pytest.mark.parametrize(
    ("offset", "width", "radius"), [(3, 1, 0), (20, 2, 0), (0, 4, 16), (3, 2, 12)]
)
def test_a_line_around_a_picture_is_no_object(
    offset: int, width: int, radius: int, tmp_path
) -> None:
    for second in (False, True):  # a second line, of another colour, within it
        picture = Image.new("RGB", (300, 260), "white")
        lines = ImageDraw.Draw(picture)
        for k, color in enumerate(("black", "navy")[: 1 + second]):
            at = offset + k * width
            corners = (at, at, 299 - at, 259 - at)
            lines.rounded_rectangle(corners, max(0, radius - k * width), outline=color, width=width)
        lines.rectangle((110, 60, 189, 199), fill="firebrick")
        picture.save(tmp_path / "lined.png")
        photo = read_picture(tmp_path / "lined.png")
        inside = np.zeros((260, 300), bool)
        inside[60:200, 110:190] = True
        assert ((photo.mask > 127) == inside).all() and photo.doubt is None


def test_a_large_upright_rectangle_may_be_a_frame(tmp_path) -> None:
    picture = Image.new("RGB", (300, 260), "white")
    ImageDraw.Draw(picture).rounded_rectangle((12, 12, 287, 247), 20, outline="black", width=2)
    picture.save(tmp_path / "card.png")
    assert "perhaps a frame" in read_picture(tmp_path / "card.png").doubt


def test_a_small_object_is_said_however_large_the_picture(tmp_path, capsys) -> None:
    for size, said in (
        (31, "the object has only 31x20 of the 400x300 pixels that are used; "),
        (32, ""),
    ):
        pixels = np.zeros((300, 400, 4), np.uint8)
        pixels[100:120, 50 : 50 + size, 3] = 255
        Image.fromarray(pixels).save(tmp_path / "small.png")
        read_picture(tmp_path / "small.png")
        found = capsys.readouterr().err
        assert said in found and bool(found) == bool(said)


def test_a_large_picture_and_its_box_are_reduced_together(tmp_path) -> None:
    pytest.importorskip("cv2", reason="needs the extra photos")
    rng = np.random.default_rng(0)
    colors = rng.integers(60, 120, (900, 1200, 3))
    colors[300:600, 500:800] = (220, 30, 30)
    Image.fromarray(colors.astype(np.uint8)).save(tmp_path / "large.png")
    photo = read_picture(tmp_path / "large.png", None, (460, 260, 380, 380))
    assert photo.colors.shape == (384, 512, 3) == (*photo.mask.shape, 3)
    assert (photo.mask[132:252, 218:336] > 127).mean() > 0.95
    assert (photo.mask > 127).sum() < 1.2 * 128**2
    whole = read_picture(tmp_path / "large.png", None, (0, 0, 1199, 900))
    assert (whole.mask > 127).any(), "a box of nearly the whole picture"
    with pytest.raises(ValueError, match="must lie within the 1200x900 pixels"):
        read_picture(tmp_path / "large.png", None, (1000, 0, 300, 300))


def test_a_large_cut_out_object_is_reduced(tmp_path) -> None:
    pixels = np.zeros((3000, 4500, 4), np.uint8)
    pixels[500:1500, 600:2648] = (220, 30, 30, 255)
    Image.fromarray(pixels).save(tmp_path / "large.png")
    photo = read_picture(tmp_path / "large.png")
    assert photo.mask.shape == (1500, 2250) and (photo.mask > 127).sum() == 500 * 1024
    assert (photo.colors[photo.mask > 127] == (220, 30, 30)).all()


def test_a_black_drawing_with_colours_keeps_them() -> None:
    mask, drawn = np.full((40, 40), 255, np.uint8), np.zeros((40, 40, 3), np.uint8)
    for color, without in (((255, 255, 255), True), ((40, 60, 200), False)):
        drawn[:8] = color
        assert is_uncoloured(drawn, mask) == without
    assert not is_uncoloured(drawn[:16], mask[:16]), "half of it is not black"


def test_results_never_replace_the_images(finished_run, tmp_path) -> None:
    picture = np.zeros((64, 64, 4), np.uint8)
    picture[20:40, 10:50] = 255
    Image.fromarray(picture).save(tmp_path / "chair.png")
    before = (tmp_path / "chair.png").read_bytes()
    with pytest.raises(
        ValueError, match=r"chair\.png would replace an image that was given; give another --output"
    ):
        written_files(finished_run, tmp_path, [tmp_path / "chair.png"])
    assert (tmp_path / "chair.png").read_bytes() == before


def test_guesses_replace_no_file(finished_run, tmp_path) -> None:
    images = [tmp_path / "in" / name for name in ("a.png", "a-2.png")]
    assert check_files(tmp_path, images, ()) == ["a", "a-2"]
    assert check_files(tmp_path, images, (), guesses=2) == ["000_a", "001_a-2"]
    with pytest.raises(ValueError, match=r"a-2\.png would replace an image that was given"):
        written_files(finished_run, tmp_path / "in", [tmp_path / "a.png"], [images[1]], guesses=3)


@pytest.mark.parametrize("kind", ["glb", "obj", "ply"])
def test_files_of_others_are_not_replaced(finished_run, tiny_folder, tmp_path, kind) -> None:
    def make() -> list[Path]:
        return reconstruct_dataset(finished_run, tmp_path, tiny_folder, [5], mesh_format=kind)

    files = make()
    assert make() == files, "a second call replaces its own"
    for path in files:
        before = path.read_bytes()
        path.write_bytes(b"mine")
        with pytest.raises(ValueError, match=rf"{path.name} would be replaced, and is no file of"):
            make()
        assert path.read_bytes() == b"mine"
        path.write_bytes(before)


def test_an_empty_shape_is_an_empty_file(tmp_path) -> None:
    export_mesh(
        tmp_path / "empty.glb", Surface(torch.empty(0, 3), torch.empty(0, 3, dtype=torch.int64))
    )
    assert not trimesh.load(tmp_path / "empty.glb").geometry


def test_a_large_photograph_is_prepared_like_a_small_one() -> None:
    y, x = np.mgrid[:150, :200]
    colors = np.stack([x, y, x + y], axis=2).astype(np.uint8) // 2
    mask = (255 * (((x - 110) / 60) ** 2 + ((y - 70) / 50) ** 2 < 1)).astype(np.uint8)
    large = (
        np.kron(colors, np.ones((16, 16, 1), np.uint8)),
        np.kron(mask, np.ones((16, 16), np.uint8)),
    )
    for options in ({}, {"crop": False}, {"size": 32}):
        difference = prepare_image(*large, **options).astype(int) - prepare_image(
            colors, mask, **options
        )
        assert np.abs(difference).mean() < 2, options


@pytest.mark.parametrize(("y", "x", "factor"), [(0, 0, 1), (40, 100, 1), (199, 260, 1), (8, 20, 5)])
def test_crop_centres_and_scales_the_object(y: int, x: int, factor: int) -> None:
    mask = np.zeros((300 // factor, 400 // factor), np.uint8)
    mask[y : y + 60 // factor, x : x + 120 // factor] = 255
    stored = prepare_image(np.zeros((*mask.shape, 3), np.uint8), mask, object_size=0.75)
    rows, columns = np.flatnonzero(stored[3].max(1) > 127), np.flatnonzero(stored[3].max(0) > 127)
    assert (columns[0], columns[-1]) == (8, 55)
    assert (rows[0], rows[-1]) == (20, 43)
    assert np.array_equal(stored[0], stored[3])


def test_natural_colours_on_white_for_layouts_that_have_them() -> None:
    colors = np.full((64, 64, 3), (255, 0, 10), np.uint8)
    mask = np.zeros((64, 64), np.uint8)
    mask[10:20, 30:40] = 255
    for crop in (False, True):
        stored = prepare_image(colors, mask, crop=crop, size=32, layout="kar")
        assert stored[:3, 0, 0].tolist() == [255, 255, 255], "beside the image, too"
        assert [255, 0, 10, 255] in stored.reshape(4, -1).T.tolist()


def test_photographs_are_cut_as_pascals_reader_does() -> None:
    rng = np.random.default_rng(0)
    colors = rng.integers(0, 256, (120, 200, 3), np.uint8)
    mask = np.zeros((120, 200), np.uint8)
    mask[30:70, 50:130] = 255
    stored = prepare_image(colors, mask, size=64, layout="pascal3d")
    wanted = Crops.from_images([colors], np.array([[50, 30, 80, 40]]), 64).cut()[0]
    assert np.array_equal(stored[:3], wanted), "natural colours, background and all"
    assert stored[3].mean() == pytest.approx(255 / 1.3**2, rel=0.05)


@pytest.mark.parametrize("layout", ["kato", "pascal3d"])
def test_masks_that_show_nothing_are_refused(layout: str) -> None:
    with pytest.raises(ValueError, match="no pixel above half strength"):
        prepare_image(np.zeros((4, 4, 3), np.uint8), np.full((4, 4), 9, np.uint8), layout=layout)


@pytest.mark.parametrize("kind", ["obj", "glb", "ply"])
def test_mesh_files_are_right_handed_with_normals_outwards(tmp_path, kind: str) -> None:
    sphere, faces = nmr.icosphere(2)
    vertices = sphere * torch.tensor([0.5, 0.3, 0.2]) + torch.tensor([0.1, 0.2, 0.3])
    export_mesh(tmp_path / f"a.{kind}", Surface(vertices, faces))
    mesh = trimesh.load(tmp_path / f"a.{kind}", force="mesh")
    assert (len(mesh.vertices), len(mesh.faces)) == (162, 320)
    assert mesh.is_watertight
    assert mesh.volume > 0.9 * 4 / 3 * np.pi * 0.5 * 0.3 * 0.2
    # read with the data sets' rule the mesh is where the network put it
    assert np.allclose((mesh_to_object() @ mesh.bounds.T).T.mean(0), [0.1, 0.2, 0.3], atol=1e-5)
    assert np.allclose(mesh.extents, [0.4, 0.6, 1.0], atol=1e-5)


@pytest.mark.parametrize("kind", ["glb", "obj", "ply"])
def test_colours_of_vertices_are_kept(tmp_path, kind: str) -> None:
    vertices, faces = nmr.icosphere(1)
    colors = (vertices - vertices.min()) / (vertices.max() - vertices.min())
    export_mesh(tmp_path / f"chair.{kind}", Surface(vertices, faces, colors))
    assert [path.name for path in tmp_path.iterdir()] == [f"chair.{kind}"]
    (mesh,) = trimesh.load(
        tmp_path / f"chair.{kind}", force="scene", process=False
    ).geometry.values()
    found = mesh.visual.vertex_attributes["color"] if kind == "glb" else mesh.visual.vertex_colors
    wanted = colors.numpy() ** (2.2 if kind == "glb" else 1)  # those of a GLB are linear
    assert np.abs(found[:, :3] / 255 - wanted).max() < 0.01


def test_the_faces_of_a_glb_are_seen_from_both_sides(tmp_path) -> None:
    export_mesh(tmp_path / "chair.glb", Surface(*nmr.icosphere(1)))
    content = (tmp_path / "chair.glb").read_bytes()
    tree = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    (primitive,) = tree["meshes"][0]["primitives"]
    assert tree["materials"][primitive["material"]]["doubleSided"] is True
    assert list(trimesh.load(tmp_path / "chair.glb").geometry) == ["chair"]


def test_files_and_data_sets_give_the_same_mesh(
    finished_run, tiny_folder, tmp_path, short_turntables
) -> None:
    paths = reconstruct_dataset(finished_run, tmp_path / "a", tiny_folder, [5])
    assert [p.name for p in paths] == [f"airplane_test_000005.{s}" for s in ("glb", "gif", "png")]
    with np.load(tiny_folder / "02691156_test_images.npz") as archive:
        stored = archive["arr_0"][0, 5]
    rgba = np.concatenate([255 - stored[:3], stored[3:]]).transpose(1, 2, 0)
    (tmp_path / "in").mkdir()
    Image.fromarray(rgba).save(tmp_path / "photo.png")
    Image.fromarray(rgba).save(tmp_path / "in" / "photo.png")
    files = written_files(
        finished_run, tmp_path / "b", [tmp_path / "photo.png"], crop=False, refined=False
    )
    meshes = [trimesh.load(path[0], force="mesh") for path in (files, paths)]
    assert np.array_equal(*(mesh.vertices for mesh in meshes)) and np.array_equal(
        *(mesh.faces for mesh in meshes)
    )
    (surface,) = reconstruct(load_model(finished_run).method, stored[None])
    assert np.allclose(
        (surface.vertices.numpy() @ mesh_to_object()).max(0), meshes[0].bounds[1], atol=1e-5
    )
    twins = [tmp_path / "photo.png", tmp_path / "in" / "photo.png"]
    files = written_files(finished_run, tmp_path / "c", twins, mesh_format="ply")
    assert [p.name for p in files[::3]] == ["000_photo.ply", "001_photo.ply"]
    with pytest.raises(ValueError, match="2 images but 1 masks"):
        written_files(finished_run, tmp_path / "d", twins, [tmp_path / "photo.png"])
    (tmp_path / "bad.png").write_text("no picture")
    with pytest.raises(ValueError, match=r"bad\.png"):
        written_files(finished_run, tmp_path / "e", [tmp_path / "bad.png", tmp_path / "photo.png"])
    assert (tmp_path / "e" / "photo.glb").is_file(), "the others are done"


def test_the_azimuth_of_the_input_is_found() -> None:
    mesh = make_shape("chair", np.random.default_rng(6))
    chair = torch.from_numpy(mesh.vertices @ mesh_to_object("y", "z").T).float()
    chair = chair, torch.from_numpy(mesh.faces)
    for azimuth in (0.0, 45.0, 210.0):
        camera = nmr.LookAt.from_angles(2.732, 30.0, [azimuth], half_fov_deg=15.0)
        mask = (nmr.render_silhouette(*chair, camera, image_size=128)[0] * 255).byte().numpy()
        error = torch.tensor(input_azimuth_deg(Surface(*chair), mask) - azimuth)
        assert abs(wrap_deg(error)) < 5
    # from everywhere, a sphere has one outline: the learnt probabilities decide
    mask, probabilities = np.zeros((64, 64), np.uint8), torch.full((24,), 1e-3)
    mask[16:48, 16:48], probabilities[5] = 255, 1.0  # the cell of -105 .. -90 degrees
    assert -110 < input_azimuth_deg(Surface(*nmr.icosphere(2)), mask, probabilities) < -85
