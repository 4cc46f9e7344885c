"""Plus: the mask bank, its losses, mirror images, and the clamp to the cube."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from steps import INFO, TINY, make_method

import nmr
from learn3d.config import differences
from learn3d.data.conventions import KATO
from learn3d.data.dataset import DatasetInfo
from learn3d.losses import silhouette_energy_distance
from learn3d.methods.optimization import TrainingSchedule
from learn3d.methods.plus import MaskBank, Plus, PlusSettings
from learn3d.networks.generators import SmoothSphereGenerator, SphereGenerator
from learn3d.training import take_step

SMALL = PlusSettings(**TINY, bank_size=4)


def make(plane: float | None = None, **settings: object) -> Plus:
    return make_method(SMALL, dataclasses.replace(INFO, mirror_plane_deg=plane), **settings)


@pytest.fixture
def batch(tiny_set):
    return tiny_set.batch(torch.tensor([0, 25, 48, 24]))  # views 0, 1, 0, 0


def test_the_mask_bank_keeps_the_newest() -> None:
    bank = MaskBank(5)
    assert not bank.full
    masks = torch.eye(7, 1024)
    bank.add(masks[:3], torch.tensor([0, 1, 0]))
    assert not bank.full
    assert torch.equal(bank.of_view(0), masks[[0, 2]])
    bank.add(masks[3:], torch.tensor([1, 1, 2, 0]))
    assert bank.full
    assert bank.view_ids.tolist() == [0, 1, 1, 2, 0]
    assert torch.equal(bank.of_view(1), masks[[3, 4]])


@pytest.mark.parametrize(("preset", "inside"), [("plus-kato", True), ("peng2020-kato", False)])
def test_shapes_end_at_the_box_where_it_is_known(preset: str, inside: bool) -> None:
    codes = 100 * torch.randn(8, 512, generator=torch.Generator().manual_seed(0))
    free, shapes, wide = (
        make_method(preset, dataclasses.replace(INFO, cube_side=side), **TINY).decode(codes)
        for side in (None, 1.0, 1.5)
    )
    assert (free.vertices.abs().amax((1, 2)) > 0.5).all()
    wanted = free.vertices.clamp(-0.499, 0.499) if inside else free.vertices
    assert torch.equal(shapes.vertices, wanted)
    assert KATO.exceeds_grid(shapes.vertices, "kato19").any() != inside
    assert (wide.vertices.abs().max() == 1.5 * 0.499) == inside


def test_shapes_are_compared_at_novel_views_beside_the_alternation(batch) -> None:
    method = make()
    first, second = take_step(method, batch, 1), take_step(method, batch, 2)
    assert {"projection", "smoothness", "prior", "classification", "novel_view"} <= set(first)
    assert {"confusion", "novel_view"} <= set(second)


@pytest.mark.parametrize(
    ("step", "loss", "trained"),
    [(1, "classification", {"discriminator"}), (2, "confusion", {"encoder"})],
)
def test_encoder_and_discriminator_learn_by_turns(batch, step, loss, trained) -> None:
    method = make()
    method.losses(batch, step)[loss][1].backward()
    found = {
        name
        for name, network in method.networks.items()
        if any(parameter.grad is not None for parameter in network.parameters())
    }
    assert found == trained


def test_azimuths_are_learnt_beside_the_shapes(batch) -> None:
    method, without = make(lambda_view=1.0), make()
    assert without.view_probabilities(batch.images) is None
    for step in range(1, 41):
        take_step(method, batch, step)
    found = method.view_probabilities(batch.images).argmax(1)
    assert torch.equal(found, ((batch.poses.azimuth_deg + 180) % 360 / 15).long())
    symmetric = make(90.0, lambda_view=1.0)
    loss = symmetric.losses(batch, 1)["view"][1]
    assert loss == symmetric.view_loss(batch.images, batch.poses), "of images that are not flipped"
    rotations = DatasetInfo(24, inverted=False, pose_features=9)
    with pytest.raises(ValueError, match="--lambda-view needs azimuths"):
        dataclasses.replace(SMALL, lambda_view=1.0).for_data(rotations)


def test_the_weight_of_the_smoothness_falls_over_the_run(batch) -> None:
    weights = {"lambda_smooth": 1e-2, "lambda_smooth_end": 1e-4}
    method = make_method(SMALL, schedule=TrainingSchedule(iterations=5), **weights)
    weights = [method.losses(batch, step)["smoothness"][0] for step in (1, 3, 5, 6)]
    assert weights == pytest.approx([1e-2, 1e-3, 1e-4, 1e-4])
    constant = make(lambda_smooth=0.25, lambda_smooth_end=None)
    assert constant.losses(batch, 5)["smoothness"][0] == 0.25


def test_the_loss_at_novel_views_waits_for_a_full_mask_bank(batch) -> None:
    method = make(bank_size=6)
    assert "novel_view" not in take_step(method, batch, 1)
    assert "novel_view" in take_step(method, batch, 2)
    without = make(lambda_novel_view=0.0)
    assert "mask_bank" not in without.networks
    assert "novel_view" not in take_step(without, batch, 1)


def test_the_loss_at_novel_views_moves_vertices_where_the_projection_does_not(batch) -> None:
    method = make()
    method.novel_view_loss(0.5 * method.generator.sphere.expand(4, -1, -1), batch)
    vertices = (0.5 * method.generator.sphere).repeat(4, 1, 1).requires_grad_()
    loss = method.novel_view_loss(vertices, batch)["novel_view"][1]
    (gradient,) = torch.autograd.grad(loss, vertices)
    assert torch.isfinite(gradient).all()
    assert gradient.abs().sum() > 0


def test_silhouettes_at_a_novel_view_are_compared_with_masks_of_its_class(batch) -> None:
    def small(images: torch.Tensor) -> torch.Tensor:
        return F.avg_pool2d(images[:, None], 2).flatten(1)

    method, chosen = make(), set()
    vertices = (method.generator.sphere * torch.tensor([0.5, 0.3, 0.1])).repeat(4, 1, 1)
    method.novel_view_loss(vertices, batch)
    for seed in range(8):
        torch.manual_seed(seed)
        view = int(torch.randint(4, ()))
        torch.manual_seed(seed)
        found = method.novel_view_loss(vertices, batch)["novel_view"][1]
        drawn = small(method.render(vertices, batch.poses[torch.full((4,), view)]))
        masks = batch.masks[batch.view_ids == batch.view_ids[view]]
        torch.testing.assert_close(
            found, silhouette_energy_distance(drawn, small(masks)), atol=5e-3, rtol=0
        )
        chosen.add(int(batch.view_ids[view]))
    assert chosen == {0, 1}


def test_every_second_image_is_flipped_to_a_view_of_its_own_if_shapes_are_symmetric(
    batch, monkeypatch
) -> None:
    seen, pictures, original = [], [], Plus.losses_on_codes

    def losses_on_codes(self, codes, views, step):
        seen.append(views)
        return original(self, codes, views, step)

    monkeypatch.setattr(Plus, "losses_on_codes", losses_on_codes)
    for plane, flipped, views in ((90.0, [1, 3], [0, 25, 0, 24]), (None, [], [0, 1, 0, 0])):
        method, images = make(plane), batch.images.clone()
        images[flipped] = images[flipped].flip(3)
        method.predict = lambda given, predict=method.predict: (
            pictures.append(given) or predict(given)
        )
        take_step(method, batch, 1)
        assert seen.pop().tolist() == views
        assert torch.equal(pictures.pop(), images)


def test_an_image_and_its_mirror_image_have_one_code(batch) -> None:
    free, symmetric = make(None), make(90.0)
    with torch.no_grad():
        torch.testing.assert_close(
            symmetric.encode(batch.images), symmetric.encode(batch.images.flip(3))
        )
        assert not torch.equal(free.encode(batch.images), free.encode(batch.images.flip(3)))


def test_the_length_of_a_run_whose_smoothness_falls_is_kept(tiny_config, tmp_path) -> None:
    config = tiny_config(tmp_path, preset="plus-kato", lr_schedule="constant", iterations=6)
    assert differences(dataclasses.replace(config, iterations=7), config) == [
        "iterations: 6 in the run, 7 asked for (lambda_smooth_end depends on it)"
    ]


def test_compact_objects_get_the_smooth_sphere_and_a_small_area(tiny_set) -> None:
    """A square fills its hull, a cross two thirds or less; empty masks say nothing."""
    images = np.zeros((3, 4, 64, 64), np.uint8)
    images[0, 3, 10:50, 10:50] = 255
    square = dataclasses.replace(tiny_set.select(np.arange(3)), images=images)
    assert square.solidity() == 1.0
    images[0, 3] = 0
    assert square.solidity() == 0.0
    images[0, 3, 28:36, 4:60] = images[0, 3, 4:60, 28:36] = 255
    assert 0.3 < square.solidity() < 0.67
    for solidity, kind, weight in (
        (0.9, SmoothSphereGenerator, 0.03),
        (0.6, SphereGenerator, 0.0),
        (None, SphereGenerator, 0.0),
    ):
        info = dataclasses.replace(INFO, solidity=solidity)
        method = make_method(SMALL, info, generator="auto")
        assert type(method.generator) is kind and method.settings.lambda_area == weight
    method = make_method(SMALL, generator="auto", lambda_area=0.5)
    vertices = method.generator(torch.zeros(2, 512))
    weight, area = method.surface_losses(vertices, 1)["area"]
    assert weight == 0.5
    torch.testing.assert_close(area, nmr.losses.area_loss(vertices, method.faces))
