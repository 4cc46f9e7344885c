"""Writers of data sets, one for each layout."""

from typing import Literal

from learn3d.studio.make_data.writers.kato import AROUND, DVR, KATO
from learn3d.studio.make_data.writers.photographs import PASCAL3D, PHOTOS
from learn3d.studio.make_data.writers.shapenet import KAR, R2N2

WRITERS = {"kato": KATO, "dvr": DVR, "kar": KAR, "r2n2": R2N2, "pascal3d": PASCAL3D, "photos": PHOTOS, "around": AROUND}
WrittenLayout = Literal[tuple(WRITERS)]  # a layout may have a reader only
