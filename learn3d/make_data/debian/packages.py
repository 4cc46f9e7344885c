"""Files out of Debian packages, without installing them: apt-get download, .deb archives, or an installed system.

A .deb is an `ar` archive whose member `data.tar.*` holds the files. Nothing is unpacked to disk: the few files wanted
are read into memory one at a time, and an archive with an absolute path, a ".." or an oversized member is refused.
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import shutil
import subprocess
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from urllib.parse import unquote

import numpy as np

from learn3d.files import archives, limits
from learn3d.files.reading import check_file

_HEADER_BYTES = 2**20  # between the contents of two members; long names and their kin take a few thousand
_UNPACKERS: dict[str, Callable[[BinaryIO], BinaryIO]] = {
    "": lambda file: file,
    "gz": lambda file: gzip.GzipFile(fileobj=file),
    "bz2": bz2.BZ2File,
    "xz": lzma.LZMAFile,
}
_FAULTS = (tarfile.TarError, EOFError, OSError, zlib.error, lzma.LZMAError)


class PackageMissing(ValueError):
    """The package is not where it was looked for; the message says what to do."""


@dataclass(frozen=True)
class Package:
    """One Debian package at hand: a .deb file, or the list of its files on an installed system."""

    name: str
    version: str
    deb: Path | None = None  # the archive, or
    root: Path | None = None  # the system's root, together with
    listed: tuple[str, ...] = ()  # the paths below it


@dataclass(frozen=True)
class Candidate:
    """A model of a wanted category as its package has it; `mesh` is (vertices, faces) or why there is none."""

    category: str
    title: str  # the maker's name for it
    author: str
    licence: str
    package: Package
    source: str  # path inside the package
    stem: str  # file name to use, without suffix
    mesh: tuple[np.ndarray, np.ndarray] | str  # float64 [V, 3], int64 [F, 3]; y up, front +z


def check_member_path(path: str, archive: str) -> str:
    """The path of an archive member without a leading "./"; ValueError if it leaves the archive's folder."""
    try:
        return archives.check_member_path(path)
    except ValueError as error:
        raise ValueError(f"{archive} is refused: {error}; get the package again") from None


def download_package(name: str, folder: Path) -> Package:
    """Download one package with `apt-get download` (no root, no installation) into `folder`.

    Raises PackageMissing when apt-get is not there, does not know the package, or fails.
    """
    if shutil.which("apt-get") is None:
        raise PackageMissing(
            f"apt-get is not on this machine, so {name} cannot be downloaded; "
            "put its .deb file into a folder and name it with --packages-dir"
        )
    before = set(folder.iterdir())
    command = ["apt-get", "download", "-q", name]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False)
    if result.returncode != 0 or not set(folder.iterdir()) - before:
        reason = next((line for line in result.stderr.splitlines() if line.startswith("E:")), "E: no reason given")
        component = "the component non-free" if name.endswith("-nonfree") else "the component main"
        raise PackageMissing(
            f"apt-get could not download {name} ({reason[3:]}); run `apt-get update` as root first, "
            f"and see that {component} is enabled in the apt sources"
        )
    return find_package(name, folder)


def find_package(name: str, folder: Path) -> Package:
    """The package whose file NAME_VERSION_ARCH.deb lies in `folder`; PackageMissing if none, ValueError if several."""
    found = sorted(folder.glob(f"{name}_*.deb"))
    if not found:
        raise PackageMissing(f"{folder} holds no {name}_*.deb; run `apt-get download {name}` there")
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise ValueError(f"{folder} holds several versions of {name} ({names}); keep one")
    return Package(name, unquote(found[0].stem.split("_")[1]), deb=found[0])


def installed_package(name: str, root: Path) -> Package:
    """The package as installed below `root` (its file list and version from dpkg's database); else PackageMissing."""
    database = root / "var/lib/dpkg"
    listing = database / "info" / f"{name}.list"
    if not listing.is_file():
        raise PackageMissing(f"{name} is not installed below {root}; install it, or leave --root out to download it")
    version = ""
    for paragraph in (database / "status").read_text(encoding="utf-8", errors="replace").split("\n\n"):
        fields = dict(line.split(": ", 1) for line in paragraph.splitlines() if ": " in line and line[0] != " ")
        if fields.get("Package") == name:
            version = fields.get("Version", "")
    return Package(name, version, root=root, listed=tuple(listing.read_text(encoding="utf-8").splitlines()))


def read_package(package: Package, suffixes: tuple[str, ...]) -> Iterator[tuple[str, bytes]]:
    """Each regular file of the package whose path ends in one of `suffixes`, as (path without leading /, content).

    The order is that of the archive (or of the sorted file list). Symbolic links and devices are passed over.
    Raises ValueError for unsafe member paths, members over 512 MiB and archives that cannot be read.
    """
    if package.deb is None:
        assert package.root is not None
        for line in sorted(package.listed):
            path = check_member_path(line.lstrip("/"), f"the file list of {package.name}")
            file = package.root / path
            if path.endswith(suffixes) and file.is_file() and not file.is_symlink():
                _check_size(file.stat().st_size, path, package.name, limits.PACKAGE_FILE_BYTES)
                yield path, file.read_bytes()
        return
    archive = package.deb.name
    try:
        with _data_tar(package.deb) as (tar, meter):
            for number, member in enumerate(tar):
                path = check_member_path(member.name, archive)
                if number >= limits.PACKAGE_MEMBERS:
                    raise ValueError(f"{archive} is refused: it has more than {number} members")
                meter.allow(member.size)
                if member.isreg() and path.endswith(suffixes):
                    _check_size(member.size, path, archive, limits.PACKAGE_FILE_BYTES)
                    stream = tar.extractfile(member)
                    assert stream is not None
                    yield path, stream.read()
    except _FAULTS as error:
        raise ValueError(f"{archive} cannot be read as a Debian package ({error}); download it again") from error


