"""Options from a file that somebody else may have made: every wrong one is named."""

from __future__ import annotations

import json
from typing import Any

import pytest

from learn3d.config import config_from_dict, config_to_dict, load_config
from learn3d.data.view_bins import AngleBins
from learn3d.files import limits

BASE = {"data": "d", "category": "chair", "output": "o"}

WRONG: dict[str, tuple[Any, str]] = {
    "no options": ([], r"must hold options by name \(\{\.\.\.\}\), got list"),
    "a number": (5, "must hold options by name"),
    "nothing": (None, "must hold options by name"),
    "data": (BASE | {"data": 5}, "data must be the path"),
    "output": (BASE | {"output": "a\0b"}, "output must be the path"),
    "category": (BASE | {"category": 3}, "category must be text, got 3"),
    "preset": (BASE | {"preset": {}}, "preset must be"),
    "settings": (BASE | {"settings": 3}, "takes PlusSettings, got int"),
    "rate": (BASE | {"settings": {"learning_rate": "x"}}, "learning_rate must be a number, got 'x'"),
    "huge rate": (BASE | {"settings": {"learning_rate": 10**200}}, "learning_rate must be at most"),
    "weight": (BASE | {"settings": {"lambda_smooth": -1}}, "lambda_smooth must be at least 0, got -1"),
    "true weight": (BASE | {"settings": {"lambda_smooth": True}}, "lambda_smooth must be a number, got True"),
    "pretrained": (BASE | {"settings": {"pretrained": 5}}, "pretrained must be the path"),
    "encoder": (BASE | {"settings": {"encoder": []}}, "encoder must be 'conv'"),
    "augment": (BASE | {"augment": 5}, "augment must be a list, got 5"),
    "augment's items": (BASE | {"augment": [[]]}, r"augment must be .*, got \[\]"),
    "bins": (BASE | {"view_bins": 7}, "view_bins must be text, got 7"),
    "too few": (
        BASE | {"preset": "gadelha2017-kato", "settings": {"generator_channels": [8, 8]}},
        "generator_channels",
    ),
    "lacking": ({"data": "d", "category": "chair"}, "the option output is missing"),
    "many bins": (BASE | {"view_bins": "1e-9x1"}, "there would be 21600000000000 bins; at most 100000"),
    "endless bins": (BASE | {"view_bins": "15x5:-inf:30"}, "elevation_low_deg must be a finite number"),
    "seed": (BASE | {"seed": 2**64}, "seed must be less than"),
    "true seed": (BASE | {"seed": True}, "seed must be a whole number"),
    "iterations": (BASE | {"iterations": "abc"}, "iterations must be a whole number, got 'abc'"),
    "endless": (BASE | {"iterations": 10**12}, "iterations must be at most 1000000000"),
    "batch": (BASE | {"batch_size": 10**9}, "batch_size must be at most 65536"),
    "pairs": (BASE | {"sampling": "pairs", "batch_size": 3}, "batch_size must be even, got 3"),
    "threads": (BASE | {"threads": 10**9}, "threads must be at most 4096"),
    "unknown": (BASE | {"latent": 1}, "there is no option 'latent'"),
    "channels": (
        BASE | {"preset": "gadelha2017-kato", "settings": {"generator_channels": [10**6, 1, 1, 1]}},
        "generator_channels must be at most 1024",
    ),
    "base": (
        BASE | {"preset": "peng2020-kato-vpl", "settings": {"discriminator_channels": 1024}},
        "discriminator_channels must be at most 512",
    ),
    "width": (BASE | {"preset": "peng2020-kar", "settings": {"pretrained": [1]}}, "pretrained must be the path"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_options_are_named_with_their_file(tmp_path, name):
    values, message = WRONG[name]
    (tmp_path / "config.json").write_text(json.dumps(values))
    with pytest.raises(ValueError, match=message) as error:
        load_config(tmp_path / "config.json")
    assert "config.json" in str(error.value)


def test_files_that_are_no_json_or_too_large(tmp_path, monkeypatch):
    path = tmp_path / "config.json"
    with pytest.raises(
        ValueError, match=r"no .*config\.json: is this the folder of a training run\? One begins without --resume"
    ):
        load_config(path)
    for text in ("[" * 100_000, '{"seed": NaN}', "{", "\xff"):
        path.write_text(text, encoding="latin-1")
        with pytest.raises(ValueError, match=r"config\.json is not valid JSON: "):
            load_config(path)
    path.write_text(json.dumps(BASE))
    assert config_to_dict(load_config(path)) == config_to_dict(config_from_dict(BASE))
    monkeypatch.setattr(limits, "CONFIG_BYTES", 10)
    with pytest.raises(ValueError, match=r"config\.json: has \d+ bytes, and at most 10 are read"):
        load_config(path)


def test_bins_up_to_the_limit():
    assert AngleBins.parse("1x1:-90:90").count == 64_800
    with pytest.raises(ValueError, match="there would be 129600 bins"):
        AngleBins.parse("1x0.5:-90:90")
