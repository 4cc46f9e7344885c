"""Dataclasses that check their fields: each declares at the field what it may hold.

    @checked
    class MySettings:
        learning_rate: Positive = 1e-4
        variant: Literal["a", "b"] = "a"

A value of another type is refused, not converted: neither "1" nor true is a number, and none is NaN or infinite.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass

T = TypeVar("T")


def checked(cls: type[T]) -> type[T]:
    """Class decorator: a frozen dataclass. A wrong, missing or unknown field is a ValueError, a sentence that names it.

    `__post_init__` checks what several fields have to do with each other, and may raise a ValueError as well.
    """
    cls = dataclass(frozen=True, config=ConfigDict(strict=True, extra="forbid", allow_inf_nan=False))(cls)
    check: Callable[..., None] = cls.__init__

    @functools.wraps(check)
    def init(self: T, /, *values: Any, **options: Any) -> None:
        try:
            check(self, *values, **options)
        except ValidationError as error:
            raise ValueError("; ".join(_sentence(found, cls) for found in error.errors())) from None

    cls.__init__ = init
    return cls


_WORDS = {
    "Input should": "must",
    "String should": "must",
    "Tuple should": "must",
    " after validation": "",
    "greater than or equal to": "at least",
    "less than or equal to": "at most",
    "a valid integer": "a whole number",
    "a valid number": "a number",
    "a valid string": "text",
    "a valid tuple": "a list",
}


def _sentence(error: Any, cls: type) -> str:
    """One error of pydantic's as part of a sentence: the field, what was wanted, what came."""
    name = error["loc"][0] if error["loc"] else ""
    if isinstance(name, int):  # given by position
        name = fields(cls)[name].name
    if error["type"] == "missing":
        return f"the option {name} is missing"
    if error["type"] == "unexpected_keyword_argument":
        return f"there is no option {name!r} (but {', '.join(field.name for field in fields(cls))})"
    if error["type"] == "value_error":  # raised by a validator, which says what came
        message = str(error["ctx"]["error"])
        return message if name in message.split() else f"{name} {message}".strip()
    said = error["msg"]
    for theirs, ours in _WORDS.items():
        said = said.replace(theirs, ours)
    return f"{name} {said}, got {error['input']!r:.200}"


def split_names(text: str) -> tuple[str, ...]:
    """The names in a list with commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _path(value: Any) -> Path:
    if not isinstance(value, (str, Path)) or not str(value) or "\0" in str(value):
        raise ValueError(f"must be the path of a file or folder, got {value!r:.200}")
    return Path(value)


MOST = 1e30  # the largest number of a setting: float32 ends at 3e38

Positive = Annotated[float, Field(gt=0, le=MOST)]
Weight = Annotated[float, Field(ge=0, le=MOST)]
Share = Annotated[float, Field(ge=0, le=1)]
Step = Annotated[int, Field(ge=1, le=10**9)]  # a training step, counted from 1
Count = Annotated[int, Field(ge=1)]
Pixels = Annotated[int, Field(ge=1, le=1024)]  # side of the networks' images; 224 in the papers
#: Channels of a network's first layer; its widest layer has eight times as many. 512 take 4.1 GB; 128 in the papers.
Channels = Annotated[int, Field(ge=1, le=512)]
LayerChannels = Annotated[int, Field(ge=1, le=1024)]  # channels of a layer that has a setting of its own
RARE = "shown by --help-all, not by --help"  # marks an option's type
Rare = Annotated[T, RARE]
FilePath = Annotated[Path, BeforeValidator(_path)]
Items = Field(strict=False)  # Annotated[tuple[...], Items]: JSON has lists alone
