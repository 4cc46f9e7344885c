"""Stored results and runs that are found again: adopted, refused, named."""

from __future__ import annotations

import copy
import dataclasses
import json
from typing import Any

import pytest
import stub_work

from learn3d.config import config_to_dict
from learn3d.experiments.experiment import find_conflict, read_result, read_results
from learn3d.experiments.plan import plan_runs
from learn3d.files.writing import write_json

STORED = stub_work.result().model_dump()


def with_objects(name: str, values: list[Any]) -> dict[str, Any]:
    result = copy.deepcopy(STORED)
    result["objects"][name] = values
    return result


@pytest.mark.parametrize(
    ("content", "message"),
    [
        *(
            (json.dumps(STORED | {name: value}), rf"test.json is no measurement of a run \({name}")
            for name, value in {
                "iterations": "10",
                "images": True,
                "mmd": "low",
                "data": 5,
                "config": [],
                "fingerprint": 7,
                "trained_by": {"commit": 5},
                "objects": {},
            }.items()
        ),
        *((json.dumps(with_objects(name, [])), "differ in length") for name in ("defined", "kato18", "names")),
        (json.dumps(with_objects("kato18", [10**200, None, None, None, None])), r"objects\.kato18"),
        (json.dumps({}), r"no measurement of a run \(checkpoint: Field required"),
        (json.dumps([]), "no measurement of a run"),
        ("{", "no measurement .* remove it"),
        ("[" * 99_999, "nested"),
    ],
)
def test_damaged_results_are_named(content: str, message: str, tmp_path) -> None:
    (tmp_path / "test.json").write_text(content)
    with pytest.raises(ValueError, match=message):
        read_result(tmp_path / "test.json")


def test_sound_results_are_read(tmp_path) -> None:
    write_json(tmp_path / "test.json", STORED)
    assert read_result(tmp_path / "test.json").model_dump() == STORED


def test_runs_made_by_hand_are_adopted_and_others_are_named(request_for) -> None:
    (run,) = plan_runs(request_for(methods=("proposed",)))
    assert find_conflict(run) == ""
    run.folder.mkdir(parents=True)
    config = dataclasses.replace(run.config, threads=7, iterations=3, val_split="test")
    write_json(run.folder / "config.json", config_to_dict(config))
    assert find_conflict(run) == "", "these options do not decide the result"
    with_best = dataclasses.replace(run, variant="kar-vpl")
    assert "val_split: 'test' chose the run's best networks" in find_conflict(with_best)
    for changes, words in (
        ({"batch_size": 5}, "batch_size: 4 in the run, 5 asked for"),
        ({"set": ("lambda_prior=0.5",)}, "lambda_prior: 1.0 in the run, 0.5 asked for"),
    ):
        (other,) = plan_runs(request_for(methods=("proposed",), **changes))
        assert words in find_conflict(other)


def test_runs_in_conflict_stop_the_table_are_replaced_or_left_out(tmp_path, make, capsys, request_for) -> None:
    make(request_for("mmd"))
    with pytest.raises(ValueError, match=r"batch_size: 4 in the run, 8 asked for(.|\n)*--overwrite"):
        make(request_for("mmd", batch_size=8))
    make(request_for("mmd", batch_size=8, report_only=True))
    said = capsys.readouterr().err
    assert "left out: " in said and "vanilla-seed0 has a run with other options: batch_size: 4" in said
    assert "airplane/vanilla-seed0" in json.loads((tmp_path / "out" / "mmd.json").read_text())["missing"]
    assert make(request_for("mmd", batch_size=8, overwrite=True)) == 0
    log = (tmp_path / "out/runs/airplane/vanilla-seed0/log.txt").read_text()
    assert log.count("fresh False") == log.count("fresh True") == 1


def test_finished_runs_are_skipped_and_shared(make, request_for) -> None:
    assert make(request_for("kato")) == 0
    for table in ("kato", "mmd"):
        assert make(request_for(table), work=stub_work.fail_if_started) == 0
    with pytest.raises(ValueError, match="started"):
        make(request_for(seeds=2), work=stub_work.fail_if_started)


def test_results_of_other_networks_or_data_are_not_taken(tmp_path, make, request_for) -> None:
    make(request_for())
    (run, _) = plan_runs(request_for())
    assert list(read_results([run])) == [run.folder]
    for other in (request_for(iterations=7), dataclasses.replace(request_for(), data=tmp_path / "elsewhere")):
        assert read_results(plan_runs(other)) == {}
    assert read_results([dataclasses.replace(run, variant="kar-vpl")]) == {}, "it tests the best checkpoint"
