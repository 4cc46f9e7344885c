"""Stored results: a report is made of sound ones only."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
from fuzz_targets import RESULT

from learn3d.experiments.results import read_result


def stored(folder: Path, value: Any) -> Path:
    (folder / "test.json").write_text(json.dumps(value))
    return folder / "test.json"


def test_a_sound_result_is_read(tmp_path):
    assert read_result(stored(tmp_path, RESULT)) == RESULT


CHANGES = {
    "iterations": "10",
    "images": True,
    "mmd": "low",
    "data": 5,
    "config": [],
    "fingerprint": 7,
    "trained_by": {"commit": 5},
    "objects": {},
}


@pytest.mark.parametrize("name", CHANGES)
def test_values_of_another_kind_are_named(tmp_path, name):
    with pytest.raises(ValueError, match=rf"test.json is no measurement of a run \({name}"):
        read_result(stored(tmp_path, RESULT | {name: CHANGES[name]}))


@pytest.mark.parametrize("name", ["defined", "kato18", "names"])
def test_lists_of_another_length_are_refused(tmp_path, name):
    result = copy.deepcopy(RESULT)
    result["objects"][name] = result["objects"][name][:1]
    with pytest.raises(ValueError, match=r"test.json .* differ in length"):
        read_result(stored(tmp_path, result))


def test_numbers_beyond_any_array_are_refused(tmp_path):
    result = copy.deepcopy(RESULT)
    result["objects"]["kato18"] = [10**200, None]
    with pytest.raises(ValueError, match=r"objects\.kato18"):
        read_result(stored(tmp_path, result))


def test_other_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no measurement of a run \(config"):
        read_result(stored(tmp_path, {}))
    with pytest.raises(ValueError, match=r"\(images: Field required\)"):
        read_result(stored(tmp_path, {name: value for name, value in RESULT.items() if name != "images"}))
    with pytest.raises(ValueError, match="no measurement of a run"):
        read_result(stored(tmp_path, []))
    (tmp_path / "test.json").write_text("[" * 99_999)
    with pytest.raises(ValueError, match=r"test\.json cannot be used: .* nested"):
        read_result(tmp_path / "test.json")
