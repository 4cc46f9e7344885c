"""How data sets are written: one file per layout, all with the interface of `learn3d.make_data.writers.writer`."""

from __future__ import annotations

from learn3d.data.layouts import Layout
from learn3d.make_data.writers.dvr import DvrWriter
from learn3d.make_data.writers.kar import KarWriter
from learn3d.make_data.writers.kato import KatoWriter
from learn3d.make_data.writers.pascal3d import Pascal3dWriter
from learn3d.make_data.writers.photos import PhotosWriter
from learn3d.make_data.writers.r2n2 import R2n2Writer
from learn3d.make_data.writers.writer import RenderedObject, Writer

__all__ = ["RenderedObject", "Writer", "writer_of"]


def writer_of(layout: Layout) -> type[Writer]:
    """The class that writes a layout. Raises ValueError for an unknown name."""
    writers = {
        "kato": KatoWriter,
        "dvr": DvrWriter,
        "kar": KarWriter,
        "r2n2": R2n2Writer,
        "pascal3d": Pascal3dWriter,
        "photos": PhotosWriter,
    }
    if layout not in writers:
        raise ValueError(f"layouts that can be written are {', '.join(writers)}; got {layout!r}")
    return writers[layout]
