"""load_obj and save_obj of neural_renderer."""

import os
import sys

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from reader_checks import at_most
from torch.testing import assert_close
from vectors import load_vector, vector_names

import nmr
import nmr.neural_renderer as nr
from nmr._images import read_image
from nmr.neural_renderer.load_obj import (
    bake_textures,
    load_mtl,
    load_textures,
    texture_wrapping_dict,
)
from nmr.neural_renderer.save_obj import create_texture_image

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def write(folder, **files):
    for name, text in files.items():
        (folder / name.replace("_", ".")).write_bytes(text.encode("latin-1"))
    return str(folder / "a.obj")


def test_vertices_and_faces(tmp_path):
    v = load_vector("load_obj")
    path = write(tmp_path, a_obj=str(v["text"]))
    vertices, faces = nr.load_obj(path, normalization=False)
    assert vertices.dtype == torch.float32 and faces.dtype == torch.int32
    assert np.array_equal(vertices, v["vertices_raw"]) and np.array_equal(faces, v["faces"])
    assert_allclose(nr.load_obj(path)[0], v["vertices_normalized"], atol=1e-6)


@pytest.mark.parametrize("name", vector_names("texload_*"))
def test_bake_textures(name):
    v = load_vector(name)
    # The vectors' image starts at the bottom, as the kernel gets it.
    how = int(v["texture_size"]), str(v["wrapping"]), bool(v["bilinear"])
    baked = bake_textures(v["image"][::-1], v["uv"], *how)
    chosen = v["is_update"] == 1
    assert_allclose(baked[chosen], v["textures"][chosen], atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (4, 1)])
@pytest.mark.parametrize("bilinear", [True, False])
def test_bake_images_of_one_row_or_column(shape, bilinear):
    image = np.random.default_rng(0).random((*shape, 3), dtype=np.float32)
    corner = np.array([[[0, 0], [1, 0], [1, 1]]], dtype=np.float32)
    baked = bake_textures(image, corner, 3, "REPEAT", bilinear)
    for k, color in enumerate((image[-1, 0], image[-1, -1], image[0, -1])):
        assert_allclose(baked[(0, *(2 * (np.arange(3) == k)))], color, atol=1e-6)


def test_texture_coordinates_that_nobody_reads_are_not_checked(tmp_path):
    lines = "vt a b\nvt\nf 1/7 2/8 3/9\n"
    assert nr.load_obj(write(tmp_path, a_obj=TRIANGLE + lines), False)[1].tolist() == [[0, 1, 2]]


