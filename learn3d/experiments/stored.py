"""Stored results (test.json of a run) read back: another's file must not lead a report astray."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from learn3d.files import limits
from learn3d.files.reading import parse_json, read_bytes

_NAMES = ("config", "iterations", "data", "checkpoint", "command", "images", "objects")
_REMOVE = "remove it, and it is made again"


def read_result(path: Path) -> dict[str, Any]:
    """What `results.measure` wrote. A file that is damaged, or holds something else, is a ValueError that names it."""
    content = read_bytes(path, limits.JSON_BYTES, "the measurement of a run as JSON")
    try:
        result = parse_json(content)
    except ValueError as error:
        raise ValueError(f"{path} is not valid JSON ({error}); {_REMOVE}") from None
    try:
        _check(result)
    except ValueError as error:
        raise ValueError(f"{path} is no measurement of a run: {error}; {_REMOVE}") from None
    return result


def _check(result: Any) -> None:
    if not isinstance(result, dict):
        raise ValueError(f"it must hold values by name, got {type(result).__name__}")
    if missing := [name for name in _NAMES if name not in result]:
        raise ValueError(f"it lacks {', '.join(missing)}")
    for name in ("config", "objects"):
        _need(isinstance(result[name], dict), result, name, "values by name")
    for name in ("data", "checkpoint", "command"):
        _need(isinstance(result[name], str) and "\0" not in result[name], result, name, "a text")
    for name, least in (("iterations", 1), ("step", 0), ("images", 0), ("undefined", 0)):
        number = result.get(name, least)
        fits = type(number) is int and least <= number <= limits.ITERATIONS
        _need(fits, result, name, f"a whole number from {least}")
    for name in ("seconds", "mmd", "mmd_paper", "chamfer_l1", "f_score", "voxel_iou_kato18", "voxel_iou_kato19"):
        _need(name not in result or _is_number(result[name]), result, name, "a number or null")
    for name in ("conditions", "trained_by", "tested_by"):
        _need(isinstance(result.get(name), (dict, type(None))), result, name, "values by name")
    for name in ("trained_by", "tested_by"):
        commit = (result.get(name) or {}).get("commit")
        _need(isinstance(commit, (str, type(None))), result, name, "values by name, with a text or null as its commit")
    _check_objects(result["objects"])


def _check_objects(objects: dict[str, Any]) -> None:
    names, defined = objects.get("names"), objects.get("defined")
    _need(isinstance(names, list) and all(isinstance(name, str) for name in names), objects, "names", "texts")
    counts = isinstance(defined, list) and all(type(n) is int and 0 <= n <= limits.ITERATIONS for n in defined)
    _need(counts and len(defined) == len(names), objects, "defined", f"{len(names)} numbers of images")
    for name in ("kato18", "kato19"):
        ious = objects.get(name)
        fits = isinstance(ious, list) and len(ious) == len(names) and all(map(_is_number, ious))
        _need(fits, objects, name, f"{len(names)} numbers or nulls")


def _is_number(value: Any) -> bool:
    return value is None or (type(value) in (int, float) and abs(value) <= limits.NUMBER)


def _need(fits: bool, values: dict[str, Any], name: str, wanted: str) -> None:
    if not fits:
        raise ValueError(f"{name} must be {wanted}, got {repr(values.get(name))[:60]}")
