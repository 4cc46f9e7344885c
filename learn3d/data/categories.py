"""The 13 ShapeNet categories of Kato's data set, and the prefixes of their file names."""

from __future__ import annotations

SYNSETS = {
    "airplane": "02691156",
    "bench": "02828884",
    "cabinet": "02933112",
    "car": "02958343",
    "chair": "03001627",
    "display": "03211117",
    "lamp": "03636649",
    "loudspeaker": "03691459",
    "rifle": "04090263",
    "sofa": "04256520",
    "table": "04379243",
    "telephone": "04401088",
    "vessel": "04530566",
}
_OTHER_NAMES = {"aeroplane": "airplane"}  # in Pascal3D+


def synset_of(category: str) -> str:
    """File name prefix of a category: the ShapeNet synset id of Kato's 13 names; any other name is its own prefix.

    Raises ValueError for an empty name or one that cannot be part of a file name.
    """
    if not isinstance(category, str) or not category or set(category) & set('/\\:*?"<>|\0') or category.startswith("."):
        raise ValueError(f"category must be a plain name such as 'chair' or a synset id, got {category!r}")
    if not category.isprintable():
        raise ValueError(f"category must be a plain name, without control characters, got {category!r}")
    return SYNSETS.get(_OTHER_NAMES.get(category, category), category)
