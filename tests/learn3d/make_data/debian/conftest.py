"""Packages that the tests of the Debian recipe share."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from small_packages import AIRCRAFT, AIRPLANE, CHAIR, TABLE, ac_object, ac_text, catalogue, deb, entry


@pytest.fixture
def dpkg() -> None:
    """Skips the test where dpkg is not installed."""
    if shutil.which("dpkg-deb") is None:
        pytest.skip("needs dpkg-deb")


@pytest.fixture
def debs(dpkg: None, tmp_path: Path) -> Path:
    """A catalogue with a chair, its copy, a stretched copy, a table, a cup; an airplane, a light and a balloon."""
    entries = [
        entry("Oak chair", "chair"),
        entry("Red chair", "copy"),
        entry("Tall chair", "chair", width="4", height="30", depth="4"),
        entry("Table", "table", license="CC0"),
        entry("Cup", "cup"),
        entry("Broken table", "broken"),
        entry("Odd sofa", "odd", model="/m/odd.dae"),
    ]
    models = {"m/chair.obj": CHAIR, "m/copy.obj": CHAIR, "m/table.obj": TABLE, "m/broken.obj": "v 0 0 0\nf 1 2 3"}
    folder = tmp_path / "debs"
    sh3f = {"./usr/share/sweethome3d/furniture/Test.sh3f": catalogue(entries, models)}
    notice = {"./usr/share/doc/sweethome3d-furniture/copyright": b"Free-Art"}
    deb(folder, "sweethome3d-furniture", {**sh3f, **notice})
    disc = ac_object("thing", (-5.01, -1, -1), (-5, 1, 1))
    aircraft = {
        "Plane/plane-main.xml": "<author>B. Maker</author><path>Models/plane.ac</path>",
        "Plane/Models/plane.ac": ac_text(*AIRPLANE, disc),
        "Plane/Models/lights/RedLight.ac": ac_text(AIRPLANE[0]),
        "balloon/Models/balloon1.ac": ac_text(AIRPLANE[0]),
    }
    files: dict[str, bytes | None] = {f"./{AIRCRAFT}/{path}": text.encode() for path, text in aircraft.items()}
    deb(folder, "flightgear-data-ai", {**files, f"./{AIRCRAFT}/Plane/Models/link.ac": None})
    return folder
