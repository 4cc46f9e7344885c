"""Make a data set in Kato's layout from a folder of meshes, a mesh pack or the procedural generator.

Examples:
  python tools/make_dataset.py --output data --category chair --source my_chairs --augment 5
  python tools/make_dataset.py --output data --category airplane --procedural 300
"""

import sys

import tyro

from learn3d.data.render import DatasetConfig, make_dataset


def main() -> None:
    config = tyro.cli(DatasetConfig, description=__doc__)
    try:
        report = make_dataset(config)
    except (ValueError, OSError) as error:
        sys.exit(f"make_dataset: {error}")
    print(report.text())


if __name__ == "__main__":
    main()
