"""The method of docs/contributing.md, taken from the page, is trained, resumed and evaluated."""

from __future__ import annotations

import dataclasses
import importlib
import json
import re
from pathlib import Path

import pytest

from learn3d import methods, presets
from learn3d.evaluation import evaluate
from learn3d.presets import configure
from learn3d.runs import checkpoint
from learn3d.training import load_data, train

PAGE = Path(__file__).parents[3] / "docs" / "contributing.md"


def test_the_method_of_the_page_works(
    tiny_names, tiny_folder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    section = PAGE.read_text().split("### A method")[1].split("\n### ")[0]
    module_text, preset_text = re.findall(r"```python\n(.*?)```", section, re.S)
    (tmp_path / "mirror_of_the_page.py").write_text(module_text)
    monkeypatch.syspath_prepend(tmp_path)
    page = importlib.import_module("mirror_of_the_page")
    monkeypatch.setitem(methods._METHODS, page.MirrorSettings, page.Mirror)
    names = vars(presets) | vars(page)
    for name, preset in eval("{" + preset_text + "}", names).items():
        monkeypatch.setitem(presets.PRESETS, name, dataclasses.replace(preset, preset=name))

    settings = page.MirrorSettings(
        encoder="conv-small", generator="sphere-small", learning_rate=1e-3
    )
    where = {"data": tiny_folder, "category": "airplane", "output": tmp_path / "run"}
    options = {
        "preset": "mirror-kato",
        "settings": settings,
        "batch_size": 4,
        "max_val_images": 4,
        "log_every": 1,
    }
    train(configure(**where, **options, iterations=2))
    summary = train(configure(**where, **options, iterations=4), resume=True)
    assert summary.finished
    method, config, _ = checkpoint.load_method(tmp_path / "run" / "last.safetensors")
    assert type(method) is page.Mirror
    assert config.settings == settings
    assert evaluate(method, load_data(config, "val"), max_images=4).voxel_iou > 0
    lines = [
        json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    ]
    assert lines[0].keys() >= {"projection", "smoothness", "mirror", "total"}
