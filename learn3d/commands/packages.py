"""Optional packages: what to say where one is not installed."""

#: The extra that a package belongs to; the others belong to "train".
_EXTRAS = {"matplotlib": "figures", "sklearn": "figures", "plotly": "report", "gradio": "demo"}


def missing_package(package: str) -> str:
    """Which package is needed, and the command that installs it."""
    extra = _EXTRAS.get(package, "train")
    return f'needs the package {package}, which is not installed; install it: pip install "nmr-learn3d[{extra}]"'
