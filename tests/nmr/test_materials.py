"""Meshes of several materials: what is drawn, and what OBJ and glTF files keep of them."""

import dataclasses
import io
import json
import math

import numpy as np
import pytest
import torch
from gltf_files import SQUARE, Arrays, glb, square_glb
from PIL import Image
from scenes import bumpy_sphere, leaf_of, uniform
from torch.autograd import gradcheck
from torch.testing import assert_close

import nmr

VERTICES, FACES = bumpy_sphere(1)
CAMERA = nmr.LookAt([[0.0, 0.5, -2.5], [1.5, 0.0, -2.0]])
IMAGES = [uniform(4, 6, 3), None, uniform(5, 3, 3, seed=1)]
COLORS, UV = uniform(3, 3, seed=2), 0.5 + 1.3 * VERTICES[:, :2]
NUMBERS = torch.arange(len(FACES)) % 4 - 1
UV_FACES = torch.where((torch.arange(len(FACES)) % 5 > 0)[:, None], FACES, -1)
MATERIALS = nmr.Materials(COLORS, IMAGES, NUMBERS, UV, UV_FACES)


def draw(colors, mesh=(VERTICES, FACES), camera=CAMERA, size=24, **how):
    return nmr.render_rgb(*mesh, camera, colors=colors, image_size=size, anti_aliasing=False, **how)


@pytest.mark.parametrize("filter", ["bilinear", "mipmap"])
def test_each_face_has_its_material(filter):
    """Its image where it has texture coordinates, else its colour, else grey."""
    made = nmr.Materials(COLORS, IMAGES, NUMBERS, UV, UV_FACES, "mirror", filter)
    face = nmr.render_face_index(VERTICES, FACES, CAMERA, image_size=24).long()
    has_uv, grey = (UV_FACES >= 0).all(1), torch.full((1, 3), 0.5)
    wanted = draw(nmr.FaceColors(torch.cat([COLORS, grey])[NUMBERS]))
    for number in (0, 2):
        texture = nmr.UVTexture(IMAGES[number], UV, FACES, "mirror", filter)
        shown = ((NUMBERS == number) & has_uv)[face] & (face >= 0)
        wanted = torch.where(shown.unsqueeze(-1), draw(texture), wanted)
    assert torch.equal(draw(made), wanted)
    soft, layered = (nmr.render_soft, nmr.render_transparent)
    for render in (soft, layered):  # of several layers
        one = nmr.Materials(COLORS[:1], IMAGES[:1], 0 * NUMBERS, UV, FACES, "mirror", filter)
        plain = nmr.UVTexture(IMAGES[0], UV, FACES, "mirror", filter)
        both = (render(VERTICES, FACES, CAMERA, colors=x, image_size=12).rgb for x in (one, plain))
        assert_close(*both)


def test_gradients_reach_every_image_and_colour():
    def rgb(colors, first, second, uv):
        made = nmr.Materials(colors, [first, None, second], NUMBERS, uv, UV_FACES)
        return draw(made, size=4)

    given = [leaf_of(x) for x in (COLORS, IMAGES[0], IMAGES[2], UV)]
    assert gradcheck(rgb, given)
    assert all(x.any() for x in torch.autograd.grad(rgb(*given).sum(), given))


def test_a_list_of_meshes_shares_materials():
    numbers, faces = [NUMBERS, NUMBERS[:30]], [FACES, FACES[:30]]
    corners = [UV_FACES, UV_FACES[:30]]
    made = nmr.Materials(COLORS, IMAGES, numbers, [UV, UV], corners)
    images = draw(made, ([VERTICES, VERTICES], faces))
    for b in (0, 1):
        alone = nmr.Materials(COLORS, IMAGES, numbers[b], UV, corners[b])
        assert torch.equal(images[b], draw(alone, (VERTICES, faces[b]))[b])


def test_files_keep_the_mesh_and_its_materials(tmp_path):
    """The colours of images are rounded to 8 bits."""
    for vertices in (VERTICES, VERTICES.float()):
        nmr.save_obj(tmp_path / "a.obj", vertices, FACES, MATERIALS)
        mesh = nmr.load_obj(tmp_path / "a.obj", vertices.dtype)
        assert torch.equal(mesh.vertices, vertices) and torch.equal(mesh.faces, FACES)
        assert torch.equal(mesh.uv, UV.to(vertices)) and torch.equal(mesh.uv_faces, UV_FACES)
        read = nmr.Materials.from_mesh(mesh)
        got = draw(read, (mesh.vertices, mesh.faces))
        assert_close(got.double(), draw(MATERIALS), atol=0.003, rtol=0)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"a.obj", "a.mtl", "a_1.png", "a_3.png"}
    colors = nmr.VertexColors(uniform(len(VERTICES), 3))
    nmr.save_obj(tmp_path / "b.obj", VERTICES, FACES, colors)
    assert torch.equal(nmr.load_obj(tmp_path / "b.obj", torch.float64).colors, colors.colors)


