"""Networks: encoders, generators, discriminators; each file has one kind, and names for the settings to choose by."""

from learn3d.networks.discriminators import PoseDiscriminator
from learn3d.networks.encoders import CODE_SIZE, ENCODERS, EncoderName, create_encoder, network_input
from learn3d.networks.generators import GENERATORS, GeneratorName

__all__ = [
    "CODE_SIZE",
    "ENCODERS",
    "GENERATORS",
    "EncoderName",
    "GeneratorName",
    "PoseDiscriminator",
    "create_encoder",
    "network_input",
]
