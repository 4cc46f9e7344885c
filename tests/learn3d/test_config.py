"""Options from a file that somebody else may have made: every wrong one is named."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest

from learn3d.config import config_to_dict, differences
from learn3d.files import limits
from learn3d.presets import config_from_dict, load_config

BASE = {"data": "d", "category": "chair", "output": "o"}

WRONG: dict[str, tuple[Any, str]] = {
    "no options": ([], r"must hold options by name \(\{\.\.\.\}\), got list"),
    "data": (BASE | {"data": 5}, "data must be the path"),
    "category": (BASE | {"category": 3}, "category must be a valid string, got 3"),
    "preset": (BASE | {"preset": {}}, "there is no preset"),
    "no such preset": (
        BASE | {"preset": "kato"},
        "there is no preset 'kato'; did you mean 'plus-kato'?",
    ),
    "layout": (BASE | {"layout": "shapenet"}, "layout must be 'kato'"),
    "flip": (
        BASE | {"augment": ["channels", "flip"]},
        "but 'plus-kato' learns with the class of the original",
    ),
    "size": (
        BASE | {"settings": {"encoder": "resnet18"}},
        "the layout 'kato' have 64x64 pixels, but 224 are wanted",
    ),
    "rotations": (
        BASE | {"preset": "plus-pascal", "view_bins": "15x20"},
        "view_bins '15x20': .* of the layout 'pascal3d' are rotations",
    ),
    "prgan": (
        BASE | {"preset": "gadelha2017-kato", "iterations": 4},
        "encoder_from_step=53051 is after the last of 4 iterations: .* such as 3",
    ),
    "bank": (
        BASE | {"settings": {"bank_size": 3}},
        r"\(--bank-size\): batch_size must lie in 2 .. 3, got 32",
    ),
    "form": (BASE | {"settings": {"prior_form": "cube"}}, "prior_form must be 'squared' or 'norm'"),
    "settings": (BASE | {"settings": 3}, "takes PlusSettings, got int"),
    "rate": (
        BASE | {"settings": {"learning_rate": "x"}},
        "learning_rate must be a valid number, got 'x'",
    ),
    "weight": (
        BASE | {"settings": {"lambda_smooth": -1}},
        "lambda_smooth must be greater than or equal to 0, got -1",
    ),
    "pretrained": (BASE | {"settings": {"pretrained": 5}}, "pretrained must be the path"),
    "augment": (BASE | {"augment": 5}, "augment must be a valid tuple, got 5"),
    "bins": (BASE | {"view_bins": 7}, "view_bins must be a valid string, got 7"),
    "many bins": (
        BASE | {"view_bins": "0.00001x1"},
        "there would be 2160000000 bins; at most 100000",
    ),
    "seed": (BASE | {"seed": 2**64}, "seed must be less than"),
    "iterations": (BASE | {"iterations": "abc"}, "iterations must be a valid integer, got 'abc'"),
    "pairs": (
        BASE | {"sampling": "pairs", "batch_size": 3},
        "batch_size must be a multiple of 2, got 3",
    ),
    "views": (
        BASE | {"preset": "multi-view-kato", "sampling": "views"},
        "needs sampling 'pairs', got 'views'; leave",
    ),
    "unknown": (BASE | {"latent": 1}, "there is no option 'latent'"),
    "channels": (
        BASE | {"preset": "gadelha2017-kato", "settings": {"generator_channels": [10**6, 1, 1, 1]}},
        "generator_channels must be less than or equal to 1024",
    ),
}


def test_runs_of_vpl_from_before_its_other_forms_went_are_read():
    options = {"adversary": "alternating", "anti_aliasing": True, "image_size": 64}
    vpl = BASE | {"preset": "vpl", "settings": {"discriminator_channels": 8}}
    older = vpl | {"settings": vpl["settings"] | options}
    assert config_from_dict(older) == config_from_dict(vpl)
    older["settings"]["adversary"] = "reversal"
    with pytest.raises(ValueError, match="there is no option 'adversary'"):
        config_from_dict(older)


def test_images_may_be_flipped_if_their_view_classes_are_not_read():
    settings = {"encoder": "conv-light", "lambda_view": 1.0}
    config = config_from_dict(
        BASE | {"preset": "many-views-kato", "settings": settings, "augment": ["flip"]}
    )
    assert config.augment == ("flip",) and not config.settings.reads_view_ids


@pytest.mark.parametrize("name", WRONG)
def test_wrong_options_are_named_with_their_file(tmp_path, name):
    values, message = WRONG[name]
    (tmp_path / "config.json").write_text(json.dumps(values))
    with pytest.raises(ValueError, match=message) as error:
        load_config(tmp_path / "config.json")
    assert "config.json" in str(error.value)


def test_the_length_of_a_run_whose_poses_are_weighted_anew_is_kept(tiny_config, tmp_path):
    for updates, found in (
        (1, ["iterations: 6 in the run, 7 asked for (pose_updates depends on it)"]),
        (0, []),
    ):
        options = {
            "lr_schedule": "constant",
            "poses": tmp_path / "poses.npz",
            "pose_updates": updates,
        }
        config = tiny_config(tmp_path, iterations=6, **options)
        assert differences(dataclasses.replace(config, iterations=7), config) == found


def test_the_length_of_a_run_with_a_short_ramp_is_kept(tiny_config, tmp_path):
    config = tiny_config(tmp_path, iterations=60, warmup_steps=10)
    for longer, found in (
        (70, ["iterations: 60 in the run, 70 asked for (warmup_steps depends on it)"]),
        (65, []),
    ):
        assert differences(dataclasses.replace(config, iterations=longer), config) == found


def test_files_that_are_no_json_or_too_large(tmp_path, monkeypatch):
    path = tmp_path / "config.json"
    with pytest.raises(
        FileNotFoundError, match=r"config\.json: is missing; expected .* run, leave out --resume"
    ):
        load_config(path)
    for text in ("[" * 100_000, '{"seed": NaN}', "{", "\xff"):
        path.write_text(text, encoding="latin-1")
        with pytest.raises(
            ValueError, match=r"config\.json: cannot be read \(|seed must be|is missing"
        ):
            load_config(path)
    path.write_text(json.dumps(BASE))
    assert config_to_dict(load_config(path)) == config_to_dict(config_from_dict(BASE))
    monkeypatch.setattr(limits, "TEXT_BYTES", 10)
    with pytest.raises(ValueError, match=r"config\.json: has \d+ bytes; the limit is 10"):
        load_config(path)
