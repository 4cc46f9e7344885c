"""View prior learning: it learns, and each step trains the right side with the right gradient."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import tiny_networks
import torch
import torch.nn.functional as F
from steps import backpropagate, make_method

import nmr
from learn3d.data.dataset import Batch, DatasetInfo
from learn3d.data.poses import LookAtPoses
from learn3d.methods.vpl import VPL, VPLSettings, other_views
from learn3d.training import take_step

SETTINGS = VPLSettings(discriminator_channels=8, lambda_discriminator=0.1, learning_rate=1e-3)
BASELINE = replace(SETTINGS, lambda_discriminator=0.0)


@pytest.fixture(autouse=True)
def narrow_networks(monkeypatch) -> None:
    """The published widths are tested in test_networks; a step takes a second with them."""
    tiny_networks.put_in_place(monkeypatch)


def make_batch(count: int = 2) -> Batch:
    """Ellipsoids at two views or more."""
    sphere, faces = nmr.icosphere(2)
    sizes = torch.tensor([[0.4, 0.2, 0.2], [0.2, 0.4, 0.3], [0.3, 0.3, 0.3], [0.1, 0.3, 0.4]])
    poses = LookAtPoses(torch.tensor([30.0, 120.0, 30.0, 250.0])[:count], 30.0, 2.732, 15.0)
    masks = nmr.render_silhouette(
        sphere * sizes[:count, None], faces, poses.cameras(), image_size=64
    )
    images = (255 * masks[:, None] * torch.tensor([0.3, 0.6, 0.9, 1.0])[:, None, None]).byte()
    views = torch.tensor([0, 1, 0, 2])[:count]
    return Batch(images, masks, poses, views, torch.arange(count), 0 * views, None)


def create(settings: VPLSettings, num_views: int = 3) -> VPL:
    return make_method(settings, DatasetInfo(num_views, inverted=False))


def state_of(network: torch.nn.Module) -> dict[str, torch.Tensor]:
    return copy.deepcopy(network.state_dict())


def generator_parameters(*methods: VPL) -> zip[tuple[torch.nn.Parameter, ...]]:
    """Each parameter of the generators, of all methods together."""
    return zip(*(method.generator.parameters() for method in methods), strict=True)


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


def test_a_few_steps_lower_the_projection_loss() -> None:
    method, batch = create(SETTINGS), make_batch()
    losses = [take_step(method, batch, step)["projection"] for step in range(1, 21)]
    assert losses[-1] < 0.8 * losses[0], losses
    assert method.decode(method.encode(batch.images)).vertices.shape == (2, 642, 3)


def test_alternating_steps_train_one_side() -> None:
    method, batch = create(SETTINGS), make_batch()
    before, encoder = state_of(method.discriminator), state_of(method.encoder)
    losses = take_step(method, batch, 1)
    assert losses.keys() == {"projection", "smoothness", "discrimination", "total"}
    after = state_of(method.discriminator)
    assert not any(torch.equal(before[name], after[name]) for name in before if "bias" not in name)
    assert not same(encoder, state_of(method.encoder))

    encoder = state_of(method.encoder)
    losses = take_step(method, batch, 2)
    assert losses.keys() == {"projection", "smoothness", "adversarial", "total"}
    assert same(after, state_of(method.discriminator))  # running averages too
    assert not same(encoder, state_of(method.encoder))
    backpropagate(method, batch, 2)
    assert all(parameter.grad is None for parameter in method.discriminator.parameters())


def test_odd_steps_move_shapes_as_without_a_discriminator() -> None:
    method, baseline = create(SETTINGS), create(BASELINE)
    assert "discriminator" not in baseline.networks
    batch = make_batch()
    losses, plain = backpropagate(method, batch, 1), backpropagate(baseline, batch, 1)
    assert plain.keys() == {"projection", "smoothness"}
    assert losses["projection"][1] == plain["projection"][1]
    for own, other in generator_parameters(method, baseline):
        torch.testing.assert_close(own.grad, other.grad)


def test_odd_steps_tell_the_input_view_from_another() -> None:
    batch, method, copied = make_batch(), create(SETTINGS), create(SETTINGS)
    loss = method.losses(batch, 1)["discrimination"][1]
    vertices, logits = copied.predict(batch.images)[1], []
    for views in (torch.tensor([0, 1]), torch.tensor([1, 0])):
        drawn = copied.render(vertices, batch.poses[views])
        logits.append(copied.discriminator(drawn, batch.view_ids[views]))
    wanted = F.softplus(-logits[0]).mean() + F.softplus(logits[1]).mean()
    assert loss.item() == pytest.approx(wanted.item(), rel=1e-5)


def test_even_steps_pull_the_other_view_towards_real() -> None:
    """The gradient of an even step is that of projection + smoothness + lambda_D BCE(D(other view), 1)."""
    batch = make_batch()
    baseline, method, adversary = create(BASELINE), create(SETTINGS), create(SETTINGS)
    backpropagate(baseline, batch, 2)
    weight, loss = backpropagate(method, batch, 2)["adversarial"]
    vertices = adversary.generator(adversary.encoder(batch.images.float() / 255))
    others = torch.tensor([1, 0])  # the only other view of each
    fake = nmr.render_silhouette(
        vertices, adversary.generator.faces, batch.poses[others].cameras(), image_size=64
    )
    logits = adversary.discriminator(fake, batch.view_ids[others])
    adversarial = F.binary_cross_entropy_with_logits(logits, torch.ones(2))
    assert weight == 0.1 and loss.item() == pytest.approx(adversarial.item(), rel=1e-4)
    (0.1 * adversarial).backward()
    for full, plain, expected in generator_parameters(method, baseline, adversary):
        difference = (full.grad - plain.grad - expected.grad).norm()
        assert difference < 1e-3 * expected.grad.norm()


def test_other_views_are_random_ones_of_another_class() -> None:
    view_ids = make_batch(4).view_ids
    torch.manual_seed(0)
    drawn = torch.stack([other_views(view_ids) for _ in range(200)])
    assert (view_ids[drawn] != view_ids).all()
    assert set(drawn[:, 0].tolist()) == {1, 3}
    counts = torch.bincount(drawn[:, 1], minlength=4)
    assert counts[1] == 0
    assert (counts[[0, 2, 3]] > 40).all()  # 200 / 3 expected
    torch.manual_seed(0)
    assert torch.equal(other_views(view_ids), drawn[0])
    assert other_views(torch.zeros(4, dtype=torch.int64)).max() < 4


def test_data_that_do_not_fit_the_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="tells views by their class and needs at least 2, got 1"):
        create(SETTINGS, num_views=1)
    with pytest.raises(ValueError, match="batches of at least 2, got 1"):
        SETTINGS.check_run(iterations=1, batch_size=1)
    BASELINE.check_run(iterations=1, batch_size=1)
    assert "projection" in take_step(create(BASELINE), make_batch(1), 1)
