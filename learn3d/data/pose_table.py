"""Tables of estimated poses: npz files that replace the poses of a data set.

Each row belongs to one image. Its fingerprint is a hash of the object's name and of the mask. So
a table fits any part of its data, in any order, and no other data.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from learn3d.data.dataset import ViewDataset
from learn3d.data.poses import LookAtPoses, PoseCandidates, wrap_deg
from learn3d.data.view_bins import view_classes
from learn3d.files import npz
from learn3d.files.reading import faults_of
from learn3d.files.writing import replacing

_WANTED = "a table that learn3d estimate-poses wrote"
MAX_CANDIDATES = 64


@dataclass(frozen=True, eq=False)
class PoseTable:
    """C candidate poses for each of N images, the most probable first.

    Raises ValueError for impossible values.
    """

    fingerprint: np.ndarray  # uint64 [N]
    azimuth_deg: np.ndarray  # float32 [N, C]
    elevation_deg: np.ndarray  # float32 [N, C]
    weights: np.ndarray  # float32 [N, C]: probabilities; each row sums to 1
    distance: np.ndarray  # float32 [N]
    half_fov_deg: np.ndarray  # float32 [N]
    # float32 [N]: probability that the best azimuth is within 30 degrees of the truth
    confidence: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.fingerprint)
        shape = self.azimuth_deg.shape
        if not count or len(shape) != 2 or not 1 <= shape[1] <= MAX_CANDIDATES:
            raise ValueError(
                f"azimuth_deg must be [N, C] with N >= 1 and C in 1 .. {MAX_CANDIDATES}, got {shape}"
            )
        for name, values in vars(self).items():
            dtype = np.dtype(np.uint64 if name == "fingerprint" else np.float32)
            wanted = (
                (count, shape[1])
                if name in ("azimuth_deg", "elevation_deg", "weights")
                else (count,)
            )
            if (values.dtype, values.shape) != (dtype, wanted):
                raise ValueError(
                    f"{name} must be {dtype} {list(wanted)}, got {values.dtype} {values.shape}"
                )
            if name in ("weights", "confidence") and not 0 <= values.min() <= values.max() <= 1.001:
                raise ValueError(f"{name} must lie in 0 .. 1")
        if not self.poses(np.arange(count)).in_range().all():
            raise ValueError(
                "some of its cameras are impossible (elevation, distance or field of view)"
            )
        if not np.allclose(self.weights.sum(axis=1), 1, atol=1e-3):
            raise ValueError("the weights of the candidates of an image must add up to 1")

    def poses(self, rows: np.ndarray, best: bool = False) -> LookAtPoses:
        """The B * C candidate poses of the rows `rows`, int64 [B], or only the B best ones."""
        last = 1 if best else self.azimuth_deg.shape[1]
        angles = (
            values[rows, :last].reshape(-1) for values in (self.azimuth_deg, self.elevation_deg)
        )
        return LookAtPoses(
            *angles, *(values[rows].repeat(last) for values in (self.distance, self.half_fov_deg))
        )

    def turned(self, offset_deg: float) -> PoseTable:
        """The table with this angle added to all azimuths."""
        azimuth = wrap_deg(torch.from_numpy(self.azimuth_deg) + offset_deg).numpy()
        return dataclasses.replace(self, azimuth_deg=azimuth)

    def write(self, path: Path) -> None:
        """Write the table; the same table gives the same bytes."""
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **vars(self))

    @classmethod
    def read(cls, path: Path | str) -> PoseTable:
        """Read an untrusted table. Raises DamagedFile and MissingFile."""
        names = [field.name for field in dataclasses.fields(cls)]
        with faults_of(path, _WANTED):
            return cls(*npz.read_several(Path(path), names, _WANTED))

    def apply(self, dataset: ViewDataset, source: str) -> ViewDataset:
        """The data set with the poses of this table and view classes from them.

        `source` names the table in messages.

        Raises ValueError if an image is not in the table.
        """
        wanted = fingerprints(dataset)
        order = np.argsort(self.fingerprint, kind="stable")
        rows = order[np.searchsorted(self.fingerprint[order], wanted).clip(max=len(order) - 1)]
        if len(missing := np.flatnonzero(self.fingerprint[rows] != wanted)):
            first = dataset.object_names[dataset.object_ids[missing[0]]]
            raise ValueError(
                f"{source} has no pose for {len(missing)} of {len(dataset)} {dataset.split} images of "
                f"{dataset.category} (the first is of object {first}): it was made from other data; run learn3d "
                "estimate-poses on this data set"
            )
        poses, training = self.poses(rows, best=True), self.poses(np.arange(len(order)), best=True)
        view_ids, view_names = view_classes(poses, training)
        every = self.poses(rows)
        candidates = PoseCandidates(
            every, view_classes(every, training)[0], self.weights[rows], self.weights[rows]
        )
        parts = {"view_ids": view_ids, "view_names": view_names, "candidates": candidates}
        return dataclasses.replace(dataset, poses=poses, **parts)


def fingerprints(dataset: ViewDataset) -> np.ndarray:
    """A hash of the object's name and of the mask, for each image: uint64 [M]."""
    found = np.empty(len(dataset), np.uint64)
    for rows in np.array_split(np.arange(len(dataset)), len(dataset) // 1024 + 1):
        for row, mask in zip(rows, dataset.read_masks(rows), strict=True):
            name = dataset.object_names[dataset.object_ids[row]].encode()
            digest = hashlib.blake2b(name + b"\0" + mask.tobytes(), digest_size=8).digest()
            found[row] = int.from_bytes(digest, "little")
    return found
