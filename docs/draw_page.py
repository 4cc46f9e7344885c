"""Draws the page of `learn3d demo` after a visit to an example, in Chromium (playwright).

python docs/draw_page.py --output pictures
"""

import io
import shutil
import subprocess
import sys
from pathlib import Path

import tyro
from PIL import Image
from playwright.sync_api import sync_playwright

SIZE = {"width": 1100, "height": 1000}
COLORS = 256  # of the palette of the picture


def main(output: Path, example: str = "chair") -> None:
    command = [sys.executable, "-m", "learn3d", "demo", "--port", "0", "--no-browser"]
    output.mkdir(parents=True, exist_ok=True)
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server,
        sync_playwright() as playwright,
    ):
        chromium = shutil.which("chromium")
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        tab = browser.new_page(viewport=SIZE, reduced_motion="reduce")  # the mesh does not turn
        tab.set_default_timeout(300_000)
        tab.goto(server.stdout.readline().split()[4])
        tab.get_by_role("button", name=example, exact=True).click()
        tab.locator("body.given:not(.busy) .view > canvas").wait_for()
        image = Image.open(io.BytesIO(tab.screenshot())).convert("RGB")
        image.quantize(COLORS, dither=Image.Dither.NONE).save(output / "page.png", optimize=True)
        browser.close()
        server.terminate()


if __name__ == "__main__":
    tyro.cli(main)
