"""Networks: encoders, generators, discriminators. Settings choose them by name."""

from typing import Literal

from learn3d.networks.discriminators import PoseDiscriminator
from learn3d.networks.encoders import CODE_SIZE, ENCODERS, EncoderName, create_encoder, network_input
from learn3d.networks.generators import (
    BoundedGenerator,
    ConvCubeGenerator,
    LinearCubeGenerator,
    SmallSphereGenerator,
    SmoothSphereGenerator,
    SphereGenerator,
)
from learn3d.networks.mesh_generator import MeshGenerator, Symmetry, SymmetryOption

__all__ = [
    "CODE_SIZE",
    "ENCODERS",
    "GENERATORS",
    "EncoderName",
    "GeneratorName",
    "MeshGenerator",
    "PoseDiscriminator",
    "Symmetry",
    "SymmetryOption",
    "create_encoder",
    "network_input",
]

GeneratorName = Literal["auto", "sphere", "sphere-smooth", "sphere-small", "bounded", "cube-conv", "cube-fc"]
GENERATORS: dict[str, type[MeshGenerator]] = {
    "sphere": SphereGenerator,
    "sphere-smooth": SmoothSphereGenerator,
    "sphere-small": SmallSphereGenerator,
    "bounded": BoundedGenerator,
    "cube-conv": ConvCubeGenerator,
    "cube-fc": LinearCubeGenerator,
}
