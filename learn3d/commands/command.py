"""Commands as dataclasses: the docstring describes the command, its fields are options, the texts
below them the help.

tyro parses the command line and writes the help. If a field holds a dataclass, its fields are
options, too.
"""

import dataclasses
import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import docstring_parser
import tyro
from typing_extensions import Self, dataclass_transform  # in typing from Python 3.11 on

from learn3d.settings import checked

Split: TypeAlias = Literal["train", "val", "test"]
Which: TypeAlias = Annotated[Literal["last", "best"], tyro.conf.arg(name="checkpoint")]
Runs = tyro.conf.Positional[
    Annotated[tuple[Path, ...], tyro.conf.arg(metavar="RUN [RUN ...]", help_behavior_hint="")]
]
DataFolder = tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="DATA")]]

HELP = {"-h", "--help"}
#: Options of nested dataclasses have no prefixes.
FLAT = (tyro.conf.OmitArgPrefixes, tyro.conf.AvoidSubcommands)


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Command:
    """Base class of commands, which become `checked` dataclasses.

    `run` does the work and may return an exit status.
    """

    def __init_subclass__(cls) -> None:
        checked(cls, kw_only=True)

    @classmethod
    def about(cls) -> str:
        """The text above the options in --help."""
        return inspect.getdoc(cls) or ""

    @classmethod
    def default(cls, arguments: Sequence[str]) -> Self | None:
        """The values of options that are not given, if they depend on those that are; None: as
        the fields say.
        """
        return None

    @classmethod
    def parse(cls, name: str, arguments: Sequence[str]) -> Self:
        """The command with the given options. Prints the help and exits if --help is among them."""
        about = ""
        default = cls.default(arguments)
        if HELP & set(arguments):
            about = cls.about()
            _join_help_lines(cls, default)
        given = {} if default is None else {"default": default}
        return tyro.cli(
            cls, args=arguments, prog=f"learn3d {name}", description=about, config=FLAT, **given
        )

    def given(self, *names: str) -> dict[str, Any]:
        """Those of the options that differ from their defaults, by name."""
        return {
            name: getattr(self, name)
            for name in names
            if getattr(self, name) != getattr(type(self), name)
        }

    def refuse(self, kind: str, *names: str) -> None:
        """Raise ValueError if options are given that do not go with others (`kind`)."""
        if wrong := self.given(*names):
            options = ", ".join(f"--{name.replace('_', '-')}" for name in wrong)
            raise ValueError(f"{options} does not go with {kind}; leave it out")


def _join_help_lines(kind: type, default: object) -> None:
    """Take the source's line breaks, which tyro keeps, out of the help of a dataclass's options.

    default: an instance, or None.
    """
    options = {option.name: option for option in dataclasses.fields(kind)}
    for base in reversed(kind.__mro__[:-1]):
        for text in docstring_parser.parse_from_object(base).params:
            if text.description and text.arg_name in options:
                help_text = " ".join(text.description.split())
                options[text.arg_name].metadata = {"help": help_text}
    for name, option in options.items():
        value = getattr(default, name, None)
        nested = option.type if value is None else type(value)
        if dataclasses.is_dataclass(nested):
            _join_help_lines(nested, value)


class OnDataset(Command):
    """Options of commands that apply trained networks to a data set."""

    data: Path | None = None
    """Folder of the data set. If not given: the run's training data."""
    category: str | None = None
    """Categories, separated by commas. If not given: the run's."""
    split: Split = "test"
    """Part of the data set."""
    which: Which = "last"
    """Checkpoint of a run: the last one, or the one with the best validation IoU (of silhouettes
    at novel views, if the data have several views of an object)."""

    def pick(self, *names: str) -> dict[str, Any]:
        """The options above by name, and others."""
        return {
            name: getattr(self, name) for name in ("data", "category", "split", "which", *names)
        }
