"""Colours of meshes: per vertex, per face, cubes of texels, images with uv coordinates, or a
class of your own.

Any object with ``sample(fragments) -> [B, H, W, C]`` can be used as colours: see :class:`Colors`.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from . import ops
from ._packing import as_tuple, is_list
from ._validate import (
    callers_level,
    check_choice,
    check_faces,
    check_indices,
    check_values,
    describe,
    holds_for_all,
)
from ._vectors import unit
from .cameras.projection import has_perspective

if TYPE_CHECKING:
    from .fragments import Fragments

__all__ = [
    "Colors",
    "FaceColors",
    "NormalMap",
    "TextureCubes",
    "UVTexture",
    "VertexColors",
    "sample_texture",
]


class Colors(Protocol):
    """The interface of colours: write a class with this method for shading of your own."""

    def sample(self, fragments: Fragments) -> Tensor:
        """``[B, H, W, C]`` in the dtype of the vertices; values on the background are ignored.

        Of fragments with layers, ``[B, H, W, K, C]``.
        """
        ...


@dataclass(frozen=True, eq=False)
class VertexColors:
    """A colour per vertex, interpolated over faces with perspective correction.

    Parameters
    ----------
    colors : float Tensor [V, C] or [B, V, C]; for a list of meshes a list of [V_b, C]
        Any number of channels, not clamped. Differentiable.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes; when drawn, for another number of vertices.

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
        Any number of channels, not clamped. Differentiable.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes; when drawn, for another number of faces.

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

    The point with barycentric weights (b0, b1, b2) has the colour at ``(ts - 1) (b0, b1, b2)`` in
    the cube of its face, interpolated between the eight nearest texels. Texel [ts - 1, 0, 0] is the
    colour of the face's first vertex. As published, colours do not move vertices through the
    weights, even with ``interpolation_gradient``, and the place in the cube ends at
    ``ts - 1 - eps``, with the ``eps`` of the render function.

    Parameters
    ----------
    textures : float Tensor [F, ts, ts, ts, C] or [B, F, ts, ts, ts, C]; for a list of meshes a list of the former
        ts >= 2, any number of channels; values are not clamped. Differentiable.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes; when drawn, for another number of faces.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(1)
    >>> colors = nmr.TextureCubes(torch.rand(len(faces), 4, 4, 4, 3))
    >>> nmr.render_rgb(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), colors=colors, image_size=64).shape
    torch.Size([1, 64, 64, 3])
    """

    textures: Tensor | list[Tensor]

    def __post_init__(self) -> None:
        for cubes in as_tuple(check_values(self.textures, "textures", "F, ts, ts, ts, C")):
            sides = cubes.shape[-4:-1]
            if (
                len(set(sides)) != 1
                or sides[0] < 2
                or sides != as_tuple(self.textures)[0].shape[-4:-1]
            ):
                raise ValueError(
                    "textures must be cubes [ts, ts, ts, C] of one size ts >= 2, "
                    f"got {', '.join(describe(part) for part in as_tuple(self.textures))}"
                )

    def sample(self, fragments: Fragments) -> Tensor:
        """Colours ``[B, H, W, C]`` of fragments, 0 on background."""
        if fragments.layers:
            return fragments._each_layer(self.sample(fragments._wide()))
        textures = check_values(self.textures, "textures", "F, ts, ts, ts, C")
        textures = fragments.mesh.values(textures, "textures", "face")
        return ops.texture_cubes(
            textures,
            fragments.sided_face_index,
            fragments.weights,
            fragments.mesh.starts,
            fragments.eps,
        )


@dataclass(frozen=True, eq=False)
class UVTexture:
    """An image mapped onto the mesh by uv coordinates.

    Parameters
    ----------
    image : float Tensor [H, W, C] or [B, H, W, C]; for a list of meshes a list of [H_b, W_b, C]
        Row 0 is the top. Any number of channels. Differentiable.
    uv : float Tensor [T, 2] or [B, T, 2]; for a list of meshes a list of [T_b, 2]
        (0, 0) is the bottom left corner of the image, (1, 1) its top right one; texel centres are
        at half texels. Differentiable. Beyond 1e6, or not finite, counts as 0.
    uv_faces : integer Tensor [F, 3] or [B, F, 3], or a list; optional
        Row of uv at each corner of each face, so that faces may differ at a seam. Without it there
        is one uv per vertex.
    wrap : "repeat", "clamp" or "mirror"
        How the image continues outside [0, 1].
    filter : "bilinear" or "mipmap"
        "bilinear": between the four nearest texels. If the image is drawn smaller than it is, most
        texels are skipped, flicker, and get no gradient. "mipmap" takes colours from smaller copies
        of the image, linearly between the two that fit best (trilinear): about the mean of the
        texels that the pixel covers.

    Notes
    -----
    Mipmaps: each level has half the height and width of the one before, rounded down, until one
    texel is left; a texel is the mean of the area that it covers. The level of a pixel is OpenGL's,
    ``log2(max(|d(x, y)/dX|, |d(x, y)/dY|))``, where (x, y) is the position in texels of the full
    image and (X, Y) that in pixels of the raster, clamped to the levels. The derivatives are those
    of the pixel's face. The level counts as a constant in gradients.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes; when drawn, if they do not fit the meshes.

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
    filter: Literal["bilinear", "mipmap"] = "bilinear"

    def __post_init__(self) -> None:
        for image in as_tuple(check_values(self.image, "image", "H, W, C")):
            if 0 in image.shape[-3:]:
                raise ValueError(f"image must have texels, got {describe(image)}")
            if image.shape[-3] <= 4 < min(image.shape[-2:]):
                warnings.warn(
                    f"image {list(image.shape)} is taken for [H, W, C] with {image.shape[-1]} channels; if it is "
                    "[C, H, W], give image.permute(1, 2, 0)",
                    stacklevel=callers_level(),
                )
        for uv in as_tuple(check_values(self.uv, "uv", "T, 2")):
            if uv.shape[-1] != 2:
                raise ValueError(f"uv must have shape [T, 2] or [B, T, 2], got {describe(uv)}")
        if self.uv_faces is not None:
            for faces in as_tuple(self.uv_faces):
                batch = len(faces) if isinstance(faces, Tensor) and faces.ndim else 0
                check_faces(faces, batch, torch.device("cpu"), "uv_faces")
            if len(as_tuple(self.uv)) == len(as_tuple(self.uv_faces)):  # else refused when drawn
                for faces, uv in zip(as_tuple(self.uv_faces), as_tuple(self.uv), strict=True):
                    if not holds_for_all(faces != -1):
                        raise ValueError(
                            "uv_faces is -1 at faces without texture coordinates; nmr.Materials draws them in a colour"
                        )
                    check_indices(faces, uv.shape[-2], "uv_faces", "row", "uv", "rows")
        check_choice(self.wrap, "wrap", ops.WRAPS)
        check_choice(self.filter, "filter", ("bilinear", "mipmap"))

    def sample(self, fragments: Fragments) -> Tensor:
        """Colours ``[B, H, W, C]`` of fragments, 0 on background."""
        # the level depends on the place of a pixel in the image
        if fragments.layers and self.filter == "mipmap":
            return torch.stack(
                [self.sample(fragments.layer(k)) for k in range(fragments.layers)], dim=3
            )
        if fragments.layers:
            return fragments._each_layer(self.sample(fragments._wide()))
        attributes, corners, starts = fragments._corner_values(
            self.uv, self.uv_faces, "uv", "uv_faces"
        )
        at = attributes, corners, fragments.sided_face_index, fragments.weights, starts
        texels, grids, count = self._texels(fragments)
        level = None
        if self.filter == "mipmap":
            texels = ops.mipmaps(texels, grids, count)
            vertices = fragments.vertices
            if not has_perspective(fragments.camera):  # as at one depth
                vertices = torch.cat(
                    [vertices[..., :2], torch.ones_like(vertices[..., 2:])], dim=-1
                )
            values = (
                x if x is None else x.detach()
                for x in (vertices, *fragments.mesh.arrays[1:], *at, grids)
            )
            level = ops.uv_levels(*values)
        return ops.sample_uv(texels, grids, level, *at, ops.WRAPS.index(self.wrap))

    def _texels(self, fragments: Fragments) -> tuple[Tensor, Tensor, int]:
        """All texels ``[., C]``, the place of each level of each image among them, and the number
        of texels.
        """
        image = check_values(self.image, "image", "H, W, C")
        batch = fragments.mesh.batch
        if len(image) not in (1, batch):
            raise ValueError(
                f"image must be one for all {batch} images drawn, or one for each, got {len(image)}"
            )
        sizes = [tuple(part.shape[:2]) for part in image]
        levels = (
            max([1, *(max(size).bit_length() for size in sizes)]) if self.filter == "mipmap" else 1
        )
        grids, count = level_grids(sizes, levels)
        if isinstance(image, Tensor):
            texels = image.reshape(-1, image.shape[-1])
        else:
            texels = torch.cat([part.reshape(-1, part.shape[-1]) for part in image])
        return texels.to(fragments.weights), grids, count


