"""`learn3d make-dataset`."""

from __future__ import annotations

from dataclasses import dataclass

from learn3d.commands.command import Command
from learn3d.make_data.render import DatasetConfig, make_dataset
from learn3d.make_data.sharded import make_shards
from learn3d.terminal import say


@dataclass(frozen=True)
class MakeDataset(Command):
    """Render a data set from a folder of meshes, a mesh pack or procedural shapes, in the layout of a published one.

    Examples:
      learn3d make-dataset --output data --category chair --source my_chairs --augment 5
      learn3d make-dataset --output data --category airplane --procedural 300
      learn3d make-dataset --output kar --category chair --source my_chairs --layout kar --views 20
      learn3d make-dataset --output big --category chair --source my_chairs --shards --jobs 8
      learn3d make-dataset --output pascal --category car --procedural 100 --layout pascal3d
    """

    config: DatasetConfig

    def run(self) -> int:
        if self.config.shards:
            return make_shards(self.config)
        say(make_dataset(self.config).text())
        return 0
