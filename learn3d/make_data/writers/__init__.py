"""Writers of data sets, one for each layout."""

from __future__ import annotations

from typing import Literal

from learn3d.make_data.writers.around import AroundWriter
from learn3d.make_data.writers.kato import DvrWriter, KatoWriter
from learn3d.make_data.writers.photographs import Pascal3dWriter, PhotosWriter
from learn3d.make_data.writers.shapenet import KarWriter, R2n2Writer
from learn3d.make_data.writers.writer import RenderedObject, Writer

__all__ = ["WRITERS", "RenderedObject", "Writer", "WrittenLayout"]

WRITERS: dict[str, type[Writer]] = {
    "kato": KatoWriter,
    "dvr": DvrWriter,
    "kar": KarWriter,
    "r2n2": R2n2Writer,
    "pascal3d": Pascal3dWriter,
    "photos": PhotosWriter,
    "around": AroundWriter,
}
WrittenLayout = Literal[tuple(WRITERS)]  # a layout may have a reader only
