"""What is planned for a table, and what is found again."""

from __future__ import annotations

import dataclasses
import shlex

import pytest
import stub_work

from learn3d.commands import train
from learn3d.config import config_to_dict
from learn3d.experiments import published
from learn3d.experiments.experiment import Call
from learn3d.experiments.plan import Options, command_line, plan_runs
from learn3d.experiments.results import conflicts_with, read_results
from learn3d.experiments.tables import TABLES
from learn3d.files.writing import write_json
from learn3d.presets import PRESETS


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


def test_schedules_follow_the_number_of_iterations(tmp_path, options) -> None:
    (run,) = plan_runs(TABLES["prgan"], options(methods=("prgan",), iterations=2000))
    assert run.config.settings.encoder_from_step == 1001
    for table in TABLES.values():
        for run in plan_runs(table, Options(tmp_path, tmp_path, ("chair",), seeds=1)):
            usual = PRESETS[run.variant.preset].settings
            assert run.config.settings == dataclasses.replace(
                usual, **{name: value for name, value in run.variant.changes.items() if hasattr(usual, name)}
            ), "what is not changed is as published"


def test_smaller_batches_show_as_many_images(tmp_path) -> None:
    def sizes(**asked: int) -> set[tuple[str, int, int]]:
        options = Options(tmp_path, tmp_path, ("chair",), ("proposed", "proposed-shared", "plus"), seeds=1, **asked)
        return {(r.variant.name, r.config.iterations, r.config.batch_size) for r in plan_runs(TABLES["plus"], options)}

    small = {("proposed-shared", 80_000, 32), ("plus", 80_000, 32)}
    assert sizes() == {("proposed", 20_000, 128)} | small
    assert sizes(iterations=50, batch_size=8) == {("proposed", 50, 8), ("proposed-shared", 200, 2), ("plus", 200, 2)}
    with pytest.raises(ValueError, match="divides batches by 4: batch_size must be a multiple, got 6"):
        sizes(batch_size=6)


@pytest.mark.parametrize("name", ["kar", "pascal", "plus-single"])
def test_plus_sees_as_many_images_as_the_proposed_method(name: str, tmp_path) -> None:
    runs = plan_runs(TABLES[name], Options(tmp_path, tmp_path, ("airplane",), seeds=1))
    images = {run.variant.name: run.config.iterations * run.config.batch_size for run in runs}
    ours, theirs = {"kar": ("kar-plus", "bins-15x20")}.get(name, ("pascal-plus", "pascal-proposed"))
    if name == "plus-single":
        ours, theirs = "single-plus", "single-proposed"
    assert images[ours] == images[theirs]


def test_short_runs_warm_up_for_a_tenth(tmp_path) -> None:
    options = Options(tmp_path, tmp_path, ("chair",), ("proposed-schedule", "proposed-shared", "plus"), 100, seeds=1)
    found = {run.variant.name: run.config.warmup_steps for run in plan_runs(TABLES["plus"], options)}
    assert found == {"proposed-schedule": 10, "proposed-shared": 40, "plus": 40}


def test_changes_reach_the_methods_that_they_name(options) -> None:
    changes = ("precision=fp32", "Vanilla-AE:learning-rate=3e-4", "lambda_smooth=0.5", "augment=flip-image,channels")
    vanilla, proposed = plan_runs(TABLES["kato"], options(changes=changes))
    assert (vanilla.config.settings.learning_rate, proposed.config.settings.learning_rate) == (3e-4, 1e-4)
    for run in (vanilla, proposed):
        assert run.config.settings.lambda_smooth == 0.5
        assert (run.config.precision, run.config.augment) == ("fp32", ("flip-image", "channels"))


def test_several_whole_numbers_are_numbers(options) -> None:
    for text in ("prgan:discriminator_channels=8,16,32,64", "discriminator-channels=[8,16,32,64]"):
        (run,) = plan_runs(TABLES["prgan"], options(methods=("prgan",), changes=(text,)))
        assert run.config.settings.discriminator_channels == (8, 16, 32, 64)
    with pytest.raises(ValueError, match="discriminator_channels"):
        plan_runs(TABLES["prgan"], options(methods=("prgan",), changes=("discriminator_channels=8,16,32,a",)))
    with pytest.raises(ValueError, match="discriminator_channels"):
        plan_runs(TABLES["prgan"], options(methods=("prgan",), changes=("discriminator_channels=[8]",)))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"methods": ("vpn",)}, "no method 'vpn'; it has vanilla, vpl, proposed"),
        ({"changes": ("lambda_x=1",)}, "no setting 'lambda_x'; there are encoder"),
        ({"changes": ("lambda_prior",)}, "written as name=value"),
        ({"changes": ("pascal:lambda_prior=1",)}, "names the method 'pascal'; there are vanilla, proposed"),
        ({"changes": ("seed=1",)}, "seed has an option of its own"),
        ({"changes": ("lambda_prior=-1",)}, "lambda_prior must be"),
        ({"categories": ("chair", "chair")}, "categories must be different"),
        ({"seeds": 0}, "seeds must be"),
        ({"iterations": -1}, "iterations must be"),
        ({"layout": "dvr"}, "the layout 'dvr' has no true voxels"),
    ],
)
def test_wrong_requests_are_named(given, message, options) -> None:
    with pytest.raises(ValueError, match=message):
        plan_runs(TABLES["kato"], options(**given))


