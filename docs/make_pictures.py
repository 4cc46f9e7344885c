"""Makes the pictures of README and docs, and records commit and sources of each in docs/images/made.json.

python docs/make_pictures.py views.png     # draw this one (without names: list them, and say which are out of date)
python docs/make_pictures.py views.png --record     # the picture is there already: only record it
REPORT=report.html python docs/make_pictures.py report.png           # of tools/quickstart.sh, vanilla in batches of 32
OUTPUT=results python docs/make_pictures.py results-tsne.png      # from the runs of generated chairs
OUTPUT=long python docs/make_pictures.py results-long.png         # from those of `learn3d experiment kato`, 5,000 steps
OUTPUT=CARS_OUTPUT python docs/make_pictures.py results-cars.png  # the same for generated cars
OUTPUT=GENERATED_OUTPUT python docs/make_pictures.py results-airplanes.png  # generated airplanes, 20,000 steps
"""

import base64
import hashlib
import io
import json
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parent.parent
IMAGES = ROOT / "docs" / "images"
RECORDS = IMAGES / "made.json"


@dataclass(frozen=True)
class Picture:
    """How a picture is made."""

    command: str  # run in the repository's root; {folder} is an empty folder
    result: str  # what it leaves there: a path in {folder} or in the repository, the last match of a pattern; or
    # NOTEBOOK#K: picture K of its outputs, made small
    sources: tuple[str, ...]  # files that decide what it shows
    # left, top, right and bottom of the part that is kept
    box: tuple[float, float, float, float] = (
        0,
        0,
        1,
        1,
    )
    small: bool = False  # made to fit into 320 x 240 pixels


_QUICKSTART = ("tools/quickstart.sh", "learn3d/studio/tables/grids.py")
_QUICKSTART += ("learn3d/methods/plus.py", "learn3d/networks/encoders.py")
_RUN = '"$OUTPUT"/runs/airplane/{}-seed0'
_THREE = " ".join(map(_RUN.format, ("vanilla", "proposed", "plus")))
_LONG = " ".join(map(_RUN.format, ("vanilla", "proposed")))
_CARS = _LONG.replace("airplane", "car")
_CHAIRS = _LONG.replace("airplane", "chair")
_CURVES = ("kato-generated=generated", "kato-generated-chairs=generated")
_CURVES += ("kato-generated-chairs-longer=generated",)
_CURVES += ("kato-cars=generated", "ablation-cars=generated", "baselines-generated-cars=generated")
_CURVES += ("kato-5000", "ablation-5000-bf16", "baselines-debian")
_FUNCTIONS = (
    "silhouette",
    "rgb",
    "depth",
    "normals",
    "face_index",
    "soft_silhouette",
    "soft",
    "transparent",
)
_FUNCTIONS = (
    *(f"render_{name}" for name in _FUNCTIONS),
    "icosphere",
    "voxelize",
    "colors",
    "lights",
    "look_at",
)
_NOTEBOOKS = {
    "quick_tour": 5,
    "shape_from_silhouettes": 4,
    "texture_and_light": 4,
    "photographs_to_glb": 1,
}
_SCRIPTS = {  # picture that a script draws, and the part of it that the gallery shows
    "fit_masks": ("fit_masks.png", (0, 0, 1 / 3, 1)),
    "fit_packed": ("fit_packed.png", (0, 0, 1, 1)),
    "fit_silhouette": ("fit_silhouette.png", (0, 0, 1, 1)),
    "fit_texture": ("fit_texture.png", (0, 0, 1, 1)),
    "fit_lit_vase": ("fit_lit_vase.png", (0, 0, 1, 1)),
    "find_camera": ("find_camera.png", (0, 0.25, 1, 0.75)),
    "draw_surfaces": ("room.png", (0, 0, 1, 1)),
    "make_photo_folder": ("chair/images/chair000_0.jpg", (0, 0, 1, 1)),
}


def _grid(runs: str, images: int = 2) -> Picture:
    """Meshes of test images, beside the truth."""
    return Picture(
        f"learn3d figures grid --truth --images {images} --runs {runs} --output {{folder}}/grid.png",
        "{folder}/grid.png",
        ("learn3d/studio/tables/grids.py",),
    )


