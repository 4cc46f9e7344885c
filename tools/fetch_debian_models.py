"""Take airplanes, chairs, tables, cabinets, sofas and lamps out of Debian packages, into a folder of PLY meshes.

Examples:
  python tools/fetch_debian_models.py --output models
  python tools/fetch_debian_models.py --output models --packages-dir debs --category airplane chair
"""

import sys

import tyro

from learn3d.make_data.debian.models import FetchConfig, fetch_debian_models
from learn3d.terminal import in_a_sentence, say


@in_a_sentence()
def main() -> int:
    report = fetch_debian_models(tyro.cli(FetchConfig, description=__doc__))
    say(report.summary())
    return 0


if __name__ == "__main__":
    sys.exit(main())
