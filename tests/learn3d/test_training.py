"""The training step's alternation, the presets, sampling, resumption, and how a run ends."""

from __future__ import annotations

import dataclasses
import json
import shutil
import signal

import numpy as np
import pytest
import torch

import nmr
from learn3d import training
from learn3d.config import TrainConfig, check_resume, config_from_dict, config_to_dict, load_config
from learn3d.data.dataset import ViewDataset
from learn3d.data.readers import kato
from learn3d.data.sampling import shuffled_epochs
from learn3d.distributed.process_group import SINGLE_PROCESS
from learn3d.methods import DatasetInfo, create_method
from learn3d.methods.multi_view import MultiViewSettings
from learn3d.methods.plus import PlusSettings
from learn3d.methods.pose_invariant import PoseInvariant
from learn3d.presets import PRESETS
from learn3d.runs import checkpoint, state
from learn3d.runs.checkpoint import DataFingerprint, Progress
from learn3d.training import train

VANILLA = "peng2020-kato-vanilla"


def snapshot(network: torch.nn.Module) -> list[torch.Tensor]:
    return [p.detach().clone() for p in network.parameters()]


def changed(network: torch.nn.Module, before: list[torch.Tensor]) -> bool:
    return any(not torch.equal(p, q) for p, q in zip(network.parameters(), before, strict=True))


def make_step(config: TrainConfig, data: ViewDataset):
    """Networks by name, and a function that takes one step with them."""
    method = create_method(config.settings, DatasetInfo(24), device="cpu", precision="fp32", seed=0)
    batch = data.batch(torch.tensor([0, 25, 50, 7]))
    return method.networks, lambda iteration: method.take_step(batch, iteration)


def test_alternation(tiny_config, tiny_set, tmp_path) -> None:
    networks, step = make_step(tiny_config(tmp_path), tiny_set)
    for iteration in (1, 2, 3):
        before = {name: snapshot(network) for name, network in networks.items()}
        losses = step(iteration)
        assert changed(networks["encoder"], before["encoder"])
        assert changed(networks["generator"], before["generator"])
        odd = iteration % 2 == 1
        assert changed(networks["discriminator"], before["discriminator"]) == odd
        assert ("classification" in losses, "confusion" in losses) == (odd, not odd)
        if not odd:
            assert all(p.grad is None for p in networks["discriminator"].parameters())


def gradients(config: TrainConfig, data: ViewDataset, iteration: int) -> dict[str, list[torch.Tensor]]:
    networks, step = make_step(config, data)
    step(iteration)
    return {
        name: [p.grad.clone() for p in network.parameters() if p.grad is not None] for name, network in networks.items()
    }


def test_classification_does_not_reach_encoder_and_generator(tiny_config, tiny_set, tmp_path) -> None:
    with_cls = gradients(tiny_config(tmp_path), tiny_set, 1)
    without = gradients(tiny_config(tmp_path, lambda_classification=0.0), tiny_set, 1)
    for name in ("encoder", "generator"):
        assert all(torch.equal(a, b) for a, b in zip(with_cls[name], without[name], strict=True))
    assert with_cls["discriminator"]
    assert not without["discriminator"]


def test_confusion_reaches_the_encoder_only(tiny_config, tiny_set, tmp_path) -> None:
    with_adv = gradients(tiny_config(tmp_path), tiny_set, 2)
    without = gradients(tiny_config(tmp_path, lambda_adversarial=0.0), tiny_set, 2)
    assert any(not torch.equal(a, b) for a, b in zip(with_adv["encoder"], without["encoder"], strict=True))
    assert all(torch.equal(a, b) for a, b in zip(with_adv["generator"], without["generator"], strict=True))
    assert not with_adv["discriminator"]


def test_vanilla_has_no_discriminator_and_no_code_losses(tiny_config, tiny_set, tmp_path) -> None:
    networks, step = make_step(tiny_config(tmp_path, preset=VANILLA), tiny_set)
    assert "discriminator" not in networks
    for iteration in (1, 2):
        assert set(step(iteration)) == {"projection", "smoothness", "total"}


def test_printed_losses_differ_from_those_of_the_published_code(tiny_config, tiny_set, tmp_path) -> None:
    printed = {"adversarial_form": "probability", "prior_form": "norm"}
    _, released = make_step(tiny_config(tmp_path), tiny_set)
    _, paper = make_step(tiny_config(tmp_path, **printed), tiny_set)
    a, b = released(2), paper(2)
    assert a["projection"] == b["projection"]
    assert a["smoothness"] == b["smoothness"]
    assert a["confusion"] > 5 * b["confusion"]  # near uniform the log form is about K^2 times larger
    assert a["prior"] != b["prior"]