def sample_texture(
    image: Tensor,
    uv: Tensor,
    derivatives: Tensor | None = None,
    wrap: Literal["repeat", "clamp", "mirror"] = "repeat",
) -> Tensor:
    """Colours of a texture image at uv coordinates of your own.

    Parameters
    ----------
    image : float Tensor [h, w, C] or [B, h, w, C]
        Row 0 is the top. Any number of channels. Differentiable.
    uv : float Tensor [B, H, W, 2]
        As in :class:`UVTexture`. Differentiable.
    derivatives : float Tensor [B, H, W, 4], optional
        (du/dX, du/dY, dv/dX, dv/dY) per pixel, for colours from mipmaps as in :class:`UVTexture`;
        without gradient. Default: bilinear.
    wrap : "repeat", "clamp" or "mirror"
        How the image continues outside [0, 1].

    Returns
    -------
    Tensor [B, H, W, C]

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes.

    Examples
    --------
    >>> nmr.sample_texture(torch.rand(16, 32, 3), torch.rand(1, 8, 8, 2)).shape
    torch.Size([1, 8, 8, 3])
    """
    image = check_values(image, "image", "h, w, C")
    if is_list(image) or 0 in image.shape[1:]:
        raise ValueError(
            f"image must be a tensor [h, w, C] or [B, h, w, C] with texels, got {describe(image)}"
        )
    for values, name, channels in ((uv, "uv", 2), (derivatives, "derivatives", 4)):
        if values is None and name == "derivatives":
            continue
        if not isinstance(values, Tensor) or not values.is_floating_point():
            raise TypeError(
                f"{name} must be a float tensor [B, H, W, {channels}], got {describe(values)}"
            )
        if values.ndim != 4 or values.shape[:3] != uv.shape[:3] or values.shape[3] != channels:
            raise ValueError(
                f"{name} must have shape [B, H, W, {channels}], got {describe(values)}"
            )
    if len(image) not in (1, len(uv)):
        raise ValueError(
            f"image must be one for all {len(uv)} images drawn, or one for each, got {len(image)}"
        )
    check_choice(wrap, "wrap", ops.WRAPS)
    height, width = image.shape[1:3]
    levels = 1 if derivatives is None else max(height, width).bit_length()
    grids, count = level_grids([(height, width)] * len(image), levels)
    texels, level = image.reshape(-1, image.shape[-1]), None
    if derivatives is not None:
        texels = ops.mipmaps(texels, grids, count)
        steps = derivatives.detach().to(image).unflatten(-1, (2, 2)) * image.new_tensor(
            [[width], [height]]
        )
        level = steps.square().sum(-2).amax(-1).clamp(min=1).log2() / 2
        level = level.nan_to_num(0).clamp(max=levels - 1)
    return sample_places(texels, grids, level, uv.to(image), wrap)


