"""Real meshes (airplanes, chairs, tables, cabinets, sofas, lamps) out of Debian packages, into a folder of PLY files.

    python tools/fetch_debian_models.py --output models
"""

from __future__ import annotations

import sys

import tyro

from learn3d.data.debian_models import FetchConfig, fetch_debian_models


def main() -> int:
    """Parse, fetch, print; 1 with one sentence when it cannot be done."""
    config = tyro.cli(FetchConfig, description=__doc__)
    try:
        report = fetch_debian_models(config)
    except (ValueError, OSError) as error:
        print(f"fetch_debian_models: {error}", file=sys.stderr)
        return 1
    print(report.summary())
    return 0


if __name__ == "__main__":
    sys.exit(main())
