"""The page of `learn3d demo` in a browser: the real command, a real page, and the end of both."""

from __future__ import annotations

import base64
import io
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

pytest.importorskip("uvicorn", reason="needs the extra demo")
api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
CHROMIUM = shutil.which("chromium")
if CHROMIUM is None:
    pytest.skip("needs Chromium (apt-get install chromium)", allow_module_level=True)

PATIENCE = 300_000  # milliseconds; a second or two on an idle machine


@pytest.fixture(scope="module")
def browser() -> Iterator[api.Browser]:
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"]
        )
        yield browser
        browser.close()


@pytest.fixture
def page(browser, server) -> Iterator[api.Page]:
    """The open page; afterwards it must have had no errors, and have asked for nothing from elsewhere."""
    page = browser.new_page(viewport={"width": 1280, "height": 1100})
    page.set_default_timeout(PATIENCE)
    said, asked = [], []
    page.on(
        "console", lambda message: said.append(message.text) if message.type == "error" else None
    )
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(server[1])
    page.get_by_role("button", name="sofa").wait_for()
    yield page
    page.close()
    assert said == []
    assert [url for url in asked if not url.startswith((server[1], f"blob:{server[1]}"))] == []


def pixels(place: api.Locator) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(place.screenshot())).convert("RGB")).astype(int)


