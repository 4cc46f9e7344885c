"""Files out of Debian packages, without installing them: from .deb files that are there, or by apt-get download."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np


class Candidate(NamedTuple):
    """A model as its package has it."""

    category: str
    title: str  # the maker's name for it
    author: str
    licence: str
    source: str  # path inside the package
    stem: str  # file name to use, without suffix
    read: Callable[[], tuple[np.ndarray, np.ndarray]]  # vertices float64 [V, 3] (y up, front +z), faces int64 [F, 3]


def get_package(name: str, folder: Path) -> Path:
    """The .deb file of a package in `folder`; if there is none, apt-get downloads it there, without being root.

    Raises ValueError if apt-get fails, OSError if it is not installed.
    """
    if not any(folder.glob(f"{name}_*.deb")):
        result = subprocess.run(["apt-get", "download", "-q", name], cwd=folder, capture_output=True, text=True)
        if result.returncode != 0:
            raise ValueError(
                f"apt-get could not download {name} ({result.stderr.strip()}); run `apt-get update` as root, enable "
                "the component non-free for packages of that name, or put the .deb file into the folder --packages-dir"
            )
    return max(folder.glob(f"{name}_*.deb"))


def read_package(package: Path, suffixes: tuple[str, ...]) -> dict[str, bytes]:
    """The plain files of a .deb file whose paths end in one of `suffixes`, by path without a leading /.

    Raises ValueError for a damaged file, OSError if dpkg-deb is not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        if subprocess.run(["dpkg-deb", "--extract", package, folder], capture_output=True).returncode != 0:
            raise ValueError(f"{package} cannot be read as a Debian package; download it again")
        found = [path for path in Path(folder).rglob("*") if path.as_posix().endswith(suffixes)]
        plain = [path for path in found if path.is_file() and not path.is_symlink()]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in plain}
