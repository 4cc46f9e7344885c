"""The mirror plane that masks and poses show."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from mirrors import reflected

import nmr
from learn3d.data.dataset import ViewDataset
from learn3d.data.mirror_plane import find_mirror_plane
from learn3d.data.poses import RotationPoses
from learn3d.data.readers import kato


def triangles_seen(plane: float | None, objects: int) -> ViewDataset:
    """Sets of random triangles at two places, with their mirror images if there is a plane, from Kato's 24 views."""
    rng = torch.Generator().manual_seed(3)
    images = np.zeros((objects, 24, 4, 64, 64), np.uint8)
    empty = kato.from_arrays(
        images, np.zeros((objects, 32, 32, 32), bool), category="chair", split="train"
    )
    cameras = empty.poses[torch.arange(24)].cameras()
    for i in range(objects):
        vertices = 0.25 * torch.rand(36, 3, generator=rng)
        vertices[:18] += torch.tensor([0.2, -0.3, -0.1])  # below, to the front
        vertices[18:] += torch.tensor([-0.1, 0.1, 0.2])  # above, to the side
        faces = torch.arange(36).reshape(12, 3)
        if plane is not None:
            vertices = torch.cat([vertices, reflected(vertices, plane)])
            faces = torch.cat([faces, faces + 36])
        masks = nmr.render_silhouette(
            vertices[None].expand(24, -1, -1), faces, cameras, image_size=64
        )
        images[i, :, 3] = (255 * masks).byte().numpy()
    return dataclasses.replace(empty, images=images.reshape(-1, 4, 64, 64))


def some_views(whole: ViewDataset, of_each: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.concatenate(
        [24 * k + rng.choice(24, of_each, False) for k in range(whole.num_objects)]
    )


@pytest.mark.parametrize(
    ("plane", "objects", "views", "found"),
    [
        (37.5, 12, 24, True),
        (135.0, 12, 24, True),
        (90.0, 480, 1, True),  # no object is seen twice
        (37.5, 160, 1, True),  # so few that noise must be subtracted
        (37.5, 40, 4, True),
        (None, 40, 4, False),
        (None, 60, 24, False),
        (0.0, 3, 24, False),  # too few images
    ],
)
def test_finds_the_plane_if_there_is_one_and_views_are_enough(plane, objects, views, found) -> None:
    whole = triangles_seen(plane, objects)
    assert find_mirror_plane(whole.select(some_views(whole, views))) == (plane if found else None)


@pytest.mark.parametrize("plane", [0.0, 90.0, None])
def test_few_azimuths_suffice_from_six_on(plane: float | None) -> None:
    whole = triangles_seen(plane, objects=40)
    for cameras in (4, 6, 8, 12):
        kept = np.flatnonzero(np.arange(len(whole)) % (24 // cameras) == 0)
        assert find_mirror_plane(whole.select(kept)) == (None if cameras < 6 else plane)


def test_needs_azimuths() -> None:
    dataset = triangles_seen(0.0, objects=1)
    poses = RotationPoses(torch.eye(3).expand(24, 3, 3))
    with pytest.raises(ValueError, match="azimuth and elevation"):
        find_mirror_plane(dataclasses.replace(dataset, poses=poses))
