"""Untrusted files are opened if they are plain and of a bounded size; JSON is only JSON."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from learn3d.files import npz, sandbox
from learn3d.files.images import PHOTOGRAPHS, open_image
from learn3d.files.meshes import read_mesh
from learn3d.files.reading import check_file, parse_json, read_bytes, read_text
from learn3d.files.volumes import read_binvox, read_matlab
from learn3d.files.weights import read_state_dict


def test_only_plain_files_of_a_stated_size_are_read(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes("ä\r\nb\rc\n".encode())
    assert check_file(path, 8, "a text") == 8 and read_text(path, 8, "a text") == "ä\nb\nc\n"
    with pytest.raises(ValueError, match=r"a\.txt: has 8 bytes, and at most 6 are read; expected a text"):
        read_bytes(path, 6, "a text")
    with pytest.raises(FileNotFoundError, match=r"b\.txt: is missing; expected a text"):
        read_bytes(tmp_path / "b.txt", 8, "a text")
    for bad in (tmp_path, tmp_path / ("n" * 300), tmp_path / "\0"):
        with pytest.raises(ValueError, match=r"cannot be read .*; expected a text"):
            read_bytes(bad, 8, "a text")
    path.write_bytes(b"\xff")
    with pytest.raises(ValueError, match=r"a\.txt: cannot be read as text \(.*; expected a text"):
        read_text(path, 8, "a text")


READERS = {
    "npz": lambda path: sandbox.read(npz.read, path, "a"),
    "image": lambda path: open_image(path, PHOTOGRAPHS, 100),
    "mesh": read_mesh,
    "MATLAB": lambda path: sandbox.read(read_matlab, path, "Volume", 32),
    "binvox": lambda path: sandbox.read(read_binvox, path, 32),
    "weights": read_state_dict,
    "text": lambda path: read_text(path, 100, "a text"),
}


@pytest.mark.parametrize("kind", READERS)
def test_pipes_are_not_waited_for_and_devices_not_read(tmp_path: Path, kind: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zeros").symlink_to("/dev/zero")
    for name in ("pipe", "zeros"):
        with pytest.raises(ValueError, match="cannot be read: it is no plain file; expected"):
            READERS[kind](tmp_path / name)


def test_json():
    assert parse_json(b'{"a": [1, 2.5, null, true, "]]]]\\"[["]}') == {"a": [1, 2.5, None, True, ']]]]"[[']}
    assert parse_json("[" * 32 + "]" * 32)
    assert parse_json("[NaN, 1e999]", finite=False)[1] == float("inf")
    cases = {
        "[" * 1_000_000: "nested too deeply",
        '{"a":' * 100_000: "nested too deeply",
        "[NaN]": "NaN is no number of JSON",
        "[-Infinity]": "-Infinity is no number of JSON",
        "1e999": "1e999 is no number of JSON",
        "9" * 5000: "digits",
        "{": "Expecting",
    }
    for text, message in cases.items():
        with pytest.raises(ValueError, match=message):
            parse_json(text)
    with pytest.raises(ValueError, match="utf-8"):
        parse_json(b'"\xff"')
