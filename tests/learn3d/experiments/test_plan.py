"""The runs that are planned for a table, and their commands."""

from __future__ import annotations

import dataclasses
import shlex

import pytest

from learn3d.commands.train import Train
from learn3d.experiments.plan import Request, command_line, plan_runs
from learn3d.experiments.tables import BINS, TABLES, VARIANTS
from learn3d.presets import PRESETS


def test_runs_of_a_table_have_names_and_configurations(tmp_path) -> None:
    runs = plan_runs(Request("ablation", tmp_path, tmp_path / "out", category="chair,lamp", seeds=2))
    assert len({run.folder for run in runs}) == len(runs) == 4 * 2 * 2
    run = next(run for run in runs if run.name == "chair/without-adversarial-seed1")
    assert run.folder == tmp_path / "out" / "runs" / "chair" / "without-adversarial-seed1"
    settings = run.config.settings
    assert (settings.lambda_adversarial, settings.lambda_classification, settings.lambda_prior) == (0, 0, 1)
    assert (run.config.seed, run.config.iterations, run.config.batch_size) == (1, 20_000, 128)
    bins = plan_runs(Request("bins", tmp_path, tmp_path, category="chair"))
    assert [(run.config.view_bins, run.config.layout) for run in bins] == [(width, "kar") for width in BINS]


def test_only_named_settings_differ_from_the_preset(tmp_path, request_for) -> None:
    for table in TABLES:
        for run in plan_runs(Request(table, tmp_path, tmp_path, "chair", seeds=1)):
            variant = VARIANTS[run.variant]
            usual = PRESETS[variant.preset].settings
            changed = {name: value for name, value in variant.changes.items() if hasattr(usual, name)}
            assert run.config.settings == dataclasses.replace(usual, **changed)
    (run,) = plan_runs(request_for("prgan", methods=("prgan",), iterations=2000))
    assert run.config.settings.encoder_from_step == 1001, "the second half, however long it is"


def test_smaller_batches_show_as_many_images(tmp_path) -> None:
    def sizes(**asked: int) -> set[tuple[str, int, int, int]]:
        request = Request("plus", tmp_path, tmp_path, "chair", ("proposed", "proposed-shared", "plus"), **asked)
        runs = plan_runs(dataclasses.replace(request, seeds=1))
        return {(r.variant, r.config.iterations, r.config.batch_size, r.config.warmup_steps) for r in runs}

    small = {("proposed-shared", 80_000, 32, 100), ("plus", 80_000, 32, 100)}
    assert sizes() == {("proposed", 20_000, 128, 0)} | small
    short = {("proposed-shared", 200, 2, 20), ("plus", 200, 2, 20)}
    assert sizes(iterations=50, batch_size=8) == {("proposed", 50, 8, 0)} | short
    with pytest.raises(ValueError, match="divides batches by 4: batch_size must be a multiple, got 6"):
        sizes(batch_size=6)
    for table, plus, proposed in (("kar", "kar-plus", "bins-15x20"), ("pascal", "pascal-plus", "pascal-proposed")):
        runs = plan_runs(Request(table, tmp_path, tmp_path, "airplane", seeds=1))
        images = {run.variant: run.config.iterations * run.config.batch_size for run in runs}
        assert images[plus] == images[proposed]


def test_changes_reach_the_methods_that_they_name(request_for) -> None:
    changes = ("precision=fp32", "vanilla:learning-rate=3e-4", "lambda_smooth=0.5", "augment=flip-image,channels")
    vanilla, proposed = plan_runs(request_for(set=changes))
    assert (vanilla.config.settings.learning_rate, proposed.config.settings.learning_rate) == (3e-4, 1e-4)
    for run in (vanilla, proposed):
        assert run.config.settings.lambda_smooth == 0.5
        assert (run.config.precision, run.config.augment) == ("fp32", ("flip-image", "channels"))
    (run,) = plan_runs(request_for("prgan", methods=("PrGAN",), set=("prgan:discriminator_channels=8,16,32,64",)))
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
        ({"table": "prgan", "methods": ("prgan",), "set": ("discriminator_channels=8,a",)}, "discriminator_chan"),
        ({"seeds": 0}, "jobs and seeds must be at least 1"),
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
    changes += {"kato": ("vpl:anti_aliasing=false",), "prgan": ("perspective=true",)}.get(table, ("lambda_prior=0.25",))
    asked = {"iterations": 7, "layout": "kar", "set": changes}
    for run in plan_runs(Request(table, tmp_path / "a b", tmp_path, "chair", **asked)):
        assert Train.parse("train", shlex.split(command_line(run.config))[2:]).config == run.config