def weights(config: TrainConfig) -> tuple[float, ...]:
    names = ("lambda_smooth", "lambda_classification", "lambda_adversarial", "lambda_prior")
    return tuple(getattr(config.settings, name) for name in names)


def test_preset_fills_in_what_is_not_given(tmp_path) -> None:
    best = TrainConfig(data=tmp_path, category="airplane", output=tmp_path)
    assert (best.preset, best.iterations, best.batch_size, best.augment) == ("plus-kato", 80_000, 32, ("colors",))
    config = TrainConfig(data=tmp_path, category="airplane", output=tmp_path, preset="peng2020-kato")
    assert weights(config) == (0.001, 1, 1, 1)
    assert weights(TrainConfig(data=tmp_path, category="airplane", output=tmp_path, preset=VANILLA)) == (0.001, 0, 0, 0)
    assert (config.iterations, config.batch_size, config.settings.learning_rate) == (20_000, 128, 1e-4)
    assert (config.layout, config.sampling, config.augment, config.view_bins) == ("kato", "views", (), None)
    given = TrainConfig(data=tmp_path, category="airplane", output=tmp_path, iterations=7, view_bins="15x20")
    assert (given.iterations, given.batch_size, given.view_bins) == (7, 32, "15x20")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "kato"}, "^there is no preset 'kato'; did you mean 'plus-kato'?"),
        ({"settings": MultiViewSettings()}, "'plus-kato' takes PlusSettings, got MultiViewSettings"),
        ({"layout": "shapenet"}, "layout must be 'kato'"),
        ({"sampling": "all"}, "sampling must be 'views'"),
        ({"augment": ("zoom",)}, "augment must be 'flip'"),
        ({"augment": ("channels", "flip")}, "but 'peng2020-kato' learns with the class of the original"),
        ({"layout": "r2n2"}, "the layout 'r2n2' has no split val; validate on test"),
        ({"encoder": "resnet18"}, "images of the layout 'kato' have 64x64 pixels, but 224 are wanted"),
        ({"layout": "pascal3d", "view_bins": "15x20"}, "view_bins '15x20': .* of the layout 'pascal3d' are rotations"),
        ({"preset": "gadelha2017-kato"}, "encoder_from_step=53051 lies beyond the 4 iterations: .* such as 3"),
        (
            {"preset": "gadelha2017-kato", "augment": ("flip",), "encoder_from_step": 2},
            "'gadelha2017-kato' learns with",
        ),
        ({"preset": "plus-kato", "bank_size": 3}, r"\(--bank-size\): batch_size must lie in 2 .. 3, got 4; --lambda"),
        ({"preset": "plus-kato", "batch_size": 1}, "batch_size must lie in 2 .. 2048, got 1"),
        ({"view_bins": "15"}, "view bins are written as AZIMUTHxELEVATION"),
        ({"prior_form": "cube"}, "prior_form must be 'squared' or 'norm'"),
        ({"iterations": 0}, "iterations must be at least 1"),
        ({"batch_size": 2.5}, "batch_size must be a whole number, got 2.5"),
        ({"learning_rate": float("nan")}, "learning_rate must be a finite number"),
        ({"lambda_smooth": -1.0}, "lambda_smooth must be at least 0"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"category": ""}, "category must have at least 1 character"),
        ({"threads": 0}, "threads must be at least 1"),
    ],
)
def test_wrong_options_are_named(tiny_config, tmp_path, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        if "settings" in options:
            TrainConfig(data=tmp_path, category="airplane", output=tmp_path, **options)
        tiny_config(tmp_path, **options)


def test_config_survives_json_and_names_unknown_options(tmp_path) -> None:
    config = TrainConfig(
        data=tmp_path,
        category="chair",
        output=tmp_path / "run",
        settings=PlusSettings(lambda_prior=0.5),
        threads=2,
        augment=("channels",),
    )
    values = json.loads(json.dumps(config_to_dict(config)))
    assert config_from_dict(values) == config
    with pytest.raises(ValueError, match="no option 'latent'"):
        config_from_dict(values | {"latent": 3})
    with pytest.raises(ValueError, match="no option 'latent'"):
        config_from_dict(values | {"settings": {"latent": 3}})
    with pytest.raises(ValueError, match="option output is missing"):
        config_from_dict({"data": "a", "category": "b"})
    with pytest.raises(ValueError, match="folder of a training run"):
        load_config(tmp_path / "config.json")
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(ValueError, match="not valid JSON"):
        load_config(tmp_path / "config.json")


def test_resume_may_change_only_what_does_not_matter(tiny_config, tmp_path) -> None:
    saved = tiny_config(tmp_path)
    check_resume(tiny_config(tmp_path, iterations=9, threads=1, validate_every=3), saved)
    with pytest.raises(ValueError, match="batch_size: 4 in the run, 8 asked for; seed: 0 in the run, 1 asked for"):
        check_resume(tiny_config(tmp_path, batch_size=8, seed=1), saved)


@pytest.mark.parametrize(("samples", "batch"), [(24, 5), (24, 24), (7, 20)])
def test_batches_go_through_every_epoch_completely(samples: int, batch: int) -> None:
    steps = 3 * samples
    drawn = torch.cat([shuffled_epochs(samples, batch, seed=0, step=step) for step in range(1, steps + 1)])
    assert len(drawn) == steps * batch
    epochs = drawn[: len(drawn) // samples * samples].reshape(-1, samples)
    assert torch.equal(epochs.sort(dim=1).values, torch.arange(samples).expand_as(epochs))
    assert not torch.equal(epochs[0], epochs[1])
    assert torch.equal(shuffled_epochs(samples, batch, seed=0, step=3), shuffled_epochs(samples, batch, seed=0, step=3))
    other = torch.cat([shuffled_epochs(samples, batch, seed=1, step=step) for step in range(1, steps + 1)])
    assert not torch.equal(drawn, other)


def test_object_share() -> None:
    images = np.zeros((1, 24, 4, 64, 64), np.uint8)
    images[:, :12, 3, 10:26, 5:37] = 255  # 16 x 32: half of the picture
    data = kato.from_arrays(images, np.zeros((1, 32, 32, 32), bool), "airplane", "train")
    assert data.object_share() == pytest.approx(0.25)  # the other twelve are empty


def test_a_finished_run_leaves_everything(finished_run, read_metrics) -> None:
    names = {path.name for path in finished_run.iterdir()}
    assert names == {
        "config.json",
        "last.safetensors",
        "best.safetensors",
        "metrics.jsonl",
        "journal.txt",
        "tensorboard",
        "pictures",
    }
    metrics = read_metrics(finished_run)
    assert [(m["step"], m["split"]) for m in metrics] == [(s, "train") for s in (1, 2, 3, 4)] + [(4, "val")]
    assert "confusion" in metrics[1]
    assert 0 <= metrics[-1]["voxel_iou"] <= 1
    assert "mmd" not in metrics[-1], "four images of one object: a code per view, which is none to compare"
    assert (finished_run / "pictures" / "000004.png").stat().st_size > 1000
    assert list((finished_run / "tensorboard").iterdir())


TRAIN_STEP = PoseInvariant.take_step


def signal_after(number: int, step: int):
    """The training step, with a signal to this process at the end of one of them."""

    def step_and_signal(self, batch, now: int):
        losses = TRAIN_STEP(self, batch, now)
        if now == step:
            signal.raise_signal(number)
        return losses

    return step_and_signal


def test_sigterm_saves_and_says_how_to_resume(tiny_config, run_folder, monkeypatch, capsys) -> None:
    handler = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(PoseInvariant, "take_step", signal_after(signal.SIGTERM, 1))
    summary = train(tiny_config(run_folder, preset=VANILLA))
    assert (summary.step, summary.finished) == (1, False)
    assert signal.getsignal(signal.SIGTERM) is handler
    assert "stopped by SIGTERM after step 1" in capsys.readouterr().err
    assert (run_folder / "last.safetensors").exists()


def test_a_second_interrupt_does_not_wait(tiny_config, run_folder, monkeypatch) -> None:
    def twice(*arguments):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(PoseInvariant, "take_step", twice)
    with pytest.raises(KeyboardInterrupt):
        train(tiny_config(run_folder, preset=VANILLA))


def test_interrupted_run_resumes_bit_for_bit(
    tiny_config, finished_run, run_folder, monkeypatch, capsys, read_metrics
) -> None:
    monkeypatch.setattr(PoseInvariant, "take_step", signal_after(signal.SIGINT, 2))
    summary = train(tiny_config(run_folder))
    assert (summary.step, summary.finished) == (2, False)
    assert f"--output {run_folder} --resume" in capsys.readouterr().err

    torch.manual_seed(99)  # whatever the new process does before
    monkeypatch.setattr(PoseInvariant, "take_step", TRAIN_STEP)
    with open(run_folder / "metrics.jsonl", "a") as file:
        file.write('{"step": 3, "split": "train"}\n{"step": 4, "spl')  # as a crash after the checkpoint would leave it
    summary = train(tiny_config(run_folder), resume=True)
    assert (summary.step, summary.finished) == (4, True)
    assert read_metrics(run_folder) == read_metrics(finished_run)
    for name in ("last", "best"):
        ours, about = checkpoint.load(run_folder / f"{name}.safetensors")
        theirs, about_theirs = checkpoint.load(finished_run / f"{name}.safetensors")
        assert ours.keys() == theirs.keys()
        assert all(torch.equal(ours[key], theirs[key]) for key in ours)
        assert (about.fingerprint, about.info) == (about_theirs.fingerprint, about_theirs.info)
        assert dataclasses.replace(about.progress, seconds=0.0) == dataclasses.replace(
            about_theirs.progress, seconds=0.0
        )
        assert about.progress.seconds > 0


def test_resume_refuses_conflicts_and_finished_runs(tiny_config, finished_run) -> None:
    with pytest.raises(ValueError, match=r"cannot resume with different options .*learning_rate"):
        train(tiny_config(finished_run, learning_rate=1e-3), resume=True)
    with pytest.raises(ValueError, match="has taken 4 steps, more than the 3 asked for"):
        train(tiny_config(finished_run, iterations=3), resume=True)


def check_nothing_to_do(config: TrainConfig) -> None:
    """What happens to a finished run when everything fits: nothing."""
    before = {path: path.stat().st_mtime_ns for path in config.output.rglob("*") if path.is_file()}
    summary = train(config, resume=True)
    assert (summary.step, summary.finished, summary.best_step) == (4, True, 4)
    assert {path: path.stat().st_mtime_ns for path in config.output.rglob("*") if path.is_file()} == before


def change_metadata(monkeypatch: pytest.MonkeyPatch, change) -> None:
    """Let checkpoints be read as if they had been written with other metadata."""
    load = checkpoint.load

    def changed_load(path):
        tensors, metadata = load(path)
        return tensors, change(metadata)

    monkeypatch.setattr(checkpoint, "load", changed_load)


def write_images(tiny_folder, folder, change) -> None:
    """A copy of the tiny data with other training images."""
    shutil.copytree(tiny_folder, folder)
    path = folder / "02691156_train_images.npz"
    with np.load(path) as archive:
        images = change(archive["arr_0"])
    np.savez_compressed(path, images)
    np.savez_compressed(folder / "02691156_train_voxels.npz", np.zeros((len(images), 32, 32, 32), bool))


def one_pixel(images: np.ndarray) -> np.ndarray:
    images[1, 5, 0, 30, 30] ^= 1
    return images


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda images: images[:2], "other training data: 72 images .* in the run, 48 with"),
        (one_pixel, "other training data: 72 images with the CRC-32"),
    ],
)
def test_resume_refuses_other_data(tiny_config, tiny_folder, finished_run, tmp_path, change, message: str) -> None:
    write_images(tiny_folder, tmp_path / "data", change)
    with pytest.raises(ValueError, match=message):
        train(tiny_config(finished_run, data=tmp_path / "data"), resume=True)