def level_grids(sizes: list[tuple[int, int]], levels: int) -> tuple[Tensor, int]:
    """Places of the levels of images (height, width), as :mod:`nmr.ops` has them, and the number
    of their texels.
    """
    grids, first = [], 0
    for height, width in sizes:
        for _ in range(levels):
            grids.append((first, height, width))
            first += height * width
            height, width = max(height // 2, 1), max(width // 2, 1)
    return torch.tensor(grids, dtype=torch.int64, device="cpu").view(len(sizes), levels, 3), first


def sample_places(
    texels: Tensor, grids: Tensor, level: Tensor | None, uv: Tensor, wrap: str
) -> Tensor:
    """Colours ``[B, H, W, C]`` of checked textures at ``uv [B, H, W, 2]``."""
    # One face with uv (1, 0), (0, 1) and (0, 0) at its corners: its weights are the coordinates.
    corners = torch.eye(3, 2, dtype=uv.dtype, device=uv.device).unsqueeze(0)
    face_index = torch.zeros(uv.shape[:3], dtype=torch.int32, device=uv.device)
    at = (
        corners,
        torch.arange(3, device=uv.device).unsqueeze(0),
        face_index,
        F.pad(uv, (0, 1)),
        None,
    )
    return ops.sample_uv(texels, grids, level, *at, ops.WRAPS.index(wrap))


class NormalMap(UVTexture):
    """Normals from an image in tangent space, for ``Lights(normals=...)``; the arguments are
    those of UVTexture.

    A texel (x, y, z) means the direction ``x T + y B + z N``, normalised. N is the interpolated
    normal of the vertices, outward for faces that are counter-clockwise from outside; T the
    direction in which u grows on the face, made orthogonal to N; B completes the two to the side in
    which v grows. Image files hold (texel + 1) / 2: pass ``2 * image - 1``. Unlike MikkTSpace's, T
    and B are not interpolated between faces.

    Differentiable in the image, the uv coordinates and the vertices.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> bumps = torch.rand(16, 32, 3) - 0.5 + torch.tensor([0.0, 0.0, 2.0])
    >>> lights = nmr.Lights(normals=nmr.NormalMap(bumps, vertices[:, :2], wrap="mirror"))
    >>> rgb = nmr.render_rgb(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), lights=lights, image_size=64)
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        for image in as_tuple(self.image):
            if image.shape[-1] != 3:
                raise ValueError(
                    f"the image of normals must have 3 channels, got {describe(image)}"
                )

    def sample(self, fragments: Fragments) -> Tensor:
        """Outward normals in world space ``[B, H, W, 3]`` of fragments, 0 on background."""
        if fragments.layers:
            return torch.stack(
                [self.sample(fragments.layer(k)) for k in range(fragments.layers)], dim=3
            )
        texel, world = super().sample(fragments), fragments.world
        all_vertices = (
            world.expand(len(fragments.faces), -1, -1) if fragments.faces.ndim == 3 else world
        )
        normals = -ops.normals(all_vertices, fragments.faces, fragments.mesh.starts, True)
        n = unit(ops.interpolate(normals, fragments.faces, *fragments._at))
        sides, changes = [], []  # from corner 0 to corners 1 and 2, in space and in uv
        for k in (1, 2):
            weights = fragments.weights.new_zeros(3)
            weights[0], weights[k] = -1.0, 1.0
            side = replace(fragments, weights=weights.expand_as(fragments.weights))
            sides.append(ops.interpolate(world, fragments.faces, *side._at))
            changes.append(side._interpolate(self.uv, self.uv_faces, "uv", "uv_faces"))
        (du1, dv1), (du2, dv2) = (change.split(1, dim=-1) for change in changes)
        turned = torch.sign(du1 * dv2 - du2 * dv1)  # -1: the image is mirrored on the face
        along = turned * (dv2 * sides[0] - dv1 * sides[1])
        t = unit(along - n * (n * along).sum(-1, keepdim=True))
        x, y, z = texel.split(1, dim=-1)
        mapped = unit(x * t + y * turned * torch.linalg.cross(n, t) + z * n)
        return mapped
