"""Readers, a file per layout of published data sets."""

from learn3d.data.readers import around, dvr, kar, kato, pascal3d, photos

#: Layout -> module with `PROPERTIES` and two functions. `load(folder, category, split, *, findings, ...)` reads a split
#: of a category (name or synset id), with the keywords `PROPERTIES.options`. It raises MissingFile or DamagedFile for
#: the first fault; if the findings are not strict, it records all faults and returns None. `contents(folder)` returns
#: the categories of a folder and the splits of each.
READERS = {
    "kato": kato,
    "dvr": dvr,
    "kar": kar,
    "pascal3d": pascal3d,
    "photos": photos,
    "around": around,
}
