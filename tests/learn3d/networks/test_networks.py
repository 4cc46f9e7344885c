"""Architecture of the networks, the generator's rule, and what goes into them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn
from vectors import load_vector

from learn3d import device as precision_module
from learn3d.device import autocast, resolve_precision
from learn3d.methods import DatasetInfo, Method, create_method
from learn3d.networks import PoseDiscriminator, network_input
from learn3d.networks.encoders import ConvEncoder, EncoderName, create_encoder
from learn3d.networks.generators import SphereGenerator, deform_sphere
from learn3d.presets import PRESETS


def create(preset: str, seed: int = 0, device: str = "cpu") -> Method:
    return create_method(PRESETS[preset].settings, DatasetInfo(24), device=device, precision="fp32", seed=seed)


def layer_sizes(network: nn.Module) -> list[tuple[int, int]]:
    return [(m.in_features, m.out_features) for m in network.modules() if isinstance(m, nn.Linear)]


def test_encoder_is_the_papers() -> None:
    encoder = ConvEncoder()
    convolutions = [m for m in encoder.modules() if isinstance(m, nn.Conv2d)]
    shapes = [(c.in_channels, c.out_channels, c.kernel_size, c.stride, c.padding) for c in convolutions]
    assert shapes == [
        (4, 64, (5, 5), (2, 2), (2, 2)),
        (64, 128, (5, 5), (2, 2), (2, 2)),
        (128, 256, (5, 5), (2, 2), (2, 2)),
    ]
    assert layer_sizes(encoder) == [(16384, 1024), (1024, 1024), (1024, 512)]
    assert not isinstance(encoder.layers[-1], nn.ReLU)
    codes = encoder(torch.rand(2, 4, 64, 64))
    assert codes.shape == (2, 512)
    assert (codes < 0).any()


def test_generator_and_discriminator_are_the_papers() -> None:
    generator = SphereGenerator()
    assert layer_sizes(generator) == [(512, 1024), (1024, 2048), (2048, 1926)]
    assert layer_sizes(PoseDiscriminator(24)) == [(512, 256), (256, 128), (128, 24)]
    assert generator.faces.shape == (1280, 3)
    assert generator.edges.shape == (1920, 4)
    vertices = generator(torch.zeros(3, 512))
    assert vertices.shape == (3, 642, 3)
    assert vertices.dtype == torch.float32
    assert not [name for name in generator.state_dict() if not name.startswith("layers")]


def test_generator_rule_vectors() -> None:
    case = {key: torch.from_numpy(value) for key, value in load_vector("generator_rule").items() if value.ndim}
    assert torch.equal(deform_sphere(case["base"], case["bias"]), case["vertices"])


def test_initial_weights_follow_the_seed_and_not_the_discriminator() -> None:
    with_d = create("peng2020-kato", seed=3).networks
    without = create("peng2020-kato-vanilla", seed=3).networks
    other = create("peng2020-kato-vanilla", seed=4).networks
    assert "discriminator" not in without
    for name in ("encoder", "generator"):
        ours, theirs = with_d[name].state_dict(), without[name].state_dict()
        assert all(torch.equal(ours[key], theirs[key]) for key in ours)
    assert not torch.equal(other["encoder"].layers[0].weight, without["encoder"].layers[0].weight)


def test_network_input_scales_bytes_to_the_unit_interval() -> None:
    images = torch.zeros(2, 4, 64, 64, dtype=torch.uint8)
    images[1, 3, 5, 6] = 255
    result = network_input(images, "cpu")
    assert result.dtype == torch.float32
    assert result.sum() == 1
    assert result[1, 3, 5, 6] == 1
    assert result.is_contiguous(memory_format=torch.channels_last)
    noise = torch.randint(0, 256, (3, 4, 64, 64), dtype=torch.uint8)
    assert torch.equal(network_input(noise, "cpu"), noise.float() / 255)


@pytest.mark.parametrize(("flags", "wanted"), [("fpu avx512_bf16", "bf16"), ("amx_bf16", "bf16"), ("avx2", "fp32")])
def test_auto_precision_follows_the_cpu(monkeypatch, tmp_path, flags: str, wanted: str) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(f"model name : x\nflags\t\t: {flags}\n")
    monkeypatch.setattr(precision_module, "CPUINFO", str(cpuinfo))
    assert resolve_precision("auto", "cpu") == wanted
    assert resolve_precision("fp32", "cpu") == "fp32"
    monkeypatch.setattr(precision_module, "CPUINFO", str(tmp_path / "missing"))
    assert resolve_precision("auto", "cpu") == "fp32"


def test_bf16_changes_results_little() -> None:
    networks = create("peng2020-kato-vanilla").networks
    images = network_input(torch.from_numpy(np.random.default_rng(0).integers(0, 256, (1, 4, 64, 64), np.uint8)), "cpu")
    with torch.no_grad():
        exact = networks["generator"](networks["encoder"](images))
        with autocast("cpu", "bf16"):
            rough = networks["generator"](networks["encoder"](images))
    assert rough.dtype == torch.float32
    assert 0 < (rough - exact).abs().max() < 0.005


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
def test_missing_cuda_is_said() -> None:
    with pytest.raises(ValueError, match="sees no CUDA device"):
        create("peng2020-kato", device="cuda")


@pytest.mark.parametrize("name", ["conv-light", "conv-centred"])
def test_encoders_with_he_weights_tell_images_apart_from_the_start(name: EncoderName) -> None:
    """Codes vary with the image by a good part of their size, so that shapes can differ in the first steps."""
    images = torch.zeros(16, 4, 64, 64)
    for k, (height, width) in enumerate(torch.randint(4, 60, (16, 2), generator=torch.Generator().manual_seed(0))):
        images[k, :, :height, :width] = 1
    for seed in range(3):
        torch.manual_seed(seed)
        codes = create_encoder(name, inverted=True)(images)
        assert codes.std(0).norm() > 0.2 * codes.mean(0).norm()


@pytest.mark.parametrize("name", ["conv-light", "conv-centred"])
def test_a_white_background_is_as_good_as_a_black_one(name: EncoderName) -> None:
    """The same images stored as they are and inverted, as Kato's are, have the same codes."""
    images = torch.rand(4, 4, 64, 64)
    natural = torch.cat([1 - images[:, :3], images[:, 3:]], dim=1)
    codes = []
    for stored, inverted in ((images, True), (natural, False)):
        torch.manual_seed(0)
        codes.append(create_encoder(name, inverted=inverted)(stored))
    torch.testing.assert_close(*codes)
