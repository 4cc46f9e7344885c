"""Furniture of a catalogue: its category, its text, its placement."""

from __future__ import annotations

import numpy as np
import pytest

from learn3d.make_data.debian.furniture import furniture_category, place_furniture, read_catalogue


@pytest.mark.parametrize(
    ("name", "category"),
    [
        ("Winchester armchair", "chair"),
        ("Bar stool", "chair"),
        ("Class seat", "chair"),
        ("Wheelchair", None),
        ("Chair with cushion", "chair"),
        ("Round table", "table"),
        ("Table fan", None),
        ("Table tennis bat", None),
        ("Tablet", None),
        ("Computer desk", "table"),
        ("Desk lamp", "lamp"),
        ("Wall light", "lamp"),
        ("Light switch", None),
        ("Candle", None),
        ("Bedside table", "cabinet"),
        ("Chest freezer", None),
        ("Angle shelf 160", "cabinet"),
        ("Blue corner shelf", None),
        ("Towel rack", None),
        ("Washbasin with cabinet", None),
        ("Futon couch", "sofa"),
        ("Opened sofa bed", None),
        ("Toilets unit", None),
    ],
)
def test_category_by_name(name: str, category: str | None):
    assert furniture_category(name, "Living room") == category


def test_category_by_section():
    assert furniture_category("Chair lift", "Vehicles") is None


def test_catalogue_text():
    general, entries = read_catalogue("# x\nlicense=L\nname#2=B\n name#1 = caf\\u00e9 = A\nmodel#1=/m\n")
    assert general == {"license": "L"}
    assert entries == [{"name": "café = A", "model": "/m"}, {"name": "B"}]


def test_furniture_is_turned_and_stretched():
    vertices = np.array([[0.0, 0, 0], [1, 2, 3]])
    turned = place_furniture(vertices, {"modelRotation": "0 0 1 0 1 0 -1 0 0"})
    np.testing.assert_allclose(turned[1], [3, 2, -1])
    placed = place_furniture(
        vertices, {"modelRotation": "0 0 1 0 1 0 -1 0 0", "width": "6", "height": "1", "depth": "5"}
    )
    np.testing.assert_allclose(placed[1], [6, 1, -5])


@pytest.mark.parametrize("rotation", ["1 0 0", "1 0 0 0 1 0 0 0 -1", "2 0 0 0 1 0 0 0 1"])
def test_bad_rotation(rotation: str):
    with pytest.raises(ValueError, match="modelRotation is not a rotation"):
        place_furniture(np.eye(3), {"modelRotation": rotation})


def test_names_that_are_no_characters_and_numbers_that_are_none():
    _, entries = read_catalogue("name#1=half \\ud83d a pair\nname#" + "9" * 5000 + "=x\nname#2=ok")
    assert [e["name"] for e in entries] == ["half ? a pair", "ok"]