# What a line may not say is in test_obj.py.
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no vertices"),
        (TRIANGLE, "has no faces"),
        (TRIANGLE + "f 1 1 " + "9" * 400 + "\n", "cannot be read"),
        (TRIANGLE + "vt\nf 1 2 3\n", "line 4.*2 numbers are needed"),
        (TRIANGLE + "f 1 2 3\n", "names no .mtl file"),
        ("v 1 1 1\n" * 3 + "f 1 2 3\n", "finite in float32"),
    ],
)
def test_errors_of_files(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        nr.load_obj(write(tmp_path, a_obj=text), load_texture=True)


def materials(tmp_path):
    """Four faces: red by Kd, an image, no material, an image but no texture coordinates (its Kd counts)."""
    image_module = pytest.importorskip("PIL.Image")
    pixels = np.random.default_rng(0).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    (tmp_path / "images").mkdir()
    image_module.fromarray(pixels).save(tmp_path / "images" / "wood dark.png")
    obj = "mtllib a.mtl\n" + TRIANGLE + "vt 0 0\nvt 1 0\nvt 1 1\nf 1 2 3\nusemtl red\nf 1 2 3\n"
    obj += "usemtl dark wood\nf 1/1 2/2 3/3\nf 1 2 3\n"
    mtl = "newmtl red\nKd 1 0 0.25\nnewmtl dark wood\nKd 0 0 1\nmap_Kd images\\wood dark.png\n"
    return write(tmp_path, a_obj=obj, a_mtl=mtl), pixels


def test_textures_of_materials(tmp_path):
    path, pixels = materials(tmp_path)
    _, faces, textures = nr.load_obj(path, texture_size=2, load_texture=True)
    assert faces.shape == (4, 3) and textures.dtype == torch.float32
    assert textures.shape == (4, 2, 2, 2, 3)
    for face, color in ((0, [0.5, 0.5, 0.5]), (1, [1, 0, 0.25]), (3, [0, 0, 1.0])):
        assert torch.all(textures[face] == torch.tensor(color))
    for texel, pixel in (((1, 0, 0), (7, 0)), ((0, 1, 0), (7, 7)), ((0, 0, 1), (0, 7))):
        assert_allclose(textures[2][texel], pixels[pixel] / 255, atol=1e-5)


@pytest.mark.parametrize(
    ("library", "used", "made", "color"),
    [
        ("a.mtl # materials", "red # the roof", "red", (51, 51, 51)),
        ("a.mtl", "red", "red # the roof", 51),
        ("none.mtl a.mtl", "red roof", "red", (51, 51, 51, 0)),
    ],
)
def test_names_and_comments(tmp_path, monkeypatch, library, used, made, color):
    """Without a material of the whole name, the first word is the name, as published. Alpha is dropped."""
    image_module = pytest.importorskip("PIL.Image")
    mode = {1: "L", 3: "RGB", 4: "RGBA"}[np.size(color)]
    image_module.new(mode, (2, 2), color).save(tmp_path / "wood.png")
    obj = f"mtllib {library}\n{TRIANGLE}vt 0.5\nusemtl {used}\nf 1/1 2/1 3/1\n"
    mtl = f"newmtl blue\nKd 0 0 1\n\nnewmtl {made}\nKd 1 0 0 # red\nmap_Kd wood.png\n"
    write(tmp_path, a_obj=obj, a_mtl=mtl, none_mtl="# nothing")
    monkeypatch.chdir(tmp_path.parent)
    textures = nr.load_obj(f"{tmp_path.name}/a.obj", load_texture=True)[2]
    assert_close(textures, torch.full_like(textures, 0.2))


def test_images_of_16_bits(tmp_path):
    image_module = pytest.importorskip("PIL.Image")
    image_module.fromarray(np.full((2, 2), 13107, dtype=np.uint16)).save(tmp_path / "deep.png")
    assert_allclose(read_image(str(tmp_path / "deep.png")), np.full((2, 2, 3), 0.2), atol=1e-6)


def test_textures_of_another_material_file(tmp_path):
    path, _ = materials(tmp_path)
    textures = nr.load_obj(path, texture_size=2, load_texture=True)[2]
    assert torch.equal(load_textures(path, tmp_path / "a.mtl", 2), textures)
    other = tmp_path / "b.mtl"
    other.write_text("newmtl red\nKd 0 1 0\n")
    green = load_textures(path, other, 2, use_bilinear=False)[1]
    assert torch.all(green == torch.tensor([0, 1.0, 0]))
    modes = "REPEAT MIRRORED_REPEAT CLAMP_TO_EDGE CLAMP_TO_BORDER".split()
    assert texture_wrapping_dict == {mode: number for number, mode in enumerate(modes)}
    other.write_text("newmtl x\nKd 1 1\n")
    with pytest.raises(ValueError, match=r"b.mtl, line 2.*3 numbers are needed"):
        load_mtl(other)


def test_images_without_pillow(tmp_path, monkeypatch):
    path, _ = materials(tmp_path)
    monkeypatch.setitem(sys.modules, "PIL", None)  # importing it fails
    assert len(nr.load_obj(path)) == 2
    textured = torch.rand(3, 3), torch.tensor([[0, 1, 2]]), torch.rand(1, 2, 2, 2, 3)
    for use in (
        lambda: nr.load_obj(path, load_texture=True),
        lambda: nr.save_obj(tmp_path / "b.obj", *textured),
    ):
        with pytest.raises(ImportError, match=r"pip install pillow"):
            use()


def test_hostile_materials_and_images(tmp_path, monkeypatch):
    image_module = pytest.importorskip("PIL.Image")
    obj = f"mtllib a.mtl\n{TRIANGLE}vt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    path = write(tmp_path, a_obj=obj, a_mtl="newmtl m\nmap_Kd t.png\n")

    def refused(message, kind=ValueError):
        with pytest.raises(kind, match=message):
            nr.load_obj(path, load_texture=True)

    write(tmp_path, t_png="no image")
    refused(r"the image .*t\.png cannot be read")
    image_module.new("RGB", (9, 9)).save(tmp_path / "t.png")
    monkeypatch.setattr("nmr._images._MOST_PIXELS", 80)
    refused("9x9 pixels, at most 80 are read")
    (tmp_path / "t.png").unlink()
    refused("t.png", FileNotFoundError)
    write(tmp_path, a_mtl="newmtl m\nmap_Kd \n")
    refused("regular file|No such file", (ValueError, OSError))
    monkeypatch.setattr("nmr.obj._MOST_BYTES", 20)
    refused(r"a\.obj has \d+ bytes; at most 20 are read")


def test_long_lines_and_names_take_little_memory(tmp_path):
    """Some 140 times the size of the file, and nothing per face."""
    write(tmp_path, a_obj=f"{TRIANGLE}f {'1 ' * 50_000}\n")
    with at_most(200 * 100_000):
        assert nr.load_obj(tmp_path / "a.obj")[1].shape == (49_998, 3)
    name = "m" * 200_000
    write(tmp_path, a_obj=f"mtllib a.mtl\n{TRIANGLE}usemtl {name}\n" + "f 1 2 3\n" * 2000)
    write(tmp_path, a_mtl=f"newmtl {name}\nKd 1 0 0\n")
    with at_most(2**26):
        textures = nr.load_obj(tmp_path / "a.obj", load_texture=True, texture_size=2)[2]
    assert textures.shape == (2000, 2, 2, 2, 3) and (textures[..., 0] == 1).all()


def test_texture_image():
    v = load_vector("create_texture_image")
    image, uv = create_texture_image(torch.from_numpy(v["textures"]), int(v["texture_size_out"]))
    assert_allclose(image, v["image"], atol=1e-5)
    assert_allclose(uv, v["uv"], atol=1e-6)


@pytest.mark.parametrize("num_faces", [1, 2, 3, 5, 7])
def test_tiles_without_a_face_are_black(num_faces):
    image, uv = create_texture_image(torch.ones(num_faces, 1, 1, 1, 3), 4)
    tiles = image[::-1].reshape(image.shape[0] // 4, 4, -1, 4, 3).swapaxes(1, 2).reshape(-1, 16, 3)
    filled = tiles.max((1, 2)) > 0.9
    assert filled[:num_faces].all() and not filled[num_faces:].any()
    assert uv.min() >= 0 and uv.max() <= 1


def test_mesh_comes_back_exactly(tmp_path):
    vertices, faces = nmr.icosphere(1)
    vertices = vertices * torch.rand(len(vertices), 1) ** 9
    nr.save_obj(tmp_path / "a.obj", vertices.requires_grad_(), faces)
    again, again_faces = nr.load_obj(tmp_path / "a.obj", normalization=False)
    assert torch.equal(again, vertices) and torch.equal(again_faces.long(), faces)
    assert sorted(os.listdir(tmp_path)) == ["a.obj"]


@pytest.mark.parametrize("texture_size", [1, 2, 4])
def test_textures_come_back(tmp_path, texture_size):
    pytest.importorskip("PIL")
    vertices, faces = nmr.icosphere(0)
    # A texture that is linear in the weights, in which any correct resampling finds the same colours.
    corners = torch.rand(len(faces), 1 if texture_size == 1 else 3, 3).expand(-1, 3, -1)
    weights = torch.cartesian_prod(*[torch.linspace(0, 1, texture_size)] * 3).view(-1, 3)
    weights[0] = 1
    weights = weights / weights.sum(-1, keepdim=True)
    textures = (weights @ corners).view(-1, *[texture_size] * 3, 3)
    nr.save_obj(tmp_path / "mesh.obj", vertices, faces, textures)
    assert sorted(os.listdir(tmp_path)) == ["mesh.mtl", "mesh.obj", "mesh.png"]
    loaded = nr.load_obj(tmp_path / "mesh.obj", texture_size=4, load_texture=True)[2]
    for k in range(3):
        texel = 3 * torch.eye(3, dtype=torch.int64)[k]
        assert_close(loaded[(slice(None), *texel)], corners[:, k], rtol=0, atol=0.03)
