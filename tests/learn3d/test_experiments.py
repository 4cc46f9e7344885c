"""Tables: what is planned, what is found again, statistics, reports, failing and stopped runs, one real run."""

from __future__ import annotations

import copy
import csv
import dataclasses
import importlib.util
import json
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from learn3d import training
from learn3d.experiments import formats, pool, published, results
from learn3d.experiments.experiment import Call, run_experiment
from learn3d.experiments.plan import (
    Options,
    State,
    command_line,
    found_runs,
    is_current,
    plan_runs,
    read_results,
    read_state,
)
from learn3d.experiments.pool import NOT_FROM_HERE
from learn3d.experiments.statistics import percentile_interval, resampled_means, t_interval
from learn3d.experiments.tables import TABLES
from learn3d.experiments.worker import carry_out
from learn3d.presets import PRESETS
from learn3d.run_folder import sole_use
from learn3d.training import Summary

TOOLS = Path(__file__).parents[2] / "tools"

#: Stands in for the worker: a category called "fails" fails, "waits" goes on until it is interrupted, others leave a
#: result whose IoUs depend on the variant, the seed and the object.
STUB = """
import json, os, sys, time
request = json.loads(sys.stdin.readline())
config, folder = request["config"], request["config"]["output"]
print("threads", os.environ["OMP_NUM_THREADS"], config["threads"], "fresh", request["fresh"], flush=True)
print("own session", os.getsid(0) == os.getpid() if hasattr(os, "getsid") else None, flush=True)
if request["category"] == "fails":
    print("first line"); print("error: no such data"); sys.exit(1)
if request["category"] == "waits":
    try:
        print("waiting", flush=True); time.sleep(60)
    except KeyboardInterrupt:
        time.sleep(0.5 * (request["variant"]["name"] == "proposed"))
        print("saved", flush=True); sys.exit(75)
base = {"vanilla": 0.3, "proposed": 0.4}[request["variant"]["name"]] + 0.01 * request["seed"]
means = [round(base + 0.02 * k, 5) for k in range(5)]
table = {"names": list("abcde"), "images": [24] * 5, "defined": [24] * 5, "kato18": means, "kato19": means}
iou = sum(means) / 5
result = {"config": config, "command": "python tools/train.py ...", "data": os.path.realpath(config["data"])}
result |= {"checkpoint": request["variant"]["checkpoint"], "seed": request["seed"]}
result |= {"iterations": config["iterations"], "step": config["iterations"], "seconds": 60.0, "conditions": {}}
result |= {"trained_by": {"commit": "0123456789ab"}, "tested_by": {"commit": "ba9876543210"}}
result |= {"voxel_iou_kato18": iou, "voxel_iou_kato19": iou - 0.05, "mmd": 1 - base, "mmd_paper": 0.5, "images": 120}
result |= {"chamfer_l1": 0.1, "f_score": 0.6, "undefined": 0, "objects": table, "views": table}
json.dump(result, open(os.path.join(folder, "test.json"), "w"))
print("tested", flush=True)
"""


@pytest.fixture
def stub(tmp_path: Path) -> tuple[str, str]:
    path = tmp_path / "stub.py"
    path.write_text(STUB)
    return sys.executable, str(path)


def options(folder: Path, **more: object) -> Options:
    given = {"categories": ("airplane",), "methods": ("vanilla", "proposed"), "iterations": 6, "batch_size": 4}
    return Options(folder / "data", folder / "out", **(given | more))


# --- the paper's figures


@pytest.mark.parametrize("name", ["KATO", "PRGAN", "KAR", "ABLATION", "MMD", "PASCAL"])
def test_printed_means_agree_with_the_printed_rows(name: str) -> None:
    for label, row in getattr(published, name).items():
        if row.mean is not None:
            assert np.mean(list(row.values.values())) == pytest.approx(row.mean, abs=0.001), label


def test_tables_take_rows_of_the_paper_and_share_runs() -> None:
    assert set(TABLES) == {"kato", "prgan", "kar", "ablation", "bins", "mmd", "multi-view", "pascal", "precision"}
    variants: dict[str, object] = {}
    for table in TABLES.values():
        assert table.baseline in [row.label for row in table.rows]
        assert all(row.published is not None for row in table.rows) or table.name == "precision"
        for variant in table.variants:
            assert variants.setdefault(variant.name, variant) == variant, "one name, two meanings"
    assert len(TABLES["bins"].rows) == 7
    assert TABLES["kar"].rows[2].variant in TABLES["bins"].variants


