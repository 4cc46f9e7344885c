"""Optional packages: what to say where one is not installed."""

_EXTRAS = {"matplotlib": "figures", "sklearn": "figures", "gradio": "demo"}  # the others belong to "train"


def missing_package(package: str) -> str:
    """Which package is needed, and the command that installs it."""
    extra = _EXTRAS.get(package, "train")
    return f'needs the package {package}, which is not installed; install it: pip install "nmr-learn3d[{extra}]"'
