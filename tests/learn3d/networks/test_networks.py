"""All networks in tables: published sizes, shapes, dtypes, gradients; and the rules of encoders and generators."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from steps import INFO, make_method
from torch import Tensor, nn
from vectors import load_vector

from learn3d.methods import create_method
from learn3d.methods.method import Method
from learn3d.networks.discriminators import OneHotViewDiscriminator, pose_discriminator
from learn3d.networks.encoders import (
    CENTRED_SIZE,
    ENCODERS,
    EncoderName,
    ViewClassifier,
    centre,
    network_input,
)
from learn3d.networks.generators import GENERATORS, deform_sphere
from learn3d.networks.voxel_gan import InverseEncoder, SilhouetteDiscriminator, VoxelGenerator
from learn3d.presets import PRESETS

#: A published network, and how many numbers it learns: widths, kernels, biases and batch norms.
#: Strides and padding follow from the shapes of the table below.
PUBLISHED: dict[str, tuple[Callable[[], nn.Module], int]] = {
    "encoder": (ENCODERS["conv"], 19_383_488),
    "generator": (GENERATORS["sphere"], 6_570_886),
    "symmetric generator": (lambda: GENERATORS["sphere"]("z"), 4_630_483),
    "discriminator": (lambda: pose_discriminator(24), 167_320),
    "dcgan": (lambda: OneHotViewDiscriminator(24), 11_083_137),
    "voxels": (VoxelGenerator, 2_304_612),
    "silhouettes": (SilhouetteDiscriminator, 17_228_545),
    "inverse encoder": (InverseEncoder, 2_463_433),
}


def layers(network: nn.Module, *kinds: type[nn.Module]) -> list[nn.Module]:
    return [module for module in network.modules() if isinstance(module, kinds)]


@pytest.mark.parametrize("name", PUBLISHED)
def test_networks_have_the_published_size(name: str) -> None:
    create, learned = PUBLISHED[name]
    network = create()
    assert sum(p.numel() for p in network.parameters() if p.requires_grad) == learned
    assert {m.negative_slope for m in layers(network, nn.LeakyReLU)} <= {0.2}
    batch_norms = layers(network, nn.modules.batchnorm._BatchNorm)
    if create in (VoxelGenerator, SilhouetteDiscriminator, InverseEncoder):
        assert all(abs(m.weight.std() - 0.1) < 0.01 for m in layers(network, nn.Linear))
        assert all(m.momentum == 0.1 for m in batch_norms)


IMAGES, CODES, MASKS = (2, 4, 64, 64), (2, 512), (2, 64, 64)
SPHERES = (2, 642, 3)

#: A network of small width, the shapes of its inputs (an integer: classes below it), and of its output.
SMALL: dict[str, tuple[Callable[[], nn.Module], list, tuple[int, ...]]] = {
    **{name: (encoder, [IMAGES], CODES) for name, encoder in ENCODERS.items()},
    **{name: (generator, [CODES], SPHERES) for name, generator in GENERATORS.items()},
    "symmetric": (lambda: GENERATORS["sphere-small"](30.0), [CODES], SPHERES),
    "discriminator": (lambda: pose_discriminator(24), [CODES], (2, 24)),
    "dcgan": (lambda: OneHotViewDiscriminator(5, channels=4), [MASKS, 5], (2,)),
    "voxels": (lambda: VoxelGenerator((4, 4, 2, 1)), [(2, 200)], (2, 64, 64, 64)),
    "silhouettes": (lambda: SilhouetteDiscriminator((4, 4, 4, 8)), [MASKS], (2,)),
    "inverse encoder": (InverseEncoder, [MASKS], (2, 201)),
}


@pytest.mark.parametrize("name", SMALL)
def test_shapes_and_gradients_of_all_networks(name: str) -> None:
    """Float32 results of the right shape, which depend on every parameter and on every input."""
    create, wanted, shape = SMALL[name]
    torch.manual_seed(0)
    network = create()
    inputs = [
        torch.tensor([0, s - 1]) if isinstance(s, int) else torch.rand(s).requires_grad_()
        for s in wanted
    ]
    output = network(*inputs)
    assert output.shape == shape
    assert output.dtype == torch.float32
    if shape == CODES:
        assert (output < 0).any() == (name != "resnet18")
    (output * torch.randn(shape)).sum().backward()
    assert all(x.grad.any() for x in inputs if x.is_floating_point())
    gradients = {key: p.grad for key, p in network.named_parameters() if p.requires_grad}
    assert [key for key, g in gradients.items() if g is None or not g.isfinite().all()] == []
    assert [key for key, g in gradients.items() if not g.any()] == []


def test_dcgan_sees_silhouette_and_view() -> None:
    network, silhouettes = OneHotViewDiscriminator(5, channels=4), torch.rand(2, 64, 64)
    expected = torch.zeros(2, 6, 64, 64)
    expected[:, 0], expected[0, 1], expected[1, 4] = silhouettes, 1, 1
    network.layers = nn.Flatten()
    assert torch.equal(network(silhouettes, torch.tensor([0, 3])), expected.flatten(1))


def test_generator_rule_vectors() -> None:
    case = load_vector("generator_rule")
    base, bias, vertices = (torch.from_numpy(case[key]) for key in ("base", "bias", "vertices"))
    assert torch.equal(deform_sphere(base, bias), vertices)


@pytest.mark.parametrize("memory_format", [torch.channels_last, torch.contiguous_format])
def test_network_input_scales_bytes_to_the_unit_interval(
    memory_format: torch.memory_format,
) -> None:
    noise = torch.randint(0, 256, (3, 4, 64, 64), dtype=torch.uint8)
    result = network_input(noise, "cpu", memory_format=memory_format)
    assert torch.equal(result, noise.float() / 255)
    assert result.is_contiguous(memory_format=memory_format)
    with pytest.raises(ValueError, match=r"images must be uint8 \[B, 4, 224, 224\]"):
        network_input(noise, "cpu", 224)


@pytest.mark.parametrize("name", ["conv-light", "conv-centred"])
def test_encoders_with_he_weights_tell_images_apart_from_the_start(name: EncoderName) -> None:
    """Codes vary with the image by a good part of their size. A white background is as good as a black one."""
    images = torch.zeros(16, 4, 64, 64)
    sizes = torch.randint(4, 60, (16, 2), generator=torch.Generator().manual_seed(0))
    for image, (height, width) in zip(images, sizes, strict=True):
        image[:, :height, :width] = 1
    natural = torch.cat([1 - images[:, :3], images[:, 3:]], dim=1)
    for seed in range(3):
        codes = []
        for stored, inverted in ((images, True), (natural, False)):
            torch.manual_seed(seed)
            codes.append(ENCODERS[name](inverted)(stored))
        assert codes[0].std(0).norm() > 0.2 * codes[0].mean(0).norm()
        torch.testing.assert_close(*codes)


def box(image: Tensor) -> tuple[int, ...]:
    """Top, left, bottom, right (excluded) of the mask of an image [4,S,S]."""
    inside = (image[3] > 0.5).nonzero()
    return *inside.amin(0).tolist(), *(inside.amax(0) + 1).tolist()


def wedge(size: int, top: int, left: int) -> Tensor:
    """A right-angled triangle of this size with a gradient of colours, at this place of an image [1,4,64,64]."""
    y, x = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    inside = (x <= y).float()
    image = torch.stack([inside * x / size, inside * y / size, inside, inside])[None]
    return F.pad(image, (left, 64 - size - left, top, 64 - size - top))


def test_centred_objects_take_the_same_part_of_the_image() -> None:
    centred = centre(torch.cat([wedge(20, 3, 40), wedge(40, 23, 1), wedge(60, 2, 2)]))
    extent = round(64 * CENTRED_SIZE)
    first = (64 - extent) // 2
    for image in centred:
        wanted = (first, first, first + extent, first + extent)
        assert box(image) == pytest.approx(wanted, abs=1)
    assert (centred[1:] - centred[:1]).abs().mean() < 0.02
    torch.manual_seed(0)
    wedges = torch.cat([wedge(30, 3, 30), wedge(60, 2, 2), wedge(60, 2, 2).flip(2)])
    for network in (ENCODERS["conv-centred"](inverted=False), ViewClassifier(24, inverted=False)):
        with torch.no_grad():
            small, large, other = network(wedges)
        assert (small - large).norm() < 0.2 * (large - other).norm()


def test_the_background_goes_on_beyond_the_border_and_the_mask_does_not() -> None:
    image = torch.ones(1, 4, 64, 64)
    image[:, 3, :, 40:] = 0  # the object fills the height: it must become smaller
    image[:, :3, :, :40] = 0.25
    centred = centre(image)[0]
    top, left, bottom, right = box(centred)
    assert abs(bottom - top - 64 * CENTRED_SIZE) <= 1
    assert abs((left + right) / 2 - 32) <= 1
    assert torch.equal(centred[:3, 30, -1], torch.ones(3))
    assert not centred[3, 0].any()
    image[:, 3] = 0.4  # no mask: the image stays
    assert torch.equal(centre(image), image)


def test_initial_weights_follow_the_seed_and_not_the_discriminator() -> None:
    with_d = make_method("peng2020-kato", seed=3).networks
    without = make_method("peng2020-kato-vanilla", seed=3).networks
    other = make_method("peng2020-kato-vanilla", seed=4).networks
    assert "discriminator" not in without
    for name in ("encoder", "generator"):
        ours, theirs = with_d[name].state_dict(), without[name].state_dict()
        assert all(torch.equal(ours[key], theirs[key]) for key in ours)
    assert not torch.equal(other["encoder"].layers[0].weight, without["encoder"].layers[0].weight)


def create(device: str, precision: str) -> Method:
    settings = PRESETS["peng2020-kato-vanilla"].settings
    return create_method(settings, INFO, device=device, precision=precision, seed=0)


def test_bf16_changes_results_little() -> None:
    images = torch.randint(256, (1, 4, 64, 64), dtype=torch.uint8)
    with torch.no_grad():
        exact, rough = (create("cpu", p).predict(images)[1] for p in ("fp32", "bf16"))
    assert rough.dtype == torch.float32
    assert 0 < (rough - exact).abs().max() < 0.005


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
def test_missing_cuda_is_said() -> None:
    with pytest.raises(ValueError, match="sees no CUDA device"):
        create("cuda", "fp32")