# --- planning


def test_runs_of_a_table_have_names_and_configurations(tmp_path) -> None:
    runs = plan_runs(TABLES["ablation"], Options(tmp_path, tmp_path / "out", categories=("chair", "lamp"), seeds=2))
    assert len(runs) == 4 * 2 * 2
    assert len({run.folder for run in runs}) == len(runs)
    run = next(run for run in runs if run.name == "chair/without-adversarial-seed1")
    assert run.folder == tmp_path / "out" / "runs" / "chair" / "without-adversarial-seed1"
    settings = run.config.settings
    assert (settings.lambda_adversarial, settings.lambda_classification, settings.lambda_prior) == (0, 0, 1)
    assert (run.config.seed, run.config.iterations, run.config.batch_size) == (1, 20_000, 128)


def test_bins_are_a_training_option(tmp_path) -> None:
    runs = plan_runs(TABLES["bins"], Options(tmp_path, tmp_path, categories=("chair",)))
    assert [run.config.view_bins for run in runs] == list(published.BINS)
    assert {run.config.layout for run in runs} == {"kar"}


def test_schedules_follow_the_number_of_iterations(tmp_path) -> None:
    settings = [
        plan_runs(TABLES[table], options(tmp_path, methods=(name,), iterations=2000))[0].config.settings
        for table, name in (("prgan", "prgan"), ("multi-view", "multi-view"))
    ]
    assert (settings[0].encoder_from_step, settings[1].decay_at_step) == (1001, 1900)
    for table in TABLES.values():
        for run in plan_runs(table, Options(tmp_path, tmp_path, ("chair",), seeds=1)):
            usual = PRESETS[run.variant.preset].settings
            assert run.config.settings == dataclasses.replace(
                usual, **{name: value for name, value in run.variant.changes.items() if hasattr(usual, name)}
            ), "what is not changed is as published"


def test_changes_reach_the_methods_that_they_name(tmp_path) -> None:
    changes = ("precision=fp32", "Vanilla-AE:learning-rate=3e-4", "lambda_smooth=0.5", "augment=flip-image,channels")
    vanilla, proposed = plan_runs(TABLES["kato"], options(tmp_path, changes=changes))
    assert (vanilla.config.settings.learning_rate, proposed.config.settings.learning_rate) == (3e-4, 1e-4)
    for run in (vanilla, proposed):
        assert run.config.settings.lambda_smooth == 0.5
        assert (run.config.precision, run.config.augment) == ("fp32", ("flip-image", "channels"))


def test_several_whole_numbers_are_numbers(tmp_path) -> None:
    for text in ("prgan:discriminator_channels=8,16,32,64", "discriminator-channels=[8,16,32,64]"):
        (run,) = plan_runs(TABLES["prgan"], options(tmp_path, methods=("prgan",), changes=(text,)))
        assert run.config.settings.discriminator_channels == (8, 16, 32, 64)
    with pytest.raises(ValueError, match="discriminator_channels must be a whole number >= 1, got 'a'"):
        plan_runs(TABLES["prgan"], options(tmp_path, methods=("prgan",), changes=("discriminator_channels=8,16,32,a",)))
    with pytest.raises(ValueError, match=r"discriminator_channels must be 4 whole numbers, got \(8,\)"):
        plan_runs(TABLES["prgan"], options(tmp_path, methods=("prgan",), changes=("discriminator_channels=[8]",)))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"methods": ("vpn",)}, "no method 'vpn'; it has vanilla, vpl, proposed"),
        ({"changes": ("lambda_x=1",)}, "no setting 'lambda_x'; there are encoder"),
        ({"changes": ("lambda_prior",)}, "written as name=value"),
        ({"changes": ("pascal:lambda_prior=1",)}, "names the method 'pascal'; there are vanilla, proposed"),
        ({"changes": ("seed=1",)}, "seed has an option of its own"),
        ({"changes": ("lambda_prior=-1",)}, "lambda_prior must be a number >= 0"),
        ({"categories": ("chair", "chair")}, "categories must be different"),
        ({"seeds": 0}, "seeds must be"),
        ({"iterations": -1}, "iterations must be"),
        ({"layout": "dvr"}, "the layout 'dvr' has no true voxels"),
    ],
)
def test_wrong_requests_are_named(tmp_path, given, message) -> None:
    with pytest.raises(ValueError, match=message):
        plan_runs(TABLES["kato"], options(tmp_path, **given))


