"""Lets code that imports ``neural_renderer`` find this package, unchanged."""

from __future__ import annotations

from nmr._drop_in import alias_package


def install_as(name: str = "neural_renderer", *, replace: bool = False) -> None:
    """From now on, ``import neural_renderer`` in this process means this package, and so do
    imports of its modules.

    Call it once, before other people's code is imported. ``import neural_renderer as nr``,
    ``from neural_renderer.projection import projection`` and the like then work there as written.
    Nothing is written to disk.

    Parameters
    ----------
    name : str
        The name under which that code imports the package; with dots if it is part of a package
        of theirs ("external.neural_renderer").
    replace : bool
        Take the name also if a package of that name is installed or already imported. Code that
        has imported it keeps the other one.

    Raises
    ------
    ImportError
        If there is such a package, and ``replace`` is False.
    ValueError
        For a name that no import could have.

    >>> nr.install_as()
    >>> from neural_renderer.projection import projection
    """
    alias_package(
        __package__, name, replace, "neural_renderer", "pip uninstall neural_renderer_pytorch"
    )
