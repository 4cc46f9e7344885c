"""Meshes as text: AC3D, OBJ, polygons as triangles."""

from __future__ import annotations

import numpy as np
import pytest
from small_packages import AIRPLANE, ac_object, ac_text

from learn3d.make_data.debian.mesh_text import read_ac3d, read_obj, triangulate


def test_ac3d_tree_names_and_transforms():
    child = ac_object("child", (0, 0, 0), (1, 1, 1)).replace("numvert", "loc 10 0 0\nnumvert")
    turned = 'OBJECT group\nname "g"\ndata 5\nkids9\nrot 0 1 0 -1 0 0 0 0 1\nloc 0 0 5\nkids 1\n' + child
    blank = ac_object("blank", (0, 0, 0), (1, 1, 1)).replace("numsurf", "\nnumsurf")
    line = ac_object("line", (0, 0, 0), (1, 1, 1)).replace("0X30", "0x2")
    blur = ac_object("Prop-Blur", (0, 0, 0), (1, 1, 1), "kids 1") + "\n" + ac_object("inner", (0, 0, 0), (1, 1, 1))
    parts = read_ac3d(ac_text(turned, blank, line, blur), skip=lambda name: "Blur" in name)
    assert [one.name for one in parts] == ["child", "blank"]
    np.testing.assert_allclose(parts[0].vertices.min(axis=0), [-1, 10, 5])  # row vectors: (x, y) -> (-y, x)
    assert len(parts[0].faces) == 12


@pytest.mark.parametrize("text", ["", "hello", ac_text(AIRPLANE[0])[:-40]])
def test_bad_ac3d(text: str):
    with pytest.raises(ValueError, match="AC3D"):
        read_ac3d(text)


def area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.mark.parametrize("start", range(6))
def test_concave_polygons_keep_their_area(start: int):
    arrow = np.roll([[0, 0], [4, 0], [1, 1], [0, 4]], start, axis=0)
    ell = np.roll([[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3]], start, axis=0)
    for outline, expected in ((arrow, 4.0), (ell, 5.0), (ell[::-1], 5.0)):
        vertices = np.column_stack([outline, outline[:, 0]]).astype(float)  # in the plane z = x
        faces = triangulate([list(range(len(outline)))], vertices)
        assert len(faces) == len(outline) - 2
        assert area(vertices, faces) == pytest.approx(expected * np.sqrt(2))
        before = np.cross(vertices, np.roll(vertices, -1, axis=0)).sum(axis=0)
        after = np.cross(vertices[faces[0, 1]] - vertices[faces[0, 0]], vertices[faces[0, 2]] - vertices[faces[0, 0]])
        assert before @ after > 0  # the winding stays


def test_obj_text():
    vertices, faces = read_obj("# c\nv 0 0 0\nv 1 0 0 1 1 1\nv 0 1 \\\n 0\ng x\nf 1/2/3 -2//1 3\nf 1 2\nl 1 2\n")
    np.testing.assert_array_equal(vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(faces, [[0, 1, 2]])
    with pytest.raises(ValueError, match="three numbers"):
        read_obj("v 0 0\nv 1 2 3")
    with pytest.raises(ValueError, match="names vertex 3, but there are 1"):
        read_obj("v 0 0 0\nf 1 2 4")


TEXTS = {
    "a vertex beyond any": ("v 0 0 0\nf 1 1 " + "9" * 400, "names vertex 9999"),
    "a vertex before any": ("v 0 0 0\nf 1 1 -9", "names vertex -8"),
    "many corners": ("v 0 0 0\nf" + " 1" * 2001, "a polygon has 2001 corners; at most 2000 are read"),
    "no number": ("f 1 2 x", "invalid literal"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_obj_texts_that_cannot_be(name: str):
    text, message = TEXTS[name]
    with pytest.raises(ValueError, match=message):
        read_obj(text)


def test_ac3d_polygons_without_a_kind_are_left_out():
    assert read_ac3d("AC3Db\nOBJECT poly\nnumvert 1\n0 0 0\nrefs 3\n0 0 0\n0 0 0\n0 0 0\nkids 0") == []
    with pytest.raises(ValueError, match="ends in the middle"):
        read_ac3d("AC3Db\nOBJECT poly\nnumvert 99999999999\n0 0 0")
