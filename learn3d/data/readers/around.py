"""Generated objects seen from all sides: our own layout, as shards only (`learn3d.data.shards`).

Images are 64x64, with colours stored as 255 - colour. Cameras have any azimuth, elevations in -10
.. 60 degrees, fields of view in 14 .. 40 degrees, and see the whole object. Every view has a
depth map. Voxel axes are Kato's; the view classes are 24 cells of azimuth.
"""

from pathlib import Path
from typing import NoReturn

from learn3d.data.view_bins import AngleBins
from learn3d.files.reading import FaultHandler, MissingFile, refuse

BINS = AngleBins.parse("15x70:-10:60")


def load(
    folder: Path | str, category: str, split: str, *, on_fault: FaultHandler = refuse
) -> NoReturn:
    """Raise MissingFile, as only shards exist."""
    hint = "make them: learn3d make-dataset --layout around --shards"
    raise MissingFile(Path(folder), f"has no shards of {category}, {split}; {hint}")


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """No categories, as only shards exist."""
    return {}
