"""Sizes before contents, JSON that is only JSON, and a block that is stopped."""

from __future__ import annotations

import os
import sys

import pytest

from learn3d.files import reading
from learn3d.files.reading import check_file, parse_json, read_bytes, read_text

linux = pytest.mark.skipif(sys.platform != "linux", reason="memory is limited on Linux only")


def test_only_plain_files_of_a_stated_size_are_read(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes("ä\r\nb\rc\n".encode())
    assert check_file(path, 8, "a text") == 8 and read_text(path, 8, "a text") == "ä\nb\nc\n"
    with pytest.raises(ValueError, match=r"a\.txt: has 8 bytes, and at most 6 are read; expected a text"):
        read_bytes(path, 6, "a text")
    with pytest.raises(FileNotFoundError, match=r"b\.txt: is missing; expected a text"):
        read_bytes(tmp_path / "b.txt", 8, "a text")
    with pytest.raises(ValueError, match="cannot be read: it is no plain file"):
        read_bytes(tmp_path, 8, "a text")
    with pytest.raises(ValueError, match=r"cannot be read .*; expected a text"):
        read_bytes(tmp_path / ("n" * 300), 8, "a text")
    path.write_bytes(b"\xff")
    with pytest.raises(ValueError, match=r"a\.txt: cannot be read as text \(.*; expected a text"):
        read_text(path, 8, "a text")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names here")
def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe: cannot be read: it is no plain file"):
        read_bytes(tmp_path / "pipe", 8, "a text")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names here")
def test_a_pipe_that_takes_the_place_of_a_file_is_not_waited_for(tmp_path, monkeypatch):
    def check_and_replace(path, *_):
        path.unlink()
        os.mkfifo(path)

    (tmp_path / "a.txt").write_bytes(b"1")
    monkeypatch.setattr(reading, "check_file", check_and_replace)
    with pytest.raises(ValueError, match=r"a\.txt: cannot be read \(it is no plain file any more\)"):
        read_bytes(tmp_path / "a.txt", 8, "a text")


def test_json():
    assert parse_json(b'{"a": [1, 2.5, null, true, "]]]]\\"[["]}') == {"a": [1, 2.5, None, True, ']]]]"[[']}
    assert parse_json("[" * 32 + "]" * 32)
    assert parse_json("[NaN, 1e999]", finite=False)[1] == float("inf")
    cases = {
        "[" * 1_000_000: "nested too deeply",
        '{"a":' * 100_000: "nested too deeply",
        "[NaN]": "NaN is no number of JSON",
        "[-Infinity]": "-Infinity is no number of JSON",
        "1e999": "1e999 is too large a number",
        "9" * 5000: "a whole number has 5000 digits",
        "{": "Expecting",
    }
    for text, message in cases.items():
        with pytest.raises(ValueError, match=message):
            parse_json(text)
    with pytest.raises(ValueError, match="utf-8"):
        parse_json(b'"\xff"')
