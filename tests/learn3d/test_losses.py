"""Losses on codes and logits against reference vectors, values and gradients."""

from __future__ import annotations

import itertools

import pytest
import torch
from vectors import load_vector

from learn3d.losses import (
    domain_confusion_loss,
    gaussian_prior_loss,
    mmd,
    pose_classification_loss,
    silhouette_energy_distance,
    silhouette_pyramid_loss,
)
from learn3d.networks import PoseDiscriminator


@pytest.fixture(scope="module")
def case() -> dict[str, torch.Tensor]:
    return {k: torch.from_numpy(v) for k, v in load_vector("loss_adversarial").items() if v.dtype.kind in "fi"}


@pytest.fixture
def discriminator(case) -> PoseDiscriminator:
    network = PoseDiscriminator(24)
    for i, layer in enumerate(m for m in network.layers if isinstance(m, torch.nn.Linear)):
        layer.weight.data.copy_(case[f"W{i}"])
        layer.bias.data.copy_(case[f"b{i}"])
    return network


def close(actual: torch.Tensor, expected: torch.Tensor, tolerance: float = 2e-6) -> None:
    scale = float(expected.abs().max())
    torch.testing.assert_close(actual, expected, rtol=0, atol=tolerance * scale)


def test_discriminator_log_probabilities(case, discriminator) -> None:
    close(torch.log_softmax(discriminator(case["z"]), dim=1), case["logp"])


@pytest.mark.parametrize(("form", "name"), [("log", "adv_code"), ("probability", "adv_paper")])
def test_domain_confusion(case, discriminator, form: str, name: str) -> None:
    codes = case["z"].clone().requires_grad_()
    loss = domain_confusion_loss(discriminator(codes), form)
    loss.backward()
    close(loss, case[name], 1e-5)
    close(codes.grad, case[f"grad_z_{name}"], 1e-5)
    if form == "log":
        close(discriminator.layers[-1].bias.grad, case["grad_b2_adv_code"], 1e-5)


def test_domain_confusion_of_confident_logits(case) -> None:
    logits = case["logits"].clone().requires_grad_()
    loss = domain_confusion_loss(logits, "log")
    loss.backward()
    close(loss, case["adv_code_logits"])
    close(logits.grad, case["grad_logits_adv_code"])


def test_confusion_is_zero_for_uniform_output() -> None:
    for form in ("log", "probability"):
        assert domain_confusion_loss(torch.full((2, 24), 3.0), form) < 1e-10


def test_pose_classification(case, discriminator) -> None:
    loss = pose_classification_loss(discriminator(case["z"]), case["labels"].long())
    loss.backward()
    close(loss, case["cls"])
    close(discriminator.layers[-1].weight.grad, case["grad_W2_cls"])
    close(discriminator.layers[-1].bias.grad, case["grad_b2_cls"])


@pytest.mark.parametrize(("form", "name"), [("squared", "prior_code"), ("norm", "prior_paper")])
def test_gaussian_prior(case, form: str, name: str) -> None:
    codes = case["z"].clone().requires_grad_()
    loss = gaussian_prior_loss(codes, form)
    loss.backward()
    close(loss, case[name])
    close(codes.grad, case[f"grad_z_{name}"])


def test_prior_of_zero_codes_has_a_finite_gradient() -> None:
    for form in ("squared", "norm"):
        codes = torch.zeros(2, 5, requires_grad=True)
        gaussian_prior_loss(codes, form).backward()
        assert torch.equal(codes.grad, torch.zeros(2, 5))


def test_low_precision_inputs_give_float32_losses() -> None:
    logits, codes = torch.randn(2, 24).bfloat16(), torch.randn(2, 8).bfloat16()
    views = torch.tensor([0, 5])
    losses = [domain_confusion_loss(logits, "log"), pose_classification_loss(logits, views), mmd(codes, codes)]
    losses += [gaussian_prior_loss(codes, "norm")]
    assert all(loss.dtype == torch.float32 for loss in losses)


def test_mmd_vectors() -> None:
    case = {k: torch.from_numpy(v) for k, v in load_vector("loss_mmd").items() if v.dtype.kind == "f"}
    source, target = case["source"].clone().requires_grad_(), case["target"].clone().requires_grad_()
    value = mmd(source, target)
    value.backward()
    close(value, case["mmd"])
    close(source.grad, case["grad_source"], 1e-5)
    close(target.grad, case["grad_target"], 1e-5)
    assert float(mmd(source, source).detach()) == pytest.approx(float(case["mmd_same"]), abs=1e-6)
    close(mmd(case["source"], case["target"], bandwidth=10.0), case["mmd_fixed_sigma"])


