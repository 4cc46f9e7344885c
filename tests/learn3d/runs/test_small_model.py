"""The small model in the package: its file is small, and its shapes of generated objects are right."""

from __future__ import annotations

import pytest

from learn3d.data.layouts import load_dataset
from learn3d.evaluation import evaluate
from learn3d.make_data.render import DatasetConfig, make_dataset
from learn3d.runs.checkpoint import load_method
from learn3d.runs.export import small_model


def test_size() -> None:
    assert small_model().stat().st_size < 8e6


@pytest.mark.parametrize(("category", "iou"), [("airplane", 0.35), ("car", 0.6), ("sofa", 0.35)])
def test_it_knows_generated_objects(category: str, iou: float, tmp_path) -> None:
    make_dataset(DatasetConfig(tmp_path, category, procedural=8, test=6, val=1, seed=99))
    method, *_ = load_method(small_model())
    method.set_training(False)
    assert evaluate(method, load_dataset("kato", tmp_path, category, "test")).voxel_iou > iou
