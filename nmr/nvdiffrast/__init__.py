"""The interface of nvdiffrast's torch module on the CPU: ``import nmr.nvdiffrast.torch as dr``.

Names, arguments, shapes and conventions are nvdiffrast's: clip-space positions, images with row 0
at the bottom. The operators of :mod:`nmr` do the work. :func:`install_as` lets other people's
``import nvdiffrast.torch as dr`` find this package. ``docs/migrating/nvdiffrast.md`` lists the
differences.
"""

from nmr.nvdiffrast import torch
from nmr.nvdiffrast.install_as import install_as

__all__ = ["install_as", "torch"]

# The version of the interface; some scripts check it.
__version__ = "0.4.0"
