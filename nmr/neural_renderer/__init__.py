"""The interface of neural_renderer_pytorch 1.1.3, on the CPU:
``import nmr.neural_renderer as nr``.

Names, arguments, their order and defaults are the published ones. So are images and gradients,
except for defects that are corrected here (``docs/migrating/neural_renderer.md`` lists them). The
operators of :mod:`nmr` do the work. Images are ``[B, 3, h, w]`` and ``[B, h, w]`` with row 0 at
the top; vertices ``[B, V, 3]``, faces ``[B, F, 3]``, textures ``[B, F, ts, ts, ts, 3]``.
:func:`install_as` lets other people's ``import neural_renderer`` find this package.
"""

import sys
from types import ModuleType

from nmr.neural_renderer.get_points_from_angles import get_points_from_angles
from nmr.neural_renderer.install_as import install_as
from nmr.neural_renderer.lighting import lighting
from nmr.neural_renderer.load_obj import load_obj
from nmr.neural_renderer.look import look
from nmr.neural_renderer.look_at import look_at
from nmr.neural_renderer.mesh import Mesh
from nmr.neural_renderer.perspective import perspective
from nmr.neural_renderer.projection import projection
from nmr.neural_renderer.rasterize import (
    Rasterize,
    rasterize,
    rasterize_depth,
    rasterize_rgbad,
    rasterize_silhouettes,
)
from nmr.neural_renderer.renderer import Renderer
from nmr.neural_renderer.save_obj import save_obj
from nmr.neural_renderer.vertices_to_faces import vertices_to_faces

__all__ = [
    "Mesh",
    "Rasterize",
    "Renderer",
    "get_points_from_angles",
    "install_as",
    "lighting",
    "load_obj",
    "look",
    "look_at",
    "perspective",
    "projection",
    "rasterize",
    "rasterize_depth",
    "rasterize_rgbad",
    "rasterize_silhouettes",
    "save_obj",
    "vertices_to_faces",
]

# The version of the interface; some scripts check it.
__version__ = "1.1.3"
name = "neural_renderer_pytorch"


class _Package(ModuleType):
    """Functions here have the names of their modules, and stay functions if a module is imported
    under another name.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if not (isinstance(value, ModuleType) and callable(self.__dict__.get(name))):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
