"""Command lines, parsed by tyro into a dataclass; a short --help and a complete --help-all."""

from __future__ import annotations

import dataclasses
import shutil
import textwrap
import types
import typing
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro

T = TypeVar("T")
_WORDS = {int: "N", float: "X", str: "NAME", Path: "PATH"}  # what stands for a value in the help


def parse(
    kind: type[T],
    arguments: Sequence[str],
    *,
    name: str,
    about: str,
    more: str = "",
    common: Collection[str] = (),
    default: T | None = None,
) -> T:
    """The options of `learn3d <name>`.

    --help shows `about` and the options in `common` (all where it is empty), --help-all adds `more` and the others.
    """
    style, complete = (tyro.conf.FlagCreatePairsOff,), "--help-all" in arguments
    if complete or {"-h", "--help"} & set(arguments):
        kind, default = _for_help(kind, default, () if complete else common)
        extra = more if complete else f"More options: learn3d {name} --help-all" if common else ""
        about, arguments = _wrapped(f"{about}\n{extra}".strip()), ["--help"]
    return tyro.cli(kind, args=arguments, prog=f"learn3d {name}", description=about, default=default, config=style)


def names(text: str) -> tuple[str, ...]:
    """The names in a list with commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _for_help(kind: type, default: Any, common: Collection[str]) -> tuple[type, Any]:
    """One dataclass for the help, with the fields of those inside it: values in plain words, what is not common hidden.

    It inherits from them, which is where tyro finds the text of each field.
    """
    kinds, hints, values = _flat(kind, default)
    for name, hint in hints.items():
        value = values.get(name)
        if hint is None or (common and name not in common):
            hints[name] = Annotated[hint or str, tyro.conf.Suppress]
        else:
            label = f"(default: {_plain(value)})" if name in values else "(required)"
            if isinstance(value, bool) or (name in values and value in (None, (), "")):
                label = ""
            hints[name] = Annotated[hint, tyro.conf.arg(metavar=_words(hint), help_behavior_hint=label)]
    body = {"__annotations__": hints, "__doc__": kind.__doc__, "__module__": kind.__module__, **values}
    return dataclasses.dataclass(frozen=True, kw_only=True)(type(kind.__name__, kinds, body)), None


def _flat(kind: type, default: Any) -> tuple[tuple[type, ...], dict[str, Any], dict[str, Any]]:
    """The classes, hints (None for a dataclass) and values of a dataclass's fields, with those of the ones in it."""
    kinds, hints, values = (kind,), {}, {}
    types_of = typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        value = field.default if default is None else getattr(default, field.name)
        if dataclasses.is_dataclass(value):
            inner = _flat(type(value), value)
            kinds, hints, values = inner[0] + kinds, hints | {field.name: None} | inner[1], values | inner[2]
            value = ""
        else:
            hints[field.name] = types_of[field.name]
        if value is not dataclasses.MISSING and value is not tyro.MISSING:
            values[field.name] = value
    return kinds, hints, values


def _wrapped(text: str) -> str:
    """Text for the terminal's width; commands, which are copied, stay in one line."""
    width, lines = shutil.get_terminal_size((100, 40)).columns, []
    for line in text.splitlines():
        indent = " " * (len(line) - len(line.lstrip()) + 2)
        command = line.lstrip().startswith(("learn3d", "torchrun"))
        lines.append(line if command else textwrap.fill(line, width, subsequent_indent=indent))
    return "\n".join(lines)


def _words(hint: Any) -> str | None:
    """What stands for a value of this type; None for a flag, which has none."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        own = [mark.metavar for mark in hint.__metadata__ if getattr(mark, "metavar", None)]
        return own[0] if own else _words(inner[0])
    if origin in (typing.Union, types.UnionType):
        words = [_words(part) for part in inner if part is not type(None)]
        return "|".join(dict.fromkeys(word for word in words if word)) or None
    if origin is Literal:
        return "{" + ",".join(map(str, inner)) + "}"
    if origin is tuple:
        word = _words(inner[0])
        return f"{word} [{word} ...]" if inner[-1] is Ellipsis else " ".join(map(_words, inner))
    return _WORDS.get(hint)


def _plain(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
