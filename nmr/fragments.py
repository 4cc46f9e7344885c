"""Fragments: the nearest face at each pixel, with all that shading needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from . import ops
from ._packing import LARGEST_COORDINATE, MeshBatch
from ._validate import (
    GRADIENTS,
    as_floats,
    cast_under_autocast,
    check_choice,
    check_flag,
    check_values,
    describe,
)
from ._vectors import unit
from .cameras.projection import ProjectingCamera, cofactors, has_perspective

if TYPE_CHECKING:
    from .cameras import Camera


@dataclass(frozen=True, eq=False)
class Fragments:
    """The nearest face at each centre of the raster, made by :func:`nmr.render_fragments`.

    H and W are the image's, or twice as many with anti-aliasing; row 0 is the top. For shading of
    your own, compute an image ``[B, H, W, C]`` and call :meth:`resolve`, which averages pixels and
    gives the vertices NMR's gradient.

    Attributes
    ----------
    sided_face_index : int32 Tensor [B, H, W]
        ``sided_face_index[b, y, x] = f``: face f is nearest and seen from its front; ``F + f``:
        from its back; -1: background. ``face_index`` and ``is_back`` say the same.
    weights : Tensor [B, H, W, 3]
        Barycentric weights in space (perspective-correct) of the face's vertices in their own
        order, of sum 1; 0 on background. Differentiable in the vertices (at fixed face indices);
        ``weights.detach()`` is NMR's definition, in which colours move vertices through edges only.
    depth : Tensor [B, H, W]
        z of the nearest point, ``far`` on background. Differentiable in the vertices.
    vertices, faces
        The meshes in renderer space, ``[B, V, 3]``; of a list ``[N, 3]``, one after the other.

    distances : Tensor [B, H, W, K], or None without blur_radius
        Squared distance from the border of the face, in units of half the shorter side of the
        image; negative inside. Differentiable in x and y of the vertices.

    With ``faces_per_pixel`` K > 1 or a ``blur_radius`` these, and all that is computed of them,
    have one more axis, nearest first: sided_face_index and depth ``[B, H, W, K]``, weights ``[B, H,
    W, K, 3]``. :meth:`resolve` takes one image.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> fragments = nmr.render_fragments(0.5 * vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), image_size=64)
    >>> heights = fragments.interpolate(vertices[:, 1:])  # a value for each vertex: [V, 2]
    >>> image = fragments.resolve(heights)
    >>> image.shape
    torch.Size([1, 64, 64, 2])
    """

    sided_face_index: Tensor
    weights: Tensor
    depth: Tensor
    mesh: MeshBatch  # in renderer space
    world: Tensor  # the vertices before the camera, [B or 1, V, 3] or packed
    camera: Camera | None
    anti_aliasing: bool
    eps: float
    _drawn: MeshBatch  # the meshes as drawn: faces that cross the near plane are cut
    # None: surfaces behind others, or blurred, which have no edge gradient
    _drawn_face_index: Tensor | None
    distances: Tensor | None = None

    @property
    def vertices(self) -> Tensor:
        return self.mesh.vertices

    @property
    def faces(self) -> Tensor:
        return self.mesh.faces

    @property
    def layers(self) -> int | None:
        """K, or None without that axis."""
        return self.sided_face_index.shape[3] if self.sided_face_index.ndim == 4 else None

    def layer(self, k: int) -> Fragments:
        """The k-th nearest surfaces, without the axis for K; 0 is the visible one.

        Everything can be done with it, except that only layer 0 can be resolved: NMR's gradient
        is that of the edges that are seen.
        """
        if self.layers is None or not -self.layers <= k < self.layers:
            have = (
                "one layer without an axis for it"
                if self.layers is None
                else f"layers 0..{self.layers - 1}"
            )
            raise IndexError(
                f"layer {k} was requested of fragments with {have}; see faces_per_pixel"
            )
        index = self._drawn_face_index
        return replace(
            self,
            sided_face_index=self.sided_face_index[..., k],
            weights=self.weights[..., k, :],
            depth=self.depth[..., k],
            _drawn_face_index=None
            if index is None or k not in (0, -self.layers)
            else index[..., k],
            distances=None if self.distances is None else self.distances[..., k],
        )

    def _wide(self) -> Fragments:
        """All layers side by side, as one raster ``[B, H, W K]``."""
        index = self.sided_face_index.flatten(2)
        weights = self.weights.flatten(2, 3)
        depth = self.depth.flatten(2)
        return replace(self, sided_face_index=index, weights=weights, depth=depth)

    def _each_layer(self, raster: Tensor) -> Tensor:
        """Values ``[B, H, W K, C]`` of :meth:`_wide` as ``[B, H, W, K, C]``."""
        return raster.unflatten(2, self.sided_face_index.shape[2:])

    @property
    def covered(self) -> Tensor:
        """bool ``[B, H, W]``: some face is there."""
        return self.sided_face_index >= 0

    @property
    def is_back(self) -> Tensor:
        """bool ``[B, H, W]``: the face there is seen from its back (its vertices run clockwise on
        the screen).
        """
        return self.sided_face_index >= self._num_faces

    @property
    def face_index(self) -> Tensor:
        """int32 ``[B, H, W]``: index of the nearest face, seen from either side; -1 is
        background.
        """
        return torch.where(
            self.is_back, self.sided_face_index - self._num_faces, self.sided_face_index
        )

    @property
    def _num_faces(self) -> int | Tensor:
        num_faces = self.mesh.num_faces
        return (
            num_faces.unsqueeze(-1) if isinstance(num_faces, Tensor) and self.layers else num_faces
        )

    def interpolate(
        self, attributes: Tensor | list[Tensor], corners: Tensor | list[Tensor] | None = None
    ) -> Tensor:
        """Values given at vertices, interpolated at each pixel: ``[B, H, W, C]``, 0 on
        background.

        Parameters
        ----------
        attributes : float Tensor [V, C] or [B, V, C]; for a list of meshes a list of [V_b, C]
        corners : integer Tensor [F, 3] or [B, F, 3] (or a list), optional
            Row of attributes at each corner of each face, if there is not one row per vertex: a
            texture with seams.

        Differentiable in attributes, and in weights.
        """
        return self._interpolate(attributes, corners, "attributes", "corners")

    def _interpolate(
        self, attributes: object, corners: object, name: str, corners_name: str
    ) -> Tensor:
        if self.layers:
            return self._each_layer(
                self._wide()._interpolate(attributes, corners, name, corners_name)
            )
        attributes, faces, starts = self._corner_values(attributes, corners, name, corners_name)
        return ops.interpolate(attributes, faces, self.sided_face_index, self.weights, starts)

    def _corner_values(
        self, attributes: object, corners: object, name: str, corners_name: str
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Checked attributes, their rows at the corners of faces, and starts, as the operators
        take them.
        """
        values = check_values(attributes, name, "V, C")
        if corners is None:
            return self.mesh.values(values, name, "vertex"), self.faces, self.mesh.starts
        return self.mesh.values(values, name), *self.mesh.corners(corners, values, corners_name)

    def per_face(self, values: Tensor | list[Tensor]) -> Tensor:
        """Values of faces, ``[F, C]``, ``[B, F, C]`` or a list, at each pixel: ``[B, H, W, C]``,
        0 on background.
        """
        return self._per_face(values, "values")

    def _per_face(self, values: object, name: str) -> Tensor:
        if self.layers:
            return self._each_layer(self._wide()._per_face(values, name))
        values = self.mesh.values(check_values(values, name, "F, C"), name, "face")
        rows = values.reshape(-1, values.shape[-1])
        rows = torch.cat([rows, rows.new_zeros(1, rows.shape[1])])
        index = self.face_index.long() + self.mesh.first_faces(len(values))
        index = torch.where(self.covered, index, len(rows) - 1)
        # embedding, not indexing: its backward pass sums in a fixed order.
        return F.embedding(index, rows, padding_idx=len(rows) - 1)

    def normals(self, smooth: bool = False, space: str = "world") -> Tensor:
        """Unit normals of the side that is seen, ``[B, H, W, 3]``, 0 on background.

        Flat: the normal of the face. Smooth: the normals of its vertices (means over the adjacent
        faces, weighted by area), interpolated. In a left-handed world (LookAt) the front of face
        (v0, v1, v2) has the normal ``(v0 - v1) x (v2 - v1)``, as in the published renderer, in a
        right-handed one (Pinhole) the opposite one. Differentiable in the world-space vertices
        and, if smooth, in weights.

        With ``space="camera"`` the axes are those of renderer space: x to the right of the image,
        y up, z away from the viewer (so z is negative if a face looks at the viewer). It needs
        one of nmr's cameras, or none, and is differentiable in its rotation, too. A camera that
        sees nothing gives 0.
        """
        check_choice(space, "space", ("world", "camera"))
        smooth = check_flag(smooth, "smooth")
        if self.layers:
            return self._each_layer(self._wide().normals(smooth, space))
        normals = self._lit(None, None, torch.zeros(0, 3, dtype=torch.int64, device="cpu"), smooth)
        if space == "world" or self.camera is None:
            return normals
        if not isinstance(self.camera, ProjectingCamera):
            raise ValueError(
                f"normals in camera space need one of nmr's cameras, not {type(self.camera).__name__}; "
                "rotate those in world space"
            )
        matrix, intrinsics, *_ = self.camera.projection(normals.dtype).parameters()
        turned = _turn(normals, _along_normals(matrix[:, :, :3].to(normals))[:, None, None])
        return unit(_turn(turned, _image_axes(intrinsics.to(normals))[:, None, None]))

    def _lit(
        self,
        colors: Tensor | None,
        parameters: Tensor | None,
        layout: Tensor,
        smooth: bool,
        positions: bool = False,
        highlights: bool = False,
        own: Tensor | None = None,
    ) -> Tensor:
        """Lit colours ``[B, H, W, 3]`` (:func:`nmr.ops.lit`); without parameters the normals.

        ``positions``: the light depends on the position of a point; ``highlights``: also on that
        of the eye; ``own``: outward normals of the vertices in the layout of the meshes, or of
        the pixels ``[B, H, W, 3]``.
        """
        viewer = self._viewer(highlights)
        if own is not None and own.ndim == 4:
            normals, at = -own.flatten(1, 2), self._as_pixels(own, positions)
            return ops.lit(colors, normals, parameters, layout, viewer, *at, None, True)
        world = self.world.expand(len(self.faces), -1, -1) if self.faces.ndim == 3 else self.world
        normals = ops.normals(world, self.faces, self.mesh.starts, smooth) if own is None else -own
        points = usable(world) if positions else world.detach()
        at = viewer, points, self.faces, *self._at, smooth or own is not None
        return ops.lit(colors, normals, parameters, layout, *at)

    def _as_pixels(self, like: Tensor, positions: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Points, faces, face indices and weights of a mesh of one face with one vertex for each
        pixel of a raster like ``like [B, H, W, 3]``. Without ``positions`` the points are 0.
        """
        count, points = like.shape[1] * like.shape[2], torch.zeros_like(like)
        if positions:
            points = ops.interpolate(usable(self.world), self.faces, *self._at)
        number = torch.arange(count, dtype=torch.int32, device=like.device)
        index = number.view(1, *like.shape[1:3]) + count * self.is_back
        index = torch.where(self.covered, index, -1).int()
        faces = number.long().view(-1, 1).expand(-1, 3)
        weights = like.new_tensor([1.0, 0.0, 0.0]).expand_as(like)
        return points.flatten(1, 2), faces, index, weights

    @property
    def _at(self) -> tuple[Tensor, Tensor, Tensor | None]:
        return self.sided_face_index, self.weights, self.mesh.starts

    def _viewer(self, needs_eye: bool) -> Tensor:
        """Viewers of the images, ``[B, 5]``: see :func:`nmr.ops.lit`."""
        batch = self.mesh.batch
        if self.camera is None:  # renderer space itself, seen along z
            return self.weights.new_tensor([0.0, 0.0, -1.0, 0.0, 1.0]).expand(batch, 5)
        if isinstance(self.camera, ProjectingCamera):
            viewer = self.camera.projection(self.weights.dtype).viewer().to(self.weights)
            return viewer.nan_to_num(0, 0, 0).expand(batch, 5)
        eye = getattr(self.camera, "eye", None)
        if eye is None and needs_eye:
            raise ValueError(
                "highlights need the eye of the camera: "
                f"give {type(self.camera).__name__} an attribute eye, [3] or [B, 3], in world space"
            )
        eye = (
            as_floats((0.0, 0.0, 0.0) if eye is None else eye, "eye", "[3] or [B, 3]")
            .detach()
            .to(self.weights)
        )
        eye = eye.reshape(-1, 3).expand(batch, 3)
        side = -1.0 if getattr(self.camera, "right_handed", False) else 1.0
        return torch.cat([eye, eye.new_tensor([1.0, side]).expand(batch, 2)], dim=1)

    def resolve(self, image: Tensor, gradient: str = "nmr") -> Tensor:
        """The image ``[B, h, w, C]`` of a shaded raster ``[B, H, W, C]``, with NMR's gradient or
        another one.

        The mean of 2x2 pixels with anti-aliasing, else the image itself. The gradient goes back
        to the raster and, by NMR's definition, to x and y of the vertices: every visible edge is
        pulled by those pixels whose loss would fall if the edge moved over them. The change of
        the loss is summed over all C channels. With ``gradient="local"`` or ``"none"``: as in
        :func:`nmr.render`. No second derivative.

        Raises
        ------
        TypeError, ValueError
            If image is not a float tensor [B, H, W, C] of the dtype of the vertices, or for
            another gradient.
        """
        check_choice(gradient, "gradient", GRADIENTS)
        image = cast_under_autocast(image)
        if self.layers or self._drawn_face_index is None:
            raise ValueError(
                "only the nearest surfaces can be resolved, because NMR's gradient is that of the edges that are seen: "
                "combine the layers into one image [B, H, W, C] and call fragments.layer(0).resolve(image)"
            )
        if not isinstance(image, Tensor) or image.dtype != self.vertices.dtype:
            raise TypeError(
                f"image must be a tensor of {self.vertices.dtype}, as the vertices are, got {describe(image)}"
            )
        if image.ndim != 4 or image.shape[:3] != self.sided_face_index.shape:
            raise ValueError(
                f"image must have shape {[*self.sided_face_index.shape, 'C']}, got {describe(image)}"
            )
        return self._resolve(image, None, gradient)

    def _resolve(self, image: Tensor, background: Tensor | None, gradient: str) -> Tensor:
        """The same; pixels without a face have the colour ``background [B | 1, C]``, if it is
        given.
        """
        vertices, faces, starts = self._drawn.arrays
        vertices = vertices.detach() if gradient == "none" else vertices
        edges = self.anti_aliasing, self.eps, gradient == "local", has_perspective(self.camera)
        return ops.resolve(
            image, background, vertices, faces, starts, self._drawn_face_index, *edges
        )


def _turn(vectors: Tensor, matrices: Tensor) -> Tensor:
    """Matrices times vectors ``[..., 3]``; in full precision, as torch.autocast changes products
    of matrices alone.
    """
    return (matrices * vectors.unsqueeze(-2)).sum(-1)


def _along_normals(matrices: Tensor) -> Tensor:
    """How normals turn if ``matrices [B, 3, 3]`` move the points: the transposed inverse, times a
    positive number; 0 if there is no inverse.
    """
    matrices = torch.where(matrices.isfinite(), matrices, 0.0)
    turns = cofactors(matrices)
    return turns * (turns[:, 2] * matrices[:, 2]).sum(-1).sign()[:, None, None]


def _image_axes(intrinsics: Tensor) -> Tensor:
    """Right and up in the image and the direction of view ``[B, 3, 3]``, in camera axes; a skew
    turns nothing.
    """
    up = unit(intrinsics[:, 1, :2])
    right = torch.stack([up[:, 1], -up[:, 0]], dim=1)
    mirrored = (right * intrinsics[:, 0, :2]).sum(1, keepdim=True) < 0
    right = torch.where(mirrored, -right, right)
    flat = torch.nn.functional.pad(torch.stack([right, up], dim=1), (0, 1))
    return torch.cat([flat, flat.new_tensor([[[0.0, 0.0, 1.0]]]).expand(len(flat), 1, 3)], dim=1)


def usable(points: Tensor) -> Tensor:
    """Puts points that are not finite, or so large that a product overflows, at the origin,
    without gradient.
    """
    return torch.where(
        (points.abs() < LARGEST_COORDINATE).all(-1, keepdim=True), points, torch.zeros_like(points)
    )