def test_a_method_whose_preset_is_absent_is_named(tmp_path, monkeypatch) -> None:
    monkeypatch.delitem(PRESETS, "peng2020-kato-vanilla")
    with pytest.raises(ValueError, match=r"method 'vanilla' .* needs the preset 'peng2020-kato-vanilla'.*--methods"):
        plan_runs(TABLES["kato"], options(tmp_path))


@pytest.mark.parametrize("table", ["kato", "ablation", "bins", "prgan"])
def test_the_command_of_a_run_gives_its_configuration(tmp_path, table: str) -> None:
    spec = importlib.util.spec_from_file_location("tool_train_commands", TOOLS / "train.py")
    train = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = train
    spec.loader.exec_module(train)
    changes = ("precision=fp32", "augment=flip-image,channels", "max_val_images=4")
    changes += {"kato": ("vpl:anti_aliasing=false",), "prgan": ("perspective=true",)}.get(table, ("lambda_prior=0.25",))
    methods = [row.variant.name for row in TABLES[table].rows if row.variant and row.variant.preset in PRESETS]
    given = Options(tmp_path / "a b", tmp_path, ("chair",), tuple(methods), 7, layout="kar", changes=changes)
    for run in plan_runs(TABLES[table], given):
        assert train.parse(shlex.split(command_line(run.config))[2:]).config == run.config


# --- what is there already


@pytest.fixture
def made_by_hand(tmp_path, finished_run, tiny_folder):
    """The plan of a run whose folder holds one that tools/train.py would have left: four steps of batch 4."""
    (tmp_path / "out" / "runs" / "airplane").mkdir(parents=True)
    (tmp_path / "out" / "runs" / "airplane" / "proposed-seed0").symlink_to(finished_run)
    given = {"methods": ("proposed",), "iterations": 4, "changes": ("precision=fp32",)}

    def plan(**more: object):
        given_options = options(tmp_path, **(given | more))
        return plan_runs(TABLES["kato"], dataclasses.replace(given_options, data=tiny_folder))[0]

    return plan


def test_runs_made_by_hand_are_adopted(made_by_hand) -> None:
    assert read_state(made_by_hand()) == State("trained", 4)
    assert read_state(made_by_hand(iterations=9)) == State("unfinished", 4)
    assert read_state(made_by_hand(threads=7)) == State("trained", 4), "what does not decide the result may differ"


def test_a_trained_run_whose_checkpoint_is_damaged_goes_on(made_by_hand, finished_run) -> None:
    run = made_by_hand()
    run.folder.unlink()
    run.folder.mkdir()
    last = run.folder / "last.safetensors"
    shutil.copy(finished_run / "last.safetensors", last)
    with open(last, "r+b") as file:
        file.seek(-1000, os.SEEK_END)
        file.write(b"rubbish")
    assert read_state(run) == State("unfinished", 4), "training finds the damage and goes back to the one before"
    (run.folder / "checkpoints").mkdir()
    shutil.copy(finished_run / "last.safetensors", run.folder / "checkpoints" / "step-000004.safetensors")
    last.write_bytes(b"rubbish")
    assert read_state(run).step == 4, "the header of the one before counts"
    shutil.rmtree(run.folder)


def test_other_options_are_named(made_by_hand) -> None:
    with pytest.raises(ValueError, match=r"proposed-seed0 has a run with other options: batch_size: 4 .* 5 asked for"):
        read_state(made_by_hand(batch_size=5))
    with pytest.raises(ValueError, match=r"lambda_prior: 1\.0 in the run, 0\.5 asked for"):
        read_state(made_by_hand(changes=("precision=fp32", "lambda_prior=0.5")))
    with pytest.raises(ValueError, match="iterations: 4 taken by the run, 3 asked for"):
        read_state(made_by_hand(iterations=3))


def test_the_split_that_chose_the_best_networks_counts(made_by_hand) -> None:
    run = made_by_hand(changes=("precision=fp32", "val_split=test"))
    assert read_state(run) == State("trained", 4)
    best = dataclasses.replace(run, variant=dataclasses.replace(run.variant, checkpoint="best"))
    with pytest.raises(ValueError, match="val_split: 'val' chose the run's best networks, 'test' asked for"):
        read_state(best)


