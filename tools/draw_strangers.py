"""Draws pictures of things that the model has not seen, out of icon sets and a room planner's catalogue.

python -m pip install resvg_py
python tools/draw_strangers.py --output strangers
python tools/measure_likeness.py --pictures strangers/report --sheet strangers.png

The rule: a picture of a known kind has a name that ends with a word of its kind in `WORDS` and has
no word of `OTHER_THINGS`, apart from numbers and `STYLES`. Each set in turn gives its next name by
the alphabet. Other things have exactly the names in `THINGS`, from one set after the other. Even
numbers are for tuning, odd ones for reports. It needs npm.
"""

import io
import itertools
import json
import re
import subprocess
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path

import tyro
from PIL import Image

SIDE = 512  # width of a drawing in pixels
PARTS = "tune", "report"  # folders of even and odd numbers
# packages of npm with their versions; from game-icons on, drawings have one colour
SETS = {
    "@iconify-json/emojione-v1": "1.2.3",
    "@iconify-json/noto-v1": "1.2.5",
    "react-planner": "2.0.6",
    "@iconify-json/icon-park": "1.2.4",
    "@iconify-json/streamline-ultimate-color": "1.2.2",
    "@streetmix/illustrations": "2.1.1",
    "@iconify-json/game-icons": "1.2.4",
    "@iconify-json/mdi": "1.2.3",
    "@iconify-json/ph": "1.2.2",
    "@iconify-json/solar": "1.2.13",
}
ENDINGS = {"ph": "-fill", "solar": "-bold"}  # of the names that are taken from these sets
WORDS = {
    "airplane": "airplane fighter",
    "car": "car automobile taxi suv jeep hatchback estate",
    "chair": "chair armchair seat stool chairdesk",
    "lamp": "lamp",
    "sofa": "sofa couch",
    "table": "table desk deskdouble furniture",
}
THINGS = (
    "star dog ship trolleybus bottle guitar bicycle horse wine-glass house umbrella camera fridge "
    "hammer rocket locomotive cat violin anchor mushroom sailboat scissors butterfly crown trash "
    "key fish bus helicopter shoe elephant sink"
).split()
STYLES = set("fill bold left angled sideways one two outbound".split())
OTHER_THINGS = set(
    "and baby booster cable car file folder human information insert laboratory lava magic massage off "
    "oil outdoor periodic pivot pool post railway shield toilet tram vendor".split()
)
# drawings of tables of figures, of several things, and of a plug
NOT_THEM = (
    "icon-park table,icon-park lamp,mdi table,ph table-fill,solar table-bold,mdi seat,ph seat-fill,"
    "streamline-ultimate-color office-desk-lamp,game-icons round-table,react-planner desk"
)


def load_package(name: str, version: str, folder: Path) -> Path:
    """The file of a package of npm, loaded into a folder."""
    command = ["npm", "pack", "--silent", f"{name}@{version}"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    (path,) = folder.glob("*.tgz")
    return path


def read_set(package: str, version: str, folder: Path) -> dict[str, bytes]:
    """The drawings of a package by their names, SVG or PNG files; the package is loaded into a folder."""
    with tarfile.open(load_package(package, version, folder)) as packed:
        if package.startswith("@iconify-json"):
            icons = json.load(packed.extractfile("package/icons.json"))
            return {name: icon_svg(icons | icon) for name, icon in icons["icons"].items()}
        place = re.compile(
            r"package/(images/[a-z]+|demo/src/catalog/items/[a-z-]+)/[a-z_A-Z-]+\.(svg|png)"
        )
        files = filter(place.fullmatch, packed.getnames())
        return {
            Path(name).stem.replace("_", "-"): packed.extractfile(name).read() for name in files
        }


def icon_svg(icon: dict) -> bytes:
    """The SVG file of an icon of iconify."""
    size = icon.get("width", 16), icon.get("height", 16)
    spaces = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
    return f'<svg {spaces} viewBox="0 0 {size[0]} {size[1]}">{icon["body"]}</svg>'.encode()


def draw_svg(svg: bytes, width: int) -> Image.Image:
    """An SVG file as a picture in RGBA, `width` pixels wide."""
    import resvg_py  # here, so that the tests need no such package

    content = bytes(resvg_py.svg_to_bytes(svg_string=svg.decode(), width=width))
    return Image.open(io.BytesIO(content)).convert("RGBA")


def choose(names: dict[str, list[str]], kind: str, count: int) -> Iterator[tuple[str, str]]:
    """Up to `count` pairs of set and name of a known kind. names: of each set."""
    wanted = set(WORDS[kind].split())

    def fits(package: str, name: str) -> bool:
        words = [word for word in name.split("-") if not word.isdigit() and word not in STYLES]
        known = words[-1:] and words[-1] in wanted and not OTHER_THINGS & {*words[:-1]}
        return bool(known) and f"{package.split('/')[-1]} {name}" not in NOT_THEM.split(",")

    found = ([(each, name) for name in names[each] if fits(each, name)] for each in SETS)
    in_turn = itertools.chain.from_iterable(itertools.zip_longest(*found))
    yield from itertools.islice(filter(None, in_turn), count)


def choose_others(names: dict[str, list[str]]) -> Iterator[tuple[str, str]]:
    """Pairs of set and name of other things, each from the next set that has it."""
    turn = itertools.cycle(SETS)
    for thing in THINGS:
        for package in itertools.islice(turn, len(SETS)):
            name = thing + ENDINGS.get(package.split("/")[-1], "")
            if name in names[package]:
                yield package, name
                break


def main(output: Path, count: int = 10) -> None:
    """Write PNG files tune/NUMBER-KIND-SET-NAME.png and report/..., and print their names.

    count: pictures of each known kind.
    """
    for part in PARTS:
        (output / part).mkdir(parents=True, exist_ok=True)
    drawings, names = {}, {}
    for package in SETS:
        with tempfile.TemporaryDirectory() as folder:
            drawings[package] = read_set(package, SETS[package], Path(folder))
        ending = ENDINGS.get(package.split("/")[-1], "")
        names[package] = sorted(name for name in drawings[package] if name.endswith(ending))
    chosen = [(kind, *each) for kind in WORDS for each in choose(names, kind, count)]
    chosen += [("other", *each) for each in choose_others(names)]
    for number, (kind, package, name) in enumerate(chosen):
        content = drawings[package][name]
        if b"<svg" in content[:2000]:
            image = draw_svg(content, SIDE)
        else:
            image = Image.open(io.BytesIO(content)).convert("RGBA")
        path = (
            output / PARTS[number % 2] / f"{number:02}-{kind}-{package.split('/')[-1]}-{name}.png"
        )
        image.save(path)
        print(path.stem)


if __name__ == "__main__":
    tyro.cli(main)
