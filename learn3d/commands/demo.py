"""Open a page in the browser that turns pictures into meshes, and fits a mesh to silhouettes that you draw.

Examples:
  learn3d demo
  learn3d demo --run runs/vanilla runs/proposed    (meshes of both, side by side)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from learn3d.commands.parsing import parse
from learn3d.terminal import say


@dataclass(frozen=True)
class Command:
    """What is asked for."""

    run: tuple[Path, ...] = ()
    """Run folders (or checkpoint files) of trained models; without any, the small one that comes with the package."""
    port: int = 7860
    """Where the page is: http://HOST:PORT."""
    host: str = "127.0.0.1"
    """Address that is listened on. 0.0.0.0: anybody in the network can use the page."""
    browser: bool = True
    """Only print the address, and open no browser."""


def run(arguments: Sequence[str]) -> int:
    """Serve the page until Ctrl-C."""
    command = parse(Command, arguments, name="demo", about=__doc__)
    from learn3d.demo.page import serve

    serve(command.run, host=command.host, port=command.port, browser=command.browser, report=say)
    return 0
