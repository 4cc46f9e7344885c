"""Make a data set from a folder of meshes, a mesh pack or the procedural generator, in the layout of any that we read.

Examples:
  python tools/make_dataset.py --output data --category chair --source my_chairs --augment 5
  python tools/make_dataset.py --output data --category airplane --procedural 300
  python tools/make_dataset.py --output kar --category chair --source my_chairs --layout kar --views 20
  python tools/make_dataset.py --output pascal --category car --procedural 100 --layout pascal3d
"""

import sys

import tyro

from learn3d.make_data.render import DatasetConfig, make_dataset
from learn3d.terminal import in_a_sentence, say


@in_a_sentence()
def main() -> int:
    report = make_dataset(tyro.cli(DatasetConfig, description=__doc__))
    say(report.text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