def test_runs_in_conflict_stop_the_table_or_are_replaced(tmp_path, stub, capsys) -> None:
    run_experiment(Call("mmd", options(tmp_path)), worker=stub)
    with pytest.raises(ValueError, match=r"batch_size: 4 in the run, 8 asked for(.|\n)*--overwrite"):
        run_experiment(Call("mmd", options(tmp_path, batch_size=8)), worker=stub)
    assert run_experiment(Call("mmd", options(tmp_path, batch_size=8), overwrite=True), worker=stub) == 0
    log = (tmp_path / "out/runs/airplane/vanilla-seed0/log.txt").read_text()
    assert log.count("fresh False") == log.count("fresh True") == 1


def test_finished_runs_are_skipped_and_shared(tmp_path, stub, capsys) -> None:
    assert run_experiment(Call("kato", options(tmp_path)), worker=stub) == 0
    broken = (sys.executable, "-c", "raise SystemExit('started')")
    assert run_experiment(Call("kato", options(tmp_path)), worker=broken) == 0
    assert run_experiment(Call("mmd", options(tmp_path)), worker=broken) == 0, "the same runs serve another table"
    assert run_experiment(Call("kato", options(tmp_path, seeds=2)), worker=broken) == 1


def test_a_result_of_fewer_iterations_is_not_taken(made_by_hand) -> None:
    """As where tools/train.py took a measured run further by hand."""
    run = made_by_hand()
    result = {"iterations": 3, "checkpoint": "last", "data": str(run.config.data.resolve())}
    assert not is_current(run, result)
    assert is_current(run, result | {"iterations": 4})
    assert not is_current(run, result | {"iterations": 4, "checkpoint": "best"})


def test_a_result_of_other_data_is_not_taken(tmp_path, stub) -> None:
    run_experiment(Call("kato", options(tmp_path)), worker=stub)
    moved = plan_runs(TABLES["kato"], dataclasses.replace(options(tmp_path), data=tmp_path / "elsewhere"))
    assert read_state(moved[0]).stage == "trained"
    assert read_results(moved) == {}


# --- processes


def test_a_failing_run_does_not_stop_the_others(tmp_path, stub, capsys) -> None:
    call = Call("kato", options(tmp_path, categories=("fails", "airplane"), threads=3), jobs=2)
    assert run_experiment(call, worker=stub) == 1
    shown = capsys.readouterr().err
    assert "FAILED fails/vanilla-seed0; the end of its log:" in shown
    assert "error: no such data" in shown
    assert "2 of 4 runs failed" in shown
    report = json.loads((tmp_path / "out" / "kato.json").read_text())
    assert report["missing"] == ["fails/vanilla-seed0", "fails/proposed-seed0"]
    assert report["rows"][0]["cells"]["airplane"]["values"]["kato18"] == pytest.approx(0.34)
    assert report["rows"][0]["cells"]["mean"] == {"paper_printed": 0.357}, "no mean over what is not there"
    assert "threads 3 3" in (tmp_path / "out/runs/airplane/vanilla-seed0/log.txt").read_text()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="POSIX signals")
@pytest.mark.skipif(os.name != "posix", reason="a pipe without a reader ends otherwise there")
def test_runs_go_on_where_nobody_reads_their_progress(tmp_path, stub, monkeypatch) -> None:
    for name in ("stdout", "stderr"):
        reading, writing = os.pipe()
        os.close(reading)
        monkeypatch.setattr(sys, name, open(writing, "w"))
    assert run_experiment(Call("kato", options(tmp_path)), worker=stub) == 0
    assert (tmp_path / "out" / "kato.md").is_file()


def test_ctrl_c_stops_all_runs_and_the_next_call_goes_on(tmp_path, stub, capsys) -> None:
    call = Call("kato", options(tmp_path, categories=("waits", "airplane")), jobs=2)
    logs = [tmp_path / f"out/runs/waits/{name}-seed0/log.txt" for name in ("vanilla", "proposed")]

    def interrupt() -> None:
        deadline = time.monotonic() + 30
        while not all(log.is_file() and "waiting" in log.read_text() for log in logs) and time.monotonic() < deadline:
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    assert run_experiment(call, worker=stub) == 130
    assert all("saved" in log.read_text() for log in logs)
    assert all("own session True" in log.read_text() for log in logs), "else the terminal would interrupt them too"
    assert "stopped; the same command goes on" in capsys.readouterr().err
    assert not (tmp_path / "out/runs/airplane").exists(), "nothing new is started"


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no terminals")
@pytest.mark.parametrize(("nohup", "status"), [(True, 0), (False, 130)])
def test_a_closed_terminal_stops_the_runs_except_under_nohup(tmp_path, stub, monkeypatch, nohup, status) -> None:
    start = pool._start
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if nohup else signal.SIG_DFL)
    monkeypatch.setattr(pool, "_start", lambda *given: (signal.raise_signal(signal.SIGHUP), start(*given))[1])
    try:
        assert run_experiment(Call("kato", options(tmp_path)), worker=stub) == status
    finally:
        signal.signal(signal.SIGHUP, before)


