"""Finds the vertical plane at which the objects of a data set are mirror images of themselves, from masks and poses.

If the objects are symmetric about the plane that a camera of azimuth p looks along, an object looks from azimuth
2 p - a as its mirror image does from azimuth a, at the same elevation. So the mean mask of the views around 2 p - a,
flipped left-right, is that of the views around a. Of any single object nothing is assumed, and no two views of an
object are needed.
"""

from __future__ import annotations

import numpy as np

from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.data.poses import LookAtPoses

SECTOR_DEG = 15.0  # width of the sectors of azimuth whose masks are averaged; planes are found to half of it
_SECTORS = round(360 / SECTOR_DEG)
_ENOUGH, _MOST = 4, 2048  # images that a sector must have to be compared, and that are looked at
_COMPARED = _SECTORS // 2  # sectors that must be compared, or all where cameras stand at fewer azimuths
_PLANES = 6  # planes that must be compared, and one for every sector with images
_CLEAR = 0.1  # how much smaller than the median over all planes the difference at the mirror plane must be


def find_mirror_plane(dataset: ViewDataset) -> float | None:
    """Azimuth in degrees, 0 .. 172.5, of a camera that looks along the mirror plane; None: there is none to be seen.

    For each plane p the squared differences of the mean masks of sectors v and 2 p - v are summed over pixels and
    sectors, less those expected by chance. A plane is found if the smallest of the 24 sums is below a tenth of their
    median. A sector is compared if it and its mirror image have four images: random azimuths need some 150 images.
    Cameras at n < 24 equally spaced azimuths show n planes, at least 6.

    Raises ValueError if poses are unknown, or not given by azimuth and elevation.
    """
    if not isinstance(dataset.poses, LookAtPoses):
        raise ValueError(
            "symmetry 'auto' needs camera poses given by azimuth and elevation; give the plane (x, z, degrees) or None"
        )
    sectors = np.rint(dataset.poses.azimuth_deg.numpy() / SECTOR_DEG).astype(int) % _SECTORS
    means = np.zeros((_SECTORS, MASK_SIZE, MASK_SIZE))
    known = np.zeros(_SECTORS, bool)
    noise = np.zeros(_SECTORS)  # expected squared error of each mean, summed over pixels
    for sector in range(_SECTORS):
        samples = np.flatnonzero(sectors == sector)
        if len(samples) < _ENOUGH:
            continue
        some = np.linspace(0, len(samples) - 1, min(len(samples), _MOST)).round().astype(int)
        stored = dataset.images if dataset.masks is None else dataset.masks
        seen = stored[samples[some]].reshape(len(some), -1, MASK_SIZE, MASK_SIZE)[:, -1] / np.float32(255)
        means[sector], known[sector] = seen.mean(axis=0), True
        noise[sector] = seen.var(axis=0).sum() / (len(seen) - 1)
    differences = np.full(_SECTORS, np.inf)
    for plane in range(_SECTORS):  # at plane * SECTOR_DEG / 2
        other = (plane - np.arange(_SECTORS)) % _SECTORS
        compared = known & known[other]
        if compared.sum() < max(1, min(_COMPARED, known.sum())):
            continue
        moved = other != np.arange(_SECTORS)  # a sector that is its own mirror image has one mean, and less noise
        squares = np.square(means - means[other][..., ::-1]).sum(axis=(1, 2))
        differences[plane] = np.mean((squares - np.where(moved, noise + noise[other], 2 * noise))[compared])
    seen = np.isfinite(differences)
    if seen.sum() < max(_PLANES, known.sum()):
        return None
    best = int(differences.argmin())
    clear = differences[best] < _CLEAR * np.median(differences[seen])
    return best * SECTOR_DEG / 2 if clear else None
