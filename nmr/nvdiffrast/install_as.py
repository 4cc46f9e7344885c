"""Lets code that imports ``nvdiffrast`` find this package, unchanged."""

from __future__ import annotations

from nmr._drop_in import alias_package


def install_as(name: str = "nvdiffrast", *, replace: bool = False) -> None:
    """From now on, ``import nvdiffrast.torch as dr`` in this process means this package.

    Call it once, before other people's code is imported. Nothing is written to disk.

    Parameters
    ----------
    name : str
        The name under which that code imports the package.
    replace : bool
        Take the name also if a package of that name is installed or already imported. Code that has imported it
        keeps the other one.

    Raises
    ------
    ImportError
        If there is such a package, and ``replace`` is False.
    ValueError
        For a name that no import could have.

    >>> nmr.nvdiffrast.install_as()
    >>> import nvdiffrast.torch as dr
    """
    alias_package(__package__, name, replace, "nvdiffrast", "pip uninstall nvdiffrast")
