"""Writers of data sets, one for each layout."""

from typing import Literal

from learn3d.studio.make_data.writers.kar import KAR
from learn3d.studio.make_data.writers.kato import AROUND, KATO
from learn3d.studio.make_data.writers.photographs import PASCAL3D, PHOTOS

WRITERS = {"kato": KATO, "kar": KAR, "pascal3d": PASCAL3D, "photos": PHOTOS, "around": AROUND}
WrittenLayout = Literal[tuple(WRITERS)]  # a layout may have a reader only
