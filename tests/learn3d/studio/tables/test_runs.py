"""The runs of a table: planned, found again, failing, stopped, resumed, and a real one."""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import shlex
import shutil
import signal
import threading

import numpy as np
import pytest
import stub_work
from children import wait_until

from learn3d.commands.train import Train
from learn3d.config import config_to_dict
from learn3d.device import resolve_precision
from learn3d.files.writing import write_json
from learn3d.presets import PRESETS, command_line
from learn3d.runs import checkpoint
from learn3d.runs.checkpoint import Progress
from learn3d.runs.measurement import evaluate_runs
from learn3d.runs.run import Summary
from learn3d.studio.poses.options import PoseOptions
from learn3d.studio.tables import experiment
from learn3d.studio.tables.experiment import (
    find_conflict,
    read_results,
    run_experiment,
    train_and_test,
)
from learn3d.studio.tables.plan import PlannedRun, Request, plan_runs
from learn3d.studio.tables.tables import BIN_WIDTHS, TABLES, VARIANTS
from learn3d.tasks import Workers


def test_runs_of_a_table_have_names_and_configurations(tmp_path) -> None:
    runs = plan_runs(
        Request("ablation", tmp_path, tmp_path / "out", category="chair,lamp", seeds=2)
    )
    assert len({run.config.output for run in runs}) == len(runs) == 4 * 2 * 2
    (run,) = (run.config for run in runs if run.name == "chair/without-adversarial-seed1")
    assert run.output == tmp_path / "out" / "runs" / "chair" / "without-adversarial-seed1"
    settings = run.settings
    assert (settings.lambda_adversarial, settings.lambda_classification, settings.lambda_prior) == (
        0,
        0,
        1,
    )
    assert (run.seed, run.iterations, run.batch_size) == (1, 20_000, 128)
    bins = plan_runs(Request("bins", tmp_path, tmp_path, category="chair"))
    assert [(run.config.view_bins, run.config.layout) for run in bins] == [
        (width, "kar") for width in BIN_WIDTHS
    ]


def test_only_named_settings_differ_from_the_preset(tmp_path, request_for) -> None:
    for table in TABLES:
        for run in plan_runs(Request(table, tmp_path, tmp_path, "chair", seeds=1)):
            variant = VARIANTS[run.variant]
            usual = PRESETS[variant.preset].settings
            changed = {
                name: value for name, value in variant.changes.items() if hasattr(usual, name)
            }
            assert run.config.settings == dataclasses.replace(usual, **changed)
    (run,) = plan_runs(request_for("prgan", methods=("prgan",), iterations=2000))
    assert run.config.settings.encoder_from_step == 1001, "the second half, however long it is"


def test_smaller_batches_show_as_many_images(tmp_path) -> None:
    def sizes(**asked: int) -> set[tuple[str, int, int, int]]:
        request = Request(
            "plus", tmp_path, tmp_path, "chair", ("proposed", "proposed-shared", "plus"), **asked
        )
        runs = plan_runs(dataclasses.replace(request, seeds=1))
        return {
            (r.variant, c.iterations, c.batch_size, c.schedule.warmup_steps)
            for r in runs
            for c in (r.config,)
        }

    small = {("proposed-shared", 80_000, 32, 100), ("plus", 80_000, 32, 100)}
    assert sizes() == {("proposed", 20_000, 128, 0)} | small
    short = {("proposed-shared", 200, 2, 20), ("plus", 200, 2, 20)}
    assert sizes(iterations=50, batch_size=8) == {("proposed", 50, 8, 0)} | short
    with pytest.raises(
        ValueError, match="divides batches by 4: batch_size must be a multiple, got 6"
    ):
        sizes(batch_size=6)
    for table, plus, proposed in (
        ("kar", "kar-plus", "bins-15x20"),
        ("pascal", "pascal-plus", "pascal-proposed"),
    ):
        runs = plan_runs(Request(table, tmp_path, tmp_path, "airplane", seeds=1))
        images = {run.variant: run.config.iterations * run.config.batch_size for run in runs}
        assert images[plus] == images[proposed]


