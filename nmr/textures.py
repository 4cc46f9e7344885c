"""Colours of meshes: per vertex, per face, cubes of texels, images with uv coordinates, or a class of your own.

Any object with ``sample(fragments) -> [B, H, W, C]`` can be used as colours: see :class:`Colors`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from . import ops
from ._packing import is_list
from ._validate import check_faces, check_values, describe

if TYPE_CHECKING:
    from .fragments import Fragments

__all__ = ["Colors", "FaceColors", "TextureCubes", "UVTexture", "VertexColors"]


class Colors(Protocol):
    """The interface of colours: write a class with this method for shading of your own."""

    def sample(self, fragments: Fragments) -> Tensor:
        """``[B, H, W, C]`` in the dtype of the vertices; values on the background are ignored."""
        ...


@dataclass(frozen=True, eq=False)
class VertexColors:
    """A colour per vertex, interpolated over faces with perspective correction.

    Parameters
    ----------
    colors : float Tensor [V, C] or [B, V, C]; for a list of meshes a list of [V_b, C]
        Any number of channels; values are not clamped. Differentiable.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes; when drawn, also if there is not one colour per vertex.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> colors = nmr.VertexColors((vertices + 1) / 2)
    >>> nmr.render_rgb(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), colors=colors, image_size=64).shape
    torch.Size([1, 64, 64, 3])
    """

    colors: Tensor | list[Tensor]

    def __post_init__(self) -> None:
        check_values(self.colors, "colors", "V, C")

    def sample(self, fragments: Fragments) -> Tensor:
        """Colours ``[B, H, W, C]`` of fragments, 0 on background."""
        return fragments._interpolate(self.colors, None, "colors", "")


@dataclass(frozen=True, eq=False)
class FaceColors:
    """A colour per face.

    Parameters
    ----------
    colors : float Tensor [F, C] or [B, F, C]; for a list of meshes a list of [F_b, C]
        Any number of channels; values are not clamped. Differentiable.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes; when drawn, also if there is not one colour per face.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(1)
    >>> colors = nmr.FaceColors(torch.rand(len(faces), 3))
    >>> nmr.render_rgb(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), colors=colors, image_size=64).shape
    torch.Size([1, 64, 64, 3])
    """

    colors: Tensor | list[Tensor]

    def __post_init__(self) -> None:
        check_values(self.colors, "colors", "F, C")

    def sample(self, fragments: Fragments) -> Tensor:
        """Colours ``[B, H, W, C]`` of fragments, 0 on background."""
        return fragments._per_face(self.colors, "colors")


@dataclass(frozen=True, eq=False)
class TextureCubes:
    """A cube of texels per face, as in the Neural Mesh Renderer.

    The point with barycentric weights (b0, b1, b2) has the colour at ``(ts - 1) (b0, b1, b2)`` in the cube of its face,
    interpolated between the eight nearest texels. Texel [ts - 1, 0, 0] is the colour of the face's first vertex. As in
    the published renderer, colours do not move vertices through the weights, even with ``interpolation_gradient``.

    Parameters
    ----------
    textures : float Tensor [F, ts, ts, ts, C] or [B, F, ts, ts, ts, C]; for a list of meshes a list of the former
        ts >= 2, any number of channels; values are not clamped. Differentiable.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes; when drawn, also if there is not one cube per face.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(1)
    >>> colors = nmr.TextureCubes(torch.rand(len(faces), 4, 4, 4, 3))
    >>> nmr.render_rgb(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), colors=colors, image_size=64).shape
    torch.Size([1, 64, 64, 3])
    """

    textures: Tensor | list[Tensor]

    def __post_init__(self) -> None:
        for cubes in _each(check_values(self.textures, "textures", "F, ts, ts, ts, C")):
            sides = cubes.shape[-4:-1]
            if len(set(sides)) != 1 or sides[0] < 2 or sides != _each(self.textures)[0].shape[-4:-1]:
                raise ValueError(
                    "textures must be cubes [ts, ts, ts, C] of one size ts >= 2, "
                    f"got {', '.join(describe(part) for part in _each(self.textures))}"
                )

    def sample(self, fragments: Fragments) -> Tensor:
        """Colours ``[B, H, W, C]`` of fragments, 0 on background."""
        textures = check_values(self.textures, "textures", "F, ts, ts, ts, C")
        textures = fragments.mesh.values(textures, "textures", "face")
        return ops.sample_texture_cubes(
            textures, fragments.owner, fragments.weights, fragments.mesh.starts, fragments.eps
        )


@dataclass(frozen=True, eq=False)
class UVTexture:
    """An image mapped onto the mesh by uv coordinates, with bilinear interpolation.

    Parameters
    ----------
    image : float Tensor [H, W, C] or [B, H, W, C]; for a list of meshes a list of [H_b, W_b, C]
        Row 0 is the top; any number of channels. Differentiable.
    uv : float Tensor [T, 2] or [B, T, 2]; for a list of meshes a list of [T_b, 2]
        (0, 0) is the bottom left corner of the image, (1, 1) its top right one; texel centres are at half texels.
        Differentiable. Coordinates that are not finite, or larger than 1e6, count as 0.
    uv_faces : integer Tensor [F, 3] or [B, F, 3], or a list; optional
        Row of uv at each corner of each face. Without it there is one uv per vertex. At a seam, faces that share a
        vertex have different rows.
    wrap : "repeat", "clamp" or "mirror"
        How the image continues outside [0, 1].

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes; when drawn, also if they do not fit the meshes.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> colors = nmr.UVTexture(torch.rand(16, 32, 3), vertices[:, :2], wrap="mirror")
    >>> nmr.render_rgb(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), colors=colors, image_size=64).shape
    torch.Size([1, 64, 64, 3])
    """

    image: Tensor | list[Tensor]
    uv: Tensor | list[Tensor]
    uv_faces: Tensor | list[Tensor] | None = None
    wrap: Literal["repeat", "clamp", "mirror"] = "repeat"

    def __post_init__(self) -> None:
        for image in _each(check_values(self.image, "image", "H, W, C")):
            if 0 in image.shape[-3:]:
                raise ValueError(f"image must have texels, got {describe(image)}")
        for uv in _each(check_values(self.uv, "uv", "T, 2")):
            if uv.shape[-1] != 2:
                raise ValueError(f"uv must have shape [T, 2] or [B, T, 2], got {describe(uv)}")
        if self.uv_faces is not None:
            for faces in _each(self.uv_faces):
                batch = len(faces) if isinstance(faces, Tensor) and faces.ndim else 0
                check_faces(faces, batch, torch.device("cpu"), "uv_faces")
        if self.wrap not in ("repeat", "clamp", "mirror"):
            raise ValueError(f'wrap must be "repeat", "clamp" or "mirror", got {self.wrap!r}')

    def sample(self, fragments: Fragments) -> Tensor:
        """Colours ``[B, H, W, C]`` of fragments, 0 on background."""
        uv = fragments._interpolate(self.uv, self.uv_faces, "uv", "uv_faces")
        uv = torch.where(uv.detach().abs() < 1e6, uv, torch.zeros_like(uv))
        texels, first, height, width = self._texels(fragments)
        x, y = uv[..., 0] * width - 0.5, (1 - uv[..., 1]) * height - 0.5
        column, row = x.detach().floor(), y.detach().floor()
        right, down = (x - column).unsqueeze(-1), (y - row).unsqueeze(-1)
        colors, nothing = 0, len(texels) - 1
        for dy, share_y in ((0, 1 - down), (1, down)):
            line = first + _wrapped(row.long() + dy, height, self.wrap) * width
            for dx, share_x in ((0, 1 - right), (1, right)):
                index = line + _wrapped(column.long() + dx, width, self.wrap)
                index = torch.where(fragments.covered, index, nothing)
                # embedding, not indexing: its backward pass sums in a fixed order.
                colors = colors + share_y * share_x * F.embedding(index, texels, padding_idx=nothing)
        return colors

    def _texels(self, fragments: Fragments) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """All texels ``[., C]`` and a row of zeros; first texel, height and width of each image ``[B | 1, 1, 1]``."""
        image, batch = check_values(self.image, "image", "H, W, C"), fragments.mesh.batch
        if len(image) not in (1, batch):
            raise ValueError(f"image must be one for all {batch} images drawn, or one for each, got {len(image)}")
        sizes = torch.tensor([part.shape[:2] for part in image], device=fragments.owner.device)
        height, width = sizes.T.reshape(2, -1, 1, 1)
        first = torch.cumsum(height * width, 0) - height * width
        rows = [part.reshape(-1, part.shape[-1]) for part in image]
        texels = torch.cat([*rows, rows[0].new_zeros(1, rows[0].shape[1])])
        return texels.to(fragments.weights), first, height, width


def _wrapped(index: Tensor, size: Tensor, wrap: str) -> Tensor:
    """Maps texel indices outside 0..size - 1 back into the image."""
    if wrap == "repeat":
        return index % size
    if wrap == "clamp":
        return torch.minimum(index.clamp_min(0), size - 1)
    index = index % (2 * size)
    return torch.minimum(index, 2 * size - 1 - index)


def _each(values: Tensor | tuple[Tensor, ...] | list[Tensor]) -> tuple[Tensor, ...]:
    return tuple(values) if is_list(values) else (values,)