def test_resume_refuses_other_poses(tiny_config, tiny_set, finished_run, monkeypatch) -> None:
    moved = dataclasses.replace(tiny_set.poses, azimuth_deg=tiny_set.poses.azimuth_deg + 1)
    sets = (dataclasses.replace(tiny_set, poses=moved),) * 2
    monkeypatch.setattr(training, "load_splits", lambda _, **__: sets)
    with pytest.raises(ValueError, match="other training data: 72 images with the CRC-32"):
        train(tiny_config(finished_run), resume=True)


def test_resume_refuses_another_mirror_plane(tiny_config, finished_run, monkeypatch) -> None:
    change_metadata(
        monkeypatch, lambda m: dataclasses.replace(m, info=dataclasses.replace(m.info, mirror_plane_deg=7.5))
    )
    with pytest.raises(ValueError, match=r"was trained on data of .*mirror_plane_deg=7\.5"):
        train(tiny_config(finished_run), resume=True)


def test_the_best_of_other_validation_images_is_forgotten(tiny_config, finished_run, tmp_path) -> None:
    run = shutil.copytree(finished_run, tmp_path / "run")
    assert train(tiny_config(run), resume=True).best_step > 0
    other = tiny_config(run, max_val_images=6)
    assert train(other, resume=True).best_step == 0, "nothing was left to do"
    summary = train(dataclasses.replace(other, iterations=5), resume=True)
    assert (summary.step, summary.best_step) == (5, 5)