def test_changes_reach_the_methods_that_they_name(request_for) -> None:
    changes = (
        "precision=fp32",
        "vanilla:learning-rate=3e-4",
        "lambda_smooth=0.5",
        "augment=flip-image,channels",
    )
    vanilla, proposed = (run.config for run in plan_runs(request_for(set=changes)))
    assert (vanilla.settings.learning_rate, proposed.settings.learning_rate) == (3e-4, 1e-4)
    for run in (vanilla, proposed):
        assert run.settings.lambda_smooth == 0.5
        assert (run.precision, run.augment) == ("fp32", ("flip-image", "channels"))
    (run,) = plan_runs(
        request_for("prgan", methods=("PrGAN",), set=("prgan:discriminator_channels=8,16,32,64",))
    )
    assert run.config.settings.discriminator_channels == (8, 16, 32, 64)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"table": "katoo"}, r"no table 'katoo'; did you mean 'kato'\? There are kato, prgan"),
        ({"methods": ("vpn",)}, "no method of the table 'vpn'; did you mean 'vpl'"),
        ({"set": ("lambda_x=1",)}, "--set lambda_x=1: give NAME=VALUE or METHOD:NAME=VALUE"),
        ({"set": ("lambda_prior",)}, "NAME=VALUE"),
        ({"set": ("pascal:lambda_prior=1",)}, "a method of vanilla, proposed"),
        ({"set": ("seed=1",)}, "that neither the table nor another option decides"),
        ({"set": ("lambda_prior=-1",)}, "lambda_prior must be"),
        (
            {"table": "prgan", "methods": ("prgan",), "set": ("discriminator_channels=8,a",)},
            "discriminator_chan",
        ),
        ({"seeds": 0}, "seeds must be greater than or equal to 1, got 0"),
        ({"iterations": -1}, "iterations must be"),
        ({"layout": "dvr"}, "the layout 'dvr' has no true voxels"),
    ],
)
def test_wrong_requests_are_named(given, message, request_for) -> None:
    with pytest.raises(ValueError, match=message):
        plan_runs(request_for(**given))


@pytest.mark.parametrize("table", ["kato", "ablation", "bins", "prgan"])
def test_the_command_of_a_run_gives_its_configuration(tmp_path, table: str) -> None:
    changes = ("precision=fp32", "augment=flip-image,channels", "max_val_images=4")
    changes += {"kato": ("vpl:clamp_to_cube=true",), "prgan": ("distance=2.5",)}.get(
        table, ("lambda_prior=0.25",)
    )
    asked = {"iterations": 7, "layout": "kar", "set": changes}
    for run in plan_runs(Request(table, tmp_path / "a b", tmp_path, "chair", **asked)):
        assert Train.parse("train", shlex.split(command_line(run.config))[2:]).config == run.config


SMALL = ("precision=fp32", "encoder=conv-small", "generator=sphere-small")


def test_finished_runs_are_skipped_and_shared(make, request_for) -> None:
    assert make(request_for("kato")) == 0
    for table in ("kato", "mmd"):
        assert make(request_for(table), work=stub_work.fail_if_started) == 0
    with pytest.raises(ValueError, match="started"):
        make(request_for(seeds=2), work=stub_work.fail_if_started)


def test_results_of_other_networks_or_data_are_not_taken(tmp_path, make, request_for) -> None:
    make(request_for())
    (run, _) = plan_runs(request_for())
    assert list(read_results([run])) == [run.name]
    for other in (
        request_for(iterations=7),
        dataclasses.replace(request_for(), data=tmp_path / "elsewhere"),
    ):
        assert read_results(plan_runs(other)) == {}


def test_runs_made_by_hand_are_adopted_and_others_are_named(make, request_for) -> None:
    (planned,) = plan_runs(request_for(methods=("proposed",)))
    run = planned.config
    assert find_conflict(run) == ""
    run.output.mkdir(parents=True)
    precision = resolve_precision("auto", "cpu")
    config = dataclasses.replace(
        run, threads=7, iterations=3, val_split="test", precision=precision
    )
    write_json(run.output / "config.json", config_to_dict(config))
    assert find_conflict(run) == "", "these options do not decide the result"
    with pytest.raises(
        ValueError, match=r"batch_size: 4 in the run, 5 asked for(.|\n)*choose another --output"
    ):
        make(request_for(methods=("proposed",), batch_size=5))
    with pytest.raises(ValueError, match=r"lambda_prior: 1.0 in the run, 0.5 asked for"):
        make(request_for(methods=("proposed",), set=("lambda_prior=0.5",), report_only=True))


def test_a_failing_run_does_not_stop_the_others(tmp_path, capsys, request_for, read_report) -> None:
    call = request_for(
        category="fails,airplane", methods=("vanilla",), threads=3, workers=Workers(2)
    )
    assert run_experiment(call, work=stub_work.work) == 1
    shown = capsys.readouterr().err
    assert "FAILED fails/vanilla-seed0; the end of its log:" in shown
    assert "error: no such data" in shown
    assert "1 of 2 runs failed" in shown
    assert "| Vanilla-AE | here (kato18) | - | 0.340 [" in read_report()
    assert "Missing: fails/vanilla-seed0." in read_report()
    assert "threads 3" in (tmp_path / "out/runs/airplane/vanilla-seed0/log.txt").read_text()


@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
def test_ctrl_c_stops_all_runs_and_the_next_call_goes_on(tmp_path, capsys, request_for) -> None:
    call = request_for(category="waits,airplane", workers=Workers(2))
    logs = [tmp_path / f"out/runs/waits/{name}-seed0/log.txt" for name in ("vanilla", "proposed")]

    def interrupt() -> None:
        wait_until(lambda: all(log.is_file() and "waiting" in log.read_text() for log in logs))
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    assert run_experiment(call, work=stub_work.work) == 130
    assert all("saved" in log.read_text() for log in logs)
    assert "stopped; the same command goes on" in capsys.readouterr().err
    assert not (tmp_path / "out/runs/airplane").exists(), "nothing new is started"


