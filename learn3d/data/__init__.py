"""Data sets: one batch type, readers that hide each data set's oddities, and the maker of data sets from meshes."""

from learn3d.data.batch import Batch
from learn3d.data.kato import KatoDataset, synset_of

__all__ = ["Batch", "KatoDataset", "synset_of"]
