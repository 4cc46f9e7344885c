"""Files out of Debian packages, without installing them: from .deb archives that are there, or by apt-get download.

Nothing of an archive is written to disk: dpkg-deb unpacks it into a stream, and the few files wanted are read from
there. So it does not matter where its paths and links point to.
"""

from __future__ import annotations

import shutil
import subprocess
import tarfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from urllib.parse import unquote

import numpy as np

from learn3d.files import limits
from learn3d.files.reading import check_file

_HEADER_BYTES = 2**20  # between the contents of two files of an archive; long names take a few thousand


class PackageMissing(ValueError):
    """The package was not found; the message says what to do."""


@dataclass(frozen=True)
class Package:
    """One Debian package at hand."""

    name: str
    version: str
    path: Path  # of its .deb file


@dataclass(frozen=True)
class Candidate:
    """A model of a wanted category as its package has it."""

    category: str
    title: str  # the maker's name for it
    author: str
    licence: str
    package: Package
    source: str  # path inside the package
    stem: str  # file name to use, without suffix
    # Gives vertices float64 [V, 3] (y up, front +z) and faces int64 [F, 3]. Called in a worker process.
    read: Callable[[], tuple[np.ndarray, np.ndarray]]


def download_package(name: str, folder: Path) -> Package:
    """Download one package with `apt-get download` (no root, no installation) into `folder`.

    Raises PackageMissing if apt-get is not installed, does not know the package, or fails.
    """
    if shutil.which("apt-get") is None:
        raise PackageMissing(
            f"apt-get is not on this machine, so {name} cannot be downloaded; "
            "put its .deb file into a folder and name it with --packages-dir"
        )
    quiet = {"capture_output": True, "text": True, "errors": "replace", "stdin": subprocess.DEVNULL}
    result = subprocess.run(["apt-get", "download", "-q", name], cwd=folder, check=False, **quiet)
    if result.returncode != 0 or not any(folder.glob(f"{name}_*.deb")):
        reason = next((line[3:] for line in result.stderr.splitlines() if line.startswith("E:")), "no reason given")
        component = "non-free" if name.endswith("-nonfree") else "main"
        raise PackageMissing(
            f"apt-get could not download {name} ({reason}); run `apt-get update` as root first, "
            f"and see that the component {component} is enabled in the apt sources"
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
    return Package(name, unquote(found[0].stem.split("_")[1]), found[0])


def read_package(package: Package, suffixes: tuple[str, ...], licences: Path) -> Iterator[tuple[str, bytes]]:
    """Each plain file of the package whose path ends in one of `suffixes`, as (path without leading /, content).

    The order is that of the archive. Symbolic links and devices are left out. The package's copyright file is
    written to LICENCES/NAME.copyright.
    Raises ValueError for archives that cannot be read and for more than 2 GiB in all.
    """
    if shutil.which("dpkg-deb") is None:
        raise ValueError("dpkg-deb is not on this machine; install dpkg (Debian, Ubuntu, Homebrew and others have it)")
    check_file(package.path, limits.PACKAGE_BYTES, "a Debian package")
    file, notice, licence, total = package.path.name, f"/doc/{package.name}/copyright", None, 0
    command = ["dpkg-deb", "--fsys-tarfile", str(package.path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        stream = _Stream(process.stdout)
        try:
            with tarfile.open(fileobj=stream, mode="r|") as tar:
                for number, member in enumerate(tar):
                    if number >= limits.PACKAGE_MEMBERS:
                        raise ValueError(f"{file} is refused: it has more than {number} members")
                    stream.expect(member.size)
                    path = member.name.removeprefix("./").lstrip("/")
                    if not member.isreg() or not path.endswith((*suffixes, notice)):
                        continue
                    total += member.size
                    if total > (most := limits.PACKAGE_WANTED_BYTES):
                        wanted = ", ".join(suffixes)
                        raise ValueError(f"{package.name} is refused: its files {wanted} have more than {most} bytes")
                    content = tar.extractfile(member).read()
                    if path.endswith(notice):
                        licence = content
                    else:
                        yield path, content
            while stream.read(2**16):  # bytes after the last file, so that dpkg-deb can end
                pass
            if process.wait() != 0:
                raise OSError("it is damaged")
        except (tarfile.TarError, EOFError, OSError) as error:
            raise ValueError(f"{file} cannot be read as a Debian package ({error}); download it again") from error
        finally:
            process.kill()
    if licence is not None:
        licences.mkdir(exist_ok=True)
        (licences / f"{package.name}.copyright").write_bytes(licence)


class _Stream:
    """A tar archive as it is unpacked, stopped if a header is far larger than headers are: tarfile keeps them."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._left, self._total = file, _HEADER_BYTES, limits.PACKAGE_BYTES

    def expect(self, size: int) -> None:
        """Allow a file of that size and one more header."""
        self._left = size + _HEADER_BYTES

    def read(self, size: int) -> bytes:
        content = self._file.read(size)
        self._left -= len(content)
        self._total -= len(content)
        if self._left < 0 or self._total < 0:
            raise OSError(f"it unpacks to more than its headers say, or than {limits.PACKAGE_BYTES} bytes")
        return content
