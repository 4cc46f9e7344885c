"""Writers of data sets, one for each layout."""

from typing import Literal

from learn3d.studio.make_data.writers.kar import KAR_WRITER
from learn3d.studio.make_data.writers.kato import AROUND_WRITER, KATO_WRITER
from learn3d.studio.make_data.writers.photographs import PASCAL3D_WRITER, PHOTOS_WRITER

WRITERS = {
    "kato": KATO_WRITER,
    "kar": KAR_WRITER,
    "pascal3d": PASCAL3D_WRITER,
    "photos": PHOTOS_WRITER,
    "around": AROUND_WRITER,
}
WrittenLayout = Literal[tuple(WRITERS)]  # a layout may have a reader only
