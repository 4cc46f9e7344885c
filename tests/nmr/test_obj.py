"""OBJ files in all their forms, and polygons cut into triangles."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import double
from torch.testing import assert_close

import nmr
import nmr.neural_renderer as nr
from nmr.obj import read_obj, triangulate

CORNERS = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
SQUARE = CORNERS + "f 1 2 3\nf 1 3 4\n"
NOTHING = re.compile(b"(?!)")
SAME_SQUARES = {
    "one polygon": CORNERS + "f 1 2 3 4\n",
    "relative numbers": CORNERS + "f -4 -3 -2\nf -4 -2 -1\n",
    "relative numbers between vertices": "v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1\nv 0 1 0\nf -4 -2 -1\n",
    "tabs and indentation": SQUARE.replace(" ", "\t").replace("f", "\t  f"),
    "comments behind lines": SQUARE.replace("\n", " # 1 2 3\n"),
    "a comment without a space": SQUARE.replace("\n", "# 1 2 3\n"),
    "Windows": SQUARE.replace("\n", "\r\n"),
    "old Mac": SQUARE.replace("\n", "\r"),
    "continued lines": SQUARE.replace("f 1 ", "f 1 \\\n ").replace("v 1 1", "v \\\r\n1 1"),
    "byte order mark": "\xef\xbb\xbf" + SQUARE,
    "Latin-1": "# Gr\xf6\xdfe\no St\xfchle\n" + SQUARE,
    "groups, points, lines": "o a\ng b\ns off\n"
    + SQUARE
    + "p 1\nl 1 2\nvp 1\ncurv 1 2\nf 1\nf 1 2\n",
    "colours and w": SQUARE.replace("0\nv", "0 0.1 0.2 0.3\nv", 1).replace("0\nv", "0 1\nv", 1),
    "normals that are missing": SQUARE.replace("f 1 2 3", "f 1//1 2//1 3//1"),
    "texture coordinates that are missing": SQUARE.replace("f 1 2 3", "f 1/1 2/2/7 3/"),
    "forms mixed in a line": "vt 0 0\nvt 1\n" + SQUARE.replace("f 1 2 3", "f 1 2/2 3/-1/-5"),
    "words behind numbers": SQUARE.replace("v 1 0 0", "v 1 0 0 // a corner"),
    "exponents and signs": SQUARE.replace("v 1 0", "v +1e0 -0.0").replace("v 0 1", "v .0 1."),
    "no line end": SQUARE[:-1],
    "zeros at the end": SQUARE[:-1] + "\0\0",
    "capital letters": SQUARE.upper(),
    "a comment that ends in a backslash": "# C:\\models\\\n" + SQUARE,
    "fo": SQUARE.replace("f ", "fo "),
}


def triangles(text: str, **options: bool) -> list:
    obj = read_obj(io.BytesIO(text.encode("latin-1")), **options)
    return obj.vertices[obj.faces].tolist()


@pytest.mark.parametrize("with_uv", [True, False])
@pytest.mark.parametrize("in_blocks", [True, False])
@pytest.mark.parametrize("name", SAME_SQUARES)
def test_the_same_square(
    monkeypatch: pytest.MonkeyPatch, name: str, in_blocks: bool, with_uv: bool
) -> None:
    if not in_blocks:
        monkeypatch.setattr("nmr.obj._BLOCK", NOTHING)
    assert triangles(SAME_SQUARES[name], with_uv=with_uv) == triangles(SQUARE)


WRONG = {
    "f 1 2 0": "line 5: 'f 1 2 0' cannot be read: there is no element 0",
    "f -5 1 2": "line 5: .* there is no element -5",
    "f 1 2 5": "line 5: 'f 1 2 5' cannot be read: it refers to vertex 5, but there are 4",
    "vt 0 0\nf 1/1 2/1 3/2": "line 6: .* refers to texture coordinate 2, but there are 1",
    "f 1 /2 3": "line 5: .* corners such as",
    "f 1 2 3.5": "line 5: .* corners such as",
    "f": "line 5: .* a face needs corners",
    "v 1,5 0 0": "line 5: .* 3 numbers are needed, finite in float32",
    "v 1 1e39 0": "line 5: .* 3 numbers are needed, finite in float32",
    "v 1 nan 0": "line 5: .* 3 numbers are needed",
    "f 1 2 \\\n 3\n# \\\nv 1 2": "line 8: 'v 1 2' cannot be read",
}


@pytest.mark.parametrize("lines", WRONG)
def test_wrong_lines_are_named(lines: str) -> None:
    with pytest.raises(ValueError, match=WRONG[lines]):
        triangles(CORNERS + lines + "\nf 1 2 3\n")


def test_colors_texture_coordinates_and_materials() -> None:
    text = CORNERS.replace("1 0\n", "1 0 .5 .25 nan\n", 1).replace("0 0\n", "0 0 1 0 .5 1\n", 1)
    text += "vt 0 1 5\nvt .5\nf 1/1 2/2 3/1 4/2\nusemtl red # roof\nf 1 2/1 3/1\nusemtl a b\nf -4/-2 -3/-1 -2/1\n"
    obj = read_obj(io.BytesIO(text.encode()))
    np.testing.assert_array_equal(obj.colors[[0, 1]], [[1, 0, 0.5], [np.nan] * 3])
    assert obj.uv.tolist() == [[0, 1], [0.5, 0]]
    assert obj.uv_faces.tolist() == [[0, 1, 0], [0, 0, 1], [-1, -1, -1], [0, 1, 0]]
    assert obj.materials == ["", "red", "a b"] and obj.face_material.tolist() == [0, 0, 1, 2]


def test_utf16_is_refused() -> None:
    with pytest.raises(ValueError, match="UTF-16"):
        read_obj(io.BytesIO(SQUARE.encode("utf-16")))


OUTLINES = {
    "arrow": [[0, 0], [4, 0], [1, 1], [0, 4]],
    "L": [[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3]],
    "U": [[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3]],
    "comb, with corners on its straight side": [
        [0, 0], [2, 0], [4, 0], [6, 0], [6, 3], [5, 1], [4, 3], [3, 1], [2, 3], [1, 1], [0, 3],
    ],
    "window, joined to its hole by a double edge": [
        [0, 0], [4, 0], [4, 4], [0, 4], [0, 0], [1, 1], [1, 3], [3, 3], [3, 1], [1, 1],
    ],
    "zigzag": [[0, 5], *([k, k % 2] for k in range(5000))],
    "star": [[np.cos(0.2 * np.pi * i) * r, np.sin(0.2 * np.pi * i) * r] for i, r in enumerate([1, 0.4] * 5)],
}  # fmt: skip


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("name", OUTLINES)
def test_concave_polygons_keep_their_area_and_winding(name: str, turned: bool) -> None:
    outline = np.array(OUTLINES[name])[:: -1 if turned else 1]
    count = len(outline)
    for start in range(0, count, 1 + count // 10):
        flat = np.roll(outline, start, axis=0)
        # in a slanted plane, at UTM coordinates
        vertices = np.column_stack([flat, flat[:, 0]]) + [4.5e6, 5e5, 100]
        faces = triangulate(vertices, np.arange(count), np.array([count]))
        outwards = vertices - vertices[0]
        whole = np.cross(outwards, np.roll(outwards, -1, axis=0)).sum(0)
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        parts = np.cross(b - a, c - a)
        np.testing.assert_allclose(np.linalg.norm(parts, axis=1).sum(), np.linalg.norm(whole))
        assert (parts @ whole >= -1e-9).all()


def test_polygons_stay_in_order_and_convex_ones_are_fans() -> None:
    vertices = np.random.default_rng(0).normal(size=(9, 3))
    vertices[:5] = [[0, 0, 0], [2, 0, 0], [3, 1, 0], [2, 2, 0], [0, 2, 0]]
    polygons = [[5, 6, 7], [0, 1, 2, 3, 4], [8, 7], [0], [8], [0, 1, 2, 3]]
    corners = np.concatenate(polygons)
    faces = corners[triangulate(vertices, corners, np.array([len(p) for p in polygons]))]
    assert faces[:4].tolist() == [[5, 6, 7], [0, 1, 2], [0, 2, 3], [0, 3, 4]] and len(faces) == 6
    with pytest.raises(ValueError, match="missing vertex; there are 9"):
        triangulate(vertices, np.array([0, 1, 9]), np.array([3]))


TEXTURED = "mtllib {library}\n" + CORNERS + "vt 0 0\nvt 1 0\nvt 1 1\n{used}\nf 1/1 2/2 3/3\n"
FOUND = {  # the line `map_Kd`, the file of the image
    "options and spaces": ("map_Kd -s 1 1 1 -o .5 -clamp on my tex.png", "my tex.png"),
    "an option of two numbers": ("map_Kd -mm 0 1 t.png", "t.png"),
    "quotes": ('map_Kd "t 1.png"', "t 1.png"),
    "lower case": ("map_kd t.png", "t.png"),
    "upper case and a tab": ("MAP_KD\tt.png", "t.png"),
    "a name in another case": ("map_Kd T.PNG", "t.png"),
    "a folder in another case": ("map_Kd Maps\\T.png", "maps/t.png"),
    "a path of another machine": ("map_Kd C:\\Users\\x\\maps\\t.png", "t.png"),
    "another one": ("map_Kd /home/x/My Maps/t.PNG", "t.png"),
    "a number sign and a comment": ("map_Kd t#1.png # oak", "t#1.png"),
    "a name that begins with a number": ("map_Kd -s 2 3d.png", "3d.png"),
}


@pytest.mark.parametrize("case", FOUND)
def test_images_of_materials_are_found(tmp_path: Path, case: str) -> None:
    image_module = pytest.importorskip("PIL.Image")
    line, image = FOUND[case]
    (tmp_path / "maps").mkdir()
    image_module.new("RGB", (4, 4), (255, 51, 0)).save(tmp_path / image)
    library = f"\ufeffNEWMTL red\nkd 1 0 0.5\n{line}\n"
    (tmp_path / "A b.mtl").write_text(library, encoding="utf-8")
    path = tmp_path / "a.obj"
    path.write_text(TEXTURED.format(library="a b.MTL", used="usemtl red"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        textures = nr.load_obj(path, load_texture=True)[2]
        (material,) = nmr.load_obj(path).materials
    assert_close(textures[0, 1, 1, 1], torch.tensor([1, 0.2, 0]))
    assert material.name == "red" and material.color == (1, 0, 0.5)
    assert Path(material.image).samefile(tmp_path / image)


@pytest.mark.parametrize(
    ("used", "said"), [("", "no line `usemtl`"), ("usemtl rod", r"\('rod'\) are in no library")]
)
def test_faces_without_a_known_material_are_said(tmp_path: Path, used: str, said: str) -> None:
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\n")
    (tmp_path / "a.obj").write_text(TEXTURED.format(library="a.mtl", used=used))
    for read in (nmr.load_obj, lambda path: nr.load_obj(path, load_texture=True)):
        with pytest.warns(
            UserWarning, match=f"1 of 1 faces stay grey.*{said}.*the libraries have 'red'"
        ):
            read(tmp_path / "a.obj")
    (tmp_path / "a.mtl").unlink()
    with pytest.warns(UserWarning, match=r"a\.mtl, which is missing"):
        assert nmr.load_obj(tmp_path / "a.obj").face_material.tolist() == [-1]
    with pytest.raises(FileNotFoundError, match=r"a\.mtl"):
        nr.load_obj(tmp_path / "a.obj", load_texture=True)


def test_tensors_of_an_obj_file(tmp_path: Path) -> None:
    text = "v 500000.25 4500000.5 0 255 0 51\nv 500001.25 4500000.5 0\nv 500000.25 4500001.5 0.5 0 0 0\nvt .5 1\n"
    path = tmp_path / "a.obj"
    path.write_text(text + "f 1/1 2/1 3/1\n")
    mesh = nmr.load_obj(path, dtype=torch.float64)
    moved = (mesh.vertices - mesh.vertices[0]).tolist()
    assert moved == [[0, 0, 0], [1, 0, 0], [0, 1, 0.5]] and mesh.faces.dtype == torch.int64
    assert_close(mesh.colors[:2], double([[1, 0, 0.2], [0.5] * 3]))
    assert mesh.uv.tolist() == [[0.5, 1]] and mesh.uv_faces.tolist() == [[0, 0, 0]]
    assert mesh.materials == ()
    normalized = torch.tensor([[-1, -1, -0.5], [1, -1, -0.5], [-1, 1, 0.5]])
    assert_close(nr.load_obj(path)[0], normalized)
    path.write_text(CORNERS)
    with pytest.raises(ValueError, match=r"a\.obj has no faces"):
        nmr.load_obj(path)


@pytest.mark.parametrize(
    "colors, first",
    [
        (["1.0001 1 0", "0 0 0", "0.5 0 0"], [1, 1, 0]),  # a rounded 1
        (["2 0 0", "0 0 0", "1 0 0"], [2 / 255, 0, 0]),  # bytes, nearly black
        (["127.5 0 0", "0 0 0", "0.5 0 0"], [0.5, 0, 0]),
        (["1 0 1", "0 0 0", "1 0 0"], [1, 0, 1]),
    ],
)
def test_colors_above_one(tmp_path: Path, colors: list[str], first: list[float]) -> None:
    lines = [f"v {k} {k % 2} 0 {color}" for k, color in enumerate(colors)]
    (tmp_path / "a.obj").write_text("\n".join([*lines, "f 1 2 3"]))
    mesh = nmr.load_obj(tmp_path / "a.obj", dtype=torch.float64)
    assert_close(mesh.colors[0], double(first))
