"""The program `learn3d`: each command is a class in a module of its own, which is imported when the command is known.

torch takes seconds to import, and Ctrl-C may come in the middle of it.
"""

from __future__ import annotations

import importlib
import sys
from importlib import metadata

from learn3d.commands.packages import missing_package
from learn3d.terminal import note, say, unknown_name, without_traceback

#: Module and class of each command, and what it does.
COMMANDS = {
    "train": ("train:Train", "train a model that turns one image into a 3D shape"),
    "evaluate": ("evaluate:Evaluate", "measure trained models on a test set"),
    "reconstruct": ("reconstruct:Reconstruct", "turn images into meshes with a trained model"),
    "export": ("export:Export", "write a trained model into one small file"),
    "demo": ("demo:Demo", "a page that turns pictures into meshes"),
    "make-dataset": ("make_dataset:MakeDataset", "render a data set from meshes"),
    "convert-dataset": ("convert_dataset:ConvertDataset", "keep a data set in shards, for data larger than memory"),
    "check-dataset": ("check_dataset:CheckDataset", "list everything that is wrong with a data set"),
    "experiment": ("experiment:Experiment", "make a table of the paper: train, measure, report"),
    "figures": ("figures:Figures", "draw the paper's figures from trained models"),
    "report": ("report:Report", "write a page about trained models, with shapes to turn"),
    "fetch-debian-models": ("fetch_debian_models:FetchDebianModels", "get meshes out of Debian packages"),
}
HELP = """usage: learn3d COMMAND [OPTIONS]

{commands}

Options of a command: learn3d COMMAND --help (the common ones), --help-all (all)
"""


@without_traceback(MemoryError, FloatingPointError)
def main(*given: str) -> int:
    """Run the command that `given`, or else the command line, names; returns the exit status."""
    name, *arguments = [*given, *sys.argv[1:]] or ["--help"]
    if name in ("-h", "--help", "--help-all"):
        width = max(map(len, COMMANDS))
        say(HELP.format(commands="\n".join(f"  {command:{width}}  {text}" for command, (_, text) in COMMANDS.items())))
        return 0
    if name == "--version":
        say(metadata.version("nmr-learn3d"))
        return 0
    if name not in COMMANDS:
        raise ValueError(unknown_name("command", name, COMMANDS))
    module, _, kind = COMMANDS[name][0].partition(":")
    try:
        command = getattr(importlib.import_module(f"learn3d.commands.{module}"), kind)
        return command.parse(name, arguments).run() or 0
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "learn3d", "nmr"):
            raise
        note(f"error: learn3d {name} {missing_package(package, name)}")
        return 1