def test_resume_finds_its_data_in_another_folder(tiny_config, tiny_folder, finished_run, tmp_path) -> None:
    shutil.copytree(tiny_folder, tmp_path / "moved")
    check_nothing_to_do(tiny_config(finished_run, data=tmp_path / "moved"))


def test_resume_refuses_another_arithmetic(tiny_config, finished_run, monkeypatch) -> None:
    change_metadata(
        monkeypatch, lambda m: dataclasses.replace(m, config=dataclasses.replace(m.config, precision="auto"))
    )
    check_nothing_to_do(tiny_config(finished_run, precision="fp32"))  # by name it is what "auto" was
    monkeypatch.setattr(training, "resolve_precision", lambda precision, device: "bf16")
    with pytest.raises(ValueError, match="the run computes in fp32, but precision 'auto' means bf16 here; ask for"):
        train(tiny_config(finished_run, precision="auto"), resume=True)


def test_resume_without_a_checkpoint(tiny_config, run_folder) -> None:
    with pytest.raises(ValueError, match="no checkpoint"):
        train(tiny_config(run_folder), resume=True)


def test_used_folder_is_refused_and_overwrite_keeps_foreign_files(
    tiny_config, run_folder, monkeypatch, read_metrics
) -> None:
    run_folder.mkdir()
    (run_folder / "notes.txt").write_text("mine")
    (run_folder / "config.json").write_text(json.dumps(config_to_dict(tiny_config(run_folder))))
    (run_folder / "metrics.jsonl").write_text('{"step": 0, "split": "train"}\n')
    with pytest.raises(ValueError, match="has a run; continue it"):
        train(tiny_config(run_folder))
    monkeypatch.setattr(training, "draw", lambda *arguments: None)
    train(tiny_config(run_folder, iterations=1, preset=VANILLA), overwrite=True)
    assert (run_folder / "notes.txt").read_text() == "mine"
    assert read_metrics(run_folder)[0]["step"] == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"augment": ("crop",)}, "crop needs the original images"),
        ({"preset": "kato2018-kato", "sampling": "views"}, "choose sampling 'pairs'"),
        ({"preset": "peng2020-kato-vpl", "batch_size": 1}, "batches of at least 2, got 1"),
    ],
)
def test_what_no_step_can_be_taken_with_leaves_the_older_run(
    options, message: str, tiny_config, finished_run, tmp_path
) -> None:
    run = shutil.copytree(finished_run, tmp_path / "run")
    before = {path.name for path in run.iterdir()}
    with pytest.raises(ValueError, match=message):
        train(tiny_config(run, **options), overwrite=True)
    assert {path.name for path in run.iterdir()} == before


