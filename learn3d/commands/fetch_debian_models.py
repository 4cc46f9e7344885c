"""Take airplanes, chairs, tables, cabinets, sofas and lamps out of Debian packages, into a folder of PLY meshes.

Examples:
  learn3d fetch-debian-models --output models
  learn3d fetch-debian-models --output models --packages-dir debs --category airplane,chair
"""

from __future__ import annotations

from collections.abc import Sequence

from learn3d.commands.parsing import parse
from learn3d.make_data.debian.models import FetchConfig, fetch_debian_models
from learn3d.terminal import say


def run(arguments: Sequence[str]) -> int:
    """Fetch the models, and say how many there are."""
    say(fetch_debian_models(parse(FetchConfig, arguments, name="fetch-debian-models", about=__doc__)).summary())
    return 0