def test_mmd_as_printed_equals_its_double_sum() -> None:
    generator = torch.Generator().manual_seed(0)
    x, y = torch.randn(5, 3, generator=generator), torch.randn(5, 3, generator=generator) + 1
    both = torch.cat([x, y])
    bandwidth = sum((a - b).square().sum() for a, b in itertools.permutations(both, 2)) / (10 * 9)

    def mean_kernel(p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        return sum(torch.exp(-(a - b).square().sum() / bandwidth) for a in p for b in q) / 25

    expected = (mean_kernel(x, x) - 2 * mean_kernel(x, y) + mean_kernel(y, y)).sqrt()
    torch.testing.assert_close(mmd(x, y, "paper"), expected)


def test_mmd_of_equal_codes_is_zero() -> None:
    codes = torch.ones(4, 3)
    assert float(mmd(codes, codes)) == 0
    assert float(mmd(codes, codes, "paper")) == 0


@pytest.mark.parametrize(
    "call",
    [
        lambda: domain_confusion_loss(torch.zeros(1, 2), "linear"),
        lambda: gaussian_prior_loss(torch.zeros(1, 2), "linear"),
        lambda: mmd(torch.zeros(2, 2), torch.zeros(2, 2), "linear"),
    ],
)
def test_unknown_form(call) -> None:
    with pytest.raises(ValueError, match=r"form must be .* got 'linear'"):
        call()


def test_mmd_refuses_unequal_sets() -> None:
    with pytest.raises(ValueError, match=r"must be \[N, C\] of one shape"):
        mmd(torch.zeros(2, 3), torch.zeros(4, 3))


def test_silhouette_pyramid_equals_its_sum() -> None:
    torch.manual_seed(0)
    prediction, target = torch.rand(3, 48, 48), (torch.rand(3, 48, 48) > 0.6).float()
    expected = 0.0
    for p, t in zip(prediction.tolist(), target.tolist(), strict=True):
        for _ in range(5):
            norms = [sum(v * v for row in image for v in row) ** 0.5 for image in (p, t)]
            pixels = zip(itertools.chain(*p), itertools.chain(*t), strict=True)
            expected += sum((a / norms[0] - b / norms[1]) ** 2 for a, b in pixels) / 3
            p, t = (
                [
                    [
                        (
                            image[2 * y][2 * x]
                            + image[2 * y][2 * x + 1]
                            + image[2 * y + 1][2 * x]
                            + image[2 * y + 1][2 * x + 1]
                        )
                        / 4
                        for x in range(len(image) // 2)
                    ]
                    for y in range(len(image) // 2)
                ]
                for image in (p, t)
            )
    assert float(silhouette_pyramid_loss(prediction, target)) == pytest.approx(expected, rel=1e-5)


def test_silhouette_pyramid_of_equal_and_of_empty_images() -> None:
    disc = ((torch.arange(64) - 32)[:, None] ** 2 + (torch.arange(64) - 32) ** 2 < 300).float()[None]
    empty = torch.zeros(1, 64, 64, requires_grad=True)
    assert float(silhouette_pyramid_loss(disc, disc)) == 0
    assert float(silhouette_pyramid_loss(disc / 2, disc)) == pytest.approx(0, abs=1e-10)  # of the shape, not the grey
    loss = silhouette_pyramid_loss(empty, disc)
    assert loss.item() == pytest.approx(5)
    loss.backward()
    assert torch.isfinite(empty.grad).all()


@pytest.mark.parametrize(
    ("prediction", "target", "message"),
    [
        (torch.rand(2, 16, 16), torch.rand(2, 32, 32), r"must be \[B, S, S\] of one shape"),
        (torch.rand(0, 16, 16), torch.rand(0, 16, 16), "with B >= 1"),
        (torch.rand(1, 8, 8), torch.rand(1, 8, 8), "5 levels need at least 16 pixels"),
    ],
)
def test_silhouette_pyramid_refuses(prediction, target, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        silhouette_pyramid_loss(prediction, target)


def test_energy_distance_equals_its_sum() -> None:
    generator = torch.Generator().manual_seed(0)
    drawn, real = (torch.rand(n, 20, generator=generator, dtype=torch.float64) for n in (4, 3))
    drawn.requires_grad_()

    def distance(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return 1 - a @ b / (a @ a + b @ b - a @ b)

    across = torch.stack([distance(p, t) for p in drawn for t in real]).mean()
    within = torch.stack([distance(p, q) for p, q in itertools.permutations(drawn, 2)]).mean()
    found = silhouette_energy_distance(drawn, real)
    torch.testing.assert_close(found, 2 * across - within)
    torch.testing.assert_close(
        torch.autograd.grad(found, drawn, retain_graph=True), torch.autograd.grad(2 * across - within, drawn)
    )


def test_energy_distance_is_least_for_the_same_distribution() -> None:
    """Two kinds of masks, half and half: copies of the mean, of one kind, or of other shares are all farther away."""
    kinds = torch.zeros(2, 16)
    kinds[0, :8], kinds[1, 4:] = 1, 1
    real = kinds.repeat(50, 1)
    same = silhouette_energy_distance(real, real)
    for other in (kinds.mean(0).repeat(100, 1), kinds[:1].repeat(100, 1), kinds[[0, 0, 0, 1]].repeat(25, 1)):
        assert silhouette_energy_distance(other, real) > same + 0.01


def test_energy_distance_of_empty_silhouettes() -> None:
    drawn = torch.zeros(3, 9, requires_grad=True)
    loss = silhouette_energy_distance(drawn, torch.zeros(2, 9))
    assert loss == 0
    (gradient,) = torch.autograd.grad(loss, drawn)
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize(("drawn", "real"), [((1, 4), (3, 4)), ((2, 4), (0, 4)), ((2, 4), (2, 5)), ((2, 2, 4), (2, 4))])
def test_energy_distance_refuses(drawn: tuple[int, ...], real: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="N >= 2"):
        silhouette_energy_distance(torch.zeros(drawn), torch.zeros(real))
