"""View prior learning: all forms learn, and each step trains the right side with the right gradient."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import tiny_networks
import torch
import torch.nn.functional as F
from steps import backpropagate, make_method

import nmr
from learn3d.data.conventions import KATO
from learn3d.data.dataset import Batch, DatasetInfo, ViewDataset
from learn3d.data.poses import LookAtPoses, RotationPoses
from learn3d.losses import silhouette_pyramid_loss
from learn3d.methods.vpl import VPL, VPLSettings, other_views
from learn3d.networks.generators import GENERATORS, ConvCubeGenerator, LinearCubeGenerator
from learn3d.presets import PRESETS
from learn3d.training import take_step

REIMPLEMENTED = VPLSettings(discriminator_channels=8, lambda_discriminator=0.1, learning_rate=1e-3)
SMALL = {
    "image_size": 32,
    "silhouette_size": 64,
    "discriminator_channels": 8,
    "learning_rate": 2e-3,
}
SHAPENET = replace(PRESETS["kato2019-kar"].settings, **SMALL)
SHAPENET_CLASS = replace(SHAPENET, class_conditional=True, lambda_discriminator=0.2)
PASCAL = replace(
    PRESETS["kato2019-pascal"].settings, **SMALL, encoder="preact-resnet18", object_scale=0.6
)
FORMS = {
    "reimplemented": REIMPLEMENTED,
    "shapenet": SHAPENET,
    "class": SHAPENET_CLASS,
    "pascal": PASCAL,
}
SHAPE = DatasetInfo(num_views=3, inverted=False, num_classes=2)


@pytest.fixture(autouse=True)
def narrow_networks(monkeypatch) -> None:
    """The published widths are tested in test_networks; a step takes a second with them."""
    tiny_networks.put_in_place(monkeypatch)
    monkeypatch.setitem(GENERATORS, "cube-conv", partial(ConvCubeGenerator, channels=64))
    monkeypatch.setitem(GENERATORS, "cube-fc", partial(LinearCubeGenerator, channels=128))


def make_batch(image_size: int, count: int = 2, rotations: bool = False) -> Batch:
    """Boxy ellipsoids at two views, of two categories."""
    sphere, faces = nmr.icosphere(2)
    sizes = torch.tensor([[0.4, 0.2, 0.2], [0.2, 0.4, 0.3], [0.3, 0.3, 0.3], [0.1, 0.3, 0.4]])
    poses = LookAtPoses(torch.tensor([30.0, 120.0, 30.0, 250.0])[:count], 30.0, 2.732, 15.0)
    if rotations:
        random = torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(0))
        poses = RotationPoses(torch.linalg.qr(random)[0])
    vertices = sphere * sizes[:count, None]
    images, masks = (
        255 * nmr.render_silhouette(vertices, faces, poses.cameras(), image_size=size)
        for size in (image_size, 64)
    )
    colors = images[:, None] * torch.tensor([0.3, 0.6, 0.9])[:, None, None]
    return ViewDataset(
        category="a,b",
        split="train",
        images=torch.cat([colors, images[:, None]], dim=1).byte().numpy(),
        poses=poses,
        view_ids=np.array([0, 1, 0, 2])[:count],
        view_names=("0", "1", "2"),
        object_ids=np.arange(count),
        object_names=tuple("abcd"[:count]),
        voxels=None,
        convention=KATO,
        inverted=True,
        masks=masks.byte().numpy(),
        class_ids=np.array([0, 1, 0, 0])[:count],
        class_names=("a", "b"),
    ).batch(torch.arange(count))


def create(settings: VPLSettings, **shape: int) -> VPL:
    return make_method(settings, replace(SHAPE, **shape))


def state_of(network: torch.nn.Module) -> dict[str, torch.Tensor]:
    return copy.deepcopy(network.state_dict())


def generator_parameters(*methods: VPL) -> zip[tuple[torch.nn.Parameter, ...]]:
    """Each parameter of the generators, of all methods together."""
    return zip(*(method.generator.parameters() for method in methods), strict=True)


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize("form", FORMS)
def test_a_few_steps_lower_the_projection_loss(form: str) -> None:
    settings = FORMS[form]
    rotations = form == "pascal"
    method = create(settings, pose_features=9 if rotations else 3)
    batch = make_batch(settings.image_size, rotations=rotations)
    steps = 20 if form == "reimplemented" else 14
    losses = [take_step(method, batch, step)["projection"] for step in range(1, steps + 1)]
    assert losses[-1] < 0.8 * losses[0], losses
    meshes = method.decode(method.encode(batch.images))
    assert meshes.vertices.shape == (2, 642 if form == "reimplemented" else 1352, 3)


def test_alternating_steps_train_one_side() -> None:
    method = create(REIMPLEMENTED)
    batch = make_batch(64)
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
    method = create(REIMPLEMENTED)
    baseline = create(replace(REIMPLEMENTED, lambda_discriminator=0.0))
    assert "discriminator" not in baseline.networks
    batch = make_batch(64)
    losses, plain = backpropagate(method, batch, 1), backpropagate(baseline, batch, 1)
    assert plain.keys() == {"projection", "smoothness"}
    assert losses["projection"][1] == plain["projection"][1]
    for own, other in generator_parameters(method, baseline):
        torch.testing.assert_close(own.grad, other.grad)


def test_even_steps_pull_the_other_view_towards_real() -> None:
    """The gradient of an even step is that of projection + smoothness + lambda_D BCE(D(other view), 1)."""
    batch = make_batch(64)
    baseline = create(replace(REIMPLEMENTED, lambda_discriminator=0.0))
    method = create(REIMPLEMENTED)
    backpropagate(baseline, batch, 2)
    weight, loss = backpropagate(method, batch, 2)["adversarial"]
    adversary = create(REIMPLEMENTED)
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


def test_reversal_gives_shapes_minus_lambda_times_and_the_discriminator_all() -> None:
    """Gradients of one joint step, against the discrimination loss written out and differentiated plainly."""
    batch = make_batch(32)
    plain = create(SHAPENET)
    images = batch.images.float() / 255
    vertices = plain.generator(plain.encoder(images))
    renderer = {"anti_aliasing": False, "gradient": "local"}
    views = (batch.poses, batch.poses[torch.tensor([1, 0])])
    silhouettes = [
        nmr.render_silhouette(
            vertices, plain.generator.faces, poses.cameras(), image_size=64, **renderer
        )
        for poses in views
    ]
    logits = [
        plain.discriminator(s, poses.features())
        for s, poses in zip(silhouettes, views, strict=True)
    ]
    loss = F.softplus(-logits[0]).mean() + F.softplus(logits[1]).mean()
    weights = [p for p in plain.discriminator.parameters() if p.requires_grad]
    *of_weights, of_real, of_fake = torch.autograd.grad(
        loss, [*weights, *silhouettes], retain_graph=True
    )
    projection = silhouette_pyramid_loss(silhouettes[0], batch.masks)
    (of_projection,) = torch.autograd.grad(projection, silhouettes[0], retain_graph=True)
    pressure = 1e-4 * nmr.losses.inflation_loss(vertices, plain.generator.faces)

    for factor in (0.1, 0.7):
        method = create(replace(SHAPENET, lambda_discriminator=factor))
        losses = backpropagate(method, batch, 1)
        assert losses.keys() == {"projection", "inflation", "discrimination"}
        assert losses["discrimination"][1].item() == pytest.approx(loss.item(), rel=1e-4)
        own = [p.grad for p in method.discriminator.parameters() if p.requires_grad]
        torch.testing.assert_close(own, list(of_weights), rtol=1e-3, atol=1e-5)
        # The renderer's gradient is not linear in that of the images (only pixels that lower the loss pull): sum first.
        of_results = [of_projection - factor * of_real, -factor * of_fake, torch.ones(())]
        (expected,) = torch.autograd.grad(
            [*silhouettes, pressure], plain.generator.base, of_results, retain_graph=True
        )
        torch.testing.assert_close(
            method.generator.base.grad, expected, rtol=1e-3, atol=1e-4 * expected.abs().max()
        )


def test_other_views_are_random_ones_of_another_class() -> None:
    batch = make_batch(32, 4)
    torch.manual_seed(0)
    drawn = torch.stack([other_views(batch, "random") for _ in range(200)])
    assert (batch.view_ids[drawn] != batch.view_ids).all()
    assert set(drawn[:, 0].tolist()) == {1, 3}
    counts = torch.bincount(drawn[:, 1], minlength=4)
    assert counts[1] == 0
    assert (counts[[0, 2, 3]] > 40).all()  # 200 / 3 expected
    torch.manual_seed(0)
    assert torch.equal(other_views(batch, "random"), drawn[0])
    alike = replace(batch, view_ids=torch.zeros(4, dtype=torch.int64))
    assert other_views(alike, "random").max() < 4


def test_other_views_as_published() -> None:
    batch = make_batch(32, 4)  # categories 0, 1, 0, 0
    assert other_views(batch, "reversed").tolist() == [3, 2, 1, 0]
    assert other_views(batch, "next").tolist() == [2, 1, 3, 0]


def test_input_mask_is_the_target_at_its_size() -> None:
    settings = replace(SHAPENET, image_size=96, silhouette_size=96, lambda_discriminator=0.0)
    batch = make_batch(96)
    wrong = replace(batch, masks=torch.zeros(2, 64, 64))
    losses = [take_step(create(settings), b, 1)["projection"] for b in (batch, wrong)]
    assert losses[0] == losses[1]
    # 25 / 255 is below 0.1
    faint = replace(batch, images=torch.where(batch.images == 0, 25, batch.images))
    method = create(settings)
    method.predict = lambda images: VPL.predict(method, batch.images)
    assert take_step(method, faint, 1)["projection"] == losses[0]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"image_size": 224}, "encoder 'conv' takes images of 64 pixels, got image_size 224"),
        (
            {"encoder": "resnet18", "image_size": 100},
            "must be a multiple of 32 for encoder 'resnet18', got 100",
        ),
        ({"silhouette_size": 128}, r"silhouette_size must be 64, .* or image_size \(64\), got 128"),
        (
            {"pretrained": "weights.pth"},
            "weights are for the encoder 'resnet18', got encoder 'conv'",
        ),
        (
            {"class_conditional": True},
            "class_conditional needs discriminator 'spectral-patch', got 'dcgan'",
        ),
    ],
)
def test_settings_that_contradict_each_other_are_refused(
    settings: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        VPLSettings(**settings)


def test_data_that_do_not_fit_the_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="needs data of several categories, got one"):
        create(SHAPENET_CLASS, num_classes=1)
    with pytest.raises(ValueError, match="tells views by their class and needs at least 2, got 1"):
        create(VPLSettings(), num_views=1)
    settings = replace(SHAPENET, image_size=64)
    with pytest.raises(ValueError, match="batches of at least 2, got 1"):
        settings.check_run(iterations=1, batch_size=1)
    baseline = replace(settings, lambda_discriminator=0.0)
    baseline.check_run(iterations=1, batch_size=1)
    assert "projection" in take_step(create(baseline), make_batch(64, 1), 1)
