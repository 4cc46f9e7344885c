"""Lets code that imports ``nvdiffrast`` find this package, unchanged."""

from __future__ import annotations

from nmr._drop_in import alias_package


def install_as(name: str = "nvdiffrast", *, replace: bool = False) -> None:
    """From now on, ``import nvdiffrast.torch as dr`` in this process means this package.

    ``name`` is the name under which other code imports the package. With ``replace`` it is taken
    even if a package of that name is installed. Raises ImportError if there is one and
    ``replace`` is False, ValueError for a name that no import could have.

    >>> nmr.nvdiffrast.install_as()
    >>> import nvdiffrast.torch as dr
    """
    alias_package(__package__, name, replace, "nvdiffrast", "pip uninstall nvdiffrast")
