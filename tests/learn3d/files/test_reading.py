"""Reading and writing whole files."""

from __future__ import annotations

import errno
import json
import os
import re
from pathlib import Path

import pytest

from learn3d.files import npz, sandbox, writing
from learn3d.files.formats import read_matlab, read_mesh, read_state_dict
from learn3d.files.images import PHOTOGRAPHS, open_image
from learn3d.files.reading import parse_json, read_bytes, read_json, read_text


def test_only_regular_files_below_a_limit_are_read(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes("ä\r\nb\rc\n".encode())
    assert read_text(path, 8, "a text") == "ä\nb\nc\n"
    with pytest.raises(ValueError, match=r"a\.txt: has 8 bytes; the limit is 6; expected a text"):
        read_bytes(path, 6, "a text")
    with pytest.raises(FileNotFoundError, match=r"b\.txt: is missing; expected a text"):
        read_bytes(tmp_path / "b.txt", 8, "a text")
    for bad in (tmp_path, tmp_path / ("n" * 300), tmp_path / "\0"):
        with pytest.raises(ValueError, match=r"cannot be read .*; expected a text"):
            read_bytes(bad, 8, "a text")
    path.write_bytes(b"\xff")
    with pytest.raises(ValueError, match=r"a\.txt: cannot be read \(Unicode.*; expected a text"):
        read_text(path, 8, "a text")


READERS = {
    "npz": lambda path: npz.read(path, "a", "an array"),
    "image": lambda path: open_image(path, PHOTOGRAPHS, 100),
    "mesh": read_mesh,
    "MATLAB": lambda path: sandbox.read(read_matlab, path, "Volume", 32),
    "weights": read_state_dict,
    "text": lambda path: read_text(path, 100, "a text"),
}


@pytest.mark.parametrize("kind", READERS)
def test_pipes_are_not_waited_for_and_devices_not_read(tmp_path: Path, kind: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zeros").symlink_to("/dev/zero")
    for name in ("pipe", "zeros"):
        with pytest.raises(ValueError, match="cannot be read: it is not a regular file; expected"):
            READERS[kind](tmp_path / name)


def test_json(tmp_path):
    assert parse_json(b'{"a": [1, 2.5, null, true, "]]]]\\"[["]}') == {
        "a": [1, 2.5, None, True, ']]]]"[[']
    }
    assert parse_json("[" * 32 + "]" * 32)
    cases = {
        "[" * 1_000_000: "nested too deeply",
        '{"a":' * 100_000: "nested too deeply",
        "9" * 5000: "digits",
        "{": "Expecting",
    }
    for text, message in cases.items():
        with pytest.raises(ValueError, match=message):
            parse_json(text)
    (tmp_path / "a.json").write_bytes(b'"\xff"')
    with pytest.raises(
        ValueError, match=r"a\.json: cannot be read \(.*utf-8.*\); expected a list\. Perhaps"
    ):
        read_json(tmp_path / "a.json", 8, "a list")


def test_files_are_replaced_whole(tmp_path) -> None:
    path = tmp_path / "a.json"
    path.write_text("a much longer content than the new one")
    writing.write_json(path, {"name": [1, None]})
    assert json.loads(path.read_text()) == {"name": [1, None]}
    path.with_name("earlier").write_bytes(b"old")
    (tmp_path / ".a.json.partial").hardlink_to(
        tmp_path / "earlier"
    )  # left behind by a killed process
    writing.write_bytes(path, b"x")
    assert path.read_bytes() == b"x" and (tmp_path / "earlier").read_bytes() == b"old"
    assert {p.name for p in tmp_path.iterdir()} == {"a.json", "earlier"}


@pytest.mark.parametrize("sync", [False, True])
def test_a_failed_write_leaves_the_old_file_alone(tmp_path, sync: bool) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"old")
    with pytest.raises(OSError, match="disk full"), writing.replacing(path, sync=sync) as temporary:
        temporary.write_bytes(b"ne")
        raise OSError("disk full")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_disk_without_room_names_the_file(tmp_path) -> None:
    full = pytest.raises(OSError, match=r"No space left on device: '.*/a\.json'")
    with full, writing.replacing(tmp_path / "a.json") as temporary:
        temporary.symlink_to("/dev/full")
        temporary.write_bytes(b"{}")
    assert list(tmp_path.iterdir()) == []


def test_sync_comes_before_the_new_name(tmp_path, monkeypatch) -> None:
    calls = []
    replace = os.replace
    monkeypatch.setattr(os, "fsync", lambda number: calls.append("fsync"))
    monkeypatch.setattr(os, "replace", lambda a, b: (calls.append("replace"), replace(a, b)))
    writing.write_bytes(tmp_path / "a", b"x", sync=True)
    assert calls == ["fsync", "replace", "fsync"], (
        "the content, the name, the folder that holds the name"
    )


def test_only_regular_files_are_replaced(tmp_path) -> None:
    """Never with a path in /dev: should the check be broken, the test would break the machine."""
    fifo, folder, link, output = (tmp_path / name for name in ("fifo", "folder", "link", "output"))
    os.mkfifo(fifo)
    folder.mkdir()
    link.symlink_to(fifo)
    with open(tmp_path / "file", "wb") as file:
        output.symlink_to(f"/proc/self/fd/{file.fileno()}")  # as /dev/stdout is one
        before = {path.name: path.lstat().st_ino for path in tmp_path.iterdir()}
        for path in (fifo, folder, link, output):
            with pytest.raises(OSError, match="is not a regular file and is not replaced"):
                writing.write_json(path, {})
            with pytest.raises(OSError, match="is not a regular file"):
                writing.check_target(path, "--json")
    assert {path.name: path.lstat().st_ino for path in tmp_path.iterdir()} == before


def test_a_target_is_checked_before_the_work(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for path in (tmp_path, Path()):
        writing.check_target(path / "t.json", "--json")
        writing.check_target(path / "a" / "b", "--output", folder=True)
    assert list(tmp_path.iterdir()) == [], "nothing is made"
    (tmp_path / "file").touch()
    for name, folder, why in (
        ("a/t.json", False, "No such file or directory"),
        (".", False, "not a regular file"),
        ("file/t.json", False, "Not a directory"),
        ("file", True, "Not a directory"),
        ("file/a/b", True, "Not a directory"),
    ):
        with pytest.raises(OSError, match=rf"^cannot write .*{why}.* give another --x$"):
            writing.check_target(tmp_path / name, "--x", folder=folder)


def test_a_full_disk_is_named_with_its_folder(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=re.escape(f"No space left on device: '{tmp_path}'")):
        with writing.publishing(tmp_path, ["a"]):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
