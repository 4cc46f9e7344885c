"""Take airplanes, chairs, tables, cabinets, sofas and lamps out of Debian packages, into a folder of PLY meshes.

Examples:
  python tools/fetch_debian_models.py --output models
  python tools/fetch_debian_models.py --output models --packages-dir debs --categories airplane chair
"""

import sys

import tyro

from learn3d.data.debian_models import FetchConfig, fetch_debian_models


def main() -> None:
    config = tyro.cli(FetchConfig, description=__doc__)
    try:
        report = fetch_debian_models(config)
    except (ValueError, OSError) as error:
        sys.exit(f"fetch_debian_models: {error}")
    print(report.summary())


if __name__ == "__main__":
    main()
