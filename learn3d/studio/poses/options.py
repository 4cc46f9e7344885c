"""Options of the estimation of poses."""

from typing import Annotated, Literal

from pydantic import Field

from learn3d.data.pose_table import MAX_CANDIDATES
from learn3d.settings import checked


@checked
class PoseOptions:
    azimuths: Annotated[int, Field(ge=4, le=360, multiple_of=4)] = 24
    """Number of candidate azimuths, equally spaced; a multiple of 4."""
    prototypes: Annotated[int, Field(ge=1, le=64)] = 24
    """Number of fitted shapes, each for one kind of object."""
    restarts: Annotated[int, Field(ge=1, le=100)] = 4
    """Number of initialisations of the mean shape; the best one is kept."""
    repeats: Annotated[int, Field(ge=1, le=100)] = 3
    """Number of independent estimates that are averaged: more are more reliable and take longer."""
    prior: Literal["uniform", "free"] = "uniform"
    """Prior over azimuths. uniform: all azimuths are about equally frequent in the data. free: no
    assumption."""
    steps: Annotated[int, Field(ge=1, le=100_000)] = 300
    """Optimisation steps of each mean shape and of each of the three stages of the prototypes."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of the initial shapes and of the order of the images."""
    candidates: Annotated[int, Field(ge=1, le=MAX_CANDIDATES)] = 4
    """Number of poses of each image with a probability above 0; each training step draws one."""
