"""Commands as dataclasses: the docstring describes the command, its fields are options, the texts below them the help.

tyro parses the command line and writes the help. If a field holds a dataclass, its fields are options, too. If a
default means "not given", the help text explains it in parentheses: "(default: ...)".
"""

import dataclasses
import inspect
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import docstring_parser
import tyro
from typing_extensions import Self, dataclass_transform  # in typing from Python 3.11 on

from learn3d.settings import RARE

Split: TypeAlias = Literal["train", "val", "test"]
Which: TypeAlias = Annotated[Literal["last", "best"], tyro.conf.arg(name="checkpoint")]
Runs = tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="RUN [RUN ...]", help_behavior_hint="")]]
DataFolder = tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="DATA")]]


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Command:
    """Base class of commands, which become frozen dataclasses. `run` does the work and may return an exit status."""

    def __init_subclass__(cls) -> None:
        dataclasses.dataclass(frozen=True, kw_only=True)(cls)

    @classmethod
    def about(cls, everything: bool) -> str:
        """The text above the options in --help; with `everything`, in --help-all."""
        return inspect.getdoc(cls) or ""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> Mapping[str, Any]:
        """Defaults that depend on other options, by name. They replace the defaults of the fields."""
        return {}

    @classmethod
    def parse(cls, name: str, arguments: Sequence[str]) -> Self:
        """The command with the given options. Prints the help and exits if --help is among them."""
        defaults, everything = cls.defaults(arguments), "--help-all" in arguments
        brief = bool({"-h", "--help"} & set(arguments)) and not everything
        about = cls.about(everything) if brief or everything else ""
        if brief and any(rare for *_, rare in _options(cls, defaults)):
            about += f"\n\nlearn3d {name} --help-all shows more options."
        # tyro parses into a flat dataclass without checks, because it would catch the ValueError of a refused value.
        words = ["--help"] if everything else arguments
        flat = tyro.cli(cls.flat(defaults, brief), args=words, prog=f"learn3d {name}", description=about)
        return _build(cls, defaults, vars(flat))

    @classmethod
    def flat(cls, defaults: Mapping[str, Any], brief: bool = False) -> type:
        """A dataclass of all options for tyro. With `brief` the rare ones are hidden."""
        options = _options(cls, defaults)
        fields = [(n, tyro.conf.Suppress[hint] if brief and rare else hint, field) for n, hint, field, rare in options]
        return dataclasses.make_dataclass(cls.__name__, fields, kw_only=True)

    def given(self, *names: str) -> dict[str, Any]:
        """Those of the options that differ from their defaults, by name."""
        return {name: getattr(self, name) for name in names if getattr(self, name) != getattr(type(self), name)}

    def refuse(self, kind: str, *names: str) -> None:
        """Raise ValueError if options are given that do not go with others (`kind`)."""
        if wrong := self.given(*names):
            options = ", ".join(f"--{name.replace('_', '-')}" for name in wrong)
            raise ValueError(f"{options} does not go with {kind}; leave it out")


class OnDataset(Command):
    """Options of commands that apply trained networks to a data set."""

    data: Path | None = None
    """Folder of the data set (default: the run's training data)."""
    category: str | None = None
    """Categories, separated by commas (default: the run's)."""
    split: Split = "test"
    """Part of the data set."""
    which: Which = "last"
    """Checkpoint of a run: the last one, or the one with the best validation IoU (of silhouettes at novel views, if the
    data have several views of an object)."""

    def pick(self, *names: str) -> dict[str, Any]:
        """The options above by name, and others."""
        return {name: getattr(self, name) for name in ("data", "category", "split", "which", *names)}


def _options(
    kind: type, defaults: Mapping[str, Any], instance: Any = None, rare: bool = False
) -> Iterator[tuple[str, Any, Any, bool]]:
    """Name, type, field and rarity of each option of a dataclass and of the dataclasses in it.

    The values of an `instance` have precedence over the defaults of its fields.
    """
    hints = typing.get_type_hints(kind, include_extras=True)
    bases = [docstring_parser.parse_from_object(base).params for base in reversed(kind.__mro__[:-1])]
    texts = {text.arg_name: " ".join((text.description or "").split()) for texts in bases for text in texts}
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        value = getattr(instance, field.name, defaults.get(field.name, field.default))
        is_rare = rare or RARE in getattr(hint, "__metadata__", ())
        if inner := _inner(hint, value):
            yield from _options(inner, defaults, value, is_rare)
            continue
        text = texts.get(field.name, "")
        explained = "(default: " in text
        if field.default is None and (explained or field.name in defaults):
            hint = tyro.conf.DisallowNone[hint]  # None means "not given"
        if value is False:
            hint = tyro.conf.FlagCreatePairsOff[hint]
        shown = {"help_behavior_hint": ""} if explained or value is False or value in ((), "") else {}
        hint = Annotated[hint, tyro.conf.arg(help=text, **shown)]
        yield field.name, hint, dataclasses.field(default=value), is_rare


def _build(kind: type, defaults: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
    """An instance of the dataclass, and of those in it, from the values of the options."""
    hints, given = typing.get_type_hints(kind), {}
    for field in dataclasses.fields(kind):
        inner = _inner(hints[field.name], defaults.get(field.name))
        given[field.name] = _build(inner, defaults, values) if inner else values[field.name]
    return kind(**given)


def _inner(hint: Any, value: Any) -> type | None:
    """The dataclass that a field holds; None for other types."""
    kind = type(value) if dataclasses.is_dataclass(value) else hint
    return kind if dataclasses.is_dataclass(kind) else None
