"""Colours of meshes of several materials, as files have them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from ._clip import can_read
from ._images import read_image
from ._packing import as_tuple, is_list
from ._validate import check_indices, check_values, describe
from .textures import UVTexture

if TYPE_CHECKING:
    from .fragments import Fragments
    from .mesh_files import MeshFile

__all__ = ["Materials"]

GREY = 0.5  # of faces without a material


@dataclass(frozen=True, eq=False)
class Materials:
    """The colours of a mesh of several materials: an image each, or one colour.

    A face shows the image of its material, without one (or texture coordinates) its colour times
    those of the vertices, without a material those of the vertices alone, or grey (0.5).

    Parameters
    ----------
    colors : float Tensor [M, C]
        One colour for each material. Differentiable.
    images : sequence of M float Tensors [H_m, W_m, C], or None
        Of any sizes; row 0 is the top. Differentiable, each.
    face_material : integer Tensor [F]; for a list of meshes a list of [F_b]
        Row of ``colors``, and image, of each face; -1 without a material.
    uv : float Tensor [T, 2], optional; for a list of meshes a list of [T_b, 2]
        As in :class:`UVTexture`; needed if there are images. Differentiable.
    uv_faces : integer Tensor [F, 3], or a list of [F_b, 3], optional
        Row of uv at each corner of each face; -1 without texture coordinates.
    wrap, filter
        Of all images: see :class:`UVTexture`.
    vertex_colors : float Tensor [V, C], optional; for a list of meshes a list of [V_b, C]
        Interpolated as :class:`VertexColors`; images do not show them. Differentiable.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, missing materials and rows of uv; when drawn, if they do not
        fit.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(2)
    >>> north = (vertices[faces].mean(1)[:, 1] > 0).long()
    >>> colors = torch.tensor([[0.2, 0.4, 0.8], [1.0, 1.0, 1.0]])
    >>> image = torch.rand(8, 16, 3, requires_grad=True)
    >>> materials = nmr.Materials(colors, [None, image], north, 0.5 + vertices[:, :2], faces)
    >>> rgb = nmr.render_rgb(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), colors=materials, image_size=64)
    >>> torch.autograd.grad(rgb.sum(), image)[0].shape
    torch.Size([8, 16, 3])
    """

    colors: Tensor
    images: Sequence[Tensor | None]
    face_material: Tensor | list[Tensor]
    uv: Tensor | list[Tensor] | None = None
    uv_faces: Tensor | list[Tensor] | None = None
    wrap: Literal["repeat", "clamp", "mirror"] = "repeat"
    filter: Literal["bilinear", "mipmap"] = "bilinear"
    vertex_colors: Tensor | list[Tensor] | None = None

    def __post_init__(self) -> None:
        colors = check_values(self.colors, "colors", "M, C")[0]
        if not isinstance(self.colors, Tensor) or self.colors.ndim != 2:
            raise ValueError(f"colors must be a tensor [M, C], got {describe(self.colors)}")
        if self.vertex_colors is not None:
            found = check_values(self.vertex_colors, "vertex_colors", "V, C")[0].shape[-1]
            if found != colors.shape[1]:
                raise ValueError(
                    f"vertex_colors must have {colors.shape[1]} channels as colors have, got {found}"
                )
        if not is_list(self.images) or len(self.images) != len(colors):
            got = len(self.images) if is_list(self.images) else describe(self.images)
            raise ValueError(f"images must be a list of {len(colors)}, one per colour, got {got}")
        for faces in as_tuple(self.face_material):
            if not isinstance(faces, Tensor) or faces.ndim != 1 or faces.is_floating_point():
                raise TypeError(
                    f"face_material must be an integer tensor [F], got {describe(faces)}"
                )
            known = faces[faces != -1]
            check_indices(known, len(colors), "face_material", "row", "colors", "rows")
        for number, image in enumerate(self.images):
            if image is None:
                continue
            if self.uv is None or self.uv_faces is None:
                raise ValueError("images need uv and uv_faces")
            if (
                not isinstance(image, Tensor)
                or image.ndim != 3
                or image.shape[-1] != colors.shape[1]
            ):
                raise ValueError(
                    f"images[{number}] must be a tensor [H, W, {colors.shape[1]}] as colors are, or None, "
                    f"got {describe(image)}"
                )
            self._texture(image)

    @classmethod
    def from_mesh(cls, mesh: MeshFile) -> Materials:
        """The materials and vertex colours of a mesh that :func:`load_obj` or :func:`load_gltf` has read.

        Reads their images, which needs Pillow; those of one file are one tensor. Raises
        FileNotFoundError if one is missing and ValueError if it cannot be read. The values are as
        in the files, and nothing is converted: images are sRGB, colours of glTF's materials and
        vertices linear, so that they look darker.

        Examples
        --------
        >>> mesh, camera = nmr.load_obj("chair.obj"), nmr.LookAt([0.0, 1.0, -3.0])
        >>> rgb = nmr.render_rgb(mesh.vertices, mesh.faces, camera, colors=nmr.Materials.from_mesh(mesh))
        """
        images: dict[object, Tensor] = {}
        for name, _, image, factor in mesh.materials:
            if image is None or (image, factor) in images:
                continue
            path = f"of material {name!r}" if isinstance(image, bytes) else image
            content = image if isinstance(image, bytes) else None
            read = torch.from_numpy(read_image(path, content)).to(mesh.vertices)
            images[image, factor] = read * read.new_tensor(factor)
        colors = [(GREY,) * 3 if x.color is None else x.color for x in mesh.materials]
        return cls(
            mesh.vertices.new_tensor(colors).reshape(-1, 3),
            [images.get((x.image, x.factor)) for x in mesh.materials],
            mesh.face_material,
            mesh.uv,
            mesh.uv_faces,
            vertex_colors=mesh.colors,
        )

    def sample(self, fragments: Fragments) -> Tensor:
        """Colours ``[B, H, W, C]`` of fragments, 0 on background."""
        # the image of each face, -1 if it has none; then the colour, 0 if it has an image
        chosen, plain = [], []
        images: list[Tensor] = []  # materials may share one
        for image in self.images:
            if image is not None and not any(image is other for other in images):
                images.append(image)
        of_material = [
            next((k for k, other in enumerate(images) if other is image), -1)
            for image in self.images
        ]
        for k, faces in enumerate(as_tuple(self.face_material)):
            faces = faces.to(self.colors.device, torch.int64)
            image_of_face = faces.new_tensor([*of_material, -1])[faces]
            shown = image_of_face >= 0
            if self.uv_faces is not None:
                shown = shown & (as_tuple(self.uv_faces)[k] >= 0).all(1).to(shown.device)
            chosen.append(torch.where(shown, image_of_face, -1).to(self.colors).unsqueeze(-1))
            none = self.colors.new_full((1, self.colors.shape[1]), self.without_material)
            colors = torch.cat([self.colors, none])[faces]
            plain.append(torch.where(shown.unsqueeze(-1), 0.0, colors))
        as_given = list if is_list(self.face_material) else lambda parts: parts[0]
        number = fragments._per_face(as_given(chosen), "face_material").squeeze(-1)
        image = fragments._per_face(as_given(plain), "face_material")
        if self.vertex_colors is not None:
            image = image * fragments._interpolate(self.vertex_colors, None, "vertex_colors", "")
        # images that no pixel shows are not sampled, unless autograd wants their gradient (0)
        parameters = [*images, *(() if self.uv is None else as_tuple(self.uv))]
        constant = can_read() and not any(x.requires_grad for x in parameters)
        drawn = number.unique().tolist() if constant else range(len(images))
        for k, texture in enumerate(images):
            if k in drawn:
                index = torch.where(number == k, fragments.sided_face_index, -1)
                of_image = replace(fragments, sided_face_index=index)
                image = image + self._texture(texture).sample(of_image)
        return image

    @property
    def without_material(self) -> float:
        """All channels of the colour of faces without a material, before those of the vertices."""
        return GREY if self.vertex_colors is None else 1.0

    def _texture(self, image: Tensor) -> UVTexture:
        """One image on all faces; those without texture coordinates have any."""
        lists = is_list(self.uv)
        uv = [x if len(x) else x.new_zeros(1, 2) for x in as_tuple(self.uv)]
        rows = [x.clamp(min=0) for x in as_tuple(self.uv_faces)]
        parts = (uv, rows) if lists else (uv[0], rows[0])
        return UVTexture(image, *parts, self.wrap, self.filter)
