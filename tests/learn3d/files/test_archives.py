"""Zip archives whose table of contents cannot be believed are not opened."""

from __future__ import annotations

import io
import struct
import zipfile

import pytest

from learn3d.files import limits
from learn3d.files.archives import check_member_path, open_zip


def packed(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return out.getvalue()


def refuse(content: bytes, message: str, most: int = 2**20) -> None:
    with pytest.raises(ValueError, match=message):
        open_zip(io.BytesIO(content), most)


def test_sound_archives_are_opened_from_memory_and_from_disk(tmp_path):
    content = packed({"a": b"1" * 1000, "b/c": b"2"})
    (tmp_path / "a.zip").write_bytes(content)
    for source in (io.BytesIO(content), tmp_path / "a.zip"):
        with open_zip(source, 1001) as archive:
            assert archive.read("a") == b"1" * 1000
    refuse(content, "would unpack to 1001 bytes; at most 1000 are read", most=1000)


@pytest.mark.parametrize("name", ["../x", "/x", "a/../../x", "a\\x", "C:/x", "..", "a/.."])
def test_names_that_lead_out_are_refused(name):
    refuse(packed({name: b"1"}), "points outside the archive")
    with pytest.raises(ValueError, match="points outside the archive"):
        check_member_path(name)


def test_names_within_are_kept():
    assert check_member_path("./a/b..c") == "a/b..c"


def test_strange_members_are_refused(monkeypatch):
    content = packed({"aa": b"1" * 50, "bb": b"2" * 50})
    refuse(content.replace(b"bb", b"aa"), "two of its members have the same name")
    refuse(packed({"a": b"1"}, zipfile.ZIP_BZIP2), "'a' is compressed with method 12")
    refuse(packed({"a": b"1"}, zipfile.ZIP_LZMA), "'a' is compressed with method 14")
    start = content.index(b"PK\1\2")
    refuse(content[: start + 8] + b"\1" + content[start + 9 :], "'aa' is encrypted")
    refuse(content[:-30], "not a zip file")
    refuse(b"", "not a zip file")
    monkeypatch.setattr(limits, "ZIP_MEMBERS", 1)
    refuse(content, "it has 2 members; at most 1 are read")


def test_an_archive_that_promises_more_than_deflate_can_do_is_refused():
    """Members that share their bytes: 10 KB that would unpack to 10 GB."""
    content = bytearray(packed({f"{k:04d}": b"" for k in range(100)}))
    at = content.index(b"PK\1\2")
    while (at := content.find(b"PK\1\2", at)) >= 0:
        struct.pack_into("<I", content, at + 24, 100_000_000)
        at += 4
    assert len(content) < 12_000
    refuse(bytes(content), r"would unpack to 10000000000 bytes, \d+ times its size", most=2**40)
    refuse(bytes(content), "would unpack to 10000000000 bytes; at most", most=2**30)


def test_a_table_of_contents_that_is_too_large_is_not_read(monkeypatch):
    content = packed({f"{k:04d}": b"" for k in range(100)})
    monkeypatch.setattr(limits, "ZIP_DIRECTORY_BYTES", 1000)
    refuse(content, "its table of contents has 5000 bytes; at most 1000 are read")
    monkeypatch.setattr(zipfile, "ZIP_FILECOUNT_LIMIT", 0)  # the size is in another place then
    refuse(packed({f"{k:04d}": b"" for k in range(100)}), r"its table of contents has \d+ bytes; at most 1000 are read")


def test_a_size_of_the_table_of_contents_that_lies_elsewhere_is_not_believed(monkeypatch):
    """Newer versions of Python follow the locator to wherever it points; the end states 5 bytes here."""
    content = packed({f"{k:04d}": b"" for k in range(100)})
    end = content.rindex(b"PK\5\6")
    stated = content[end : end + 12] + struct.pack("<I", 5) + content[end + 16 :]
    monkeypatch.setattr(limits, "ZIP_DIRECTORY_BYTES", 1000)
    locator = b"PK\6\7" + struct.pack("<IQI", 0, 0, 1)
    refuse(content[:end] + locator + stated, r"its table of contents has \d+ bytes; at most 1000 are read")