@pytest.mark.parametrize("table", ["kato", "ablation", "bins", "prgan"])
def test_the_command_of_a_run_gives_its_configuration(tmp_path, table: str) -> None:
    changes = ("precision=fp32", "augment=flip-image,channels", "max_val_images=4")
    changes += {"kato": ("vpl:anti_aliasing=false",), "prgan": ("perspective=true",)}.get(table, ("lambda_prior=0.25",))
    methods = [row.variant.name for row in TABLES[table].rows if row.variant and row.variant.preset in PRESETS]
    given = Options(tmp_path / "a b", tmp_path, ("chair",), tuple(methods), 7, layout="kar", changes=changes)
    for run in plan_runs(TABLES[table], given):
        assert train.read(shlex.split(command_line(run.config))[2:]).config == run.config


def test_runs_made_by_hand_are_adopted(options, tmp_path) -> None:
    """Their config.json says what they are; what does not decide the result may differ."""
    (run,) = plan_runs(TABLES["kato"], options(methods=("proposed",)))
    assert conflicts_with(run) == ""
    run.folder.mkdir(parents=True)
    write_json(run.folder / "config.json", config_to_dict(dataclasses.replace(run.config, threads=7, iterations=3)))
    assert conflicts_with(run) == ""


def test_other_options_are_named(options) -> None:
    (run,) = plan_runs(TABLES["kato"], options(methods=("proposed",)))
    run.folder.mkdir(parents=True)
    write_json(run.folder / "config.json", config_to_dict(run.config))
    for other, words in (
        (options(methods=("proposed",), batch_size=5), "batch_size: 4 in the run, 5 asked for"),
        (options(methods=("proposed",), changes=("lambda_prior=0.5",)), "lambda_prior: 1.0 in the run, 0.5 asked for"),
    ):
        assert words in conflicts_with(plan_runs(TABLES["kato"], other)[0])


def test_the_split_that_chose_the_best_networks_counts(options) -> None:
    (run,) = plan_runs(TABLES["kato"], options(methods=("proposed",)))
    run.folder.mkdir(parents=True)
    write_json(run.folder / "config.json", config_to_dict(dataclasses.replace(run.config, val_split="test")))
    assert conflicts_with(run) == ""
    best = dataclasses.replace(run, variant=dataclasses.replace(run.variant, checkpoint="best"))
    assert "val_split: 'test' chose the run's best networks" in conflicts_with(best)


def test_runs_in_conflict_stop_the_table_or_are_replaced(tmp_path, make, capsys, options) -> None:
    make(Call("mmd", options()))
    with pytest.raises(ValueError, match=r"batch_size: 4 in the run, 8 asked for(.|\n)*--overwrite"):
        make(Call("mmd", options(batch_size=8)))
    assert make(Call("mmd", options(batch_size=8), overwrite=True)) == 0
    log = (tmp_path / "out/runs/airplane/vanilla-seed0/log.txt").read_text()
    assert log.count("fresh False") == log.count("fresh True") == 1


def test_finished_runs_are_skipped_and_shared(make, options) -> None:
    assert make(Call("kato", options())) == 0
    assert make(Call("kato", options()), work=stub_work.never) == 0
    assert make(Call("mmd", options()), work=stub_work.never) == 0, "the same runs serve another table"
    with pytest.raises(ValueError, match="started"):
        make(Call("kato", options(seeds=2)), work=stub_work.never)


def test_results_of_other_networks_or_data_are_not_taken(tmp_path, make, options) -> None:
    make(Call("kato", options()))
    (run, _) = plan_runs(TABLES["kato"], options())
    assert list(read_results([run])) == [run.folder]
    for other in (options(iterations=7), dataclasses.replace(options(), data=tmp_path / "elsewhere")):
        assert read_results(plan_runs(TABLES["kato"], other)) == {}
    best = dataclasses.replace(run, variant=dataclasses.replace(run.variant, checkpoint="best"))
    assert read_results([best]) == {}
