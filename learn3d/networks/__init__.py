"""Networks: encoders, generators, discriminators; each file has one kind, and names for the settings to choose by."""

from learn3d.networks.discriminators import PoseDiscriminator
from learn3d.networks.encoders import CODE_SIZE, ENCODERS, EncoderName, create_encoder, network_input
from learn3d.networks.generators import GENERATORS, GeneratorName
from learn3d.networks.precision import autocast, check_device, resolve_precision

__all__ = [
    "CODE_SIZE",
    "ENCODERS",
    "GENERATORS",
    "EncoderName",
    "GeneratorName",
    "PoseDiscriminator",
    "autocast",
    "check_device",
    "create_encoder",
    "network_input",
    "resolve_precision",
]
