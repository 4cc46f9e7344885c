"""PrGAN: each step moves its network, the switch to the encoder, the place of voxels, and refused cameras."""

from __future__ import annotations

import copy
import dataclasses

import pytest
import torch
from steps import changed, make_method
from torch import Tensor, nn

import nmr
from learn3d.data.conventions import KATO
from learn3d.data.dataset import Batch, DatasetInfo
from learn3d.data.poses import LookAtPoses, RotationPoses
from learn3d.methods.prgan import PrGAN, PrGANSettings, statistics_loss
from learn3d.networks.voxel_gan import SHAPE_CODE, TAU
from learn3d.training import take_step

VIEWS = 4
SMALL = {"generator_channels": (4, 4, 2, 1), "discriminator_channels": (4, 4, 4, 8)}


def small_prgan(**settings: object) -> PrGAN:
    return make_method(PrGANSettings(**SMALL | settings), DatasetInfo(VIEWS, inverted=False))


def make_batch(count: int = 3, poses: LookAtPoses | RotationPoses | None = None) -> Batch:
    views = torch.arange(count) % VIEWS
    masks = torch.zeros(count, 64, 64)
    for i in range(count):
        masks[i, 20 + 3 * i : 44, 16:48] = 1
    poses = poses or LookAtPoses(-360.0 / VIEWS * views, 30.0, 2.732, 15.0)
    images = torch.zeros(count, 4, 64, 64, dtype=torch.uint8)
    images[:, 3] = (255 * masks).to(torch.uint8)
    return Batch(images, masks, poses, views, torch.arange(count), 0 * views, None)


def test_every_view_is_drawn_from_an_equal_share_of_v() -> None:
    method = small_prgan()
    z = torch.zeros(800, SHAPE_CODE + 1)
    z[:, -1] = torch.linspace(-1, 1, 801)[:-1]
    ids = method.view_ids(z)
    assert torch.equal(ids, ((z[:, -1] + 1) * VIEWS / 2).floor().long())
    assert ids.bincount().tolist() == [200] * VIEWS
    assert int(method.view_ids(torch.ones(1, SHAPE_CODE + 1))) == VIEWS - 1


def test_every_optimizer_has_its_published_numbers() -> None:
    rates = {"generator": 0.3, "discriminator": 0.2, "encoder": 0.1}
    method = small_prgan(**{f"{name}_learning_rate": rate for name, rate in rates.items()})
    found = {
        name: (optimizer.param_groups[0]["lr"], optimizer.param_groups[0]["betas"][0])
        for name, optimizer in method.optimizers.items()
    }
    assert found == {
        "generator": (0.3, 0.5),
        "generator_statistics": (0.3, 0.5),
        "discriminator": (0.2, 0.5),
        "encoder": (0.1, 0.9),
    }


@pytest.mark.parametrize(
    ("name", "network", "step"),
    [
        ("generator", "generator", 1),
        ("generator_statistics", "generator", 1),
        ("discriminator", "discriminator", 1),
        ("encoder", "encoder", 2),
    ],
)
def test_each_step_changes_its_network_only(
    monkeypatch: pytest.MonkeyPatch, name: str, network: str, step: int
) -> None:
    method = small_prgan(encoder_from_step=2)
    for other, optimizer in method.optimizers.items():
        if other != name:
            monkeypatch.setattr(optimizer, "step", lambda: None)
    before = copy.deepcopy(method.networks)
    losses = take_step(method, make_batch(), step)
    assert name in losses
    assert changed(method.networks, before) == {network}
    if name == "encoder":  # the averages of the generator's batch norms stay, too
        state = before["generator"].state_dict()
        assert all(
            torch.equal(state[key], value) for key, value in method.generator.state_dict().items()
        )


def test_discriminator_rests_while_it_is_too_good(monkeypatch: pytest.MonkeyPatch) -> None:
    method = small_prgan()
    for accuracy, rests in ((0.81, True), (0.79, False)):
        monkeypatch.setattr(
            method, "accuracy", lambda real, z, value=accuracy: torch.tensor(value).double()
        )
        before = copy.deepcopy(method.networks)
        losses = take_step(method, make_batch(), 1)
        assert ("discriminator" in losses) is not rests
        assert changed(method.networks, before) == (
            {"generator"} if rests else {"generator", "discriminator"}
        )


