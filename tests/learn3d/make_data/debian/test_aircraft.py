"""Aircraft: which files are airplanes, what is no part of them, where their front is."""

from __future__ import annotations

import numpy as np
import pytest
from small_packages import box

from learn3d.make_data.debian.aircraft import is_airplane_file, turn_to_front, without_effects
from learn3d.make_data.debian.mesh_text import Part, triangulate


@pytest.mark.parametrize(
    ("path", "whole"),
    [
        ("A320/Models/A320.ac", True),
        ("Lightning/Models/lightning-f1a.ac", True),
        ("Lightning/Models/light-red-flare.ac", False),
        ("Plane/Models/Lights/Strobe.ac", False),
        ("Plane/Models/refueling/plane.ac", False),
        ("c182/Models/toggle-white.ac", False),
        ("Cessna208Caravan/Models/wheels.ac", False),
        ("balloon/Models/tuxalloon.ac", False),
        ("Ferry/FerryBoat1.ac", False),
        ("c172/Models/c172p.ac", True),
    ],
)
def test_airplane_files(path: str, whole: bool):
    assert is_airplane_file(path) == whole


def test_turn_to_front_is_a_rotation():
    nose_up_left = turn_to_front(np.array([[-1.0, 0, 0], [0, 1, 0], [0, 0, 1]]))
    np.testing.assert_array_equal(nose_up_left, [[0, 0, 1], [0, 1, 0], [1, 0, 0]])


def part(name: str, low: tuple, high: tuple) -> Part:
    corners, quads = box(low, high)
    return Part(name, corners, triangulate(quads, corners))


def test_effects_are_found_by_shape():
    body = part("body", (-5, 0, -5), (5, 1, 5))
    disc, fan = part("a", (-5, -1, -1), (-4.99, 1, 1)), part("b", (-5, -0.4, -0.4), (-4.99, 0.4, 0.4))
    blade, wing = part("c", (-5, -1, -0.1), (-4.99, 1, 0.1)), part("d", (-1, -0.01, -1), (1, 0, 1))
    square = np.array([[9.0, 0, 0], [9, 1, 0], [9, 1, 1], [9, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    vapour, twin = Part("e", square, faces), Part("f", square, faces[:, ::-1])
    panel = Part("g", square - [4, 0, 0], faces)  # touches the body's edge
    panel.vertices[0] = [5, 0, 5]
    kept = without_effects([body, disc, fan, blade, wing, vapour, twin, panel])
    assert [one.name for one in kept] == ["body", "b", "c", "d", "g"]
