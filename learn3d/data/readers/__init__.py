"""Readers, a file per layout of published data sets."""

from learn3d.data.readers import around, dvr, kar, kato, pascal3d, photos, r2n2

#: By the name of the layout. Each module has its `PROPERTIES` and two functions. `load(folder, category, split, *,
#: findings, ...)` reads and checks a category (name or synset id) and split, with the keywords of `PROPERTIES.options`.
#: It raises MissingFile or DamagedFile for the first fault; if the findings are not strict, it notes all faults and
#: returns None. `contents(folder)` says which categories there are, with their splits.
READERS = {
    "kato": kato,
    "dvr": dvr,
    "kar": kar,
    "r2n2": r2n2,
    "pascal3d": pascal3d,
    "photos": photos,
    "around": around,
}