# --- statistics


def test_t_interval_by_hand() -> None:
    low, high = t_interval([0.50, 0.52, 0.57])
    half = 4.302653 * math.sqrt((0.03**2 + 0.01**2 + 0.04**2) / 2 / 3)  # t of two degrees of freedom
    assert (low, high) == pytest.approx((0.53 - half, 0.53 + half))
    assert t_interval([0.5]) is None


def test_bootstrap_is_over_objects_not_images() -> None:
    """Ten objects that differ, each with 24 images all alike: the interval is that of ten values, not of 240."""
    means = np.linspace(0.1, 1.0, 10)
    low, high = percentile_interval(resampled_means([24 * means], [np.full(10, 24.0)]))
    error = means.std() / math.sqrt(10)
    assert (0.55 - low, high - 0.55) == pytest.approx((1.96 * error, 1.96 * error), rel=0.12)


def test_bootstrap_interval_covers_the_true_mean() -> None:
    rng, covered = np.random.default_rng(1), 0
    for trial in range(60):
        low, high = percentile_interval(resampled_means([rng.normal(0.5, 0.1, 40)], [np.ones(40)], seed=trial))
        covered += low <= 0.5 <= high
    assert covered >= 51, "about 57 of 60 are expected"


def test_bootstrap_weighs_images_and_categories() -> None:
    one = resampled_means([np.array([3.0, 1.0])], [np.array([3.0, 2.0])])
    assert set(np.round(one, 6)) <= {1.0, 0.5, 0.8}, "mean over images: 3/3, 1/2 or 4/5"
    both = resampled_means([np.array([1.0]), np.array([0.0, 0.0])], [np.array([1.0]), np.array([1.0, 1.0])])
    assert np.all(both == 0.5), "then over categories, however many objects they have"


def test_paired_difference_has_the_smaller_interval() -> None:
    rng = np.random.default_rng(0)
    objects = rng.uniform(0.2, 0.8, 30)
    a, b = (resampled_means([objects + shift], [np.ones(30)]) for shift in (0.05, 0.0))
    assert percentile_interval(a - b) == pytest.approx((0.05, 0.05))
    assert np.ptp(percentile_interval(a)) > 0.1


# --- reports


@pytest.fixture
def report(tmp_path, stub, capsys) -> dict:
    call = Call("kato", options(tmp_path, categories=("airplane", "chair"), seeds=3), jobs=2)
    assert run_experiment(call, worker=stub) == 0
    return json.loads((tmp_path / "out" / "kato.json").read_text())


def test_report_has_the_papers_figures_beside_ours(report) -> None:
    vanilla, proposed = report["rows"]
    cell = proposed["cells"]["airplane"]
    assert cell["values"]["kato18"] == pytest.approx(0.45)  # objects .40 to .48, seeds + 0, .01, .02
    assert (cell["paper"], cell["seeds"], cell["objects"], cell["images"]) == (0.565, [0, 1, 2], 5, 120)
    assert cell["difference"] == pytest.approx(0.45 - 0.565)
    half = 4.302653 * 0.01 / math.sqrt(3)
    assert cell["interval_seeds"]["kato18"] == pytest.approx([0.45 - half, 0.45 + half])
    assert cell["interval_objects"]["kato18"][0] < 0.45 < cell["interval_objects"]["kato18"][1]
    assert cell["to_baseline"]["value"] == pytest.approx(0.1)
    assert cell["to_baseline"]["interval_objects"] == pytest.approx([0.1, 0.1]), "paired: every object gains .1"
    assert cell["to_baseline"]["interval_seeds"] == pytest.approx([0.1, 0.1]), "and every seed, however far apart"
    assert "to_baseline" not in vanilla["cells"]["airplane"]
    mean = proposed["cells"]["mean"]
    assert mean["paper"] == pytest.approx((0.565 + 0.415) / 2), "the paper's mean over the same categories"
    assert (mean["paper_printed"], mean["objects"]) == (0.524, 10)


