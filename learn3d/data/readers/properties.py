"""What sets the layouts of data sets apart, beside their readers."""

from __future__ import annotations

from dataclasses import dataclass

from learn3d.data.conventions import VoxelConvention


@dataclass(frozen=True)
class LayoutProperties:
    """What is true of all data sets of a layout."""

    voxels: bool  # there are true shapes, with which voxel IoU can be measured
    convention: VoxelConvention  # axes of the true shapes
    inverted: bool  # colours are stored as 255 - colour over black, see `ViewDataset.inverted`
    validation: bool = True  # there is a split "val"; without one, networks are validated on "test"
    angles: bool = True  # cameras have azimuth and elevation, whose cells can serve as view classes
    stretched: bool = False  # images are the object's box of a photograph, stretched to a square over its background
    options: tuple[str, ...] = ()  # of `load_dataset`, beside view_bins, that the reader knows
