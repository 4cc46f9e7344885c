"""Writers of data sets: one file per layout, all with the interface of `learn3d.make_data.writers.writer`."""

from __future__ import annotations

from learn3d.make_data.writers.dvr import DvrWriter
from learn3d.make_data.writers.kar import KarWriter
from learn3d.make_data.writers.kato import KatoWriter
from learn3d.make_data.writers.pascal3d import Pascal3dWriter
from learn3d.make_data.writers.photos import PhotosWriter
from learn3d.make_data.writers.r2n2 import R2n2Writer
from learn3d.make_data.writers.writer import RenderedObject, Writer

__all__ = ["WRITERS", "KatoWriter", "RenderedObject", "Writer"]

WRITERS: dict[str, type[Writer]] = {
    "kato": KatoWriter,
    "dvr": DvrWriter,
    "kar": KarWriter,
    "r2n2": R2n2Writer,
    "pascal3d": Pascal3dWriter,
    "photos": PhotosWriter,
}
