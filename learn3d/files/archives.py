"""Zip archives that somebody else may have made: opened only where their table of contents can be believed.

Nothing is ever unpacked to disk; still, a name that leads out of the archive is the mark of a trap and refused.
"""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from learn3d.files import limits

_END, _END64, _LOCATOR = b"PK\5\6", b"PK\6\6", b"PK\6\7"


def open_zip(source: Path | BinaryIO, most: int) -> zipfile.ZipFile:
    """Open an archive, a file or one in memory, whose members unpack to at most `most` bytes together.

    Raises ValueError, saying why, for what is no zip archive and for one with: a table of contents above 64 MiB, over
    400,000 members, two of one name, a name that is absolute or has "..", encryption, compression other than deflate,
    or more to unpack than deflate can do (members that overlap). zipfile itself keeps every member to its stated size.
    """
    try:
        if isinstance(source, Path):
            with open(source, "rb") as file:
                size = _check_directory(file)
        else:
            size = _check_directory(source)
        archive = zipfile.ZipFile(source)
    except (zipfile.BadZipFile, NotImplementedError, OSError, EOFError, struct.error) as error:
        raise ValueError(str(error)) from error
    try:
        _check_members(archive.infolist(), size, most)
    except ValueError:
        archive.close()
        raise
    return archive


def _check_members(members: list[zipfile.ZipInfo], size: int, most: int) -> None:
    """Refuse what `open_zip` says, of an archive of `size` bytes."""
    if len(members) > limits.ZIP_MEMBERS:
        raise ValueError(f"it has {len(members)} members; at most {limits.ZIP_MEMBERS} are read")
    if len({member.filename for member in members}) < len(members):
        raise ValueError("two of its members have the same name")
    for member in members:
        check_member_path(member.filename)
        if member.flag_bits & 1:
            raise ValueError(f"its member {member.filename!r} is encrypted")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"its member {member.filename!r} is compressed with method {member.compress_type}")
    total = sum(member.file_size for member in members)
    if total > most:
        raise ValueError(f"it would unpack to {total} bytes; at most {most} are read")
    if total > max(limits.SMALL_BYTES, limits.DEFLATE_EXPANSION * size):
        raise ValueError(f"it would unpack to {total} bytes, {total // max(1, size)} times its size")


def check_member_path(path: str) -> str:
    """The path of an archive member without a leading "./"; ValueError if it leaves the archive's folder."""
    parts = PurePosixPath(path).parts
    if path.startswith("/") or "\\" in path or ".." in parts or "\0" in path or path[1:2] == ":":
        raise ValueError(f"its member {path!r} points outside the archive")
    return "/".join(parts)


def _check_directory(file: BinaryIO) -> int:
    """Refuse a table of contents that is too large to be read, by its size as the end of the archive states it.

    Returns the size of the archive in bytes.
    """
    size = file.seek(0, 2)
    start = max(0, size - 65_557)  # a comment of up to 65,535 bytes may follow
    file.seek(start)
    tail = file.read()
    end = tail.rfind(_END)
    if end < 0 or len(tail) < end + 22:
        raise ValueError("File is not a zip file")
    stated = struct.unpack_from("<I", tail, end + 12)[0]
    if end >= 76 and tail[end - 76 : end - 72] == _END64:
        stated = max(stated % 0xFFFFFFFF, struct.unpack_from("<Q", tail, end - 76 + 40)[0])
    elif end >= 20 and tail[end - 20 : end - 16] == _LOCATOR:  # its 64-bit size lies elsewhere: any is possible
        stated = max(stated, size)
    if min(stated, size) > limits.ZIP_DIRECTORY_BYTES:
        raise ValueError(f"its table of contents has {stated} bytes; at most {limits.ZIP_DIRECTORY_BYTES} are read")
    return size