def test_vertex_colors_are_shown_without_images_and_kept_in_files(tmp_path):
    shades = uniform(len(VERTICES), 3)
    made = dataclasses.replace(MATERIALS, vertex_colors=shades)
    face = nmr.render_face_index(VERTICES, FACES, CAMERA, image_size=24).long()
    has_image = (NUMBERS % 2 == 0) & (UV_FACES >= 0).all(1)
    factors = nmr.FaceColors(torch.cat([COLORS, torch.ones(1, 3)])[NUMBERS])
    wanted = draw(factors) * draw(nmr.VertexColors(shades))
    wanted = torch.where((has_image[face] & (face >= 0)).unsqueeze(-1), draw(MATERIALS), wanted)
    assert_close(draw(made), wanted)

    nmr.save_obj(tmp_path / "a.obj", VERTICES, FACES, made)
    read = nmr.Materials.from_mesh(nmr.load_obj(tmp_path / "a.obj", torch.float64))
    assert_close(draw(read), draw(made), atol=0.003, rtol=0)
    nmr.save_obj(tmp_path / "b.obj", VERTICES, FACES, nmr.VertexColors(shades))
    read = nmr.Materials.from_mesh(nmr.load_obj(tmp_path / "b.obj", torch.float64))
    assert_close(draw(read), draw(nmr.VertexColors(shades)))
    with pytest.raises(
        ValueError, match="vertex_colors must have 3 channels as colors have, got 4"
    ):
        dataclasses.replace(MATERIALS, vertex_colors=uniform(len(VERTICES), 4))


def test_images_of_one_file_are_one_tensor(tmp_path):
    nmr.save_obj(tmp_path / "a.obj", VERTICES, FACES, nmr.UVTexture(IMAGES[0], UV, FACES))
    text = (tmp_path / "a.mtl").read_text()
    (tmp_path / "a.mtl").write_text(text + "newmtl other\nmap_Kd a.png\n")
    read = nmr.Materials.from_mesh(nmr.load_obj(tmp_path / "a.obj"))
    assert read.images[0] is read.images[1]


def png(image):
    file = io.BytesIO()
    Image.fromarray((255 * image).astype(np.uint8)).save(file, "png")
    return file.getvalue()


def test_gltf(tmp_path):
    picture = np.zeros((4, 8, 3))
    picture[0, -1] = 1  # at the upper right corner: (1, 0) in the file, (1, 1) here
    transform = {"offset": [0.0, 1.0], "rotation": math.pi / 2, "scale": [1.0, 2.0]}
    for use, moved in (
        ({}, lambda u, v: (u, 1 - v)),
        ({"extensions": {"KHR_texture_transform": transform}}, lambda u, v: (2 * v, u)),
    ):
        (tmp_path / "a.glb").write_bytes(square_glb(png(picture), (1, 0.5, 1, 1), **use))
        mesh = nmr.load_gltf(tmp_path / "a.glb", torch.float64)
        corners = torch.from_numpy(SQUARE).double()
        rows = torch.tensor([[0, 1, 2], [0, 2, 3], [1, 2, 3]])
        assert torch.equal(mesh.vertices[mesh.faces], corners[rows])
        wanted = [moved(*row) for row in corners[[0, 1, 2], :2].tolist()]
        assert_close(mesh.uv[mesh.uv_faces[0]], torch.tensor(wanted).double())
        assert (mesh.uv_faces[1:] == -1).all() and mesh.face_material.tolist() == [0, 1, -1]
        read = nmr.Materials.from_mesh(mesh)
        assert [x.name for x in mesh.materials] == ["a", "b"]
        assert read.images[0][0, -1].tolist() == [1, 0.5, 1] and read.images[1] is None
        assert read.colors[1].tolist() == [0, 0.5, 1]
        assert mesh.colors[mesh.faces[2], :].tolist() == [[0, 1, 0], [0, 0, 1], [0, 0, 0]]


