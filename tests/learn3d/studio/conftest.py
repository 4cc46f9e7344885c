"""Short turntables; Chromium for the pages of the studio, and pages whose errors and requests are watched."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

PATIENCE = 100_000  # milliseconds; a second or two on an idle machine
# WebGL without a graphics card
_OPTIONS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


@pytest.fixture
def short_turntables(monkeypatch) -> None:
    """Turntables take most of the time of a reconstruction."""
    monkeypatch.setattr(
        "learn3d.studio.picture_to_mesh.write.turntable",
        lambda _: np.zeros((2, 32, 32, 3), np.uint8),
    )


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("needs Chromium (apt-get install chromium)")
    with api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=chromium, args=_OPTIONS)
        yield started
        started.close()


@pytest.fixture
def visit(browser) -> Iterator[Callable[..., Any]]:
    """Opens the page of an address in a window of its own. Meshes turn by themselves only if it is asked for.

    At the end of the test no page had an error, and none asked for anything from elsewhere.
    """
    said, elsewhere, contexts = [], [], []

    def open_page(address: str, width: int = 1280, height: int = 1000, **options: Any) -> Any:
        own = (address, f"blob:{address}", "data:")

        def watch(request: Any) -> None:
            if not request.url.startswith(own):
                elsewhere.append(request.url)

        options = {
            "viewport": {"width": width, "height": height},
            "reduced_motion": "reduce",
        } | options
        contexts.append(browser.new_context(**options))
        contexts[-1].set_default_timeout(PATIENCE)
        tab = contexts[-1].new_page()
        tab.on("console", lambda line: said.append(line.text) if line.type == "error" else None)
        tab.on("pageerror", lambda error: said.append(str(error)))
        tab.on("request", watch)
        tab.goto(address)
        return tab

    yield open_page
    for context in contexts:
        context.close()
    assert said == []
    assert elsewhere == []


@pytest.fixture
def fits() -> Callable[..., None]:
    """Checks that a page fits a window of a width, and that it is light or dark as the reader asks."""

    def check(tab: Any, width: int, scheme: str) -> None:
        tab.set_viewport_size({"width": width, "height": 900})
        tab.emulate_media(color_scheme=scheme)  # as when evening comes
        for _ in range(200):  # plots are drawn again after a while
            if (wide := tab.evaluate("document.documentElement.scrollWidth")) <= width:
                break
            tab.wait_for_timeout(100)
        assert wide <= width, "nothing sticks out"
        colors = (
            tab.evaluate(f"getComputedStyle(document.body).{name}")
            for name in ("backgroundColor", "color")
        )
        ground, text = (
            np.mean([float(part) for part in color.strip("rgba()").split(",")[:3]]) / 255
            for color in colors
        )
        assert (ground > 0.9 and text < 0.4) if scheme == "light" else (ground < 0.15 < 0.6 < text)

    return check


@pytest.fixture(scope="session")
def pixels() -> Callable[[Any], np.ndarray]:
    """What one sees of an element of a page, int [H, W, 3]."""

    def take(place: Any) -> np.ndarray:
        image = Image.open(io.BytesIO(place.screenshot())).convert("RGB")
        return np.asarray(image).astype(int)

    return take
