"""docs/guarantees.md names tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_every_promise_has_a_test() -> None:
    page = (ROOT / "docs" / "guarantees.md").read_text()
    lines = [line for line in page.splitlines() if line.startswith("|") and not line.startswith(("|---", "| fault"))]
    assert len(lines) > 20
    for line in lines:
        named = re.findall(r"`((?:\w+/)?test_\w+\.py)::(\w+)`", line.split("|")[3])
        assert named, line
        for file, name in named:
            source = (ROOT / "tests" / "learn3d" / file).read_text()
            assert f"\ndef {name}(" in source, f"{file}::{name}"
