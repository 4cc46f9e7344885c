"""Models in the Debian packages: their classes, their texts, their polygons, their effects."""

from __future__ import annotations

import numpy as np
import pytest
from small_packages import AIRPLANE, ac_object, ac_text, box

from learn3d.make_data.debian.aircraft import is_airplane_file, without_effects
from learn3d.make_data.debian.furniture import furniture_category, place_furniture, read_catalogue
from learn3d.make_data.debian.mesh_text import Part, read_ac3d, read_obj, triangulate


@pytest.mark.parametrize(
    ("name", "category"),
    [
        ("Winchester armchair", "chair"),
        ("Desk lamp", "lamp"),
        ("Bedside table", "cabinet"),
        ("Chest freezer", None),
        ("Futon couch", "sofa"),
        ("Opened sofa bed", None),
    ],
)
def test_furniture_category(name: str, category: str | None) -> None:
    assert furniture_category(name, "Living room") == category
    assert furniture_category(name, "Vehicles") is None


@pytest.mark.parametrize(
    ("path", "whole"),
    [
        ("A320/Models/A320.ac", True),
        ("Lightning/Models/lightning-f1a.ac", True),
        ("Lightning/Models/light-red-flare.ac", False),
        ("Plane/Models/Lights/Strobe.ac", False),
        ("Cessna208Caravan/Models/wheels.ac", False),
        ("Ferry/FerryBoat1.ac", False),
    ],
)
def test_airplane_files(path: str, whole: bool) -> None:
    assert is_airplane_file(path) == whole


def test_catalogue_text() -> None:
    general, entries = read_catalogue("# x\nlicense=L\nempty=\nname#2=B\n name#1 = caf\\u00e9 = A\nmodel#1=/m\n")
    assert general == {"license": "L", "empty": ""}
    assert entries == [{"name": "café = A", "model": "/m"}, {"name": "B"}]


def test_furniture_is_turned_and_stretched() -> None:
    vertices, turn = np.array([[0.0, 0, 0], [1, 2, 3]]), {"modelRotation": "0 0 1 0 1 0 -1 0 0"}
    np.testing.assert_allclose(place_furniture(vertices, turn)[1], [3, 2, -1])
    placed = place_furniture(vertices, turn | {"width": "6", "height": "1", "depth": "5"})
    np.testing.assert_allclose(placed[1], [6, 1, -5])


def part(low: tuple, high: tuple) -> Part:
    corners, quads = box(low, high)
    return Part(corners, triangulate(quads, corners))


def test_effects_are_found_by_shape() -> None:
    body = part((-5, 0, -5), (5, 1, 5))
    disc, fan = part((-5, -1, -1), (-4.99, 1, 1)), part((-5, -0.4, -0.4), (-4.99, 0.4, 0.4))
    blade, wing = part((-5, -1, -0.1), (-4.99, 1, 0.1)), part((-1, -0.01, -1), (1, 0, 1))
    square = np.array([[9.0, 0, 0], [9, 1, 0], [9, 1, 1], [9, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    vapour, twin = Part(square, faces), Part(square, faces[:, ::-1])
    panel = Part(square - [4, 0, 0], faces)  # touches the body's edge
    panel.vertices[0] = [5, 0, 5]
    kept = without_effects([body, disc, fan, blade, wing, vapour, twin, panel])
    assert [id(one) for one in kept] == [id(one) for one in (body, fan, blade, wing, panel)]


def test_ac3d_tree_names_and_transforms() -> None:
    child = ac_object("child", (0, 0, 0), (1, 1, 1)).replace("numvert", "loc 10 0 0\nnumvert")
    turned = 'OBJECT group\nname "g"\ndata 5\nkids9\nrot 0 1 0 -1 0 0 0 0 1\nloc 0 0 5\nkids 1\n' + child
    blank = ac_object("blank", (0, 0, 0), (2, 2, 2)).replace("numsurf", "\nnumsurf")
    line = ac_object("line", (0, 0, 0), (1, 1, 1)).replace("0X30", "0x2")
    blur = ac_object("Prop-Blur", (0, 0, 0), (1, 1, 1), "kids 1") + "\n" + ac_object("inner", (0, 0, 0), (1, 1, 1))
    parts = read_ac3d(ac_text(turned, blank, line, blur), skip=lambda name: "Blur" in name)
    assert [one.vertices.max() for one in parts] == [11, 2]
    np.testing.assert_allclose(parts[0].vertices.min(axis=0), [-1, 10, 5])  # row vectors: (x, y) -> (-y, x)
    assert len(parts[0].faces) == 12


@pytest.mark.parametrize("text", ["", "hello", ac_text(AIRPLANE[0])[:-40]])
def test_bad_ac3d(text: str) -> None:
    with pytest.raises(ValueError, match="AC3D"):
        read_ac3d(text, skip=lambda name: False)


def area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.mark.parametrize("start", range(6))
def test_concave_polygons_keep_their_area(start: int) -> None:
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


def test_obj_text() -> None:
    vertices, faces = read_obj("# c\nv 0 0 0\nv 1 0 0 1 1 1\nv 0 1 0\ng x\nf 1/2/3 -2//1 3\nf 1 2\nl 1 2\n")
    np.testing.assert_array_equal(vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(faces, [[0, 1, 2]])
    for text in ("v 0 0\nv 1 2 3", "v 0 0 0\nf 1 2 4", "v 0 0 0\nf 1 1 -9", "f 1 2 x"):
        with pytest.raises(ValueError, match=r"inhomogeneous|names a vertex that is not there|invalid literal"):
            read_obj(text)
