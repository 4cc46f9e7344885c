"""The page of `learn3d report` in a browser: what one sees, turns and chooses there."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from learn3d.studio.picture_to_mesh.reconstruction import reconstruct_dataset

pytest.importorskip("plotly")

Open = Callable[[Path], Any]


@pytest.fixture
def open_report(visit) -> Open:
    def open_page(path: Path) -> Any:
        tab = visit(path.as_uri())
        tab.wait_for_selector("#curves .main-svg")
        tab.wait_for_selector(".mesh canvas >> nth=-1")
        return tab

    return open_page


def picture(tab: Any, number: int = 0) -> np.ndarray:
    """What one sees in a mesh's place, uint8 [H, W, 3], once it no longer changes."""
    before, place = b"", tab.locator(".mesh").nth(number)
    for _ in range(40):
        if (now := place.screenshot()) == before:
            break
        before = now
        tab.wait_for_timeout(150)
    return np.asarray(Image.open(io.BytesIO(now)).convert("RGB"))


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Share of the pixels that differ clearly."""
    return float((np.abs(before.astype(int) - after).max(axis=2) > 8).mean())


def test_a_mesh_is_saved_as_reconstruct_writes_it(
    page, runs, tiny_folder, open_report, tmp_path
) -> None:
    tab = open_report(page)
    with tab.expect_download() as download:
        tab.locator("figcaption button").first.click()
    download.value.save_as(tmp_path / "saved.obj")
    index = tab.evaluate("page.items[0].index")
    paths = reconstruct_dataset(
        runs[0], tmp_path, tiny_folder, [index], split="train", mesh_format="obj"
    )
    saved, wanted = (trimesh.load(path) for path in (tmp_path / "saved.obj", paths[0]))
    assert len(saved.faces) == len(wanted.faces) and np.allclose(
        saved.bounds, wanted.bounds, atol=2e-4
    )
    assert saved.volume == pytest.approx(wanted.volume, rel=0.01)


def test_a_drag_and_keys_turn_all_meshes(page, open_report) -> None:
    tab = open_report(page)
    assert tab.locator(".mesh").count() == 3
    assert all(place.get_attribute("alt") for place in tab.locator("img").all())
    assert all(place.get_attribute("aria-label") for place in tab.locator(".plot").all())
    assert "</script><b>one" in tab.locator("figcaption").nth(1).inner_text()
    assert "</script><b>one" in tab.locator(".mesh").first.get_attribute("aria-label")
    before = [picture(tab, number) for number in range(3)]
    for image in before:  # a shaded shape on an even ground
        assert 0.05 < (np.abs(image.astype(int) - image[3, 3]).max(axis=2) > 30).mean() < 0.9
    box = tab.locator(".mesh").first.bounding_box()
    tab.mouse.move(box["x"] + 90, box["y"] + 90)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 150, box["y"] + 130, steps=4)
    tab.mouse.up()
    turned = [picture(tab, number) for number in range(3)]
    assert all(changed(a, b) > 0.02 for a, b in zip(before, turned, strict=True))
    tab.locator(".mesh").nth(1).focus()
    for key in ("ArrowLeft", "ArrowLeft", "ArrowUp", "+"):
        tab.keyboard.press(key)
    assert all(changed(turned[number], picture(tab, number)) > 0.02 for number in range(3))
    tab.evaluate("show(item)")
    assert changed(before[0], picture(tab, 0)) == 0, "choosing an image brings its camera back"


def test_objects_are_chosen_by_click_and_keyboard(page, open_report) -> None:
    tab = open_report(page)
    title, rows = tab.locator("#chosen"), tab.locator("#objects tr[data-item]")
    first, before, shown = title.inner_text(), picture(tab, 2), tab.get_attribute("#picture", "src")
    rows.nth(1).locator("td").first.click()
    second = title.inner_text()
    assert second != first and second.startswith(rows.nth(1).locator("th").inner_text())
    assert tab.get_attribute("#picture", "src") != shown
    assert tab.get_attribute("#picture", "alt").startswith("Input image: 000")
    assert changed(before, picture(tab, 2)) > 0.02
    assert "chosen" in rows.nth(1).get_attribute("class")
    rows.nth(0).locator("button").focus()
    tab.keyboard.press("Enter")
    assert title.inner_text() == first
    tab.locator("#items input").first.focus()
    tab.keyboard.press("ArrowRight")
    assert title.inner_text() == second
    assert tab.locator(".mesh canvas").count() == 3, "scenes are filled again, not made again"


def test_the_table_sorts_and_shows_all_objects(page, open_report) -> None:
    tab = open_report(page)
    rows, heads = tab.locator("#objects tbody tr:visible"), tab.locator("#objects thead th")
    assert rows.count() == 2
    tab.check("#all")
    assert rows.count() == 3
    for down in (True, False):
        heads.nth(2).locator("button").press("Enter")
        values = [float(row.split("\t")[-1]) for row in rows.all_inner_texts()]
        assert values == sorted(values, reverse=down)
        assert heads.nth(2).get_attribute("aria-sort") == ("descending" if down else "ascending")
    heads.nth(0).locator("button").click()
    names = [row.split("\t")[0] for row in rows.all_inner_texts()]
    assert names == sorted(names) and heads.nth(2).get_attribute("aria-sort") is None


def test_it_can_be_read_in_narrow_and_wide_windows_in_light_and_dark(
    page, open_report, fits
) -> None:
    tab = open_report(page)
    for width, scheme in ((340, "dark"), (1900, "light")):
        fits(tab, width, scheme)
        picture(tab)
        for place in tab.locator(
            ".mesh, .mesh canvas, .plot, .plot .main-svg >> nth=0, #picture"
        ).all():
            box = place.bounding_box()
            assert 120 <= box["width"] and box["x"] >= 0 and box["x"] + box["width"] <= width
        assert (picture(tab).std(axis=(0, 1)) > 5).all()


def test_of_many_runs_four_are_shown_at_a_time(runs, tmp_path, open_report) -> None:
    from learn3d.studio.tables.report import write_report

    write_report([runs[0]] * 6, tmp_path / "page.html", labels=list("abcdef"))
    tab = open_report(tmp_path / "page.html")
    boxes = tab.locator("#choice input")
    assert tab.locator(".mesh canvas").count() == 5
    assert [box.is_checked() for box in boxes.all()] == [True] * 4 + [False] * 2
    assert boxes.nth(4).is_disabled()
    boxes.nth(0).uncheck()
    boxes.nth(5).check()
    tab.wait_for_function("document.querySelectorAll('.mesh canvas').length === 5")
    assert [text[0] for text in tab.locator("figcaption").all_inner_texts()] == ["i", *"bcdf", "t"]
