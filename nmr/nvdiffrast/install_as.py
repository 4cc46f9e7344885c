"""Lets code that imports ``nvdiffrast`` find this package, unchanged."""

from __future__ import annotations

from nmr._drop_in import alias_package


def install_as(name: str = "nvdiffrast", *, replace: bool = False) -> None:
    """From now on, ``import nvdiffrast.torch as dr`` in this process means this package.

    Arguments and errors are those of :func:`nmr.neural_renderer.install_as`.

    >>> nmr.nvdiffrast.install_as()
    >>> import nvdiffrast.torch as dr
    """
    alias_package(__package__, name, replace, "nvdiffrast", "pip uninstall nvdiffrast")
