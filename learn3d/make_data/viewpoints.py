"""From where the objects of a data set are looked at: one function per protocol, each a table of poses.

Angles and distances are rounded to 4 decimals, so that text files hold exactly what was drawn.
"""

from __future__ import annotations

import numpy as np
import torch

import nmr
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers import kato

KAR_HALF_FOV_DEG = 14.9314  # 60 mm lens, 32 mm sensor
KAR_ELEVATIONS_DEG = (-20.0, 40.0)
R2N2_HALF_FOV_DEG = float(np.rad2deg(np.arctan(16 / 35)))  # 35 mm lens, 32 mm sensor: focal length 2.1875
R2N2_DISTANCE = 1.75  # the distance of ratio 1
R2N2_ELEVATIONS_DEG = (25.0, 30.0)
R2N2_RATIOS = (0.65, 0.95)
PASCAL3D_ELEVATIONS_DEG = (-10.0, 40.0)
PASCAL3D_TILTS_DEG = (-15.0, 15.0)
PHOTO_ELEVATIONS_DEG = (-10.0, 50.0)
PHOTO_HALF_FOVS_DEG = (12.0, 25.0)  # lenses of 84 .. 38 mm on a square of 36 mm
ROOM = (1.02, 1.25)  # distance over the least one from which the whole bounding sphere is seen


def kato_views() -> LookAtPoses:
    """The 24 views of Kato's protocol: every 15 degrees at elevation 30."""
    return kato.view_poses(torch.arange(kato.NUM_VIEWS))


def kar_views(count: int, radius: float, rng: np.random.Generator) -> LookAtPoses:
    """Azimuths uniform in -180 .. 180, elevations in -20 .. 40; the object of that radius is seen whole.

    The distances of Kar's own files are not published; these fill the image about as much as theirs do.
    """
    azimuth_deg = _uniform(rng, (-180.0, 180.0), count)
    elevation_deg = _uniform(rng, KAR_ELEVATIONS_DEG, count)
    distance = _distances(rng, radius, np.full(count, KAR_HALF_FOV_DEG))
    return LookAtPoses(azimuth_deg, elevation_deg, distance, KAR_HALF_FOV_DEG)


def r2n2_views(count: int, rng: np.random.Generator) -> LookAtPoses:
    """R2N2's sampling: azimuths in [0, 360), elevations in [25, 30), distances 1.75 * [0.65, 0.95).

    R2N2 counts the azimuth the other way round: its azimuth a is -a here (see `learn3d.make_data.writers.r2n2`).
    """
    azimuth_deg = -_uniform(rng, (0.0, 360.0), count)
    elevation_deg = _uniform(rng, R2N2_ELEVATIONS_DEG, count)
    distance = _uniform(rng, R2N2_RATIOS, count).astype(np.float64) * R2N2_DISTANCE
    return LookAtPoses(azimuth_deg, elevation_deg, distance.astype(np.float32), R2N2_HALF_FOV_DEG)


def pascal3d_views(count: int, rng: np.random.Generator) -> np.ndarray:
    """Rotations float64 [count, 3, 3] as photographers make them, whose rows are the right, up and away of the image.

    Any azimuth, elevations in -10 .. 40, cameras tilted by up to 15 degrees.
    """
    azimuth_deg, elevation_deg, tilt_deg = (
        _uniform(rng, limits, count) for limits in ((-180.0, 180.0), PASCAL3D_ELEVATIONS_DEG, PASCAL3D_TILTS_DEG)
    )
    look = nmr.LookAt.from_angles(1.0, torch.from_numpy(elevation_deg), torch.from_numpy(azimuth_deg))
    upright = look.projection(torch.float64).matrix[:, :, :3].numpy() * np.array([[1.0], [-1.0], [1.0]])
    cos, sin = np.cos(np.deg2rad(tilt_deg)), np.sin(np.deg2rad(tilt_deg))
    roll = np.tile(np.eye(3), (count, 1, 1))
    roll[:, 0, 0], roll[:, 0, 1], roll[:, 1, 0], roll[:, 1, 1] = cos, -sin, sin, cos
    return roll @ upright


def photo_views(count: int, radius: float, rng: np.random.Generator) -> LookAtPoses:
    """Any azimuth, elevations in -10 .. 50, another lens for every picture; the object is seen whole."""
    azimuth_deg = _uniform(rng, (-180.0, 180.0), count)
    elevation_deg = _uniform(rng, PHOTO_ELEVATIONS_DEG, count)
    half_fov_deg = _uniform(rng, PHOTO_HALF_FOVS_DEG, count)
    return LookAtPoses(azimuth_deg, elevation_deg, _distances(rng, radius, half_fov_deg), half_fov_deg)


def _uniform(rng: np.random.Generator, limits: tuple[float, float], count: int) -> np.ndarray:
    """float32 [count] in [low, high), to 4 decimals (which may round up to high: then low, a whole turn less)."""
    low, high = limits
    values = np.round(rng.uniform(low, high, count), 4)
    return np.where(values >= high, low, values).astype(np.float32)


def _distances(rng: np.random.Generator, radius: float, half_fov_deg: np.ndarray) -> np.ndarray:
    """float32 [count]: from there a sphere of `radius` around the origin fits into the image."""
    least = radius / np.sin(np.deg2rad(half_fov_deg.astype(np.float64)))
    return np.round(least * rng.uniform(*ROOM, len(least)), 4).astype(np.float32)