def test_output_that_is_a_file(tiny_config, tmp_path) -> None:
    (tmp_path / "run").write_text("")
    with pytest.raises(ValueError, match="is a file; give a folder"):
        train(tiny_config(tmp_path / "run"))


def test_nan_loss_stops_before_the_step_and_names_the_last_checkpoint(tiny_config, run_folder, monkeypatch) -> None:
    calls = []

    def loss(prediction, target):
        calls.append(0)
        return prediction.mean() * (float("nan") if len(calls) == 3 else 1)

    monkeypatch.setattr(nmr.losses, "soft_iou_loss", loss)
    config = tiny_config(run_folder, preset=VANILLA, checkpoint_every=2)
    with pytest.raises(FloatingPointError, match=r"not finite at iteration 3 \(projection nan.*last good checkpoint"):
        train(config)
    tensors, metadata = checkpoint.load(run_folder / "last.safetensors")
    assert metadata.progress.step == 2
    assert all(bool(t.isfinite().all()) for t in tensors.values() if t.is_floating_point())


def test_networks_that_are_not_finite_are_not_saved(tiny_config, run_folder) -> None:
    config = tiny_config(run_folder)
    method = create_method(config.settings, DatasetInfo(24), device="cpu", precision="fp32", seed=0)
    with torch.no_grad():
        method.generator.layers[0].bias[3] = float("inf")
    run_folder.mkdir()
    with pytest.raises(FloatingPointError, match="generator has values that are not finite"):
        state.Run(config, method, DatasetInfo(24), DataFingerprint(72, "0a", "fp32"), SINGLE_PROCESS).save_last(
            Progress()
        )
    assert not list(run_folder.iterdir())


