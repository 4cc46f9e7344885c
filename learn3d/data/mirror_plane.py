"""Finds the vertical mirror plane of the objects of a data set from masks and poses.

Let p be the azimuth of a camera that looks along the plane. The view from azimuth 2 p - a mirrors
that from azimuth a, at the same elevation. So the mean mask of the views around 2 p - a, flipped
left-right, equals that of the views around a. This needs no symmetry of a single object and no
two views of one.
"""

import numpy as np

from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.data.poses import LookAtPoses

SECTOR_DEG = 15.0  # width of the azimuth sectors whose masks are averaged; candidate planes are half of it apart
_SECTORS = round(360 / SECTOR_DEG)
_MIN_IMAGES, _MAX_IMAGES = 4, 2048  # images of a sector: fewer are ignored, of more a part is used
# pairs of mirrored sectors that a candidate needs, or all if fewer sectors have images
_MIN_SECTORS = _SECTORS // 2
_MIN_PLANES = 6  # candidate planes that are needed, or one for each sector with images
# largest ratio of the difference at the mirror plane to the median over all candidates
_MAX_RATIO = 0.1


def find_mirror_plane(dataset: ViewDataset) -> float | None:
    """Azimuth in degrees of a camera that looks along the mirror plane; None if there is none, or
    if poses are unknown.

    The difference at a plane p is the mean squared difference of the mean masks of the sectors v
    and 2 p - v, less its expected value from noise. A plane is found if the smallest of the 24
    differences is below a tenth of their median. A sector counts if it and its mirror image have
    four images each; for random azimuths some 150 images suffice. Cameras at n < 24 equally
    spaced azimuths give n candidate planes; at least 6 are needed.

    Raises ValueError if poses are not given by azimuth and elevation.
    """
    if dataset.poses is None:
        return None
    if not isinstance(dataset.poses, LookAtPoses):
        raise ValueError(
            "symmetry 'auto' needs camera poses given by azimuth and elevation; give the plane (x, z, degrees) or None"
        )
    sectors = np.rint(dataset.poses.azimuth_deg.numpy() / SECTOR_DEG).astype(int) % _SECTORS
    means = np.zeros((_SECTORS, MASK_SIZE, MASK_SIZE))
    noise = np.zeros(_SECTORS)  # expected squared error of each mean, summed over pixels
    known = np.bincount(sectors, minlength=_SECTORS) >= _MIN_IMAGES
    for sector in np.flatnonzero(known):
        samples = np.flatnonzero(sectors == sector)
        part = np.linspace(0, len(samples) - 1, min(len(samples), _MAX_IMAGES)).round().astype(int)
        masks = dataset.read_masks(samples[part]) / np.float32(255)
        means[sector], noise[sector] = (
            masks.mean(axis=0),
            masks.var(axis=0).sum() / (len(masks) - 1),
        )
    differences = np.full(_SECTORS, np.inf)
    for plane in range(_SECTORS):  # its azimuth is plane * SECTOR_DEG / 2
        other = (plane - np.arange(_SECTORS)) % _SECTORS
        compared = known & known[other]
        if compared.sum() >= max(1, min(_MIN_SECTORS, known.sum())):
            squares = np.square(means - means[other][..., ::-1]).sum(axis=(1, 2))
            differences[plane] = np.mean((squares - (noise + noise[other]))[compared])
    seen = np.isfinite(differences)
    if seen.sum() < max(_MIN_PLANES, known.sum()):
        return None
    best = int(differences.argmin())
    clear = differences[best] < _MAX_RATIO * np.median(differences[seen])
    return best * SECTOR_DEG / 2 if clear else None
