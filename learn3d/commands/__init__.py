"""The program `learn3d`: each command is a class, whose module is imported when the command is known.

torch takes seconds to import, and Ctrl-C may come in the middle of it.
"""

from __future__ import annotations

import importlib
import sys
from importlib import metadata

from learn3d.terminal import note, say, unknown_name, without_traceback

#: Module and class of each command, the extra that has its packages, and what it does.
COMMANDS = {
    "train": ("train:Train", "train", "train a model that turns one image into a 3D shape"),
    "evaluate": ("models:Evaluate", "train", "measure trained models on a test set"),
    "reconstruct": ("models:Reconstruct", "train", "turn images into meshes with a trained model"),
    "export": ("models:Export", "train", "write a trained model into one small file"),
    "demo": ("pages:Demo", "demo", "a page that turns pictures into meshes"),
    "make-dataset": ("data:MakeDataset", "data", "render a data set from meshes"),
    "convert-dataset": ("data:ConvertDataset", "train", "keep a data set in shards, for data larger than memory"),
    "check-dataset": ("data:CheckDataset", "train", "list everything that is wrong with a data set"),
    "estimate-poses": ("poses:EstimatePoses", "train", "find the poses of images from their masks"),
    "experiment": ("train:Experiment", "train", "make a table of the paper: train, measure, report"),
    "figures": ("pages:Figures", "figures", "draw the paper's figures from trained models"),
    "report": ("pages:Report", "report", "write a page about trained models, with shapes to turn"),
    "fetch-debian-models": ("data:FetchDebianModels", "data", "get meshes out of Debian packages"),
}
HELP = """usage: learn3d COMMAND [OPTIONS]

{commands}

Options of a command: learn3d COMMAND --help (the common ones), --help-all (all)"""


@without_traceback(MemoryError, FloatingPointError)
def main(*given: str) -> int:
    """Run the command that `given`, or else the command line, names; returns the exit status."""
    name, *arguments = [*given, *sys.argv[1:]] or ["--help"]
    if name in ("-h", "--help", "--help-all"):
        say(HELP.format(commands="\n".join(f"  {command:19}  {text}" for command, (*_, text) in COMMANDS.items())))
        return 0
    if name == "--version":
        say(metadata.version("nmr-learn3d"))
        return 0
    if name not in COMMANDS:
        raise ValueError(unknown_name("command", name, COMMANDS))
    place, extra, _ = COMMANDS[name]
    module, _, kind = place.partition(":")
    try:
        command = getattr(importlib.import_module(f"learn3d.commands.{module}"), kind)
        return command.parse(name, arguments).run() or 0
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in ("", "learn3d", "nmr"):
            raise
        install = f"pip install '.[{extra}]' in a clone, 'FILE.whl[{extra}]' of a wheel"
        note(f"error: learn3d {name} needs the package {error.name}, which is not installed; install all: {install}")
        return 1
