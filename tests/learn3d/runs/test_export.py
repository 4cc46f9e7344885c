"""Small files of trained networks."""

from __future__ import annotations

import pytest
import torch

from learn3d.runs import checkpoint
from learn3d.runs.export import export
from learn3d.training import train


@pytest.mark.parametrize("preset", ["peng2020-kato", "peng2020-kato-vanilla", "plus-kato"])
def test_an_exported_model_gives_the_shapes_of_the_run(tiny_config, tiny_set, run_folder, tmp_path, preset) -> None:
    train(tiny_config(run_folder, preset=preset, ema_decay=0.5))
    size = export(run_folder, tmp_path / "small.safetensors")
    assert size == (tmp_path / "small.safetensors").stat().st_size
    assert size < 0.6 * (run_folder / "best.safetensors").stat().st_size
    images = torch.from_numpy(tiny_set.images[:5])
    shapes = []
    for path in (run_folder / "last.safetensors", tmp_path / "small.safetensors"):
        method, config, _ = checkpoint.load_method(path)
        with torch.no_grad():
            shapes.append(method.decode(method.encode(images)).vertices)
    torch.testing.assert_close(shapes[0], shapes[1], atol=2e-3, rtol=0)
    assert set(method.networks) == {"encoder", "generator"}
    text = config.data.as_posix() + config.output.as_posix()
    assert str(tmp_path) not in text


def test_the_path_of_pretrained_weights_stays_at_home(finished_run, tmp_path, monkeypatch) -> None:
    load = checkpoint.load_method

    def with_weights(path, **options):
        method, config, metadata = load(path, **options)
        object.__setattr__(config.settings, "pretrained", tmp_path / "resnet18.pth")
        return method, config, metadata

    monkeypatch.setattr(checkpoint, "load_method", with_weights)
    export(finished_run, tmp_path / "small.safetensors")
    assert str(tmp_path).encode() not in (tmp_path / "small.safetensors").read_bytes()


def test_other_methods_are_refused(tiny_config, run_folder, tmp_path) -> None:
    train(tiny_config(run_folder, preset="kato2018-kato", encoder="conv-small", iterations=1))
    with pytest.raises(ValueError, match="proposed, vanilla and plus"):
        export(run_folder, tmp_path / "small.safetensors")