def read_keeping_copyright(package: Package, suffixes: tuple[str, ...], folder: Path) -> Iterator[tuple[str, bytes]]:
    """As `read_package`; the package's copyright file is copied to FOLDER/NAME.copyright on the way.

    Raises ValueError for more than 2 GiB in all, too: who calls this keeps the files.
    """
    notice, total = f"/doc/{package.name}/copyright", 0
    for path, content in read_package(package, (*suffixes, notice)):
        total += len(content)
        if total > (most := limits.PACKAGE_WANTED_BYTES):
            raise ValueError(f"{package.name} is refused: its files {', '.join(suffixes)} have more than {most} bytes")
        if path.endswith(notice):
            folder.mkdir(exist_ok=True)
            (folder / f"{package.name}.copyright").write_bytes(content)
        else:
            yield path, content


def open_catalogue(content: bytes, name: str) -> zipfile.ZipFile:
    """A zip archive (.sh3f) held in memory, every member's path checked; ValueError if unsafe or not a zip file."""
    try:
        return archives.open_zip(io.BytesIO(content), limits.PACKAGE_BYTES)
    except ValueError as error:
        raise ValueError(f"{name} is refused as a zip archive: {error}; get its package again") from error


def read_member(archive: zipfile.ZipFile, path: str) -> bytes:
    """The content of one member of a zip archive; ValueError if it is missing, damaged or over 64 MiB."""
    try:
        info = archive.getinfo(path)
        _check_size(info.file_size, path, "the catalogue", limits.CATALOGUE_MEMBER_BYTES)
        return archive.read(info)
    except (KeyError, RuntimeError, NotImplementedError, zipfile.BadZipFile, *_FAULTS) as error:
        raise ValueError(f"{path} cannot be read from the catalogue ({error})") from error


def _check_size(size: int, path: str, archive: str, limit: int) -> None:
    if size > limit:
        raise ValueError(f"{path} of {archive} is refused: {size} bytes, at most {limit} are read")


class _Part(io.RawIOBase):
    """The next `size` bytes of a file."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:
        content = self._file.read(min(len(buffer), self._left))
        buffer[: len(content)] = content
        self._left -= len(content)
        return len(content)


class _Meter:
    """What a tar archive unpacks to, stopped where a header takes much more than headers do (tarfile keeps them)."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._left, self._total = file, _HEADER_BYTES, limits.PACKAGE_BYTES

    def allow(self, size: int) -> None:
        """A member of that size follows, and then another header."""
        self._left = size + _HEADER_BYTES

    def read(self, size: int) -> bytes:
        content = self._file.read(size)
        self._left -= len(content)
        self._total -= len(content)
        if self._left < 0 or self._total < 0:
            raise ValueError(f"it unpacks to more than its headers say, or than {limits.PACKAGE_BYTES} bytes")
        return content


@contextmanager
def _data_tar(deb: Path) -> Iterator[tuple[tarfile.TarFile, _Meter]]:
    """The data.tar.* of a .deb as a stream; one that Python cannot unpack (zstd) goes through dpkg-deb."""
    check_file(deb, limits.PACKAGE_BYTES, "a Debian package")
    with deb.open("rb") as file:
        kind, size = _find_data(deb, file)
        if kind in _UNPACKERS:
            meter = _Meter(_UNPACKERS[kind](io.BufferedReader(_Part(file, size))))
            with tarfile.open(fileobj=meter, mode="r|") as tar:
                yield tar, meter
            return
    if shutil.which("dpkg-deb") is None:
        raise ValueError(f"{deb.name} is compressed with {kind}, which needs dpkg-deb; install Debian's package dpkg")
    with subprocess.Popen(["dpkg-deb", "--fsys-tarfile", str(deb)], stdout=subprocess.PIPE) as process:
        try:
            meter = _Meter(process.stdout)
            with tarfile.open(fileobj=meter, mode="r|") as tar:
                yield tar, meter
        finally:
            process.kill()


def _find_data(deb: Path, file: BinaryIO) -> tuple[str, int]:
    """How the member data.tar.* is compressed and its size in bytes; the file then stands at its beginning."""
    if file.read(8) != b"!<arch>\n":
        raise ValueError(f"{deb.name} is not a Debian package; download it again")
    while len(header := file.read(60)) == 60:
        member = header[:16].decode("ascii", "replace").strip().rstrip("/")
        if not (length := header[48:58].strip()).isdigit():
            raise ValueError(f"{deb.name} is damaged: its member {member!r} has no size; download it again")
        size = int(length)
        if member.startswith("data.tar"):
            return member.removeprefix("data.tar").removeprefix("."), size
        file.seek(size + size % 2, io.SEEK_CUR)
    raise ValueError(f"{deb.name} holds no data.tar; download it again")
