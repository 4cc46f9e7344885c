"""Small files of trained networks, and the one that comes with the package."""

from __future__ import annotations

import zlib

import pytest
import torch

from learn3d.data.layouts import load_dataset
from learn3d.evaluation import evaluate
from learn3d.files.reading import DamagedFile
from learn3d.runs import checkpoint
from learn3d.studio.make_data.render import DatasetConfig, make_dataset
from learn3d.studio.picture_to_mesh.export import export
from learn3d.studio.picture_to_mesh.make import SMALL_MODEL, load_model
from learn3d.training import train


@pytest.mark.parametrize("preset", ["peng2020-kato", "plus-kato"])
def test_an_exported_model_gives_the_shapes_of_the_run(
    tiny_config, tiny_set, run_folder, tmp_path, preset
) -> None:
    train(tiny_config(run_folder, preset=preset, ema_decay=0.5))
    size = export(run_folder, tmp_path / "small.safetensors")
    assert size == (tmp_path / "small.safetensors").stat().st_size
    assert size < 0.6 * (run_folder / "best.safetensors").stat().st_size
    images, shapes = torch.from_numpy(tiny_set.images[:5]), []
    for path in (run_folder, tmp_path / "small.safetensors"):
        method, *_ = checkpoint.load_method(path)
        with torch.no_grad():
            shapes.append(method.decode(method.encode(images)).vertices)
    torch.testing.assert_close(shapes[0], shapes[1], atol=2e-3, rtol=0)
    assert set(method.networks) == {"encoder", "generator"}


def test_no_path_of_the_maker_is_in_the_file(finished_run, tmp_path, monkeypatch, capsys) -> None:
    load = checkpoint.load_method

    def with_weights(*arguments, **options):
        method, config, metadata = load(*arguments, **options)
        object.__setattr__(config.settings, "pretrained", tmp_path / "resnet18.pth")
        object.__setattr__(config, "poses", tmp_path / "poses.npz")
        return method, config, metadata

    monkeypatch.setattr(checkpoint, "load_method", with_weights)
    export(finished_run, tmp_path / "small.safetensors")
    assert "note: the file has no templates" in capsys.readouterr().err
    content = (tmp_path / "small.safetensors").read_bytes()
    assert not [path for path in (tmp_path, finished_run) if str(path).encode() in content]


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("template_codes", (3, 7)),
        ("template_axes", (5, 7)),
        ("known_codes", (5,)),
        ("known_codes", (6, 0, 512)),
        ("kind_network.layers.1.weight", (3, 3)),
    ],
)
def test_known_codes_and_templates_of_other_shapes_are_refused(tmp_path, name, shape) -> None:
    tensors, metadata = checkpoint.load(SMALL_MODEL)
    load_model(SMALL_MODEL)
    assert name in tensors
    checkpoint.save(tmp_path / "a.safetensors", tensors | {name: torch.zeros(shape)}, metadata)
    with pytest.raises(DamagedFile, match=r"a\.safetensors: has known codes or templates of other"):
        load_model(tmp_path / "a.safetensors")


@pytest.mark.parametrize("name", ["output_layer", "judge.layers.2.weight"])
def test_a_model_of_an_earlier_version_tells_other_things_by_distance(
    tmp_path, capsys, name
) -> None:
    tensors, metadata = checkpoint.load(SMALL_MODEL)
    earlier = {each: value for each, value in tensors.items() if "kind_network" not in each}
    earlier[name] = torch.zeros(7, 129)
    checkpoint.save(tmp_path / "a.safetensors", earlier, metadata)
    assert load_model(tmp_path / "a.safetensors").known_codes.judge is None
    assert "export it again" in capsys.readouterr().err


def test_other_methods_are_refused(tiny_config, run_folder, tmp_path) -> None:
    train(tiny_config(run_folder, preset="multi-view-kato", encoder="conv-small", iterations=1))
    with pytest.raises(ValueError, match="proposed, vanilla, plus and many-views"):
        export(run_folder, tmp_path / "small.safetensors")


@pytest.mark.parametrize(("category", "iou"), [("airplane", 0.5), ("car", 0.75), ("sofa", 0.55)])
def test_the_small_model_of_the_package_knows_generated_objects(
    category: str, iou: float, tmp_path
) -> None:
    assert len(zlib.compress(SMALL_MODEL.read_bytes())) < 11e6, "in the wheel"
    make_dataset(DatasetConfig(tmp_path, category, procedural=8, test=6, val=1, seed=99))
    method, *_ = checkpoint.load_method(SMALL_MODEL)
    assert evaluate(method, load_dataset("kato", tmp_path, category, "test")).voxel_iou > iou
