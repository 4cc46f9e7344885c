"""The training step's alternation, the presets, sampling, resumption, and how a run ends."""

from __future__ import annotations

import copy
import dataclasses
import shutil
import signal
from pathlib import Path

import pytest
import torch
from steps import INFO, backpropagate, changed, make_method

import nmr
from learn3d import training
from learn3d.config import TrainConfig
from learn3d.data.dataset import ViewDataset
from learn3d.data.sampling import shuffled_epochs
from learn3d.runs import checkpoint
from learn3d.training import take_step, train

VANILLA = "peng2020-kato-vanilla"


def make_step(config: TrainConfig, data: ViewDataset, step=take_step):
    """Networks by name, and a function that takes one step with them."""
    method = make_method(config.settings)
    batch = data.batch(torch.tensor([0, 25, 50, 7]))
    return method.networks, lambda iteration: step(method, batch, iteration)


def test_alternation(tiny_config, tiny_set, tmp_path) -> None:
    networks, step = make_step(tiny_config(tmp_path), tiny_set)
    for iteration in (1, 2, 3):
        before = copy.deepcopy(networks)
        losses = step(iteration)
        odd = iteration % 2 == 1
        learnt = {"encoder", "generator"} | ({"discriminator"} if odd else set())
        assert changed(networks, before) == learnt
        assert ("classification" in losses, "confusion" in losses) == (odd, not odd)


def gradients(
    config: TrainConfig, data: ViewDataset, iteration: int
) -> dict[str, list[torch.Tensor]]:
    networks, step = make_step(config, data, backpropagate)
    step(iteration)
    return {
        name: [p.grad for p in n.parameters() if p.grad is not None] for name, n in networks.items()
    }


def test_classification_reaches_the_discriminator_and_confusion_the_encoder_only(
    tiny_config, tiny_set, tmp_path
) -> None:
    for iteration, weight, reached in (
        (1, "lambda_classification", []),
        (2, "lambda_adversarial", ["encoder"]),
    ):
        with_loss = gradients(tiny_config(tmp_path), tiny_set, iteration)
        without = gradients(tiny_config(tmp_path, **{weight: 0.0}), tiny_set, iteration)
        assert reached == [
            name
            for name in ("encoder", "generator")
            if not all(map(torch.equal, with_loss[name], without[name]))
        ]
        assert bool(with_loss["discriminator"]) == (iteration == 1)
        assert not without["discriminator"]
    networks, step = make_step(tiny_config(tmp_path, preset=VANILLA), tiny_set)
    assert "discriminator" not in networks
    assert set(step(1)) == {"projection", "smoothness", "total"}


def test_printed_losses_differ_from_those_of_the_published_code(
    tiny_config, tiny_set, tmp_path
) -> None:
    printed = tiny_config(tmp_path, adversarial_form="probability", prior_form="norm")
    a, b = (make_step(config, tiny_set)[1](2) for config in (tiny_config(tmp_path), printed))
    assert {name for name in a if a[name] != b[name]} == {"confusion", "prior", "total"}


@pytest.mark.parametrize(("samples", "batch"), [(24, 5), (24, 24), (7, 20)])
def test_batches_go_through_every_epoch_completely(samples: int, batch: int) -> None:
    def draw(seed: int) -> torch.Tensor:
        steps = range(1, 3 * samples + 1)
        return torch.cat([shuffled_epochs(samples, batch, seed=seed, step=step) for step in steps])

    drawn = draw(0)
    epochs = drawn.reshape(-1, samples)
    assert torch.equal(epochs.sort(dim=1).values, torch.arange(samples).expand_as(epochs))
    assert len(drawn) == 3 * samples * batch and not torch.equal(epochs[0], epochs[1])
    assert torch.equal(drawn, draw(0)) and not torch.equal(drawn, draw(1))


def test_a_finished_run_leaves_everything(finished_run, read_metrics) -> None:
    names = {path.name for path in finished_run.iterdir()}
    assert {"config.json", "last.safetensors", "best.safetensors"} < names
    metrics = read_metrics(finished_run)
    assert [m["step"] for m in metrics] == [1, 2, 3, 4, 4]
    assert [m["split"] for m in metrics] == ["train"] * 4 + ["val"]
    assert "confusion" in metrics[1]
    assert 0 <= metrics[-1]["voxel_iou"] <= 1
    assert "mmd" not in metrics[-1], (
        "four images of one object: a code per view, which is none to compare"
    )
    assert (finished_run / "pictures" / "000004.png").stat().st_size > 1000
    assert list((finished_run / "tensorboard").iterdir())


def test_a_second_interrupt_does_not_wait(tiny_config, run_folder, monkeypatch) -> None:
    def twice(*arguments):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(training, "take_step", twice)
    with pytest.raises(KeyboardInterrupt):
        train(tiny_config(run_folder, preset=VANILLA))


def other_images(dataset: ViewDataset) -> ViewDataset:
    images = dataset.images.copy()
    images[20, 0, 30, 30] ^= 1
    return dataclasses.replace(dataset, images=images)


def other_poses(dataset: ViewDataset) -> ViewDataset:
    poses = dataclasses.replace(dataset.poses, azimuth_deg=dataset.poses.azimuth_deg + 1)
    return dataclasses.replace(dataset, poses=poses)


