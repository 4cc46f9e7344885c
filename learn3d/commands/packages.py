"""Optional packages: what to say where one is not installed."""

#: Names on the package index, where they are not those that are imported.
_NAMES = {"sklearn": "scikit-learn", "skimage": "scikit-image", "PIL": "pillow"}


def missing_package(package: str) -> str:
    """Which package is needed, and the command that installs it."""
    name = _NAMES.get(package, package)
    return f"needs the package {name}, which is not installed; install it: pip install {name}"