PICTURES = {
    "views.png": Picture(
        "python docs/examples/draw_views.py --output {folder}",
        "{folder}/views.png",
        ("docs/examples/draw_views.py",),
    ),
    # tests/test_docs.py compares it with what README's code draws
    "car.png": Picture(
        "sed -n '/^```python/,/^```/{{//!p}}' README.md > {folder}/car.py; cd {folder}; python car.py",
        "{folder}/car.png",
        (),
    ),
    "gradients.png": Picture(
        "python docs/examples/draw_gradients.py --output {folder}",
        "{folder}/gradients.png",
        ("docs/examples/draw_gradients.py",),
    ),
    "fitting.gif": Picture(
        "python docs/examples/draw_fitting.py --output {folder}",
        "{folder}/fitting.gif",
        ("docs/examples/draw_fitting.py",),
    ),
    "small-model.png": Picture(
        "python docs/examples/draw_small_model.py --output {folder}",
        "{folder}/small-model.png",
        ("docs/examples/draw_small_model.py", "learn3d/studio/picture_to_mesh/small.safetensors"),
    ),
    "page.png": Picture(
        "python docs/draw_page.py --output {folder}",
        "{folder}/page.png",
        (
            "docs/draw_page.py",
            *(f"learn3d/studio/demo/page/{name}" for name in ("index.html", "page.css")),
        ),
    ),
    "report.png": Picture(
        'python docs/draw_report.py "$REPORT" --output {folder}',
        "{folder}/report.png",
        (
            "docs/draw_report.py",
            *(f"learn3d/studio/tables/{name}" for name in ("report.html", "report.css")),
        ),
    ),
    "quickstart.png": Picture(
        "bash tools/quickstart.sh", "quickstart/plus/pictures/*.png", _QUICKSTART
    ),
    **{
        f"gallery-{name.replace('_', '-')}.png": Picture(
            f"jupyter execute --inplace docs/examples/{name}.ipynb",
            f"docs/examples/{name}.ipynb#{number}",
            (f"docs/examples/{name}.ipynb",),
        )
        for name, number in _NOTEBOOKS.items()
    },
    **{
        f"gallery-{name.replace('_', '-')}.png": Picture(
            f"python docs/examples/{name}.py --output {{folder}}",
            f"{{folder}}/{drawn}",
            (f"docs/examples/{name}.py",),
            box,
            small=True,
        )
        for name, (drawn, box) in _SCRIPTS.items()
    },
    "door-mesh.png": Picture(
        "true",
        "docs/images/small-model.png",
        ("docs/images/small-model.png",),
        (0.055, 0.22, 0.595, 0.66),
        True,
    ),
    "door-paper.png": Picture(
        "true",
        "docs/images/results-airplanes.png",
        ("docs/images/results-airplanes.png",),
        (0, 0.53, 0.62, 1),
        True,
    ),
    **{
        f"api-{name.replace('_', '-')}.png": Picture(
            "python docs/draw_api.py --output {folder}",
            f"{{folder}}/{name}.png",
            ("docs/draw_api.py",),
        )
        for name in _FUNCTIONS
    },
    "results-grid.png": _grid(_THREE, images=3),
    "results-long.png": _grid(_LONG),
    "results-airplanes.png": _grid(_LONG),
    "results-cars.png": _grid(_CARS),
    "results-chairs.png": _grid(_CHAIRS),
    "results-curves.png": Picture(
        f"python docs/draw_curves.py --output {{folder}}/curves.png {' '.join(_CURVES)}",
        "{folder}/curves.png",
        (
            "docs/draw_curves.py",
            *(f"docs/results/{name.partition('=')[0]}.json" for name in _CURVES),
        ),
    ),
    "results-angles.png": Picture(
        "python docs/draw_curves.py --output {folder}/angles.png kato-generated=generated "
        "ablation-generated=generated",
        "{folder}/angles.png",
        (
            "docs/draw_curves.py",
            "docs/results/kato-generated.json",
            "docs/results/ablation-generated.json",
        ),
    ),
    "results-tsne.png": Picture(
        f"learn3d figures tsne --runs {_CHAIRS} --output {{folder}}/tsne.png",
        "{folder}/tsne.png",
        ("learn3d/studio/tables/tsne.py",),
    ),
}


def digest(picture: Picture) -> str:
    """Of the sources of a picture."""
    return hashlib.sha256(
        b"\0".join((ROOT / source).read_bytes() for source in picture.sources)
    ).hexdigest()[:16]


def records() -> dict[str, dict[str, str]]:
    """What made.json says: command, commit and digest of the sources by name of the picture."""
    return json.loads(RECORDS.read_text())


def out_of_date() -> list[str]:
    """Pictures whose sources have changed since they were made, or that nobody has recorded."""
    made = records()
    return [
        name
        for name, picture in PICTURES.items()
        if made.get(name, {}).get("sources") != digest(picture)
    ]


def make(name: str) -> None:
    """Run the command of a picture and put what it leaves in docs/images."""
    picture = PICTURES[name]
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(picture.command.format(folder=folder), shell=True, cwd=ROOT, check=True)
        if "#" in picture.result:
            small(picture_of_notebook(*picture.result.split("#"))).save(IMAGES / name)
            return
        found = Path(picture.result.format(folder=folder))
        last = max((ROOT / found.parent).glob(found.name), key=lambda path: path.stat().st_mtime)
        if picture.small:
            image = Image.open(last).convert("RGB")
            small(
                image.crop(
                    [round(x * side) for x, side in zip(picture.box, 2 * image.size, strict=True)]
                )
            ).save(IMAGES / name)
        else:
            shutil.copyfile(last, IMAGES / name)


def small(image: Image.Image) -> Image.Image:
    """The picture, at most 320 pixels wide and 240 high."""
    image.thumbnail((320, 240))
    return image


def picture_of_notebook(notebook: str, number: str) -> Image.Image:
    """Picture `number` (from 1) among the outputs of a notebook."""
    cells = json.loads((ROOT / notebook).read_text())["cells"]
    data = [
        output.get("data", {}).get("image/png")
        for cell in cells
        for output in cell.get("outputs", [])
    ]
    pictures = ["".join(text) for text in data if text]
    return Image.open(io.BytesIO(base64.b64decode(pictures[int(number) - 1]))).convert("RGB")


def record(name: str) -> None:
    """Note the commit and the sources that the picture was made with."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    picture = PICTURES[name]
    made = records() if RECORDS.exists() else {}
    made[name] = {
        "command": picture.command,
        "commit": commit.stdout.strip(),
        "sources": digest(picture),
    }
    RECORDS.write_text(json.dumps(dict(sorted(made.items())), indent=2) + "\n")


if __name__ == "__main__":
    names = [word for word in sys.argv[1:] if word != "--record"]
    if unknown := [name for name in names if name not in PICTURES]:
        sys.exit(f"there is no picture {unknown[0]}; there are {', '.join(PICTURES)}")
    for name in names:
        if "--record" not in sys.argv:
            make(name)
        record(name)
    if not names:
        old = out_of_date()
        print(
            "\n".join(
                f"{name}{'  (out of date)' * (name in old)}: {p.command}"
                for name, p in PICTURES.items()
            )
        )
