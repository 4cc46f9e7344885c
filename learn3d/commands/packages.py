"""Optional packages: what to say where one is not installed."""

import re
from importlib import metadata

#: Names on the package index, where they are not those that are imported.
_NAMES = {"sklearn": "scikit-learn", "skimage": "scikit-image", "PIL": "pillow"}
#: The extra that has all that a command needs, where it is not "train".
_EXTRAS = {"demo": "demo", "report": "report", "figures": "figures"}
_EXTRAS |= dict.fromkeys(("make-dataset", "fetch-debian-models"), "data")


def missing_package(package: str, command: str = "train") -> str:
    """Which package is needed, the command that installs it, and the one that installs all that the command needs."""
    name = _NAMES.get(package, package)
    try:
        requirements = metadata.requires("nmr-learn3d") or []
    except metadata.PackageNotFoundError:  # used from a source folder
        requirements = []
    wanted = re.compile(rf"{re.escape(name)}[<>=;\s].*extra == ['\"](\w+)", re.IGNORECASE)
    extra = next((found[1] for found in map(wanted.match, requirements) if found), None)
    if extra in ("data", "train"):  # parts of the others
        extra = _EXTRAS.get(command, "train")
    said = f"needs the package {name}, which is not installed; install it: pip install {name}"
    if extra is None:
        return said
    return f"{said}, or all that it needs: pip install '.[{extra}]' in a clone, 'FILE.whl[{extra}]' of a wheel"
