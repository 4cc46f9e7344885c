"""neural_renderer under its old name, and scripts that were written for it."""

import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import nmr
import nmr.neural_renderer as nr
import nmr.nvdiffrast.torch

BODY = {
    "__init__.py": "",
    "renderer.py": """
import neural_renderer as nr
import neural_renderer.rasterize
from neural_renderer import Renderer, get_points_from_angles
from neural_renderer.vertices_to_faces import vertices_to_faces

assert Renderer is neural_renderer.renderer.Renderer


def mask(vertices, faces):
    renderer = nr.Renderer(camera_mode="look_at", image_size=32)
    renderer.eye = get_points_from_angles(2.732, 10, 20)
    return renderer(vertices, faces, mode="silhouettes")
""",
    "train.py": "from .renderer import mask\nfrom neural_renderer.load_obj import load_obj, load_textures\n",
}


@pytest.fixture(autouse=True)
def no_alias(monkeypatch, tmp_path):
    """No test sees the alias of another, and none leaves one."""

    def belongs(key):
        names = "neural_renderer", "nvdiffrast", "body", "external", "nmr_alias"
        return key.partition(".")[0] in names

    for key in filter(belongs, list(sys.modules)):
        monkeypatch.delitem(sys.modules, key)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    for key in filter(belongs, list(sys.modules)):
        del sys.modules[key]


def package(folder, name, **files):
    (folder / name).mkdir()
    for file, text in files.items():
        (folder / name / file).write_text(text)
    importlib.invalidate_caches()


def test_code_of_others_runs_unchanged(tmp_path):
    package(tmp_path, "body", **BODY)
    nr.install_as("neural_renderer")
    train = importlib.import_module("body.train")
    vertices, faces = nmr.icosphere(1)
    assert (
        0.05 < train.mask(0.5 * vertices[None], faces[None]).mean() < 0.9
        and train.load_obj is nr.load_obj
    )


def test_a_script_runs_untouched(tmp_path):
    """With the command of docs/migrating/neural_renderer.md."""
    root = Path(__file__).parents[3]
    page = (root / "docs" / "migrating" / "neural_renderer.md").read_text()
    (command,) = re.findall(r"```bash\n(python -c .*)\n```", page)
    (tmp_path / "train.py").write_text("""
import neural_renderer as nr
from neural_renderer.projection import projection

if __name__ == "__main__":
    print(nr.__name__, nr.__version__, projection is nr.projection)
""")
    arguments = [sys.executable, *shlex.split(command)[1:]]
    printed = subprocess.run(arguments, cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert printed.stdout == "nmr.neural_renderer 1.1.3 True\n", printed.stderr


def test_all_modules_are_those_of_this_package():
    nr.install_as()
    assert importlib.import_module("neural_renderer") is nr
    names = [key for key in sys.modules if key.startswith("nmr.neural_renderer.")]
    assert len(names) > 12
    for name in names:
        assert importlib.import_module(name.removeprefix("nmr.")) is sys.modules[name]
    with pytest.raises(ModuleNotFoundError, match=r"neural_renderer\.cuda"):
        importlib.import_module("neural_renderer.cuda")


def test_other_names_and_second_calls():
    nr.install_as("nmr_alias")
    nr.install_as("nmr_alias")
    assert importlib.import_module("nmr_alias.projection").projection is nr.projection
    assert "neural_renderer" not in sys.modules
    for name in ("nmr..alias", "", None, "neural-renderer"):
        with pytest.raises(ValueError, match="name must be one of a module"):
            nr.install_as(name)


@pytest.mark.parametrize("parent", ["body.external", "external", "nmr_alias.external"])
def test_a_copy_inside_of_a_package(tmp_path, parent):
    """The package may be one of the caller's, or there is none."""
    fit = "from .external.neural_renderer import projection\n"
    package(tmp_path, "body", **{"__init__.py": "", "fit.py": fit})
    package(tmp_path / "body", "external", **{"__init__.py": ""})
    nr.install_as(f"{parent}.neural_renderer")
    namespace = {}
    exec(
        f"import {parent}.neural_renderer as nr\nfrom {parent} import neural_renderer as same",
        namespace,
    )
    assert namespace["nr"] is namespace["same"] is nr
    assert importlib.import_module(f"{parent}.neural_renderer.look").look is nr.look
    if parent == "body.external":
        assert importlib.import_module("body.fit").projection is nr.projection


def test_nvdiffrast_too(tmp_path):
    (tmp_path / "nvdiffrast").mkdir()  # a checkout beside the script is no package
    nmr.nvdiffrast.install_as()
    assert importlib.import_module("nvdiffrast.torch") is nmr.nvdiffrast.torch
    assert sys.modules["nvdiffrast"].torch is nmr.nvdiffrast.torch


def test_an_alias_by_hand_has_its_modules():
    sys.modules["nmr_alias"] = nr
    vertices, faces = nmr.icosphere(1)
    rasterize = importlib.import_module("nmr_alias.rasterize").rasterize_silhouettes
    corners = importlib.import_module("nmr_alias.vertices_to_faces").vertices_to_faces(
        vertices[None], faces[None]
    )
    assert rasterize(corners, image_size=16).any()
    assert callable(nr.rasterize) and callable(nr.vertices_to_faces), (
        "the functions of these names are not replaced"
    )


@pytest.mark.parametrize("imported", [False, True])
def test_another_package_is_not_shadowed_in_silence(tmp_path, imported):
    package(
        tmp_path,
        "neural_renderer",
        **{"__init__.py": "from .look import answer", "look.py": "answer = 42"},
    )
    if imported:
        importlib.import_module("neural_renderer")
    message = "already imported from" if imported else "neural_renderer, .*__init__"
    with pytest.raises(
        ImportError, match=rf"{message}.*pip uninstall neural_renderer_pytorch.*replace=True"
    ):
        nr.install_as()
    other = importlib.import_module("neural_renderer")
    assert other is not nr and other.answer == 42
    nr.install_as(replace=True)
    assert importlib.import_module("neural_renderer") is nr
    assert importlib.import_module("neural_renderer.look").look is nr.look
