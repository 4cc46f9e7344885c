"""Draws the first screen of a page that `learn3d report` wrote, in Chromium (playwright).

python docs/draw_report.py quickstart/report.html --output pictures
"""

import io
import shutil
from pathlib import Path

import tyro
from PIL import Image
from playwright.sync_api import sync_playwright

SIZE = {"width": 1100, "height": 1110}
COLORS = 256  # of the palette of the picture
GRAPHICS = "--enable-unsafe-swiftshader"  # WebGL without a graphics card


def main(report: tyro.conf.Positional[Path], output: Path) -> None:
    output.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", GRAPHICS]
        )
        tab = browser.new_page(viewport=SIZE, reduced_motion="reduce")
        tab.set_default_timeout(300_000)
        tab.goto(report.resolve().as_uri())
        tab.locator("#panes canvas").first.wait_for()
        tab.wait_for_timeout(3000)  # until the plots are drawn
        image = Image.open(io.BytesIO(tab.screenshot())).convert("RGB")
        image.quantize(COLORS, dither=Image.Dither.NONE).save(output / "report.png", optimize=True)
        browser.close()


if __name__ == "__main__":
    tyro.cli(main)
