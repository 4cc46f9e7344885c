"""The script of long trainings: its commands are understood, and go on where they stopped."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from learn3d.studio.commands import Experiment, MakeDataset
from learn3d.studio.tables.plan import plan_runs

SCRIPT = Path(__file__).parents[2] / "tools" / "paper_runs.sh"
# records its arguments, and leaves the files that the script looks for
STUB = """#!{python}
import json, pathlib, sys
with open("calls.jsonl", "a") as file:
    file.write(json.dumps(sys.argv[1:]) + "\\n")
value = lambda name: pathlib.Path(sys.argv[sys.argv.index(name) + 1])
output = value("--output")
output.mkdir(parents=True, exist_ok=True)
card = sys.argv[1] == "make-dataset"
(output / ("1_card.json" if card else f"{{sys.argv[2]}}.json")).write_text("{{}}")
"""

pytestmark = pytest.mark.skipif(os.name != "posix", reason="a shell script")


def calls(folder: Path, *options: str, **environment: str) -> list[list[str]]:
    stub = folder / "bin" / "learn3d"
    stub.parent.mkdir(exist_ok=True)
    stub.write_text(STUB.format(python=sys.executable))
    stub.chmod(0o755)
    path = {"PATH": f"{stub.parent}:{os.environ['PATH']}"}
    (folder / "calls.jsonl").unlink(missing_ok=True)
    subprocess.run(
        ["bash", SCRIPT, "work", *options],
        check=True,
        cwd=folder,
        env=os.environ | path | environment,
    )
    return [json.loads(line) for line in (folder / "calls.jsonl").read_text().splitlines()]


def test_every_command_plans_runs_and_the_first_ones_matter_most(tmp_path) -> None:
    said = calls(tmp_path, "--jobs", "2", "--threads", "1")
    made = [words for words in said if words[0] == "make-dataset"]
    for _, *words in made:
        MakeDataset.parse("make-dataset", words)
    assert len(made) == 4, "three categories in Kato's layout, and Kar's"
    runs = []
    for words in said:
        if words[0] == "experiment":
            request = Experiment.parse("experiment", words[1:])
            assert request.workers.jobs == 2
            runs += [f"{run.name} {run.config.iterations}" for run in plan_runs(request)]
    order = list(dict.fromkeys(runs))
    airplane = ("vanilla", "proposed", "without-adversarial", "without-prior")
    assert order[:4] == [f"airplane/{name}-seed0 20000" for name in airplane]
    assert order[4].startswith("chair/")
    assert {"car/without-prior-seed0 20000", "airplane/vanilla-seed2 10000"} <= set(order)
    assert {"airplane/kar-vanilla-seed0 5000", "airplane/vpl-seed0 5000"} <= set(order)
    assert (tmp_path / "work/reports/ablation-chair-20000.json").is_file()


def test_the_same_command_goes_on_with_the_data_that_are_there(tmp_path) -> None:
    first = calls(tmp_path)
    again = calls(tmp_path, STEPS="5000", SEEDS="3")
    assert [words[0] for words in again].count("make-dataset") == 0 < len(first) - len(again)
    assert again[0][again[0].index("--seeds") + 1] == "3"
    assert again[0][again[0].index("--output") + 1] == "work/5000"