def test_the_journal_says_how_the_run_ended(tiny_run, run_folder, monkeypatch) -> None:
    train(tiny_run(run_folder, iterations=2))
    journal = run_folder / "journal.txt"
    assert " finished at step 2 after 0.0 min; best validation IoU " in journal.read_text().splitlines()[-1]

    def fail(*_):
        raise RuntimeError("the cat is on the keyboard")

    monkeypatch.setattr(PoseInvariant, "take_step", fail)
    with pytest.raises(RuntimeError):
        train(tiny_run(run_folder, iterations=4), resume=True)
    assert journal.read_text().splitlines()[-1].endswith(" ended by RuntimeError: the cat is on the keyboard")


def test_a_finished_run_says_that_it_was(tiny_run, run_folder) -> None:
    train(tiny_run(run_folder, iterations=2))
    assert str(train(tiny_run(run_folder, iterations=2), resume=True)).startswith(
        "was already finished at step 2; best"
    )


def test_empty_masks_are_said_and_nothing_but_empty_ones_refused(tiny_run, run_folder, tiny_set, monkeypatch) -> None:
    some, none = tiny_set.images.copy(), np.zeros_like(tiny_set.images)
    some[:5, 3] = 0
    for images in (some, none):
        sets = (dataclasses.replace(tiny_set, images=images),) * 2
        monkeypatch.setattr(training, "load_splits", lambda _, sets=sets, **__: sets)
        if images is some:
            train(tiny_run(run_folder, iterations=1))
            assert (
                f"warning: 5 of {len(some)} test images have an empty mask" in (run_folder / "journal.txt").read_text()
            )
        else:
            with pytest.raises(ValueError, match=f"all {len(some)} test images of airplane have an empty mask"):
                train(tiny_run(run_folder, iterations=1), overwrite=True)


def test_resuming_without_the_checkpoints_that_there_were_is_refused(tiny_run, run_folder) -> None:
    """Starting anew would write over best.safetensors and the metrics."""
    train(tiny_run(run_folder, iterations=4))
    (run_folder / "last.safetensors").unlink()
    shutil.rmtree(run_folder / "checkpoints")
    best = (run_folder / "best.safetensors").read_bytes()
    metadata = checkpoint.load_metadata(run_folder / "best.safetensors")
    if metadata.progress.step <= 2:  # the best of these tiny runs may be the first
        tensors, _ = checkpoint.load(run_folder / "best.safetensors")
        late = dataclasses.replace(metadata, progress=dataclasses.replace(metadata.progress, step=4))
        checkpoint.save(run_folder / "best.safetensors", tensors, late)
        best = (run_folder / "best.safetensors").read_bytes()
    with pytest.raises(ValueError, match=r"came to step 4 at least .* its checkpoints are missing: put last"):
        train(tiny_run(run_folder, iterations=6), resume=True)
    assert (run_folder / "best.safetensors").read_bytes() == best


@pytest.mark.parametrize("preset", ["peng2020-kato", "peng2020-kato-vpl", "kato2018-kato"])
@pytest.mark.parametrize(("plane", "fixed"), [(37.5, True), (None, False)])
def test_symmetry_auto_is_the_plane_that_the_data_have(preset: str, plane: float | None, fixed: bool) -> None:
    settings = dataclasses.replace(PRESETS[preset].settings, symmetry="auto", generator="sphere-small")
    shape = DatasetInfo(24, mirror_plane_deg=plane)
    generator = create_method(settings, shape, device="cpu", precision="fp32", seed=0).networks["generator"]
    assert (generator.mirror is not None) == fixed


def test_the_plane_is_found_before_the_first_step_and_kept(tiny_config, run_folder, monkeypatch) -> None:
    monkeypatch.setattr(training, "find_mirror_plane", lambda dataset: 37.5)
    train(tiny_config(run_folder, symmetry="auto"))
    method, config, metadata = checkpoint.load_method(run_folder / "best.safetensors")
    assert (config.settings.symmetry, metadata.info.mirror_plane_deg) == ("auto", 37.5)
    assert method.generator.mirror is not None
