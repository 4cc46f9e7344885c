"""Readers, a file per layout of published data sets."""

from learn3d.data.readers import dvr, kar, kato, pascal3d, photos, r2n2

#: By the name of the layout. Each module has its `PROPERTIES` and four functions: `load` (the data set of a category
#: and split), `problems` (what is wrong with its files), `contents` (categories and splits of a folder) and `count`
#: (the objects of a split).
READERS = {"kato": kato, "dvr": dvr, "kar": kar, "r2n2": r2n2, "pascal3d": pascal3d, "photos": photos}
