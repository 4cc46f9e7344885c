"""Losses on codes, logits and silhouettes against reference vectors and slow sums, values and gradients."""

from __future__ import annotations

import itertools

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from vectors import load_vector

from learn3d.evaluation import mean_mmd
from learn3d.losses import (
    domain_confusion_loss,
    gaussian_prior_loss,
    mmd,
    pose_classification_loss,
    silhouette_energy_distance,
)
from learn3d.networks.discriminators import pose_discriminator


def vector(name: str) -> dict[str, Tensor]:
    arrays = load_vector(name).items()
    return {key: torch.from_numpy(a) for key, a in arrays if a.dtype.kind in "fi"}


@pytest.fixture(scope="module")
def case() -> dict[str, Tensor]:
    return vector("loss_adversarial")


@pytest.fixture
def discriminator(case) -> torch.nn.Sequential:
    network = pose_discriminator(24)
    for i, layer in enumerate(m for m in network if isinstance(m, torch.nn.Linear)):
        layer.weight.data.copy_(case[f"W{i}"])
        layer.bias.data.copy_(case[f"b{i}"])
    return network


def close(actual: Tensor, expected: Tensor, tolerance: float = 2e-6) -> None:
    torch.testing.assert_close(
        actual, expected, rtol=0, atol=tolerance * float(expected.abs().max())
    )


@pytest.mark.parametrize("name", ["adv_code", "adv_paper", "prior_code", "prior_paper"])
def test_losses_on_codes(case, discriminator, name: str) -> None:
    losses = {
        "adv_code": lambda codes: domain_confusion_loss(discriminator(codes), "log"),
        "adv_paper": lambda codes: domain_confusion_loss(discriminator(codes), "probability"),
        "prior_code": lambda codes: gaussian_prior_loss(codes, "squared"),
        "prior_paper": lambda codes: gaussian_prior_loss(codes, "norm"),
    }
    codes = case["z"].clone().requires_grad_()
    loss = losses[name](codes)
    loss.backward()
    close(loss, case[name], 1e-5)
    close(codes.grad, case[f"grad_z_{name}"], 1e-5)
    if name == "adv_code":
        close(discriminator[-1].bias.grad, case["grad_b2_adv_code"], 1e-5)


def test_confusion_of_confident_and_of_uniform_logits(case) -> None:
    logits = case["logits"].clone().requires_grad_()
    loss = domain_confusion_loss(logits, "log")
    loss.backward()
    close(loss, case["adv_code_logits"])
    close(logits.grad, case["grad_logits_adv_code"])
    for form in ("log", "probability"):
        assert domain_confusion_loss(torch.full((2, 24), 3.0), form) < 1e-10


def test_pose_classification(case, discriminator) -> None:
    logits = discriminator(case["z"])
    close(torch.log_softmax(logits, dim=1), case["logp"])
    loss = pose_classification_loss(logits, case["labels"].long())
    loss.backward()
    close(loss, case["cls"])
    close(discriminator[-1].weight.grad, case["grad_W2_cls"])
    close(discriminator[-1].bias.grad, case["grad_b2_cls"])


@pytest.mark.parametrize("form", ["squared", "norm"])
def test_prior_of_zero_codes_has_the_gradient_zero(form: str) -> None:
    codes = torch.zeros(2, 5, requires_grad=True)
    gaussian_prior_loss(codes, form).backward()
    assert torch.equal(codes.grad, torch.zeros(2, 5))


def test_low_precision_inputs_give_float32_losses() -> None:
    logits, codes = torch.randn(2, 24).bfloat16(), torch.randn(2, 8).bfloat16()
    for loss in (
        domain_confusion_loss(logits, "log"),
        pose_classification_loss(logits, torch.tensor([0, 5])),
        gaussian_prior_loss(codes, "norm"),
    ):
        assert loss.dtype == torch.float32


def squared_distances(x: Tensor, y: Tensor) -> Tensor:
    return (x[:, None] - y).square().sum(2)


def mmd_of_views(x: Tensor, y: Tensor, name: str = "mmd") -> float:
    """The MMD between the codes of two views."""
    views = torch.cat([torch.zeros(len(x)), torch.ones(len(y))])
    return mean_mmd(torch.cat([x, y]), views, (name,))[name]


def test_mmd_vectors() -> None:
    case = vector("loss_mmd")
    source, target = (case[name].clone().requires_grad_() for name in ("source", "target"))
    pairs = ((source, source), (target, target), (source, target))
    value = mmd(*(squared_distances(*pair) for pair in pairs))
    value.backward()
    close(value, case["mmd"])
    close(source.grad, case["grad_source"], 1e-5)
    close(target.grad, case["grad_target"], 1e-5)
    different = mmd_of_views(case["source"], case["target"])
    assert different == pytest.approx(float(case["mmd"]), rel=1e-5)
    same = mmd_of_views(case["source"], case["source"])
    assert same == pytest.approx(float(case["mmd_same"]), abs=1e-6)


def test_mmd_as_printed_equals_its_double_sum() -> None:
    generator = torch.Generator().manual_seed(0)
    x, y = torch.randn(5, 3, generator=generator), torch.randn(5, 3, generator=generator) + 1
    both = torch.cat([x, y])
    bandwidth = squared_distances(both, both).sum() / (10 * 9)

    def mean_kernel(p: Tensor, q: Tensor) -> Tensor:
        return sum(torch.exp(-(a - b).square().sum() / bandwidth) for a in p for b in q) / 25

    expected = (mean_kernel(x, x) - 2 * mean_kernel(x, y) + mean_kernel(y, y)).sqrt()
    assert mmd_of_views(x, y, "mmd_paper") == pytest.approx(float(expected), rel=1e-5)
    for name in ("mmd", "mmd_paper"):
        assert mmd_of_views(torch.ones(4, 3), torch.ones(4, 3), name) == 0


def test_energy_distance_equals_its_sum() -> None:
    generator = torch.Generator().manual_seed(0)
    drawn, real = (torch.rand(n, 20, generator=generator, dtype=torch.float64) for n in (4, 3))
    drawn.requires_grad_()

    def distance(a: Tensor, b: Tensor) -> Tensor:
        return 1 - a @ b / (a @ a + b @ b - a @ b)

    across = torch.stack([distance(p, t) for p in drawn for t in real]).mean()
    within = torch.stack([distance(p, q) for p, q in itertools.permutations(drawn, 2)]).mean()
    found, wanted = silhouette_energy_distance(drawn, real), 2 * across - within
    torch.testing.assert_close(found, wanted)
    gradients = [torch.autograd.grad(value, drawn, retain_graph=True) for value in (found, wanted)]
    torch.testing.assert_close(*gradients)


def test_energy_distance_is_least_for_the_same_distribution() -> None:
    """Two kinds of masks, half and half: copies of the mean, of one kind, or of other shares are all farther away."""
    kinds = torch.stack([F.pad(torch.ones(8), (0, 8)), F.pad(torch.ones(12), (4, 0))])
    real = kinds.repeat(50, 1)
    same = silhouette_energy_distance(real, real)
    for other in (
        kinds.mean(0).repeat(100, 1),
        kinds[:1].repeat(100, 1),
        kinds[[0, 0, 0, 1]].repeat(25, 1),
    ):
        assert silhouette_energy_distance(other, real) > same + 0.01
    empty = torch.zeros(3, 9, requires_grad=True)
    loss = silhouette_energy_distance(empty, torch.zeros(2, 9))
    assert loss == 0
    assert torch.isfinite(torch.autograd.grad(loss, empty)[0]).all()
