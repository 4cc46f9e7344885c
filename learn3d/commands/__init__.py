"""The program `learn3d`.

Each command is a class; its module is imported when the command is called.

torch takes seconds to import. So it is imported inside of `main`, which handles Ctrl-C.
"""

import contextlib
import importlib
import sys
from importlib import metadata
from typing import Annotated, Any, Union

from learn3d.terminal import closed_pipe_ends, note, say, unknown_name, without_traceback

#: For each command: its module below learn3d and its class, the extra that installs its packages, and a description.
COMMANDS = {
    "train": (
        "commands.train:Train",
        "train",
        "train a model that turns one image into a 3D shape",
    ),
    "evaluate": ("commands.train:Evaluate", "train", "measure trained models on a test set"),
    "reconstruct": (
        "studio.commands:Reconstruct",
        "train",
        "turn images into meshes with a trained model",
    ),
    "export": ("studio.commands:Export", "train", "write a trained model into one small file"),
    "demo": ("studio.commands:Demo", "demo", "open a page that turns pictures into meshes"),
    "make-dataset": ("studio.commands:MakeDataset", "train", "render a data set from meshes"),
    "convert-dataset": (
        "commands.data:ConvertDataset",
        "train",
        "convert a data set larger than memory into shards",
    ),
    "check-dataset": (
        "commands.data:CheckDataset",
        "train",
        "list everything that is wrong with a data set",
    ),
    "estimate-poses": (
        "studio.commands:EstimatePoses",
        "train",
        "find the poses of images from their masks",
    ),
    "experiment": (
        "studio.commands:Experiment",
        "train",
        "make a table of the paper: train, measure, report",
    ),
    "figures": (
        "studio.commands:Figures",
        "figures",
        "draw the paper's figures from trained models",
    ),
    "report": (
        "studio.commands:Report",
        "report",
        "write a page about trained models, with shapes to turn",
    ),
}
HELP = """usage: learn3d COMMAND [OPTIONS]

{commands}

Options of a command: learn3d COMMAND --help
Tab completion in new shells:
  mkdir -p ~/.local/share/bash-completion/completions
  learn3d --completion bash > ~/.local/share/bash-completion/completions/learn3d
or, with zsh and a folder in its $fpath: learn3d --completion zsh > FOLDER/_learn3d"""


@without_traceback
def main(*given: str) -> int:
    """Run the command line, with the words `given` before it; returns the exit status."""
    name, *arguments = [*given, *sys.argv[1:]] or ["--help"]
    if name in ("-h", "--help"):
        say(
            HELP.format(
                commands="\n".join(
                    f"  {command:19}  {text}" for command, (*_, text) in COMMANDS.items()
                )
            )
        )
    elif name == "--version":
        say(metadata.version("nmr-learn3d"))
    elif name == "--completion":
        print_completion(*arguments[:1])
    elif name in COMMANDS:
        try:
            with closed_pipe_ends():
                command = _load(name).parse(name, arguments)
            return command.run() or 0
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] in ("", "learn3d", "nmr"):
                raise
            extra = COMMANDS[name][1]
            install = f"pip install '.[{extra}]' in a clone, 'FILE.whl[{extra}]' of a wheel"
            note(
                f"error: learn3d {name} needs the package {error.name}, which is not installed; install all: {install}"
            )
            return 1
    else:
        raise ValueError(unknown_name("command", name, COMMANDS))
    return 0


def _load(name: str) -> Any:
    """The class of a command."""
    module, _, kind = COMMANDS[name][0].partition(":")
    return getattr(importlib.import_module(f"learn3d.{module}"), kind)


def print_completion(shell: str = "bash") -> None:
    """Print the shell script of tab completion.

    Commands whose packages are not installed are left out.
    """
    import tyro

    if shell not in ("bash", "zsh"):
        raise ValueError(f"--completion takes bash or zsh, got {shell!r}")
    kinds = []
    for name in COMMANDS:
        with contextlib.suppress(ModuleNotFoundError):
            kind = _load(name)
            default = kind.default([])
            given = {} if default is None else {"default": default}
            kinds.append(Annotated[kind, tyro.conf.subcommand(name, **given)])
    words = ["--tyro-print-completion", shell]
    with contextlib.suppress(SystemExit):
        tyro.cli(
            Union[tuple(kinds)],  # noqa: UP007 (`|` takes no tuple)
            prog="learn3d",
            args=words,
            config=(tyro.conf.OmitArgPrefixes,),
        )
