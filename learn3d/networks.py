"""The three networks of the method: image encoder, mesh generator, pose discriminator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

import nmr

CODE_SIZE = 512
IMAGE_SIZE = 64
OBJECT_SCALE = 0.5
CPUINFO = "/proc/cpuinfo"  # where Linux lists the instructions of the CPU


class Encoder(nn.Module):
    """Image [B,4,64,64] (RGB and mask, float in [0,1]) -> shape code [B,512], unbounded (no ReLU at the end)."""

    def __init__(self) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(
            nn.Conv2d(4, 64, 5, stride=2, padding=2),
            nn.ReLU(),
            nn.Conv2d(64, 128, 5, stride=2, padding=2),
            nn.ReLU(),
            nn.Conv2d(128, 256, 5, stride=2, padding=2),
            nn.ReLU(),
        )
        self.layers = nn.Sequential(
            nn.Linear(256 * (IMAGE_SIZE // 8) ** 2, 1024),
            nn.ReLU(),
            nn.Linear(1024, 1024),
            nn.ReLU(),
            nn.Linear(1024, CODE_SIZE),
        )

    def forward(self, images: Tensor) -> Tensor:
        return self.layers(self.convolutions(images).flatten(1))


def deform_sphere(sphere: Tensor, displacement: Tensor) -> Tensor:
    """Vertices 0.5 * (sphere + displacement): [V,3] and [B,V,3] -> [B,V,3].

    The paper's text adds the displacement to the unit sphere itself. At the data set's camera a unit sphere covers the
    whole image, so no silhouette edge would be seen and nothing would be learnt; the published code has the factor 0.5.
    """
    return OBJECT_SCALE * (sphere + displacement)


class MeshGenerator(nn.Module):
    """Shape code [B,512] -> vertices float32 [B,642,3] of a deformed icosphere, in the object frame (y up).

    `faces` int64 [1280,3] and `edges` int64 [1920,4] (the table of `nmr.edge_table`) describe the fixed topology.
    """

    sphere: Tensor
    faces: Tensor
    edges: Tensor

    def __init__(self) -> None:
        super().__init__()
        sphere, faces = nmr.icosphere(3)
        self.register_buffer("sphere", sphere.float(), persistent=False)
        self.register_buffer("faces", faces, persistent=False)
        self.register_buffer("edges", nmr.edge_table(faces), persistent=False)
        self.layers = nn.Sequential(
            nn.Linear(CODE_SIZE, 1024),
            nn.ReLU(),
            nn.Linear(1024, 2048),
            nn.ReLU(),
            nn.Linear(2048, sphere.shape[0] * 3),
        )

    def forward(self, codes: Tensor) -> Tensor:
        displacement = self.layers(codes).float().reshape(codes.shape[0], -1, 3)
        return deform_sphere(self.sphere, displacement)


class PoseDiscriminator(nn.Module):
    """Shape code [B,512] -> logits [B,K] over the K discrete views."""

    def __init__(self, num_views: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(CODE_SIZE, 256),
            nn.ReLU(),
            nn.Linear(256, 128),
            nn.ReLU(),
            nn.Linear(128, num_views),
        )

    def forward(self, codes: Tensor) -> Tensor:
        return self.layers(codes)


@dataclass
class Networks:
    """The networks of one run. Vanilla-AE has no discriminator."""

    encoder: Encoder
    generator: MeshGenerator
    discriminator: PoseDiscriminator | None

    def items(self) -> list[tuple[str, nn.Module]]:
        """(name, network) for those that exist."""
        named = [("encoder", self.encoder), ("generator", self.generator), ("discriminator", self.discriminator)]
        return [(name, network) for name, network in named if network is not None]

    @property
    def device(self) -> torch.device:
        return self.generator.sphere.device


def create_networks(num_views: int, *, discriminator: bool, device: str, seed: int) -> Networks:
    """Networks with PyTorch's default initialisation, from `seed`; a discriminator does not change the other two."""
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("device 'cuda' was asked for, but this PyTorch sees no CUDA device; use device 'cpu'")
    torch.manual_seed(seed)
    networks = Networks(Encoder(), MeshGenerator(), PoseDiscriminator(num_views) if discriminator else None)
    for _, network in networks.items():
        network.to(device)
    networks.encoder.to(memory_format=torch.channels_last)
    return networks


def network_input(images: Tensor, device: torch.device | str) -> Tensor:
    """Stored images uint8 [B,4,64,64] -> float32 in [0,1] on `device`, channels last."""
    if images.dtype != torch.uint8 or images.ndim != 4 or images.shape[1:] != (4, IMAGE_SIZE, IMAGE_SIZE):
        raise ValueError(
            f"images must be uint8 [B, 4, {IMAGE_SIZE}, {IMAGE_SIZE}] (RGB and mask), "
            f"got {images.dtype} {list(images.shape)}"
        )
    images = images.to(device).to(memory_format=torch.channels_last)
    return images.to(torch.float32).div_(255)


def resolve_precision(precision: Literal["auto", "bf16", "fp32"], device: str) -> Literal["bf16", "fp32"]:
    """Turn 'auto' into the faster arithmetic: bf16 on CUDA and on x86 CPUs with bf16 instructions, fp32 elsewhere.

    Measured on two cores with avx512_bf16: 334 ms per step for the networks in bf16 (channels last) and 676 ms in fp32.
    Without the instructions bf16 is emulated and slower than fp32.
    """
    if precision != "auto":
        return precision
    if device == "cuda":
        return "bf16" if torch.cuda.is_bf16_supported() else "fp32"
    try:
        with open(CPUINFO) as file:
            flags = next((line.split(":", 1)[1].split() for line in file if line.startswith("flags")), [])
    except OSError:
        flags = []
    return "bf16" if {"avx512_bf16", "amx_bf16"} & set(flags) else "fp32"


def autocast(device: torch.device | str, precision: Literal["bf16", "fp32"]) -> torch.autocast:
    """Context in which the networks run at the given precision; losses and rendering belong outside it."""
    return torch.autocast(torch.device(device).type, dtype=torch.bfloat16, enabled=precision == "bf16")
