"""The package, and the examples in its docstrings: they run, and print what they say they print."""

from __future__ import annotations

import doctest
import importlib
import importlib.metadata
import importlib.resources
import pkgutil
from pathlib import Path

import pytest
import torch
from gltf_files import square_glb

import nmr
import nmr.neural_renderer as nr
import nmr.nvdiffrast.torch as dr


def test_the_version_is_that_of_the_distribution() -> None:
    assert nmr.__version__ == importlib.metadata.version("nmr-learn3d")


def test_type_checkers_are_told_that_there_are_hints() -> None:
    for package in ("nmr", "learn3d"):
        assert importlib.resources.files(package).joinpath("py.typed").is_file()


class _Checker(doctest.OutputChecker):
    def check_output(self, want, got, optionflags):
        """An example that shows no output has none that matters."""
        return not want.strip() or super().check_output(want, got, optionflags)


def _examples():
    for module in pkgutil.walk_packages(nmr.__path__, "nmr."):
        if not module.name.endswith("._C"):
            found = doctest.DocTestFinder().find(importlib.import_module(module.name))
            yield from (test for test in found if test.examples)


EXAMPLES = list(_examples())


@pytest.mark.parametrize("example", EXAMPLES, ids=[test.name for test in EXAMPLES])
def test_example(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    vertices, faces = nmr.icosphere(1)
    example.globs.update(torch=torch, nmr=nmr, nr=nr, dr=dr)
    if "load_gltf" in example.name:
        Path("chair.glb").write_bytes(square_glb())
    elif example.name.startswith("nmr.m"):
        nmr.save_obj("chair.obj", vertices, faces)
    if "neural_renderer" in example.name:
        textures = torch.rand(1, len(faces), 4, 4, 4, 3)
        if "load_obj" in example.name:
            pytest.importorskip("PIL")
            nr.save_obj("chair.obj", vertices, faces, textures[0])
        camera = dict(K=torch.eye(3), R=torch.eye(3), t=torch.tensor([0.0, 0.0, 3.0]))
        renderer = nr.Renderer(camera_mode="look_at")
        example.globs.update(
            vertices=vertices[None],
            faces=faces[None],
            textures=textures,
            renderer=renderer,
            **camera,
        )
    report = []
    runner = doctest.DocTestRunner(checker=_Checker())
    runner.run(example, out=report.append)
    assert runner.failures == 0, "".join(report)


def test_every_public_function_has_an_example():
    modules = (nmr, nmr.losses, nmr.metrics)
    public = {
        name for module in modules for name in module.__all__ if callable(getattr(module, name))
    }
    results = {"Fragments", "Images", "SurfacePoints"}  # and protocols: made by others
    missing = (
        public
        - {test.name.rpartition(".")[2] for test in EXAMPLES}
        - results
        - {"Camera", "Colors"}
    )
    assert not missing