def test_report_files_tell_the_same(report, tmp_path) -> None:
    out = tmp_path / "out"
    lines = list(csv.DictReader((out / "kato.csv").open()))
    assert len(lines) == 12
    assert lines[0]["run"] == "airplane/vanilla-seed0"
    assert (float(lines[0]["kato18"]), lines[0]["commit"]) == (pytest.approx(0.34), "0123456789ab")
    text = (out / "kato.md").read_text()
    assert "| Proposed | paper (kato18) | 0.565 | 0.415 | 0.490 |" in text
    assert "| difference | +0.100 ±0.000 [+0.100, +0.100] |" in text
    assert "python tools/train.py --preset peng2020-kato --data DATA --category CATEGORY" in text
    assert str(tmp_path) not in text, "no path of this machine gets into a page"
    changed = report | {"runs": [report["runs"][0] | {"commit": "0123456789ab-dirty"}]}
    assert formats.run_table(changed)[1][-1] == "012345678-dirty"
    page = (out / "kato.html").read_text()
    assert page.startswith("<!doctype html>")
    assert "0.565" in page
    assert not {"http://", "https://", "src="} & set(page.split("=")), "nothing is loaded from elsewhere"


def test_the_published_codes_figures_stand_beside_ours(tmp_path, stub) -> None:
    given = options(tmp_path, categories=("airplane", "chair"), iterations=3000)
    assert run_experiment(Call("kato", given, beside_code=True), worker=stub) == 0
    text = (tmp_path / "out" / "kato.md").read_text()
    assert "|  | published code, same meshes | 0.579 | 0.361 | 0.470 |" in text
    assert run_experiment(Call("mmd", given, report_only=True, beside_code=True), worker=stub) == 0
    assert "same meshes" not in (tmp_path / "out" / "mmd.md").read_text(), "no MMD is known at 3,000"


def test_mmd_is_compared_by_ratio(tmp_path, stub) -> None:
    run_experiment(Call("mmd", options(tmp_path)), worker=stub)
    proposed = json.loads((tmp_path / "out" / "mmd.json").read_text())["rows"][1]
    assert proposed["cells"]["airplane"]["to_baseline"]["ratio"] == pytest.approx(0.6 / 0.7)
    assert proposed["cells"]["airplane"]["difference"] == pytest.approx(0.6 - 0.272)
    assert "(x 0.86)" in (tmp_path / "out" / "mmd.md").read_text()


def test_quoted_rows_are_marked_and_never_trained(tmp_path, stub, monkeypatch, capsys) -> None:
    table, quoted = TABLES["kato"], [row for row in TABLES["pascal"].rows if row.variant is None]
    monkeypatch.setitem(TABLES, "kato", dataclasses.replace(table, rows=(*quoted, *table.rows)))
    assert run_experiment(Call("kato", options(tmp_path)), worker=stub) == 0
    text = (tmp_path / "out" / "kato.md").read_text()
    assert "| CSDM | paper, quoted from Kar et al. 2015 (voxeliser not stated) | 0.398 | 0.398 |" in text
    assert "| CMR | paper, quoted from Kanazawa et al. 2018 (voxeliser not stated) | 0.460 | 0.460 |" in text
    assert {run["variant"] for run in json.loads((tmp_path / "out" / "kato.json").read_text())["runs"]} == {
        "vanilla",
        "proposed",
    }


def test_report_only_takes_what_is_there(report, tmp_path, stub) -> None:
    given = Options(Path("nowhere"), tmp_path / "out")
    assert [run.category for run in found_runs(TABLES["kato"], given)] == ["airplane"] * 6 + ["chair"] * 6
    assert run_experiment(Call("kato", given, report_only=True), worker=stub) == 0
    again = json.loads((tmp_path / "out" / "kato.json").read_text())
    ours = [[row["cells"][c] for c in ("airplane", "mean")] for row in report["rows"]]
    theirs = [[row["cells"][c] for c in ("airplane", "mean")] for row in again["rows"] if row["label"] != "VPL"]
    assert ours == theirs
    for path in (tmp_path / "out" / "runs").glob("*/*/test.json"):  # trained with a relative --data, elsewhere
        values = json.loads(path.read_text())
        path.write_text(json.dumps(values | {"config": values["config"] | {"data": "../data"}}))
    assert len(read_results(found_runs(TABLES["kato"], given))) == 12
    with pytest.raises(ValueError, match="no result for the table bins"):
        run_experiment(Call("bins", given, report_only=True), worker=stub)


