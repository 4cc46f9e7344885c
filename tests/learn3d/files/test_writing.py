"""Whole files or nothing."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from learn3d.files import writing


def test_files_are_replaced_whole(tmp_path) -> None:
    path = tmp_path / "a.json"
    path.write_text("a much longer content than the new one")
    writing.write_json(path, {"name": [1, None]})
    assert json.loads(path.read_text()) == {"name": [1, None]}
    path.with_name("earlier").write_bytes(b"old")
    (tmp_path / ".a.json.partial").hardlink_to(tmp_path / "earlier")  # left behind by a killed process
    writing.write_bytes(path, b"x")
    assert path.read_bytes() == b"x" and (tmp_path / "earlier").read_bytes() == b"old"
    assert {p.name for p in tmp_path.iterdir()} == {"a.json", "earlier"}


@pytest.mark.parametrize("sync", [False, True])
def test_a_failed_write_leaves_the_old_file_alone(tmp_path, sync: bool) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"old")
    with pytest.raises(OSError, match="disk full"), writing.replacing(path, sync=sync) as temporary:
        assert temporary.parent == tmp_path
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
    assert calls == ["fsync", "replace", "fsync"], "the content, the name, the folder that holds the name"


def test_devices_and_folders_are_not_replaced(tmp_path) -> None:
    for path in (Path("/dev/null"), tmp_path):
        with pytest.raises(OSError, match="is no plain file and is not replaced"):
            writing.write_json(path, {})
    assert Path("/dev/null").is_char_device()


def test_a_target_is_checked_before_the_work(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for path in (tmp_path, Path()):
        writing.check_target(path / "t.json", "--json")
        writing.check_target(path / "a" / "b", "--output", folder=True)
    assert list(tmp_path.iterdir()) == [], "nothing is made"
    (tmp_path / "file").touch()
    for name, folder, why in (
        ("a/t.json", False, "no folder .*a;"),
        (".", False, "no plain file"),
        ("file/t.json", False, "file is a file;"),
        ("file", True, "file is a file;"),
        ("file/a/b", True, "file is a file;"),
    ):
        with pytest.raises(OSError, match=rf"^cannot write .*{why}.* give another --x$"):
            writing.check_target(tmp_path / name, "--x", folder=folder)

    def refuse(**_: object) -> None:
        raise PermissionError(13, "Permission denied", ".tmp8")

    monkeypatch.setattr(writing.tempfile, "TemporaryFile", refuse)
    for folder in (False, True):
        with pytest.raises(OSError, match=r"^cannot write .*Permission denied; give another --output$"):
            writing.check_target(tmp_path / "t.json", "--output", folder=folder)
