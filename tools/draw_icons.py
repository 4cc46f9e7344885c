"""Draws what the package's model makes of pictures of real furniture, to be judged by eye (docs/demo.md).

python tools/draw_icons.py --output icons --half 1
"""

import io
import zipfile
import zlib
from pathlib import Path, PurePosixPath

import numpy as np
import tyro
from PIL import Image

from learn3d.make_data.debian.furniture import furniture_category, read_catalogue
from learn3d.make_data.debian.packages import get_package, read_package
from learn3d.pictures.sheets import save_png, tile
from learn3d.pictures.surfaces import draw_around
from learn3d.reconstruction import load_model, reconstruct_picture

CATEGORIES = ("chair", "lamp", "sofa", "table")
TURNS = (0, 50, 100, 180)  # degrees from the camera's side


def icons(package: Path) -> list[tuple[int, str, Image.Image]]:
    """CRC of catalogue and name, category and icon of each piece of furniture with a transparent icon, by CRC."""
    found = []
    for path, content in sorted(read_package(package, (".sh3f",)).items()):
        archive = zipfile.ZipFile(io.BytesIO(content))
        entries = read_catalogue(archive.read("PluginFurnitureCatalog.properties").decode("latin-1"))[1]
        for entry in entries:
            category = furniture_category(entry.get("name", ""), entry.get("category", ""))
            if category in CATEGORIES and entry.get("icon"):
                icon = Image.open(io.BytesIO(archive.read(entry["icon"].removeprefix("/"))))
                if icon.mode == "RGBA":
                    found.append((zlib.crc32(f"{PurePosixPath(path).stem}{entry['name']}".encode()), category, icon))
    return sorted(found, key=lambda each: each[0])


def main(output: Path, half: int = 1, count: int = 30, side: int = 128) -> None:
    """Write OUTPUT/half-H.png: icons of Debian's sweethome3d-furniture, and the meshes made of them, one in a row.

    The icons are in two halves, those with an even CRC (half 0) and with an odd one (half 1); the first `count` of a
    half are drawn. The title of a row is the category, and what the picture was taken for; W means a warning.
    """
    output.mkdir(parents=True, exist_ok=True)
    model, rows, titles = load_model(None), [], []
    found = icons(get_package("sweethome3d-furniture", output))
    for _, category, icon in [each for each in found if each[0] % 2 == half][:count]:
        pixels = np.array(icon)
        made = reconstruct_picture(model, pixels[..., :3].copy(), pixels[..., 3].copy())
        white = Image.new("RGB", icon.size, "white")
        white.paste(icon, icon)
        views = draw_around(made.surface, [made.azimuth_deg - turn for turn in TURNS], image_size=side)
        rows.append([np.asarray(white.resize((side, side))), *views])
        titles.append(f"{category}: {made.kind}{' W' if made.warning else ''}")
    save_png(output / f"half-{half}.png", tile(rows, ["picture", *map(str, TURNS)], tile_size=side, row_titles=titles))


if __name__ == "__main__":
    tyro.cli(main)
