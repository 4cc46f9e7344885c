"""Stored results: a report is made of sound ones only."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
from fuzz_targets import RESULT

from learn3d.experiments.stored import read_result


def stored(folder: Path, value: Any) -> Path:
    (folder / "test.json").write_text(json.dumps(value))
    return folder / "test.json"


def test_a_sound_result_is_read(tmp_path):
    assert read_result(stored(tmp_path, RESULT)) == RESULT


CHANGES = {
    "iterations": ("10", "iterations must be a whole number from 1, got '10'"),
    "images": (True, "images must be a whole number from 0, got True"),
    "mmd": ("low", "mmd must be a number or null, got 'low'"),
    "data": (5, "data must be a text, got 5"),
    "config": ([], r"config must be values by name, got \[\]"),
    "conditions": (7, "conditions must be values by name, got 7"),
    "trained_by": ({"commit": 5}, "trained_by must be values by name, with a text or null as its commit, got {.*}"),
    "objects": ({}, "names must be texts, got None"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_values_of_another_kind_are_named(tmp_path, name):
    value, message = CHANGES[name]
    with pytest.raises(ValueError, match=f"test.json is no measurement of a run: {message}; remove it"):
        read_result(stored(tmp_path, RESULT | {name: value}))


@pytest.mark.parametrize("name", ["defined", "kato18", "names"])
def test_lists_of_another_length_are_named(tmp_path, name):
    result = copy.deepcopy(RESULT)
    result["objects"][name] = result["objects"][name][:1]
    with pytest.raises(ValueError, match=r"is no measurement of a run: (defined|kato18) must be"):
        read_result(stored(tmp_path, result))


def test_numbers_beyond_any_array_are_refused(tmp_path):
    result = copy.deepcopy(RESULT)
    result["objects"]["kato18"] = [10**200, None]
    with pytest.raises(ValueError, match="kato18 must be 2 numbers or nulls, got"):
        read_result(stored(tmp_path, result))


def test_other_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="it lacks config, iterations"):
        read_result(stored(tmp_path, {}))
    with pytest.raises(ValueError, match="it lacks images;"):
        read_result(stored(tmp_path, {name: value for name, value in RESULT.items() if name != "images"}))
    with pytest.raises(ValueError, match="it must hold values by name, got list"):
        read_result(stored(tmp_path, []))
    (tmp_path / "test.json").write_text("[" * 99_999)
    with pytest.raises(ValueError, match=r"test\.json is not valid JSON \(it is nested more than 32 levels deep\)"):
        read_result(tmp_path / "test.json")
