"""The commands `learn3d train`, `learn3d evaluate` ...: a module each, which parses, calls one function and prints.

Nothing heavy is imported before the command is known: torch takes seconds, and Ctrl-C may come in the middle of it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import metadata

from learn3d.commands.packages import missing_package
from learn3d.terminal import note, say, without_traceback

COMMANDS = {
    "train": "train a model that turns one image into a 3D shape",
    "evaluate": "measure trained models on a test set",
    "reconstruct": "turn images into meshes with a trained model",
    "export": "write a trained model into one small file",
    "demo": "a page that turns pictures into meshes",
    "make-dataset": "render a data set from meshes",
    "convert-dataset": "keep a data set in shards, for data larger than memory",
    "check-dataset": "list everything that is wrong with a data set",
    "experiment": "make a table of the paper: train, measure, report",
    "figures": "draw the paper's figures from trained models",
    "report": "write a page about trained models, with shapes to turn",
    "fetch-debian-models": "get meshes out of Debian packages",
}
HELP = """usage: learn3d COMMAND [OPTIONS]

{commands}

learn3d COMMAND --help has the common options of a command, --help-all has all of them.
"""


@without_traceback(MemoryError)
def main(*given: str) -> int:
    """Run the command that `given`, or else the command line, names; returns the exit status."""
    name, *arguments = [*given, *sys.argv[1:]] or ["--help"]
    if name in ("-h", "--help", "--help-all"):
        width = max(map(len, COMMANDS))
        say(HELP.format(commands="\n".join(f"  {command:{width}}  {text}" for command, text in COMMANDS.items())))
        return 0
    if name == "--version":
        say(metadata.version("nmr-learn3d"))
        return 0
    if name not in COMMANDS:
        raise ValueError(f"there is no command {name!r}; choose one of {', '.join(COMMANDS)}")
    try:
        return _command(name)(arguments)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "learn3d", "nmr"):
            raise
        note(f"error: learn3d {name} {missing_package(package, name)}")
        return 1


def _command(name: str) -> Callable[[Sequence[str]], int]:
    if name == "train":
        from learn3d.commands.train import run
    elif name == "evaluate":
        from learn3d.commands.evaluate import run
    elif name == "reconstruct":
        from learn3d.commands.reconstruct import run
    elif name == "export":
        from learn3d.commands.export import run
    elif name == "demo":
        from learn3d.commands.demo import run
    elif name == "make-dataset":
        from learn3d.commands.make_dataset import run
    elif name == "convert-dataset":
        from learn3d.commands.convert_dataset import run
    elif name == "check-dataset":
        from learn3d.commands.check_dataset import run
    elif name == "experiment":
        from learn3d.commands.experiment import run
    elif name == "figures":
        from learn3d.commands.figures import run
    elif name == "report":
        from learn3d.commands.report import run
    else:
        from learn3d.commands.fetch_debian_models import run
    return run
