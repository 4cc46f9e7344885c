"""Generated objects seen from all around: our own layout, in shards only (`learn3d.data.shards`).

Images are 64x64, with colours stored as 255 - colour. Cameras stand at any azimuth, at heights of -10 to 60 degrees, at
a distance from which the whole object is seen, and have fields of view of 14 to 40 degrees. Every view has a depth map.
Voxel axes are Kato's; the view classes are 24 cells of azimuth.
"""

from __future__ import annotations

from pathlib import Path

from learn3d.data.conventions import KATO, LayoutProperties
from learn3d.data.dataset import ViewDataset
from learn3d.data.view_bins import AngleBins
from learn3d.files.reading import STRICT, Findings, MissingFile

PROPERTIES = LayoutProperties(voxels=True, convention=KATO, inverted=True)
BINS = AngleBins.parse("15x70:-10:60")


def load(folder: Path | str, category: str, split: str, *, findings: Findings = STRICT) -> ViewDataset | None:
    """Refuse: a split that is not in shards is missing."""
    raise MissingFile(
        Path(folder), f"has no shards of {category}, {split}; make them: learn3d make-dataset --layout around --shards"
    )


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """No categories but those in shards."""
    return {}
