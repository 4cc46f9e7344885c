"""Take airplanes, chairs, tables, cabinets, sofas and lamps out of Debian packages, into a folder of PLY meshes.

Examples:
  learn3d fetch-debian-models --output models
  learn3d fetch-debian-models --output models --packages-dir debs --category airplane,chair
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from learn3d.commands.parsing import names, parse
from learn3d.make_data.debian.models import FetchConfig, fetch_debian_models
from learn3d.terminal import say


def run(arguments: Sequence[str]) -> int:
    """Fetch the models, and say how many there are."""
    config = parse(FetchConfig, arguments, name="fetch-debian-models", about=__doc__)
    config = dataclasses.replace(config, category=names(",".join(config.category)))
    say(fetch_debian_models(config).summary())
    return 0