def test_different_lengths_of_training_are_said(tmp_path, stub) -> None:
    for method, iterations in (("vanilla", 6), ("proposed", 8)):
        run_experiment(Call("kato", options(tmp_path, methods=(method,), iterations=iterations)), worker=stub)
    run_experiment(Call("kato", Options(Path("d"), tmp_path / "out"), report_only=True), worker=stub)
    assert (
        "not all trained alike: 6 iterations of batch 4, 8 iterations of batch 4"
        in (tmp_path / "out" / "kato.md").read_text()
    )


def test_results_of_another_length_than_asked_for_are_said(tmp_path, stub, capsys) -> None:
    run_experiment(Call("kato", options(tmp_path, iterations=5)), worker=stub)
    capsys.readouterr()
    for asked, note in (
        ({}, ""),
        ({"iterations": 5, "batch_size": 4}, ""),
        ({"iterations": 3}, "results of 5 iterations of batch 4, where 3 iterations were asked for"),
        ({"iterations": 5, "batch_size": 8}, "where 5 iterations of batch 8 were asked for"),
    ):
        given = Options(Path("d"), tmp_path / "out", **asked)
        assert run_experiment(Call("kato", given, report_only=True), worker=stub) == 0
        for text in (capsys.readouterr().out, (tmp_path / "out" / "kato.md").read_text()):
            assert note in text and ("asked for" in text) == bool(note), asked


def test_the_table_on_the_terminal_is_aligned_and_says_how_long_ours_were_trained(tmp_path, stub, capsys) -> None:
    run_experiment(Call("kato", options(tmp_path, iterations=5)), worker=stub)
    header, *rows, trained = capsys.readouterr().out.splitlines()
    assert trained == "here: trained for 5 iterations of batch 4"
    starts = [match.start() for match in re.finditer(r"\S+", header)]
    assert len(starts) == 3 and len(rows) >= 4
    for row in rows:
        assert all(row[start - 2 : start] == "  " and row[start] != " " for start in starts[1:]), row


def test_a_page_receives_its_table(report, tmp_path) -> None:
    page = tmp_path / "results.md"
    page.write_text("Before.\n\n<!-- table: kato -->\nold\n<!-- end: kato -->\n\nAfter.\n")
    formats.embed(page, report)
    formats.embed(page, report)
    text = page.read_text()
    assert text.startswith("Before.\n\n<!-- table: kato -->\n| method |")
    assert text.endswith("<!-- end: kato -->\n\nAfter.\n")
    assert text.count("| Proposed | paper") == 1
    assert "old" not in text
    page.write_text("nothing")
    with pytest.raises(ValueError, match="must have the lines '<!-- table: kato -->'"):
        formats.embed(page, report)


def test_names_in_results_are_no_html_and_end_no_block(report, tmp_path, stub) -> None:
    report = copy.deepcopy(report)
    report["runs"][0] |= {"commit": "<b>\n|", "general_command": "python --pretrained 'a\n```\n<script>'"}
    text = formats.to_markdown(report)
    assert "| &lt;b&gt; \\| |\n" in text and "\n````sh\npython --pretrained 'a\n```\n<script>'" in text
    (tmp_path / "out/runs/airplane").rename(tmp_path / "out/runs/<script>\x1b")
    with pytest.raises(ValueError, match=r"is no folder of a category: category must be a plain name"):
        run_experiment(Call("kato", options(tmp_path, categories=()), report_only=True), worker=stub)


def test_calls_that_make_no_sense(tmp_path) -> None:
    with pytest.raises(ValueError, match="no table 'katoo'; choose one of kato, prgan"):
        run_experiment(Call("katoo", options(tmp_path)))
    with pytest.raises(ValueError, match="jobs must be"):
        run_experiment(Call("kato", options(tmp_path), jobs=0))
    with pytest.raises(ValueError, match="give one of them"):
        run_experiment(Call("kato", options(tmp_path), report_only=True, overwrite=True))
    with pytest.raises(ValueError, match="whatever settings they have; leave --set out"):
        run_experiment(Call("kato", options(tmp_path, changes=("lambda_prior=0",)), report_only=True))


def test_a_page_without_a_place_is_noticed_before_anything_is_trained(tmp_path, stub) -> None:
    page = tmp_path / "results.md"
    page.write_text("<!-- table: bins -->\n<!-- end: bins -->\n")
    with pytest.raises(ValueError, match="must have the lines '<!-- table: kato -->'"):
        run_experiment(Call("kato", options(tmp_path), page=page), worker=stub)
    with pytest.raises(FileNotFoundError):
        run_experiment(Call("kato", options(tmp_path), page=tmp_path / "other.md"), worker=stub)
    assert not (tmp_path / "out").exists()