WRONG = {
    "damaged": (lambda: square_glb()[:-9], "cannot be read: EOFError"),
    "no scene": (lambda: b'{"asset": {"version": "2.0"}}', "has no faces"),
    "another texture": (lambda: square_glb(b"none", index=3), "cannot be read: IndexError"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_gltf_files(tmp_path, name):
    make, said = WRONG[name]
    (tmp_path / "a.glb").write_bytes(make())
    with pytest.raises(ValueError, match=said):
        nmr.load_gltf(tmp_path / "a.glb")


def test_an_image_that_is_no_image(tmp_path):
    (tmp_path / "a.glb").write_bytes(square_glb(b"no image"))
    with pytest.raises(ValueError, match="the image of material 'a' cannot be read"):
        nmr.Materials.from_mesh(nmr.load_gltf(tmp_path / "a.glb"))


def made(colors=COLORS, images=IMAGES, numbers=NUMBERS, uv=UV, uv_faces=UV_FACES):
    return nmr.Materials(colors, images, numbers, uv, uv_faces)


MISTAKES = {
    "one colour for each": (lambda: made(colors=COLORS[None]), r"colors must be a tensor \[M, C\]"),
    "one image for each": (lambda: made(images=IMAGES[:2]), "images must be a list of 3, .* got 2"),
    "whole numbers": (lambda: made(numbers=UV), "face_material must be an integer tensor"),
    "known materials": (
        lambda: made(numbers=NUMBERS + 1),
        "face_material refer to row 3, but colors",
    ),
    "places in the image": (lambda: made(uv=None), "images need uv and uv_faces"),
    "channels": (
        lambda: made(images=[UV, None, None]),
        r"images\[0\] must be a tensor \[H, W, 3\]",
    ),
    "a mesh as vertices": (
        lambda: nmr.render_rgb(nmr.mesh_files.MeshFile(*[None] * 7), CAMERA),
        "got a mesh file; write .*colors=nmr.Materials.from_mesh",
    ),
    "ending": (lambda: nmr.save_obj("a.ply", VERTICES, FACES), "filename must end in .obj"),
    "one mesh": (lambda: nmr.save_obj("a.obj", VERTICES[None], FACES), "those of one mesh"),
    "colours": (
        lambda: nmr.save_obj("a.obj", VERTICES, FACES, UV),
        "nmr.VertexColors, UVTexture or",
    ),
    "vertices": (
        lambda: nmr.save_obj("a.obj", VERTICES, FACES, nmr.VertexColors(COLORS)),
        "colors must be one per vertex, 42, got 3",
    ),
    "faces": (lambda: nmr.save_obj("a.obj", VERTICES, FACES[:9], MATERIALS), "those of 9 faces"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call, said = MISTAKES[name]
    with pytest.raises((TypeError, ValueError), match=said):
        call()
    assert not list(tmp_path.iterdir())


def test_a_gltf_file_refers_to_its_folder_alone(tmp_path):
    accessor = {"componentType": 5126, "type": "VEC3", "count": 1, "bufferView": 0}
    tree = {"asset": {"version": "2.0"}, "nodes": [{"mesh": 0}], "accessors": [accessor]}
    tree |= {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]}
    tree |= {"bufferViews": [{"byteLength": 12}]}
    for name, kind in (("../a.bin", ValueError), ("b.bin", FileNotFoundError)):
        tree["buffers"] = [{"byteLength": 12, "uri": name}]
        (tmp_path / "a.gltf").write_text(json.dumps(tree))
        with pytest.raises(kind, match="outside of its folder" if kind is ValueError else "b.bin"):
            nmr.load_gltf(tmp_path / "a.gltf")


def test_a_mirrored_node_keeps_the_side_of_its_faces(tmp_path):
    arrays = Arrays()
    look = {
        "attributes": {"POSITION": arrays.add(SQUARE)},
        "indices": arrays.add(np.uint8([[0], [1], [2]])),
    }
    nodes = [{"mesh": 0}, {"mesh": 0, "scale": [-1, 1, 1]}]
    tree = {"asset": {"version": "2.0"}, "nodes": nodes, "meshes": [{"primitives": [look]}]}
    (tmp_path / "a.glb").write_bytes(glb(tree | arrays.tree(embedded=False), arrays.content))
    mesh = nmr.load_gltf(tmp_path / "a.glb")
    assert_close(nmr.face_normals(mesh.vertices, mesh.faces), torch.tensor([[0.0, 0, 1]] * 2))
    assert mesh.vertices[mesh.faces][..., 0].amin(1).tolist() == [0, -1]


def test_materials_that_share_an_image_are_sampled_once(monkeypatch):
    vertices, faces = nmr.icosphere(2)
    image, other = uniform(4, 4, 3, seed=1).float(), uniform(4, 4, 3, seed=2).float()
    number = torch.arange(len(faces)) % 5
    sampled = []
    sample = nmr.UVTexture.sample
    monkeypatch.setattr(
        nmr.UVTexture, "sample", lambda self, at: sampled.append(self.image) or sample(self, at)
    )

    def draw(images, number):
        uv = 0.5 + vertices[:, :2] / 2
        colors = nmr.Materials(uniform(len(images), 3, seed=3).float(), images, number, uv, faces)
        return nmr.render_rgb(
            vertices, faces, nmr.LookAt([0.0, 0, -3]), colors=colors, image_size=16
        )

    copies = draw([image, image.clone(), None, other, image.clone()], number)
    sampled.clear()
    assert torch.equal(draw([image, image, None, other, image], number), copies)
    assert len(sampled) == 2 and sampled[0] is image and sampled[1] is other
    sampled.clear()  # no face has image 3
    draw([image, image, None, other, image], number.where(number != 3, 0))
    assert len(sampled) == 1
    sampled.clear()  # its gradient is 0
    wanted = other.clone().requires_grad_()
    rgb = draw([image, image, None, wanted, image], number.where(number != 3, 0))
    assert (torch.autograd.grad(rgb.sum(), wanted)[0] == 0).all()


def test_files_cannot_store_that_an_image_is_not_repeated(tmp_path):
    vertices, faces = nmr.icosphere(1)
    texture = nmr.UVTexture(torch.rand(4, 4, 3), 2 * vertices[:, :2], wrap="clamp")
    with pytest.warns(UserWarning, match="cannot store wrap='clamp'") as said:
        nmr.save_obj(tmp_path / "a.obj", vertices, faces, texture)
    assert said[0].filename == __file__
