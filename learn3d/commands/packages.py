"""Optional packages: what to say where one is not installed."""

import re
from importlib import metadata

#: Names on the package index, where they are not those that are imported.
_NAMES = {"sklearn": "scikit-learn", "skimage": "scikit-image", "PIL": "pillow"}


def missing_package(package: str) -> str:
    """Which package is needed, the command that installs it, and the one that installs all of its extra."""
    name = _NAMES.get(package, package)
    try:
        requirements = metadata.requires("nmr-learn3d") or []
    except metadata.PackageNotFoundError:  # used from a source folder
        requirements = []
    wanted = re.compile(rf"{re.escape(name)}[<>=;\s].*extra == ['\"](\w+)", re.IGNORECASE)
    extra = next((found[1] for found in map(wanted.match, requirements) if found), None)
    all_of_it = f", or all that it needs: pip install '.[{extra}]' in a clone" if extra else ""
    return f"needs the package {name}, which is not installed; install it: pip install {name}{all_of_it}"
