"""The pages: their code runs, what they name exists, and what they show is made by the code.

Our own code is in blocks marked ``python``. Code of other libraries is not run; its blocks are marked ``py``.
"""

import importlib.util
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import get_args

import imageio.v3 as imageio
import pytest
import torch
import trimesh
import tyro

from learn3d.commands import main
from learn3d.config import differences
from learn3d.data.conventions import LAYOUTS
from learn3d.methods.optimization import LRSchedule
from learn3d.presets import PRESETS
from learn3d.studio.tables.plan import plan_runs
from learn3d.studio.tables.tables import TABLES

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
MIGRATING = {path.stem: path for path in (ROOT / "docs" / "migrating").glob("*.md")}
PAGES = [README, *sorted((ROOT / "docs").glob("*.md")), *sorted(MIGRATING.values())]
PAGES += [ROOT / "tools" / "free_meshes" / "README.md"]


def python_blocks(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL)


def run_blocks(*blocks):
    """Executes them in one namespace, which is returned."""
    names = {}
    for block in blocks:
        exec(block, names)
    return names


def run(page):
    return run_blocks(*python_blocks(page))


def test_readme_fits_a_mesh_that_is_right_from_all_sides(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = run(README)
    assert capsys.readouterr().out.startswith("IoU of the silhouettes: 0.9")
    nmr, vertices, faces = names["nmr"], names["vertices"].detach(), names["faces"]
    # cameras that the fit did not have
    sides = (
        [0.0, 60.0, -5.0] * 5,
        [24.0 * k + 11 for k in range(15)],
    )
    new = nmr.LookAt.from_angles(2.732, *sides, half_fov_deg=12.0, right_handed=True)
    ours = nmr.render_silhouette(vertices, faces, new, fill_back=False, image_size=128)
    theirs = nmr.render_silhouette(names["points"], names["triangles"], new, image_size=128)
    assert nmr.losses.soft_iou_loss(ours, theirs) < 0.08
    assert trimesh.Trimesh(vertices.numpy(), faces.numpy()).volume > 0
    picture = imageio.imread(tmp_path / "car.png")
    red, _, blue = picture.astype(int).transpose(2, 0, 1)
    assert picture.shape == (256, 768, 3) and 0.05 < (red > 2 * blue).mean() < 0.5, "a red car"
    shadow = picture.max(-1) < 120
    assert 0.01 < (shadow & (red < 2 * blue)).mean() < 0.2, "and its shadow"
    shown = imageio.imread(ROOT / "docs" / "images" / "car.png")
    assert abs(picture.astype(int) - shown).mean() < 3, "draw docs/images/car.png again"


def test_each_recipe_solves_its_task_alone():
    beginning, masks, texture, camera = python_blocks(ROOT / "docs" / "what-for.md")
    names = run_blocks(beginning, masks)
    nmr = names["nmr"]
    fitted = nmr.render_silhouette(
        names["shape"], names["triangles"], names["cameras"], image_size=64
    )
    assert nmr.losses.soft_iou_loss(fitted, names["masks"]) < 0.1
    assert run_blocks(beginning, texture)["color_loss"]() < 0.01
    true_eye = nmr.cameras.points_from_angles(2.732, 30.0, 30.0)
    assert (run_blocks(beginning, camera)["eye"] - true_eye).norm() < 0.05


def test_from_pytorch3d_draws_the_same_picture_both_ways():
    names = run(MIGRATING["pytorch3d"])
    rgb, alpha, same = names["rgb"], names["alpha"], names["same"]
    assert rgb.shape == (1, 256, 256, 3) and alpha.shape == (1, 256, 256)
    assert 0.2 < alpha.mean() < 0.8
    assert (rgb - same).abs().max(-1).values.gt(
        1e-3
    ).float().mean() < 1e-3  # but for edges that round differently
    # The sphere's colours are its coordinates: in both worlds x grows to the right, y to the top.
    assert rgb[0, 128, 180, 0] > rgb[0, 128, 70, 0] and rgb[0, 70, 128, 1] > rgb[0, 180, 128, 1]
    # Nearest to the eye, which is at z = 2.7, is the greatest z.
    assert rgb[0, 128, 128, 2] > 0.9
    nmr = names["nmr"]
    fitted = nmr.render_silhouette(
        names["shape"].detach(), names["faces"], names["views"], image_size=64
    )
    assert nmr.losses.soft_iou_loss(fitted, names["target"]) < 0.1
    names["uv"] = torch.tensor([[0.0, 0.0], [1.0, 1.0], [3 / 127, 5 / 63]])
    exec(
        re.findall(r"^uv = \(.*$", MIGRATING["pytorch3d"].read_text(), flags=re.MULTILINE)[0], names
    )
    # a texel centre of align_corners=True is one of ours
    texels = names["uv"] * torch.tensor([128, 64]) - 0.5
    torch.testing.assert_close(
        texels, torch.tensor([[0.0, 0.0], [127.0, 63.0], [3.0, 5.0]]), atol=1e-4, rtol=0
    )


def test_from_nvdiffrast_draws_the_same_picture_three_ways():
    names = run(MIGRATING["nvdiffrast"])
    image = names["image"]
    assert image.shape == (1, 256, 256, 3) and 0.1 < (image != 1).any(-1).float().mean() < 0.9
    torch.testing.assert_close(names["same"], image, atol=0, rtol=0)
    assert (names["also"] - image).abs().max(-1).values.gt(1e-3).float().mean() < 1e-3
    assert names["dr"].__name__ == "nmr.nvdiffrast.torch" and names["pos"].grad.abs().sum() > 0
    # row 0 is the bottom
    assert names["drawn"][0, 30, 30].argmax() == 0 and names["drawn"][0, 200, 30].argmax() == 2
    assert names["zeros"].device.type == "cpu"


def test_from_neural_renderer_maps_of_forks():
    names = run(MIGRATING["neural_renderer"])
    index, same, visible = names["face_index"], names["same"], names["visible"]
    assert index.shape == (2, 64, 64) and torch.equal(index, same)
    assert visible.shape == (2, 320)
    for b in range(2):  # the near side of a sphere
        assert set(visible[b].nonzero()[:, 0].tolist()) == set(index[b].unique().tolist()) - {-1}
        assert 60 < visible[b].sum() < 160


def test_from_softras_draws_silhouettes_and_colours():
    names = run(MIGRATING["softras"])
    assert names["vertices"].grad.abs().sum() > 0 and 0 < names["loss"] < 0.2
    assert names["rgb"].shape == (1, 64, 64, 3) and names["covers"].shape == (1, 64, 64, 4)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_run_and_what_they_name_exists(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tested_elsewhere = ("README.md", "contributing.md", "what-for.md")
    # above, and in learn3d/methods/test_development.py
    if page.name not in tested_elsewhere and page not in MIGRATING.values():
        run(page)
    text = page.read_text()
    named = re.findall(
        r"(?:tools|docs|csrc|nmr|learn3d|tests)/[\w./-]*\w\.(?:py|sh|md|png|cpp|ipynb)", text
    )
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", text)
    missing = [name for name in {*named} if not (ROOT / name).exists()]
    missing += [
        link for link in {*links} if "://" not in link and not (page.parent / link).exists()
    ]
    assert missing == []
    assert page != README or len(named) > 5


def test_presets_schedules_and_layouts_are_on_their_pages():
    methods, data_sets = (
        (ROOT / "docs" / page).read_text() for page in ("methods/README.md", "data-sets.md")
    )
    assert not [name for name in PRESETS if f"`{name}`" not in methods]
    assert "|".join(sorted(get_args(LRSchedule))) in methods.replace("\\", "")
    assert not [name for name in LAYOUTS if f"`{name}`" not in data_sets]


def commands():
    """The command lines `learn3d ...` in the blocks of all pages, and in commands.sh."""
    for line in (ROOT / "docs" / "results" / "commands.sh").read_text().splitlines():
        if line.startswith("learn3d "):
            yield pytest.param(shlex.split(line)[1:], id=line)
    for page in [*PAGES, *sorted((ROOT / "docs" / "methods").glob("*.md"))]:
        for block in re.findall(r"```sh\n(.*?)```", page.read_text(), flags=re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                words = shlex.split(line.replace("SEED", "0"), comments=True)
                if words[:1] == ["learn3d"] and not {"...", "COMMAND", "--resume"} & set(words):
                    yield pytest.param(words[1:], id=f"{page.name}: {' '.join(words)}")


class Understood(Exception):
    pass


@pytest.mark.parametrize("words", list(commands()))
def test_documented_commands_are_understood(words, monkeypatch):
    parse = tyro.cli

    def parse_only(*args, **options):
        found = parse(*args, **options)
        if options.get("return_unknown_args"):  # train looks for its preset first
            return found
        raise Understood

    monkeypatch.setattr(tyro, "cli", parse_only)
    monkeypatch.setattr(sys, "argv", ["learn3d"])
    if words == ["--help"]:  # no command
        assert main(*words) == 0
        return
    with pytest.raises((Understood, SystemExit)) as stop:
        main(*words)
    assert not getattr(stop.value, "code", None)  # --help exits with 0


def test_the_commands_of_the_results_do_not_conflict(monkeypatch):
    """Commands that write into one folder ask for the same runs there."""
    planned, requests = {}, []
    monkeypatch.setattr(sys, "argv", ["learn3d"])
    monkeypatch.setattr("learn3d.studio.commands.require_categories", lambda *_: None)
    monkeypatch.setattr(
        "learn3d.studio.commands.run_experiment", lambda request: requests.append(request) or 0
    )
    for line in (ROOT / "docs" / "results" / "commands.sh").read_text().splitlines():
        if line.startswith("learn3d experiment"):
            main(*shlex.split(line)[1:])
            for run in plan_runs(requests.pop()):
                first = planned.setdefault(run.config.output, run.config)
                assert not differences(run.config, first), line
    assert len(planned) > 50


def test_every_promise_has_a_test() -> None:
    bits = "The bits of a render"
    page = (ROOT / "docs" / "reliability.md").read_text().split(f"## {bits}")[0]
    faults = [line.split("|")[1].strip() for line in page.splitlines() if line.startswith("|")]
    promises = json.loads((ROOT / "tests" / "data" / "promises.json").read_text())
    assert [name for name in [*faults, bits] if name not in ("fault", "---")] == list(promises)
    for tests in promises.values():
        for file, name in (test.split("::") for test in tests):
            source = (ROOT / "tests" / "learn3d" / file).read_text()
            assert f"\ndef {name}(" in source, f"{file}::{name}"


def test_the_errors_that_troubleshooting_explains_are_raised() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    first = [line.split("|")[1] for line in page.splitlines() if line.startswith("|")]
    errors = [words for cell in first for words in re.findall(r"`([^`]* [^`]*)`", cell)]
    sources = [*(ROOT / "nmr").rglob("*.py"), *(ROOT / "learn3d").rglob("*.py")]
    code = "".join(path.read_text() for path in sources)
    code = re.sub(r'"\s+f?"', "", code)  # a message is often broken into several strings
    assert len(errors) > 2 and not [words for words in errors if words not in code]


def test_the_page_has_the_tables_of_the_files():
    command = [sys.executable, ROOT / "docs" / "make_results.py", "--check"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_results_in_the_pages_are_in_the_files() -> None:
    files = " ".join(path.read_text() for path in (ROOT / "docs" / "results").glob("*.json"))
    printed = [row.printed.values() for table in TABLES.values() for row in table.rows.values()]
    known = set(re.findall(r"\d\.\d+", files)) | {
        f"{figure:.3f}" for row in printed for figure in row
    }
    pages = [path.read_text() for path in make_results.PAGES]
    written = [re.sub(r"<!-- results: .*\n(\|.*\n)*", "", page) for page in pages]
    for text in (*written, README.read_text().partition("## 3. ")[2]):
        figures = re.findall(r"(?<![\w.])\d\.\d{3}\b", text)
        assert not set(figures) - known


def _load(script: str) -> ModuleType:
    """A script of docs/ as a module."""
    spec = importlib.util.spec_from_file_location(script, ROOT / "docs" / f"{script}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


make_pictures, draw_curves, make_results = map(
    _load, ("make_pictures", "draw_curves", "make_results")
)


def test_every_picture_has_a_command_and_a_record() -> None:
    pictures = {path.name for path in make_pictures.IMAGES.iterdir() if path.suffix != ".json"}
    assert pictures == set(make_pictures.PICTURES) == set(make_pictures.records())


def test_every_picture_is_shown() -> None:
    pages = [
        ROOT / "README.md",
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "docs" / "api").glob("*.rst"),
    ]
    shown = {
        name
        for page in pages
        for name in re.findall(r"images/([\w-]+\.\w+)[)\n]", page.read_text())
    }
    assert shown == set(make_pictures.PICTURES)


def test_no_picture_is_older_than_the_code_that_draws_it() -> None:
    old = make_pictures.out_of_date()
    assert not old, f"draw them again: python docs/make_pictures.py {' '.join(old)}"


def test_a_changed_source_is_noticed(monkeypatch, tmp_path) -> None:
    source = tmp_path / "draw.py"
    source.write_text("1")
    picture = make_pictures.Picture("", "", (str(source),))
    monkeypatch.setattr(make_pictures, "PICTURES", {"a.png": picture})
    made = {"a.png": {"sources": make_pictures.digest(picture)}}
    monkeypatch.setattr(make_pictures, "records", lambda: made)
    assert make_pictures.out_of_date() == []
    source.write_text("2")
    assert make_pictures.out_of_date() == ["a.png"]


def test_curves_are_drawn_by_images_and_as_the_mean_of_seeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = {
        "airplane/vanilla-seed0": "128",
        "airplane/vanilla-seed1": "128",
        "airplane/plus-seed0": "32",
    }
    tables = {
        "runs": [["run", "networks", "iterations", "batch"]],
        "curves": [["run", "split", "step", "IoU", "MMD"]],
    }
    for number, (run, batch) in enumerate(runs.items()):
        tables["runs"].append([run, "step 1000", "1000", batch])
        tables["curves"] += [
            [run, "test", step, f"0.{number + 1}", "-"] for step in ("500", "1000")
        ]
    (tmp_path / "short.json").write_text(json.dumps(tables))
    longer = tables["curves"][-1][:2] + ["1500", "0.5", "0.1"]
    (tmp_path / "long.json").write_text(
        json.dumps(tables | {"curves": [*tables["curves"], longer]})
    )
    monkeypatch.setattr(draw_curves, "RESULTS", tmp_path)
    curves = draw_curves.read_curves(["short", "long", "short=generated"])
    assert list(curves) == ["airplane", "generated airplane"]
    assert curves["airplane"]["plus"]["0"][:, 0].tolist() == [125, 250, 375], (
        "steps of 32 images count a quarter"
    )
    lines = draw_curves.draw(curves, {}, {}).axes[0].get_lines()
    assert {line.get_label(): line.get_ydata().tolist() for line in lines} == {
        "Vanilla-AE": [pytest.approx(0.15)] * 2,
        "Plus": [0.3, 0.3, 0.5],
    }


def test_the_mean_shape_and_angles_are_drawn_with_the_curves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = "airplane/vanilla-seed0"
    content = {
        "main": [["method", "", "airplane", "mean"], ["Mean shape", "", "0.430 [0.4, 0.5]", "0.4"]],
        "runs": [["run", "networks", "iterations", "batch"], [run, "step 9", "9", "128"]],
        "curves": [["run", "split", "step", "IoU", "MMD"], [run, "val", "9", "0.5", "0.1"]],
        "angles": [["run", "0", "15", "30"], [run, "0.9", "-", "0.7"]],
    }
    (tmp_path / "new.json").write_text(json.dumps(content))
    monkeypatch.setattr(draw_curves, "RESULTS", tmp_path)
    shapes, angles = draw_curves.read_mean_shapes(["new"]), draw_curves.read_angles(["new"])
    figure = draw_curves.draw(draw_curves.read_curves(["new"]), shapes, angles)
    above, _, below = [
        {line.get_label(): line.get_xydata().tolist() for line in axes.get_lines()}
        for axes in figure.axes
    ]
    assert above == {"Vanilla-AE": [[9, 0.5]], "mean shape": [[0, 0.43], [1, 0.43]]}
    assert below == {"Vanilla-AE": [[0, 0.9], [30, 0.7]]}
    two = draw_curves.draw(draw_curves.read_curves(["new", "new=generated"]), shapes, angles)
    assert len(two.axes) == 4 and all(axes.get_lines() for axes in two.axes), "no empty panel"


def test_rows_of_another_file_are_added_below_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "results").mkdir()
    run = {"voxel IoU": "0.5", "MMD": "0.1", "F-score": "0.8", "printed MMD": "0.2"}
    content = {
        "main": [
            ["method", "", "car", "mean"],
            ["Vanilla-AE", "paper (kato18)", "0.5", "0.5"],
            ["Vanilla-AE", "here (kato18)", "0.600 [0.5, 0.7]", "0.600 [0.5, 0.7]"],
            ["Vanilla-AE", "here (kato18, without clamp)", "0.400", "0.400"],
        ],
        "differences": [["method", "car", "mean"]],
        "runs": [
            ["run", *run],
            ["car/vanilla-seed0", *run.values()],
            ["car/vanilla-seed0", "0.7", *list(run.values())[1:]],
            ["car/vanilla-seed1", "0.6", *list(run.values())[1:]],
        ],
        "curves": [
            ["run", "split", "step", "IoU", "MMD"],
            *(
                [f"car/vanilla-seed{seed}", "val", step, iou, "-"]
                for seed, ious in enumerate((("0.2", "0.4"), ("0.8", "0.6")))
                for step, iou in zip(("500", "1000"), ious, strict=True)
            ),
        ],
    }
    (tmp_path / "results" / "old.json").write_text(json.dumps(content))
    baseline = ["Mean shape", "here (voxels)", "0.712 [0.7, 0.8]", "0.712 [0.7, 0.8]"]
    content["main"] = [content["main"][0], baseline]
    for name in ("extra", "baselines-extra"):
        (tmp_path / "results" / f"{name}.json").write_text(json.dumps(content))
    monkeypatch.setattr(make_results, "DOCS", tmp_path)
    text = make_results.filled("<!-- results: old side extra -->\n")
    assert "| Vanilla-AE | 0.5 | 0.600 |  | 0.400 |" in text
    assert "| Mean shape | - | 0.712 | +0.112 |  |" in text
    assert make_results.filled(text) == text, "a second time changes nothing"
    text = make_results.filled("<!-- results: old main extra -->\n")
    assert "| Mean shape | here | 0.712 | 0.712 |" in text
    text = make_results.filled("<!-- results: extra baselines baselines-extra -->\n")
    assert "| Mean shape | 0.712 | 0.712 |" in text
    (_, row) = make_results.rows("old", "measures")
    assert row == [
        *("car", "Vanilla-AE", "0.550", "0.800", "0.100"),
        *("0.500", "0.600 after 500 and 1,000"),
    ]
