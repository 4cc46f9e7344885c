"""`learn3d demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from learn3d.commands.command import Command
from learn3d.terminal import say


@dataclass(frozen=True)
class Demo(Command):
    """Open a page in the browser that turns pictures into meshes, and fits a mesh to silhouettes that you draw.

    Examples:
      learn3d demo
      learn3d demo --run runs/vanilla runs/proposed    (meshes of both, side by side)
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.arg(name="run")] = ()
    """Run folders (or checkpoint files) of trained models (default: the small model of the package)."""
    port: int = 7860
    """Port of the page's address, http://HOST:PORT."""
    host: str = "127.0.0.1"
    """Address to listen on. With 0.0.0.0 anybody in the network can use the page."""
    browser: bool = True
    """Open a browser, or only print the address."""

    def run(self) -> None:
        from learn3d.demo.page import serve

        serve(self.runs, host=self.host, port=self.port, browser=self.browser, report=say)
