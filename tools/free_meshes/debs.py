"""Files of Debian packages, which apt-get downloads."""

import re
import subprocess
import tempfile
from pathlib import Path


def get_package(name: str, folder: Path) -> Path:
    """The .deb file of a package in `folder`.

    If it is missing, apt-get downloads it, which needs no root rights.

    Raises ValueError if apt-get fails, OSError if it is not installed.
    """
    if not any(folder.glob(f"{name}_*.deb")):
        result = subprocess.run(
            ["apt-get", "download", "-q", name], cwd=folder, capture_output=True, text=True
        )
        if result.returncode != 0:
            raise ValueError(
                f"apt-get could not download {name} ({result.stderr.strip()}); run `apt-get update` as root, enable "
                "the component non-free if the package is in it, or put the .deb file into the folder --packages-dir"
            )
    return max(
        folder.glob(f"{name}_*.deb"), key=lambda path: [*map(int, re.findall(r"\d+", path.name))]
    )


def read_package(package: Path, suffixes: tuple[str, ...]) -> dict[str, bytes]:
    """The files of a .deb file whose paths (relative to /) end in `suffixes`: path -> content.

    Raises ValueError for a damaged file, OSError if dpkg-deb is not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        if (
            subprocess.run(
                ["dpkg-deb", "--extract", package, folder], capture_output=True
            ).returncode
            != 0
        ):
            raise ValueError(f"{package} cannot be read as a Debian package; download it again")
        found = [path for path in Path(folder).rglob("*") if path.as_posix().endswith(suffixes)]
        regular = [path for path in found if path.is_file() and not path.is_symlink()]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in regular}
