"""The 13 ShapeNet categories of Kato's data set, the splits, and the names of their files."""

from pathlib import Path

SPLITS = ("train", "val", "test")
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
    forbidden = set('/\\:*?"<>|\0')
    if (
        not category
        or not category.isprintable()
        or set(category) & forbidden
        or category.startswith(".")
    ):
        raise ValueError(
            f"category must be a plain name such as 'chair' or a synset id, got {category!r}"
        )
    return SYNSETS.get(_OTHER_NAMES.get(category, category), category)


def find_splits(folder: Path | str, *patterns: str) -> dict[str, tuple[str, ...]]:
    """The categories of a folder and the splits of each. patterns: paths such as "*/SPLIT.txt"; * is the category."""
    found = {}
    for pattern in patterns:
        for split in SPLITS:
            before, after = pattern.replace("SPLIT", split).split("*")
            for path in Path(folder).glob(f"{before}*{after}"):
                name = path.relative_to(folder).as_posix().removeprefix(before).removesuffix(after)
                found.setdefault(name, set()).add(split)
    return {
        name: tuple(split for split in SPLITS if split in found[name]) for name in sorted(found)
    }