def moves(page: api.Page, place: api.Locator, before: np.ndarray) -> bool:
    """Whether more than a hundredth of the pixels change, sooner or later."""
    for _ in range(PATIENCE // 100):
        if (np.abs(pixels(place) - before).max(axis=2) > 20).mean() > 0.01:
            return True
        page.wait_for_timeout(100)
    return False


def made(page: api.Page) -> np.ndarray:
    """Wait for the meshes; the pixels of the picture with its outline."""
    page.get_by_text("Drag the mesh to turn it").wait_for()
    return pixels(page.locator("#picture"))


@pytest.fixture
def box(tmp_path) -> Path:
    colors = np.full((200, 300, 3), 200, np.uint8)
    colors[60:140, 80:220] = (40, 60, 120)
    Image.fromarray(colors).save(tmp_path / "box.png")
    return tmp_path / "box.png"


def download(page: api.Page, name: str, folder: Path) -> Path:
    with page.expect_download() as event:
        page.get_by_role("button", name=name).first.click()
    event.value.save_as(folder / event.value.suggested_filename)
    return folder / event.value.suggested_filename


def test_a_picture_becomes_meshes_that_turn_and_can_be_kept(page, box, tmp_path) -> None:
    page.locator("#file").set_input_files(box)
    seen = made(page)
    assert (seen == (40, 60, 120)).all(axis=2).mean() > 0.1, "the picture is not tinted"
    assert (seen == 255).all(axis=2).any(), "the outline"
    canvas = page.locator(".view canvas")
    assert canvas.count() == 2, "one for each run"
    before = pixels(canvas.first)
    assert np.ptp(before) > 60
    assert moves(page, canvas.first, before), "it turns by itself"
    area = canvas.first.bounding_box()
    page.mouse.move(area["x"] + area["width"] / 2, area["y"] + area["height"] / 2)
    page.mouse.down()
    before = pixels(canvas.first)
    page.mouse.move(
        area["x"] + area["width"] / 2 + 90, area["y"] + area["height"] / 2 + 30, steps=5
    )
    assert moves(page, canvas.first, before), "it turns by hand"
    page.mouse.up()
    meshes = [
        trimesh.load(download(page, kind, tmp_path), force="mesh", process=False)
        for kind in ("GLB", "OBJ")
    ]
    assert (
        np.allclose(meshes[0].vertices, meshes[1].vertices, atol=1e-4)
        and len(meshes[0].faces) > 100
    )
    (tmp_path / "kept").mkdir()
    with Image.open(download(page, "Cut-out", tmp_path / "kept")) as image:
        assert (np.asarray(image)[..., 3] > 0).mean() == pytest.approx(
            80 * 140 / (200 * 300), rel=0.05
        )


def test_the_outline_is_corrected_by_brushes_and_a_box(page, box) -> None:
    page.locator("#file").set_input_files(box)
    first = made(page)
    area = page.locator("#picture").bounding_box()

    def drag(tool: str, *ends: tuple[float, float]) -> np.ndarray:
        if (
            page.get_by_role("button", name=tool, exact=True).get_attribute("aria-pressed")
            == "false"
        ):
            page.get_by_role("button", name=tool, exact=True).click()
        for step, (x, y) in enumerate(ends):
            page.mouse.move(area["x"] + x * area["width"], area["y"] + y * area["height"], steps=6)
            if not step:
                page.mouse.down()
        page.mouse.up()
        return made(page)

    added = drag("Add", (0.1, 0.1), (0.2, 0.1))
    assert (added != first).any(axis=2)[: len(first) // 5].any(), "an outline around the stroke"
    removed = drag("Remove", (0.05, 0.1), (0.25, 0.1))
    assert np.abs(removed - first).mean() < np.abs(added - first).mean()
    assert np.abs(drag("Box", (0.2, 0.2), (0.8, 0.8)) - first).mean() < 3, "at most a pixel"


def test_what_is_no_picture_gets_a_sentence_and_a_drop_replaces_it(page, box, tmp_path) -> None:
    (tmp_path / "broken.png").write_bytes(b"no picture")
    page.locator("#file").set_input_files(box)
    page.get_by_text("Finding the").first.wait_for()
    page.locator("#file").set_input_files(tmp_path / "broken.png")  # while the first is in work
    sentence = page.get_by_text("not a picture that your browser can open")
    sentence.wait_for()
    page.wait_for_timeout(1500)
    assert sentence.is_visible() and page.locator("#progress").is_hidden()
    Image.fromarray(np.full((50, 50, 3), 90, np.uint8)).save(tmp_path / "grey.png")
    page.locator("#file").set_input_files(tmp_path / "grey.png")
    page.get_by_text("No object was found").wait_for()
    pressed = page.get_by_role("button", name="Box").get_attribute("aria-pressed")
    assert pressed == "true", "a box can be dragged at once"
    with Image.open(box) as image:
        image.paste((0, 0, 0), (240, 60, 290, 140))
        image.save(tmp_path / "two.png")
    page.locator("#file").set_input_files(tmp_path / "two.png")
    page.get_by_text("away from the object").wait_for()
    content = base64.b64encode(box.read_bytes()).decode()
    page.evaluate(
        """text => { const data = new DataTransfer(), bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
        data.items.add(new File([bytes], "box.png")); window.dispatchEvent(new DragEvent("drop", {dataTransfer: data,
        cancelable: true})); }""",
        content,
    )
    made(page)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_narrow_windows_and_dark_mode(browser, server, scheme) -> None:
    page = browser.new_page(viewport={"width": 380, "height": 800}, color_scheme=scheme)
    page.goto(server[1])
    page.get_by_role("button", name="sofa").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 380, "nothing sticks out"
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    light = np.mean(
        [int(part) for part in background[background.index("(") + 1 : -1].split(",")[:3]]
    )
    assert (light < 80) == (scheme == "dark")
    page.close()


def test_an_interrupt_ends_it_while_the_page_is_open_and_busy(browser, server) -> None:
    process, address = server
    page = browser.new_page()
    page.goto(address)
    page.get_by_role("button", name="sofa").click()
    page.locator(".view canvas").first.wait_for(timeout=PATIENCE)
    assert page.get_by_role("button", name="sofa").get_attribute("aria-pressed") == "true"
    page.get_by_role("button", name="chair").click()
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) in (0, 130), "a second or two on an idle machine"
    page.close()
    errors = (process.folder / "errors.txt").read_text()
    assert "Traceback" not in errors and "ERROR" not in errors, errors
