"""The example scripts and the notebook run, leave pictures that show something, and what they fit gets better.

The notebook's cells are executed in order in one namespace, without a Jupyter kernel: they are plain Python, and a
kernel would add a dozen dependencies to see the same.
"""

import ast
import json
import runpy
import subprocess
import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
import trimesh
import tyro
from PIL import Image

EXAMPLES = Path(__file__).parent.parent / "docs" / "examples"


@pytest.fixture(autouse=True)
def one_thread():
    """At sizes as small as these threads wait for each other longer than they work, above all on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def run(name, output, *arguments):
    """Runs an example as from the command line and returns what it returns."""
    main = runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"]
    return tyro.cli(main, args=["--output", str(output), *arguments])


def check_picture(pixels, width, height):
    assert pixels.shape == (height, width, 3) and pixels.dtype == np.uint8
    # A fifth of the pixels at least is background, and what is drawn has shades.
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 50
    assert (pixels == 255).all(-1).mean() > 0.2
    # The object is inside: nothing touches the left and the upper border.
    assert (pixels[0] == 255).all() and (pixels[:, 0] == 255).all()


def check_movie(path):
    frames = imageio.imread(path)
    assert frames.ndim == 4 and len(frames) > 10
    assert (frames[0] != frames[-1]).any(-1).mean() > 0.02


def test_every_example_is_tested_and_short():
    scripts = sorted(path.stem for path in EXAMPLES.glob("*.py"))
    fits = ["fit_lit_vase", "fit_masks", "fit_packed", "fit_silhouette", "fit_texture"]
    draws = ["draw_fitting", "draw_gradients", "draw_small_model", "draw_surfaces", "draw_views"]
    assert scripts == [*draws, "find_camera", *fits, "make_photo_folder"]
    assert all(len((EXAMPLES / f"{name}.py").read_text().splitlines()) <= 100 for name in scripts)


def test_draw_views_from_the_command_line(tmp_path):
    command = [
        sys.executable,
        str(EXAMPLES / "draw_views.py"),
        "--output",
        str(tmp_path / "new"),
        "--views",
        "2",
    ]
    done = subprocess.run([*command, "--image-size", "64"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    check_picture(imageio.imread(tmp_path / "new" / "views.png"), 2 * 64, 3 * 64)


def test_draw_fitting(tmp_path):
    ious = run("draw_fitting", tmp_path, "--frames", "12", "--size", "48", "--steps", "30")
    assert len(ious) == 6 and min(ious.values()) > 0.3 and max(ious.values()) > 0.6
    check_movie(tmp_path / "fitting.gif")


def test_draw_gradients(tmp_path):
    moved = run("draw_gradients", tmp_path, "--image-size", "64")
    assert moved["nmr"] > 2 * moved["local"] > 100 and moved["none"] == 0
    panels = np.split(imageio.imread(tmp_path / "gradients.png").astype(int), 5, axis=1)
    orange = panels[3][..., 0] - panels[3][..., 2] > 60
    blue = panels[3][..., 2] - panels[3][..., 0] > 60
    assert orange.sum() > 10 and blue.sum() < orange.sum()


def test_draw_small_model(tmp_path):
    check_picture(imageio.imread(run("draw_small_model", tmp_path)), 1065, 886)


def test_fit_masks(tmp_path):
    assert run("fit_masks", tmp_path, "--steps", "60") > 0.9
    ring = trimesh.load(tmp_path / "fit_masks.glb", force="mesh")
    assert ring.is_watertight and ring.euler_number == 0 and ring.volume > 0
    again = [
        "--folder",
        str(tmp_path / "masks"),
        "--start",
        str(tmp_path / "fit_masks.glb"),
        "--steps",
        "2",
    ]
    assert run("fit_masks", tmp_path / "again", *again) > 0.9
    assert imageio.imread(tmp_path / "fit_masks.png").shape == (2 * 90, 12 * 120)


def test_draw_surfaces(tmp_path):
    run("draw_surfaces", tmp_path, "--image-size", "64")
    room, wide, soft = (
        imageio.imread(tmp_path / f"{name}.png") for name in ("room", "wide", "soft")
    )
    assert room.shape == (64, 64, 3) and wide.shape == (64, 128, 3) and soft.shape == (32, 128)
    assert (room.max(-1) > 60).all() and (wide.max(-1) > 60).all()  # walls everywhere
    assert (np.abs(wide[:, 32:96].astype(int) - room).max(-1) > 8).mean() < 0.02
    greys = [((tile > 10) & (tile < 245)).mean() for tile in np.split(soft, 4, axis=1)]
    assert greys[0] < 0.1 and greys[0] < greys[1] < greys[2]


@pytest.mark.parametrize(
    ("name", "options", "gain", "width", "height"),
    [
        ("fit_silhouette", "--steps 60 --image-size 64", 2.5, 4 * 192, 2 * 128),
        ("fit_texture", "--steps 16 --views 6 --size 64", 5, 4 * 64, 2 * 64),
        ("fit_lit_vase", "--steps 60 --size 48", 2, 4 * 48, 3 * 48),
        ("find_camera", "--steps 120 --image-size 64", 20, 4 * 64, 4 * 64),
        ("fit_packed", "--steps 60 --image-size 48", 2, 2 * 192, 2 * 192),
    ],
)
def test_fits_get_better(tmp_path, name, options, gain, width, height):
    before, after = run(name, tmp_path, *options.split())
    assert after < before / gain
    pixels = imageio.imread(tmp_path / f"{name}.png")
    check_picture(pixels[:height] if name == "fit_texture" else pixels, width, height)
    if name in ("fit_silhouette", "find_camera"):
        check_movie(tmp_path / f"{name}.gif")


NOTEBOOKS = {  # how many pictures each shows
    "quick_tour": 6,
    "shape_from_silhouettes": 4,
    "texture_and_light": 4,
    "photographs_to_glb": 3,
}


def code_cells(name):
    cells = json.loads((EXAMPLES / f"{name}.ipynb").read_text())["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def run_notebook(name):
    """Executes the cells; the variables at the end, and the pictures that Jupyter would show below cells."""
    names, pictures = {}, []
    for cell in code_cells(name):
        body = ast.parse("".join(cell["source"])).body
        last = body.pop() if isinstance(body[-1], ast.Expr) else None
        exec(compile(ast.Module(body, []), f"{name}.ipynb", "exec"), names)
        if last is not None:
            value = eval(compile(ast.Expression(last.value), f"{name}.ipynb", "eval"), names)
            if isinstance(value, Image.Image):
                pictures.append(np.asarray(value))
    assert len(pictures) == NOTEBOOKS[name]
    return names, pictures


@pytest.mark.parametrize("name", sorted(path.stem for path in EXAMPLES.glob("*.ipynb")))
def test_notebooks_carry_the_outputs_of_one_run(name):
    cells = code_cells(name)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] == "error"]
    assert "Warning" not in str([output.get("text") for output in outputs])
    assert sum("image/png" in output.get("data", {}) for output in outputs) == NOTEBOOKS[name]
    assert all(cell["outputs"] for cell in cells if "\nprint(" in "\n" + "".join(cell["source"]))
    assert (EXAMPLES / f"{name}.ipynb").stat().st_size < 1_500_000


def test_quick_tour():
    names, pictures = run_notebook("quick_tour")
    for pixels in pictures:
        assert pixels.shape[1] == 4 * 128 and 20 < pixels.std()
    assert names["losses"][-1] < names["losses"][0] / 3


def test_shape_from_silhouettes():
    names, _ = run_notebook("shape_from_silhouettes")
    one, many, staged = (names[result] for result in ("of_one_view", "of_many", "staged"))
    assert one[0] < 0.7 < many[0] and staged[0] > 0.88  # unused silhouettes
    assert one[1] < 0.5 and many[1] > 0.8 and staged[1] > 0.85  # volume
    assert staged[2] < many[2] - 4  # normals, in degrees


def test_texture_and_light():
    names, _ = run_notebook("texture_and_light")
    together, alone = (
        (names[images] - names["truth"]).abs().mean() for images in ("found", "wrong")
    )
    assert together < alone / 4
    assert abs(names["ambient"] - names["true_ambient"]) < 0.05
    assert torch.cosine_similarity(names["direction"], names["true_direction"], dim=0) > 0.99


def test_photographs_to_glb(monkeypatch):
    monkeypatch.chdir(EXAMPLES)  # where Jupyter runs a notebook
    names, _ = run_notebook("photographs_to_glb")
    assert names["mesh"].is_watertight and names["files"][0].suffix == ".glb"
    names["temporary"].cleanup()
