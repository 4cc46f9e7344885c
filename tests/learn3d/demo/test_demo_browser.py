"""The page of `learn3d demo` in a browser: the real command, a real page, and the end of both."""

from __future__ import annotations

import io
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

pytest.importorskip("gradio", reason="needs the extra demo")
api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
CHROMIUM = shutil.which("chromium")
if CHROMIUM is None:
    pytest.skip("needs Chromium (apt-get install chromium)", allow_module_level=True)

ARGUMENTS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
#: The viewer of meshes tries WebGPU first and takes WebGL. The editor draws a layer a moment after it is shown.
HARMLESS = ("WebGPU", "No draw texture found for layer")
PATIENCE = 30_000  # milliseconds


@pytest.fixture(scope="module")
def browser() -> Iterator[api.Browser]:
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture
def page(browser, server) -> Iterator[api.Page]:
    """The open page; afterwards it must have had no errors, and have asked for nothing from elsewhere."""
    page = browser.new_page(viewport={"width": 1280, "height": 1100})
    page.set_default_timeout(PATIENCE)
    said, asked = [], []
    page.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(server[1])
    page.get_by_role("button", name="sofa").wait_for()
    yield page
    page.close()
    assert [text for text in said if not any(words in text for words in HARMLESS)] == []
    assert [url for url in asked if not url.startswith((server[1], "data:", "blob:"))] == []


def settled(place: api.Locator) -> np.ndarray:
    """The pixels of a viewer, once its mesh has come and stays the same: int [H,W,3]."""
    deadline, last = time.monotonic() + PATIENCE / 1000, None
    while time.monotonic() < deadline:
        pixels = np.asarray(Image.open(io.BytesIO(place.screenshot())).convert("RGB")).astype(int)
        if last is not None and np.ptp(pixels[40:]) > 60 and np.array_equal(pixels, last):
            return pixels
        last = pixels
        time.sleep(0.5)
    raise AssertionError("no mesh is shown")


def give(page: api.Page, path: Path) -> None:
    page.locator("input[type=file]").first.set_input_files(path)


def test_an_upload_becomes_meshes_that_turn_and_can_be_kept(page, tmp_path) -> None:
    colors = np.full((200, 300, 3), 200, np.uint8)
    colors[60:140, 80:220] = (40, 60, 120)
    Image.fromarray(colors).save(tmp_path / "box.png")
    give(page, tmp_path / "box.png")
    canvas = page.locator(".model3D canvas")
    canvas.nth(1).wait_for()
    assert canvas.count() == 2, "one for each run"
    before = settled(canvas.first)
    box = canvas.first.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 90, y + 30, steps=5)
    page.mouse.up()
    assert (np.abs(settled(canvas.first) - before).max(axis=2) > 20).mean() > 0.01
    for kind in ("GLB", "OBJ"):
        with page.expect_download() as download:
            page.get_by_role("button", name=kind).first.click()
        name = download.value.suggested_filename
        assert name.startswith("box ") and name.endswith(f".{kind.lower()}")
        download.value.save_as(tmp_path / name)
        assert len(trimesh.load(tmp_path / name, force="mesh").faces) > 100
    page.get_by_text("Correct the outline").click()
    with page.expect_download() as download:
        page.get_by_role("button", name="Save the cut-out").click()
    download.value.save_as(tmp_path / "saved.png")
    with Image.open(tmp_path / "saved.png") as image:
        assert image.mode == "RGBA"
        assert (np.asarray(image)[..., 3] > 0).sum() == pytest.approx(80 * 140, rel=0.05)


def test_the_mask_is_corrected_with_the_brush(page) -> None:
    page.get_by_role("button", name="table").first.click()
    page.locator(".model3D canvas").first.wait_for()
    first = settled(page.locator(".model3D canvas").first)

    page.get_by_text("Correct the outline").click()
    page.wait_for_timeout(4000)  # until the editor has loaded its layer
    box = page.locator("canvas").first.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y - 90)
    page.mouse.down()
    page.mouse.move(x, y + 90, steps=8)
    page.mouse.up()
    deadline = time.monotonic() + PATIENCE / 1000
    while np.array_equal(settled(page.locator(".model3D canvas").first), first):
        assert time.monotonic() < deadline, "the mesh is not the one of the painted mask"
        page.get_by_role("button", name="Make the mesh again").click()  # again while the mask is still on its way
    page.get_by_role("button", name="Empty mask").click()
    page.wait_for_timeout(1000)
    page.get_by_role("button", name="Make the mesh again").click()
    page.get_by_text("no object was found in the picture").wait_for()


def test_a_broken_picture_gets_a_sentence(page, tmp_path) -> None:
    page.get_by_text("Correct the outline").click()
    page.get_by_role("button", name="Make the mesh again").click()
    page.get_by_text("Give a picture first").wait_for()
    (tmp_path / "broken.png").write_bytes(b"no picture")
    give(page, tmp_path / "broken.png")
    page.get_by_text("broken.png: cannot be decoded as an image").wait_for()
    Image.fromarray(np.full((50, 50, 3), 90, np.uint8)).save(tmp_path / "grey.png")
    give(page, tmp_path / "grey.png")
    page.get_by_text("no object was found in the picture").wait_for()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_narrow_windows_and_dark_mode(browser, server, scheme) -> None:
    page = browser.new_page(viewport={"width": 380, "height": 800}, color_scheme=scheme)
    page.goto(server[1])
    page.get_by_role("button", name="sofa").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 380, "nothing sticks out"
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    light = np.mean([int(part) for part in background[background.index("(") + 1 : -1].split(",")[:3]])
    assert (light < 80) == (scheme == "dark")
    page.close()


def test_an_interrupt_ends_it_while_the_page_is_open_and_busy(browser, server) -> None:
    process, address = server
    page = browser.new_page()
    page.goto(address)
    page.get_by_role("button", name="sofa").click()
    page.locator(".model3D canvas").first.wait_for()
    page.get_by_role("button", name="chair").click()
    start = time.monotonic()
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=30) in (0, 130)
    assert time.monotonic() - start < 10, "a second or two, where the machine is idle"
    page.close()
    errors = (process.folder / "errors.txt").read_text()
    assert "Traceback" not in errors and "ERROR" not in errors, errors
    assert not list(process.folder.glob("learn3d-demo-*")), "what visitors gave is gone"
