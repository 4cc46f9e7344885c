"""`learn3d fetch-debian-models`."""

from __future__ import annotations

from dataclasses import dataclass

from learn3d.commands.command import Command
from learn3d.make_data.debian.models import FetchConfig, fetch_debian_models
from learn3d.terminal import say


@dataclass(frozen=True)
class FetchDebianModels(Command):
    """Take airplanes, chairs, tables, cabinets, sofas and lamps out of Debian packages, into a folder of PLY meshes.

    Examples:
      learn3d fetch-debian-models --output models
      learn3d fetch-debian-models --output models --packages-dir debs --category airplane,chair
    """

    config: FetchConfig

    def run(self) -> None:
        say(fetch_debian_models(self.config).summary())
