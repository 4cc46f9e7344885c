"""What the installed package says of itself."""

from __future__ import annotations

import importlib.metadata
import importlib.resources

import nmr


def test_the_version_is_that_of_the_distribution() -> None:
    assert nmr.__version__ == importlib.metadata.version("nmr-learn3d")


def test_type_checkers_are_told_that_there_are_hints() -> None:
    for package in ("nmr", "learn3d"):
        assert importlib.resources.files(package).joinpath("py.typed").is_file()