def test_a_damaged_result_is_named(tmp_path, stub) -> None:
    run_experiment(Call("kato", options(tmp_path)), worker=stub)
    (tmp_path / "out/runs/airplane/vanilla-seed0/test.json").write_text("{")
    with pytest.raises(ValueError, match=r"vanilla-seed0/test.json is not valid JSON .* remove it"):
        run_experiment(Call("kato", options(tmp_path), report_only=True), worker=stub)


# --- the real thing


def test_a_real_run_from_training_to_report(tmp_path, tiny_folder, capsys) -> None:
    """Two steps in a worker; then only the measurement; then a refusal to measure it on other data."""
    given = Options(
        tiny_folder, tmp_path / "out", ("airplane",), ("vanilla",), 2, 4, changes=("precision=fp32",), threads=1
    )
    assert run_experiment(Call("kato", given)) == 0
    folder = tmp_path / "out" / "runs" / "airplane" / "vanilla-seed0"
    result = json.loads((folder / "test.json").read_text())
    assert (result["iterations"], result["step"], result["images"]) == (2, 2, 24)
    assert (result["objects"]["images"], len(result["views"]["names"])) == ([24], 24)
    assert result["objects"]["kato18"][0] == pytest.approx(result["voxel_iou_kato18"], abs=1e-5)
    assert np.mean(result["views"]["kato18"]) == pytest.approx(result["voxel_iou_kato18"], abs=1e-5)
    assert {"chamfer_l1", "f_score", "mmd", "mmd_paper"} <= set(result)

    (folder / "test.json").unlink()
    run = plan_runs(TABLES["kato"], given)[0]
    assert carry_out(run, fresh=False)
    assert json.loads((folder / "test.json").read_text())["voxel_iou_kato18"] == result["voxel_iou_kato18"]
    assert (folder / "log.txt").read_text().count("training: ") == 1, "only measured again"

    np.savez(tmp_path / "02691156_train_images.npz", np.zeros((3, 24, 4, 64, 64), np.uint8))
    shutil.copy(tiny_folder / "02691156_train_voxels.npz", tmp_path)
    moved = dataclasses.replace(run, config=dataclasses.replace(run.config, data=tmp_path))
    with pytest.raises(ValueError, match=r"vanilla-seed0 was trained on other data: the CRC-32 of its 72 training"):
        carry_out(moved, fresh=False)
    shutil.rmtree(tmp_path / "out")  # checkpoints are large


@pytest.mark.parametrize(
    ("iterations", "fresh", "resume", "overwrite"), [(9, False, True, False), (9, True, False, True)]
)
def test_a_worker_resumes_or_starts_anew(made_by_hand, monkeypatch, iterations, fresh, resume, overwrite) -> None:
    calls = []

    def train(config, **how):
        calls.append(how)
        return Summary(config.output, 5, False, 0.0, 0, 0.0, 0.0)

    monkeypatch.setattr(training, "train", train)
    monkeypatch.setattr(results, "measure", lambda *_, **__: pytest.fail("a stopped run is not measured"))
    assert not carry_out(made_by_hand(iterations=iterations), fresh=fresh)
    assert calls == [{"resume": resume, "overwrite": overwrite}]


@pytest.mark.parametrize("answer", [signal.SIG_DFL, signal.SIG_IGN], ids=["foreground", "background"])
def test_a_worker_stops_when_its_parent_is_gone(answer: signal.Handlers) -> None:
    code = "import time; from learn3d.experiments import worker; worker._stop_with_parent(); time.sleep(60)"
    process = subprocess.Popen(
        [sys.executable, "-c", NOT_FROM_HERE + code],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, answer),
    )
    process.stdin.close()
    assert b"KeyboardInterrupt" in process.stderr.read()
    assert process.wait(timeout=30) != 0
    process.stderr.close()


def test_two_processes_never_share_a_run(tmp_path) -> None:
    with sole_use(tmp_path), pytest.raises(OSError, match="another process works in"), sole_use(tmp_path):
        pass
    with sole_use(tmp_path):
        pass


def test_the_page_of_results_has_a_place_for_every_table(report, tmp_path) -> None:
    page = tmp_path / "results.md"
    shutil.copy(Path(__file__).parents[2] / "docs" / "results.md", page)
    for name in TABLES:
        formats.embed(page, report | {"table": name})
    assert page.read_text().count("| Proposed | paper (kato18) | 0.565 |") == len(TABLES)
