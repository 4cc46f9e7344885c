"""Render a data set from a folder of meshes, a mesh pack or procedural shapes, in the layout of a published data set.

Examples:
  learn3d make-dataset --output data --category chair --source my_chairs --augment 5
  learn3d make-dataset --output data --category airplane --procedural 300
  learn3d make-dataset --output kar --category chair --source my_chairs --layout kar --views 20
  learn3d make-dataset --output big --category chair --source my_chairs --shards --jobs 8
  learn3d make-dataset --output pascal --category car --procedural 100 --layout pascal3d
"""

from __future__ import annotations

from collections.abc import Sequence

from learn3d.commands.parsing import parse
from learn3d.make_data.render import DatasetConfig, make_dataset
from learn3d.make_data.sharded import make_shards
from learn3d.terminal import say

COMMON = ("output", "category", "layout", "views", "source", "procedural", "test", "val", "augment", "up", "front")
COMMON += ("overwrite", "shards", "jobs")


def run(arguments: Sequence[str]) -> int:
    """Make the data set, and say what was made."""
    config = parse(DatasetConfig, arguments, name="make-dataset", about=__doc__, common=COMMON)
    if config.shards:
        return make_shards(config)
    say(make_dataset(config).text())
    return 0
