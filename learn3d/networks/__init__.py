"""Networks: encoders, generators, discriminators. Settings choose them by name."""

from learn3d.networks.encoders import CODE_SIZE, ENCODERS, EncoderName, network_input
from learn3d.networks.generators import GENERATORS, GeneratorName, MeshGenerator, Symmetry, SymmetryOption

__all__ = [
    "CODE_SIZE",
    "ENCODERS",
    "GENERATORS",
    "EncoderName",
    "GeneratorName",
    "MeshGenerator",
    "Symmetry",
    "SymmetryOption",
    "network_input",
]
