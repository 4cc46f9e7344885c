"""A mesh with its texture."""

from __future__ import annotations

import torch
from torch import Tensor

from nmr._validate import describe
from nmr.neural_renderer.load_obj import load_obj


class Mesh:
    """Vertices ``[V, 3]``, faces ``[F, 3]`` and textures ``[F, ts, ts, ts, 3]`` of one mesh.

    Without textures, a Parameter of small random numbers is made, to start an optimization from.
    """

    def __init__(
        self, vertices: Tensor, faces: Tensor, textures: Tensor | None = None, texture_size: int = 4
    ) -> None:
        if not isinstance(vertices, Tensor) or not isinstance(faces, Tensor):
            raise TypeError(
                f"Mesh takes tensors, vertices [V, 3] and faces [F, 3], got {describe(vertices)} and {describe(faces)}"
                "; Mesh.fromobj(filename) reads a file"
            )
        self.vertices = vertices
        self.faces = faces
        self.num_vertices = vertices.shape[0]
        self.num_faces = faces.shape[0]
        if textures is None:
            shape = (self.num_faces, texture_size, texture_size, texture_size, 3)
            textures = torch.nn.Parameter(0.05 * torch.randn(shape))
        self.textures = textures
        self.texture_size = textures.shape[1]

    @classmethod
    def fromobj(
        cls,
        filename_obj: str,
        normalization: bool = True,
        load_texture: bool = False,
        texture_size: int = 4,
    ) -> Mesh:
        """The mesh of an .obj file: the arguments are those of :func:`load_obj`."""
        loaded = load_obj(filename_obj, normalization, texture_size, load_texture)
        return cls(*loaded, texture_size=texture_size)

    def get_batch(self, batch_size: int) -> tuple[Tensor, Tensor, Tensor]:
        """``batch_size`` copies of vertices, faces and the sigmoid of the textures, as in the
        Chainer class.
        """
        tensors = (self.vertices, self.faces, torch.sigmoid(self.textures))
        return tuple(x.expand(batch_size, *x.shape) for x in tensors)