#: What differs from the run, and what is said; functions change its data.
REFUSED = {
    "cannot resume with different options .*learning_rate": {"learning_rate": 1e-3},
    "has taken 4 steps, more than the 3 asked for": {"iterations": 3},
    "precision: 'fp32' in the run, 'bf16' asked for": {"precision": "bf16"},
    "other training data: 72 images with the CRC-32": other_images,
    "other training data: 72 images with the CRC": other_poses,
    r"was trained on data of .*inverted=True.*, these are .*inverted=False": (
        lambda dataset: dataclasses.replace(dataset, inverted=not dataset.inverted)
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_resume_refuses_other_options_and_data(
    tiny_config, finished_run, monkeypatch, message: str
) -> None:
    change = REFUSED[message]
    if callable(change):
        load = training.load_data
        monkeypatch.setattr(training, "load_data", lambda *what: change(load(*what)))
    options = {} if callable(change) else change
    with pytest.raises(ValueError, match=message):
        train(tiny_config(finished_run, **options), resume=True)


def test_resume_finds_its_data_in_another_folder(
    tiny_config, tiny_folder, finished_run, tmp_path
) -> None:
    shutil.copytree(tiny_folder, tmp_path / "moved")

    def times() -> dict[Path, int]:
        return {p: p.stat().st_mtime_ns for p in finished_run.rglob("*") if p.is_file()}

    before = times()
    summary = train(tiny_config(finished_run, data=tmp_path / "moved"), resume=True)
    assert (summary.progress.step, summary.finished, summary.progress.best_step) == (4, True, 4)
    assert times() == before


def test_the_best_of_other_validation_images_is_forgotten(
    tiny_config, finished_run, tmp_path
) -> None:
    run = shutil.copytree(finished_run, tmp_path / "run")
    assert train(tiny_config(run), resume=True).progress.best_step > 0
    other = tiny_config(run, max_val_images=6)
    assert train(other, resume=True).progress.best_step == 0, "nothing was left to do"
    summary = train(dataclasses.replace(other, iterations=5), resume=True)
    assert (summary.progress.step, summary.progress.best_step) == (5, 5)


def test_resume_without_a_checkpoint(tiny_config, run_folder) -> None:
    with pytest.raises(ValueError, match="no checkpoint"):
        train(tiny_config(run_folder), resume=True)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"augment": ("crop",)}, "crop must be the first augmentation, and needs"),
        ({"preset": "peng2020-kato-vpl", "batch_size": 1}, "batches of at least 2, got 1"),
        (
            {"preset": "gadelha2017-kato", "encoder_from_step": 1, "elevation_deg": 20.0},
            "PrGAN needs images from 24",
        ),
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


def test_nan_loss_stops_before_the_step_and_names_the_last_checkpoint(
    tiny_config, run_folder, monkeypatch
) -> None:
    calls = []

    def loss(prediction, target):
        calls.append(0)
        return prediction.mean() * (float("nan") if len(calls) == 3 else 1)

    monkeypatch.setattr(nmr.losses, "soft_iou_loss", loss)
    config = tiny_config(run_folder, preset=VANILLA, checkpoint_every=2)
    with pytest.raises(
        FloatingPointError,
        match=r"not finite at iteration 3 \(projection nan.*last good checkpoint",
    ):
        train(config)
    tensors, metadata = checkpoint.load(run_folder / "last.safetensors")
    assert metadata.progress.step == 2
    assert all(bool(t.isfinite().all()) for t in tensors.values() if t.is_floating_point())


def test_empty_masks_are_said_and_nothing_but_empty_ones_refused(
    tiny_run, run_folder, tiny_set, monkeypatch, capsys
) -> None:
    images = tiny_set.images.copy()
    images[:5, 3] = 0
    changed = dataclasses.replace(tiny_set, images=images)
    monkeypatch.setattr(training, "load_data", lambda *_, **__: changed)
    train(tiny_run(run_folder, iterations=1))
    assert f"warning: 5 of {len(images)} test images have an empty mask" in capsys.readouterr().err
    images[:] = 0
    before = {path.name for path in run_folder.iterdir()}
    with pytest.raises(
        ValueError, match=f"all {len(images)} test images of airplane have an empty mask"
    ):
        train(tiny_run(run_folder, iterations=1), overwrite=True)
    assert {path.name for path in run_folder.iterdir()} == before


@pytest.mark.parametrize("preset", ["peng2020-kato", "peng2020-kato-vpl", "multi-view-kato"])
@pytest.mark.parametrize(("plane", "fixed"), [(37.5, True), (None, False)])
def test_symmetry_auto_is_the_plane_that_the_data_have(
    preset: str, plane: float | None, fixed: bool
) -> None:
    info = dataclasses.replace(INFO, mirror_plane_deg=plane)
    method = make_method(preset, info, symmetry="auto", generator="sphere-small")
    assert (method.generator.mirror is not None) == fixed


def test_the_plane_is_found_before_the_first_step_and_kept(
    tiny_config, run_folder, monkeypatch
) -> None:
    monkeypatch.setattr(training, "find_mirror_plane", lambda dataset: 37.5)
    train(tiny_config(run_folder, symmetry="auto"))
    method, config, metadata = checkpoint.load_method(run_folder / "best.safetensors")
    assert (config.settings.symmetry, metadata.info.mirror_plane_deg) == ("auto", 37.5)
    assert method.generator.mirror is not None


def test_symmetry_auto_without_poses_says_that_poses_are_missing(
    tiny_config, tiny_set, run_folder, monkeypatch
) -> None:
    unknown = dataclasses.replace(tiny_set, poses=None)
    monkeypatch.setattr(training, "load_data", lambda *_, **__: unknown)
    with pytest.raises(ValueError, match=r"has no poses; .* estimate them from its masks"):
        train(tiny_config(run_folder, symmetry="auto"))
