"""A damaged file among the training data: training says which and what to do, before it makes anything."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from fuzz_targets import SETTINGS, layout_target

from learn3d.config import TrainConfig
from learn3d.data.checking import check_folder
from learn3d.training import train

DAMAGED = {  # what is cut short, and a preset of the layout
    "kato": ("03001627_train_images.npz", "peng2020-kato-vanilla"),
    "dvr": ("03001627/*/image/0000.png", "peng2020-kato-vanilla"),
    "kar": ("renders/03001627/*/render_0.png", "peng2020-kar-vanilla"),
    "r2n2": ("ShapeNetRendering/03001627/*/rendering/03.png", "peng2020-kar-vanilla"),
    "pascal3d": ("chair_train.npz", "peng2020-pascal-vanilla"),
    "photos": ("chair/images/*.png", "peng2020-kato-vanilla"),
}


def test_every_layout_is_tried():
    assert set(DAMAGED) == set(SETTINGS)


@pytest.mark.parametrize("layout", DAMAGED)
def test_a_damaged_file_ends_training_with_its_name_and_what_to_do(tmp_path: Path, layout: str):
    (tmp_path / "made").mkdir()
    folder = shutil.copytree(layout_target(tmp_path / "made", layout).folder, tmp_path / "data set")
    pattern, preset = DAMAGED[layout]
    for path in folder.glob(pattern):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    where = {"data": folder, "category": "chair", "output": tmp_path / "run"}
    config = TrainConfig(**where, preset=preset, layout=layout, iterations=1, batch_size=2, val_split="test")
    with pytest.raises(ValueError) as error:
        train(config)
    named, text = Path(str(error.value).split(": ", 1)[0]), str(error.value)
    assert named.is_file() and named.match(pattern)
    assert text.endswith(f"is listed by: learn3d check-dataset '{folder}' --layout {layout}")
    assert text.count("cut short") == text.count("fetch it again") == 1
    assert not {path.name for path in (tmp_path / "run").glob("*")} - {".lock"}
    report = check_folder(layout, folder, ["chair"])
    assert str(named) in {problem.path for split in report.splits for problem in split.problems}