def test_a_real_run_from_training_to_report(tmp_path, tiny_folder, read_report) -> None:
    """Two steps in a worker; then only the measurement; then a refusal to measure it on other data."""
    given = Request(
        "kato", tiny_folder, tmp_path / "out", "airplane", ("vanilla",), 2, 4, set=SMALL, threads=1
    )
    assert run_experiment(given) == 0
    folder = tmp_path / "out" / "runs" / "airplane" / "vanilla-seed0"
    result = json.loads((folder / "test.json").read_text())
    assert (result["iterations"], result["step"], result["images"]) == (2, 2, 24)
    ((_, images, kato18, _),) = result["objects"]
    assert (images, kato18) == (24, pytest.approx(result["voxel_iou"], abs=1e-5))
    assert None not in [result[name] for name in ("chamfer_l1", "f_score", "voxel_iou_kato19")]
    assert f"| Vanilla-AE | here (kato18) | {result['voxel_iou']:.3f} [" in read_report()

    (folder / "test.json").unlink()
    run = plan_runs(given)[0]
    assert train_and_test(run)
    assert json.loads((folder / "test.json").read_text())["voxel_iou"] == result["voxel_iou"]
    assert (folder / "log.txt").read_text().count("training: ") == 1, "only measured again"
    assert result["other"] is None, "the last step was the best"

    weights, metadata = checkpoint.load(folder / "best.safetensors")
    earlier = dataclasses.replace(metadata.progress, step=1)
    weights = {
        name: value * 0.9 if value.is_floating_point() else value for name, value in weights.items()
    }
    checkpoint.save(
        folder / "best.safetensors", weights, dataclasses.replace(metadata, progress=earlier)
    )
    assert train_and_test(run)
    result = json.loads((folder / "test.json").read_text())
    assert (result["step"], result["other"]["step"]) == (2, 1)
    (best,) = evaluate_runs([folder], which="best")
    assert result["other"]["voxel_iou"] == best.voxel_iou != result["voxel_iou"]

    np.savez(tmp_path / "02691156_train_images.npz", np.full((3, 24, 4, 64, 64), 200, np.uint8))
    for name in ("train_voxels", "val_images", "val_voxels"):
        shutil.copy(tiny_folder / f"02691156_{name}.npz", tmp_path)
    moved = PlannedRun(run.variant, dataclasses.replace(run.config, data=tmp_path))
    with pytest.raises(ValueError, match="other training data"):
        train_and_test(moved)


def test_poses_are_estimated_for_the_runs_that_need_them(
    tmp_path, tiny_folder, monkeypatch
) -> None:
    """Once; a report without training has their errors, and the IoUs of both runs."""
    quick = functools.partial(PoseOptions, steps=1, restarts=1, prototypes=2)
    monkeypatch.setattr(experiment, "PoseOptions", quick)
    given = Request(
        "poses", tiny_folder, tmp_path / "out", "airplane", (), 1, 8, seeds=1, set=SMALL, threads=1
    )
    runs = plan_runs(given)
    assert all(map(train_and_test, runs))
    table, poses = tmp_path / "out/poses/airplane-seed0.npz", [run.config.poses for run in runs]
    assert poses == [None, table]
    monkeypatch.setattr(experiment, "PoseOptions", None)
    experiment.estimate_poses(runs[1].config)
    assert run_experiment(dataclasses.replace(given, report_only=True)) == 0
    _, row = json.loads((tmp_path / "out/poses.json").read_text())["poses"]
    known, estimated = (
        json.loads((run.config.output / "test.json").read_text())["voxel_iou"] for run in runs
    )
    assert row[-3:] == [f"{value:.3f}" for value in (known, estimated, estimated / known)]
    errors = json.loads(table.with_suffix(".json").read_text())
    assert row[2:4] == [f"{errors[name]:.3f}" for name in ("accuracy", "updated_accuracy")]
    assert "--poses OUTPUT/poses/CATEGORY-seedSEED.npz" in (tmp_path / "out/poses.md").read_text()


def test_a_run_goes_on_or_starts(
    finished_run, tiny_folder, request_for, tmp_path, monkeypatch
) -> None:
    given = dataclasses.replace(
        request_for(methods=("proposed",), iterations=9, set=SMALL), data=tiny_folder
    )
    (run,) = plan_runs(given)
    resumed = []

    def train(config, *, resume: bool, overwrite: bool) -> Summary:
        resumed.append(resume)
        return Summary(config.output, Progress(step=5), False, 0.0)

    monkeypatch.setattr(experiment, "train", train)
    monkeypatch.setattr(
        experiment, "evaluate_runs", lambda *_, **__: pytest.fail("a stopped run is not measured")
    )
    assert not train_and_test(run)
    shutil.copytree(finished_run, run.config.output)
    assert not train_and_test(run)
    assert resumed == [False, True]