def test_accuracy_is_the_mean_probability_of_being_right(monkeypatch: pytest.MonkeyPatch) -> None:
    method, batch = small_prgan(), make_batch(4)
    monkeypatch.setattr(method, "generate", lambda z: torch.zeros(len(z), 64, 64))
    # 3 and -1
    monkeypatch.setattr(method, "discriminator", lambda images: 4 * images.amax((1, 2)) - 1)
    probability = float(torch.tensor([3.0, 1.0]).sigmoid().mean())
    assert float(method.accuracy(batch.masks, method.sample_z(4))) == pytest.approx(probability)


def test_statistics_are_means_and_variances_over_the_batch() -> None:
    real, fake = torch.tensor([[0.0, 1.0], [2.0, 1.0]]), torch.tensor([[0.0, 0.0], [0.0, 4.0]])
    of_means, of_variances = (1 - 0) ** 2 + (1 - 2) ** 2, (1 - 0) ** 2 + (0 - 4) ** 2
    assert float(statistics_loss(real, fake)) == of_means + of_variances


def test_encoder_learns_to_invert_a_fixed_generator(monkeypatch: pytest.MonkeyPatch) -> None:
    def bars(z: Tensor) -> Tensor:  # the last eight entries of z as the grey of eight bars
        return ((z[:, -8:] + 1) / 2).repeat_interleave(8, 1)[:, :, None].expand(-1, 64, 64)

    method = small_prgan(encoder_from_step=1, encoder_learning_rate=1e-3)
    monkeypatch.setattr(method, "generate", bars)
    batch = make_batch(32)
    for step in range(1, 41):
        losses = take_step(method, batch, step)
    assert set(losses) == {"encoder", "total"}
    z = method.sample_z(64)
    with torch.no_grad():
        error = (method.encoder(bars(z)) - z).square().mean(0)
    assert error[-8:].mean() < 0.4 / 3  # chance is the variance of U(-1, 1), 1 / 3
    assert error[:-8].mean() > 0.9 / 3  # nothing tells these


def test_voxels_lie_where_the_data_sets_voxels_do() -> None:
    vertices, faces = nmr.icosphere(3)
    vertices = vertices * torch.tensor([0.15, 0.2, 0.1]) + torch.tensor([0.3, 0.1, -0.25])
    truth = KATO.voxelize(vertices, faces)
    method = small_prgan()

    density = nmr.voxelize(vertices + 0.5, faces, size=64).float() / TAU
    method.generator = nn.Module()
    method.generator.forward = lambda codes: density.expand(len(codes), -1, -1, -1)
    grids = method.decode(torch.zeros(1, SHAPE_CODE))
    assert grids.occupancy.max() == 1
    assert grids.threshold == 0.1
    occupied = grids.occupied(32)
    assert float(nmr.metrics.voxel_iou(KATO.to_axes(occupied), truth)) > 0.7
    assert float(nmr.metrics.voxel_iou(occupied, truth)) < 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"azimuth_deg": torch.tensor([0.0, -90.0, -171.0])}, "camera of view 2 has azimuth -171"),
        ({"elevation_deg": torch.tensor([30.0, 31.0, 30.0])}, "elevation 31"),
        ({"distance": 2.0}, "view 0 has .*distance 2, "),
        ({"half_fov_deg": 25.0}, "half field of view 25"),
    ],
)
def test_other_cameras_are_refused(change: dict[str, object], message: str) -> None:
    poses = LookAtPoses(torch.tensor([0.0, 270.0, 180.0]), 30.0, 2.732, 15.0)
    with pytest.raises(ValueError, match=message):
        small_prgan().check_batch(make_batch(poses=dataclasses.replace(poses, **change)))


def test_rotations_are_refused() -> None:
    batch = make_batch(poses=RotationPoses(torch.eye(3).expand(3, 3, 3)))
    with pytest.raises(
        ValueError, match=r"view k at azimuth -90 k .*this data set gives rotations"
    ):
        small_prgan().check_batch(batch)
