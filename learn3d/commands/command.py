"""A command is a dataclass: its docstring describes it, its fields are its options, the strings below explain these.

tyro parses the command line into it and writes the help. If a field's default is not a value but stands for "not
given", its text says what happens then, in parentheses: "(default: ...)".
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import shutil
import textwrap
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeAlias

import docstring_parser
import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from learn3d.settings import RARE

Split: TypeAlias = Literal["train", "val", "test"]
Which: TypeAlias = Annotated[Literal["last", "best"], tyro.conf.arg(name="checkpoint")]
Runs = tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="RUN [RUN ...]", help_behavior_hint="")]]


@dataclass(frozen=True)
class Command:
    """Base class of all commands."""

    @classmethod
    def about(cls, everything: bool) -> str:
        """The text above the options in --help, or, with `everything`, in --help-all."""
        return inspect.getdoc(cls) or ""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> Mapping[str, Any]:
        """Values of options that depend on other options, by name. They replace the defaults of the fields."""
        return {}

    @classmethod
    def parse(cls, name: str, arguments: Sequence[str]) -> Self:
        """The command with the options that are given. Prints the help and ends if that is asked for."""
        defaults, everything = cls.defaults(arguments), "--help-all" in arguments
        about, brief = "", bool({"-h", "--help"} & set(arguments)) and not everything
        if brief or everything:
            about = cls.about(everything)
        if brief and any(tyro.conf.Suppress in _marks(o.type) for o in _options(cls, None, defaults, brief=True)):
            about += f"\n\nlearn3d {name} --help-all shows more options."
        build = tyro.cli(
            cls,
            args=["--help"] if everything else arguments,
            prog=f"learn3d {name}",
            description=wrap(about),
            config=(tyro.conf.OmitArgPrefixes,),
            registry=_registry(defaults, brief),
        )
        return build()

    def run(self) -> int | None:
        """Do the work; returns the exit status if that is not 0."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class OnDataset(Command):
    """Options of commands that take trained networks to a data set."""

    data: Path | None = None
    """Folder of the data set (default: the one that each run was trained on)."""
    category: str | None = None
    """Categories, separated by commas (default: those that each run was trained on)."""
    split: Split = "test"
    """Part of the data set."""
    which: Which = "last"
    """Networks of a run to use: the last ones, or those with the best validation IoU."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device on which the networks run."""

    @property
    def where(self) -> dict[str, Any]:
        """The options above by name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(OnDataset)}


def wrap(text: str) -> str:
    """A docstring for the width of the terminal: paragraphs are filled, lines that begin with a space stay apart.

    Command lines are never broken, as users copy them. Filled lines get a hanging indent: tyro would join them again.
    """
    width, lines = shutil.get_terminal_size((100, 40)).columns, []
    for line in text.splitlines():
        if line[:1].strip() and lines and lines[-1][:1].strip():  # both are of one paragraph
            lines[-1] += f" {line}"
        else:
            lines.append(line)
    return "\n".join(map(functools.partial(_fill, width=width), lines))


def _fill(line: str, width: int) -> str:
    if line.lstrip().startswith(("learn3d", "torchrun")):
        return line
    start = re.match(r" +\S.*?  +| *", line)[0]  # up to the text of a line such as "  NAME    text"
    return textwrap.fill(line, width, subsequent_indent=" " * max(2, len(start)))


def _registry(defaults: Mapping[str, Any], brief: bool) -> ConstructorRegistry:
    """How tyro sees a dataclass: `defaults` replace its own, and the fields of a dataclass in it are options, too.

    brief: hide rare options.
    """
    registry = ConstructorRegistry()

    @registry.struct_rule
    def options_of(info: StructTypeInfo) -> StructConstructorSpec | None:
        if not dataclasses.is_dataclass(info.type):
            return None
        fields = tuple(_options(info.type, info.default, defaults, brief))
        # It is built afterwards: tyro would catch the ValueError of a value that is refused.
        return StructConstructorSpec(lambda **values: functools.partial(_build, info.type, defaults, values), fields)

    return registry


def _options(
    kind: type, instance: Any, defaults: Mapping[str, Any], brief: bool, rare: bool = False
) -> Iterator[StructFieldSpec]:
    """The options of a dataclass, which are its fields and those of the dataclasses in it."""
    hints, texts = typing.get_type_hints(kind, include_extras=True), _texts(kind)
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        value = tyro.MISSING if field.default is dataclasses.MISSING else field.default
        value = getattr(instance, field.name) if isinstance(instance, kind) else defaults.get(field.name, value)
        hidden = brief and (rare or RARE in _marks(hint))
        if inner := _inner(hint, value):
            yield from _options(inner, value, defaults, brief, hidden)
            continue
        text = texts.get(field.name, "")
        explained = "(default: " in text
        if field.default is None and (explained or field.name in defaults):  # None is nothing that one could type
            hint = tyro.conf.DisallowNone[hint]
        if value is False:
            hint = tyro.conf.FlagCreatePairsOff[hint]
        if explained or value is False or value in ((), ""):
            label = "" if explained or value is False else "(default: none)"
            hint = Annotated[hint, tyro.conf.arg(help_behavior_hint=label)]
        yield StructFieldSpec(field.name, tyro.conf.Suppress[hint] if hidden else hint, value, text)


def _build(kind: type, defaults: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
    """The dataclass of these options."""
    hints, given = typing.get_type_hints(kind), {}
    for field in dataclasses.fields(kind):
        inner = _inner(hints[field.name], defaults.get(field.name))
        given[field.name] = _build(inner, defaults, values) if inner else values[field.name]
    return kind(**given)


def _inner(hint: Any, value: Any) -> type | None:
    """The dataclass that a field holds, None for a field of another type."""
    kind = type(value) if dataclasses.is_dataclass(value) else hint
    return kind if dataclasses.is_dataclass(kind) else None


def _marks(hint: Any) -> tuple[Any, ...]:
    return getattr(hint, "__metadata__", ())


def _texts(kind: type) -> dict[str, str]:
    """The strings below the fields of a dataclass and of its base classes, each in one line."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        for text in docstring_parser.parse_from_object(base).params:
            texts[text.arg_name] = " ".join((text.description or "").split())
    return texts
