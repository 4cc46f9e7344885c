"""Dataclasses that check their fields against the types in their declarations.

    @checked
    class MySettings:
        learning_rate: Positive = 1e-4
        variant: Literal["a", "b"] = "a"

Values are never converted: "1" and true are not numbers. NaN and infinity are refused.
"""

import functools
import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from pydantic import BeforeValidator, ConfigDict, Field, ValidationError, WrapValidator
from pydantic.dataclasses import dataclass

from learn3d.terminal import unknown_name

T = TypeVar("T")


def checked(cls: type[T], *, kw_only: bool = False) -> type[T]:
    """Class decorator: a frozen dataclass that raises a ValueError naming each wrong, missing or
    unknown field.

    kw_only: fields are given by name, so those without defaults may follow others.
    `__post_init__` checks fields against each other; it may raise a ValueError, too.
    """
    config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    cls = dataclass(frozen=True, kw_only=kw_only, config=config)(cls)
    check: Callable[..., None] = cls.__init__

    @functools.wraps(check)
    def init(self: T, /, *values: Any, **options: Any) -> None:
        try:
            check(self, *values, **options)
        except ValidationError as error:
            raise ValueError("; ".join(_sentence(found, cls) for found in error.errors())) from None

    cls.__init__ = init
    return cls


def _sentence(error: Any, cls: type) -> str:
    """One of pydantic's errors as part of a sentence: the field, the wanted value, the given
    value.
    """
    name = error["loc"][0] if error["loc"] else ""
    if isinstance(name, int):  # a positional argument
        name = fields(cls)[name].name
    if error["type"] == "missing":
        return f"the option {name} is missing"
    if error["type"] == "unexpected_keyword_argument":
        return unknown_name("option", name, (field.name for field in fields(cls)))
    if error["type"] == "value_error":  # a validator's own message names the given value
        message = str(error["ctx"]["error"])
        return message if name in message.split() else f"{name} {message}".strip()
    said = re.sub(r"^\w+ should", "must", error["msg"])
    return f"{name} {said}, got {error['input']!r:.200}"


def split_names(text: str) -> tuple[str, ...]:
    """The different names of a comma-separated list; () for an empty text.

    Raises ValueError if a text has commas alone.
    """
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if text and not names:
        raise ValueError(f"a category must be a name, or names joined by commas, got {text!r}")
    return names


def _path(value: Any) -> Path:
    if not isinstance(value, (str, Path)) or not str(value) or "\0" in str(value):
        raise ValueError(f"must be the path of a file or folder, got {value!r:.200}")
    return Path(value)


LARGEST = 1e30  # largest value of a setting; float32 ends at 3e38

Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Weight = NonNegative  # weight of a loss
Share = Annotated[float, Field(ge=0, le=1)]
Step = Annotated[int, Field(ge=1, le=10**9)]  # a training step, counted from 1
Count = Annotated[int, Field(ge=1, le=10**9)]
Pixels = Annotated[int, Field(ge=1, le=1024)]  # side of the networks' images; 224 in the papers
#: Channels of a network's first layer; its widest layer has eight times as many. 512 take 4.1 GB; 128 in the papers.
Channels = Annotated[int, Field(ge=1, le=512)]
LayerChannels = Annotated[int, Field(ge=1, le=1024)]  # channels of one layer
FilePath = Annotated[Path, BeforeValidator(_path)]
#: A field that presets leave open: their value for it is tyro.MISSING, and a command line must give it.
OpenInPresets = Annotated[
    T, WrapValidator(lambda value, check: value if value is tyro.MISSING else check(value))
]
Items = Field(strict=False)  # Annotated[tuple[...], Items] accepts a list, as JSON has no tuples
