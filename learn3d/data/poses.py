"""Camera poses of a data set: look-at poses, rotations, candidates for unknown ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

import nmr
from learn3d.files import limits


def wrap_deg(angle_deg: Tensor) -> Tensor:
    """Angles in degrees, wrapped to [-180, 180)."""
    return torch.remainder(angle_deg + 180.0, 360.0) - 180.0


@dataclass(frozen=True, eq=False)
class _PoseSet:
    """Poses of M views: tensors [M, ...], and numbers that all views share."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def __getitem__(self, indices: Tensor) -> Poses:
        """The poses of the samples `indices`, int64 [B]."""
        return replace(
            self, **{name: v[indices] for name, v in vars(self).items() if isinstance(v, Tensor)}
        )

    @classmethod
    def join(cls, parts: Sequence[Poses]) -> Poses:
        """Concatenate the poses of several sets."""
        joined = {}
        for name in vars(parts[0]):
            values = [getattr(part, name) for part in parts]
            # else one number for all
            if any(isinstance(v, Tensor) for v in values) or len(set(values)) > 1:
                tensors = [torch.as_tensor(v, dtype=torch.float32) for v in values]
                values = [
                    torch.cat(
                        [
                            v if v.ndim else v.expand(len(p))
                            for v, p in zip(tensors, parts, strict=True)
                        ]
                    )
                ]
            joined[name] = values[0]
        return cls(**joined)


@dataclass(frozen=True, eq=False)
class LookAtPoses(_PoseSet):
    """M perspective cameras that look at the origin from distance, elevation, azimuth.

    Conventions of `nmr.cameras.points_from_angles`: the eye is at d (cos e sin a, sin e, -cos e
    cos a).
    """

    azimuth_deg: Tensor  # float32 [M]
    elevation_deg: Tensor | float  # float32 [M], or one value for all
    distance: Tensor | float  # float32 [M], or one value for all; units of the object frame
    half_fov_deg: Tensor | float  # float32 [M], or one value for all: half of the field of view
    num_features: ClassVar[int] = 3

    def __post_init__(self) -> None:
        for name, value in list(vars(self).items()):
            if isinstance(value, (np.ndarray, Tensor)):
                object.__setattr__(self, name, torch.as_tensor(value, dtype=torch.float32))
                if value.shape != (len(self),):
                    raise ValueError(
                        f"{name} must be [{len(self)}] or one number, got {list(value.shape)}"
                    )

    def in_range(self) -> Tensor:
        """Which poses are finite and within the bounds of `files.limits`: bool [M]."""
        (near, far), (narrow, wide) = limits.CAMERA_DISTANCE, limits.FOV_DEG
        azimuth, elevation, distance, half_fov = map(torch.as_tensor, vars(self).values())
        sound = (azimuth.abs() <= limits.ANGLE_DEG) & (elevation.abs() < 90)
        return (
            sound
            & (distance >= near)
            & (distance <= far)
            & (half_fov > narrow / 2)
            & (half_fov < wide / 2)
        )

    def cameras(self) -> nmr.LookAt:
        """The M cameras as one batch."""
        angles = self.distance, self.elevation_deg, self.azimuth_deg
        return nmr.LookAt.from_angles(*angles, half_fov_deg=self.half_fov_deg)

    def eyes(self) -> Tensor:
        """Positions of the eyes in the object frame, float32 [M, 3]."""
        return nmr.cameras.points_from_angles(
            self.distance, self.elevation_deg, self.azimuth_deg
        ).to(torch.float32)

    def mirrored(self, chosen: Tensor) -> LookAtPoses:
        """The poses after the images `chosen` (bool [M]) are flipped: azimuths are negated."""
        return replace(self, azimuth_deg=torch.where(chosen, -self.azimuth_deg, self.azimuth_deg))


@dataclass(frozen=True, eq=False)
class RotationPoses(_PoseSet):
    """M orthographic cameras, each given by a rotation (Pascal3D+): v' = R v, and x', y' in [-1,
    1] span the image.

    Objects are moved in front of the camera (z' + `depth_offset`), which changes no pixel of a
    silhouette.
    """

    rotation: Tensor  # float32 [M, 3, 3]
    depth_offset: float = 2.0
    num_features: ClassVar[int] = 9

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation", torch.as_tensor(self.rotation, dtype=torch.float32))
        if self.rotation.ndim != 3 or self.rotation.shape[1:] != (3, 3):
            raise ValueError(f"rotation must be [M, 3, 3], got {list(self.rotation.shape)}")

    def in_range(self) -> Tensor:
        """Which matrices are finite and invertible: bool [M]. Rotations may include a reflection."""
        return torch.linalg.det(self.rotation.nan_to_num()).ne(0) & self.rotation.isfinite().all(
            2
        ).all(1)

    def cameras(self) -> nmr.cameras.Projection:
        """The M cameras as one batch."""
        offset = torch.tensor([0.0, 0.0, self.depth_offset]).expand(len(self), 3)[:, :, None]
        intrinsics = torch.eye(2, 3).expand(len(self), 2, 3)
        return nmr.cameras.Projection(
            torch.cat([self.rotation, offset], dim=2), intrinsics, perspective=False
        )

    def eyes(self) -> Tensor:
        """Directions from the object to the cameras, float32 [M, 3]; the cameras are far away."""
        return -self.rotation[:, 2]

    def mirrored(self, chosen: Tensor) -> RotationPoses:
        """The poses of the images, those with `chosen` (bool [M]) flipped left-right (x' -> -x').

        For an object that is symmetric about z = 0, the pose of the flipped image is D R D' with
        D = diag(-1, 1, 1) and D' = diag(1, 1, -1).
        """
        image, body = torch.tensor([-1.0, 1.0, 1.0]), torch.tensor([1.0, 1.0, -1.0])
        mirrored = image[:, None] * self.rotation * body
        return replace(self, rotation=torch.where(chosen[:, None, None], mirrored, self.rotation))


Poses = LookAtPoses | RotationPoses


@dataclass(eq=False)
class PoseCandidates:
    """C candidate poses for each of M images. Pose i * C + c is candidate c of image i.

    The weights are the only part of a data set that changes: a training reweights them
    (`methods.pose_updates`), later batches draw by them, and checkpoints hold them.
    """

    poses: LookAtPoses  # M * C poses
    view_ids: np.ndarray  # int64 [M * C]: their view classes
    weights: np.ndarray  # float32 [M, C]: probabilities of the candidates; each row sums to 1
    prior: np.ndarray  # float32 [M, C]: the same before any reweighting

    def __len__(self) -> int:
        return len(self.weights)

    def reweight(self, weights: np.ndarray) -> float:
        """Replace the weights. Returns the share of images whose best candidate changed."""
        changed = float((weights.argmax(1) != self.weights.argmax(1)).mean())
        self.weights = weights
        return changed

    def draw(self, indices: Tensor, seed: int, step: int) -> tuple[LookAtPoses, Tensor]:
        """Poses and view classes int64 [B] of the images `indices`: a candidate each, drawn by
        weights, seed and step.

        So the gradient is an unbiased estimate of that of the expected loss over the candidates,
        at the cost of one pose.
        """
        drawn = np.random.default_rng([seed, step, 2]).random(len(indices))
        ends = self.weights[indices].cumsum(axis=1)[:, :-1]
        chosen = indices * self.weights.shape[1] + torch.from_numpy(
            (drawn[:, None] >= ends).sum(axis=1)
        )
        return self.poses[chosen], torch.from_numpy(self.view_ids[chosen])
