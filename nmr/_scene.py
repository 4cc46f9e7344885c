"""Shared by the rendering functions: checks the arguments, applies the camera, calls the
operators.
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from . import ops
from ._clip import Clipped, can_read, clip_near, clip_plane
from ._packing import MeshBatch, is_list, pack_meshes
from ._validate import (
    as_floats,
    callers_level,
    check_camera,
    check_depth_range,
    check_eps,
    check_faces,
    check_flag,
    check_image_size,
    check_transformed,
    check_vertices,
    describe,
    holds_for_all,
)
from .cameras import Camera
from .cameras.projection import (
    ProjectingCamera,
    has_perspective,
    is_projecting,
    transform,
)
from .fragments import Fragments
from .lights import Lights
from .textures import Colors

LARGEST_IMAGE = 8192
_NARROWEST = 1e-3  # part of the scene: faces that are cut nearer have images too large for float32

Meshes = Tensor | Sequence[Tensor]


class Scene(NamedTuple):
    """Checked arguments: meshes before and after the camera, and the settings of the render.

    If faces cross the near plane, ``clipped`` has the meshes that are drawn. Face index maps are
    then of these.
    """

    world: Tensor
    mesh: MeshBatch
    camera: Camera | None
    settings: ops.RasterSettings
    clipped: Clipped | None = None

    @property
    def drawn(self) -> MeshBatch:
        return self.mesh if self.clipped is None else self.clipped.mesh

    def rasterize(self) -> Tensor:
        settings = self.settings
        return ops.rasterize(
            *self.drawn.arrays, *settings.raster, *settings.visibility, settings.perspective
        )

    def rasterize_layers(self, layers: int) -> Tensor:
        settings = self.settings
        return ops.rasterize_layers(
            *self.drawn.arrays, *settings.raster, layers, *settings.visibility, settings.perspective
        )

    def silhouette(self, gradient: str) -> tuple[Tensor, Tensor]:
        vertices, faces, starts = self.drawn.arrays
        vertices = vertices.detach() if gradient == "none" else vertices
        camera, how = ops.no_camera(self.settings.perspective), self.settings[:-1]
        local = gradient == "local"
        return ops.silhouette(vertices, faces, starts, *camera, *how, False, local)[:2]

    def soft_silhouette(self, sigma: Tensor, dist_eps: float) -> Tensor:
        settings, reach = self.settings, math.log(1 / dist_eps - 1)
        transmittance = ops.soft_silhouette(
            *self.drawn.arrays, sigma.double(), *settings.raster, *settings.visibility, reach
        )
        return 1 - average(transmittance.unsqueeze(-1), settings.anti_aliasing).squeeze(-1)

    def depth(self, face_index: Tensor) -> Tensor:
        settings = self.settings
        return ops.depth_image(
            *self.drawn.arrays,
            face_index,
            settings.anti_aliasing,
            settings.far,
            settings.perspective,
        )

    def fragments(self, face_index: Tensor) -> Fragments:
        """Those of a face index map ``[B, H, W]``, or of layers ``[B, H, W, K]``."""
        if face_index.ndim == 4:
            layers = [self._weights_and_depth(layer) for layer in face_index.unbind(-1)]
            weights, depth = (torch.stack(x, dim=3) for x in zip(*layers, strict=True))
        else:
            weights, depth = self._weights_and_depth(face_index)
        drawn_face_index = face_index
        if self.clipped is not None:
            face_index = self.clipped.face_index(face_index)
        anti_aliasing, eps = self.settings.anti_aliasing, self.settings.eps
        shown = face_index, weights, depth, self.mesh, self.world, self.camera
        return Fragments(*shown, anti_aliasing, eps, self.drawn, drawn_face_index)

    def soft_fragments(
        self, layers: int, sigma: Tensor, reach: float, with_empty: bool = False
    ) -> Fragments:
        """The nearest faces whose border is at a squared distance of less than ``sigma * reach``;
        ``with_empty``: also layers that no pixel has.
        """
        settings = self.settings
        how = *settings.visibility, settings.perspective
        drawn_index = ops.soft_layers(
            *self.drawn.arrays, sigma.detach().double(), *settings.raster, layers, *how, reach
        )
        drawn_index = drawn_index if with_empty else without_empty_layers(drawn_index)
        of_drawn = ops.soft_fragments(
            *self.drawn.arrays, drawn_index, settings.far, settings.perspective
        )
        face_index, (weights, depth, distances) = drawn_index, of_drawn
        if self.clipped is not None:
            weights = self.clipped.weights(drawn_index.flatten(2), weights.flatten(2, 3)).view_as(
                weights
            )
            face_index = self.clipped.face_index(drawn_index)
        shown = face_index, weights, depth, self.mesh, self.world, self.camera
        return Fragments(*shown, settings.anti_aliasing, settings.eps, self.drawn, None, distances)

    def _weights_and_depth(self, face_index: Tensor) -> tuple[Tensor, Tensor]:
        weights, depth = ops.fragments(
            *self.drawn.arrays, face_index, self.settings.far, self.settings.perspective
        )
        return weights if self.clipped is None else self.clipped.weights(face_index, weights), depth

    def face_index(self, face_index: Tensor) -> Tensor:
        if self.clipped is not None:
            face_index = self.clipped.face_index(face_index)
        return torch.where(
            face_index >= self.mesh.num_faces, face_index - self.mesh.num_faces, face_index
        )


def make_scene(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None,
    image_size: int | tuple[int, int],
    anti_aliasing: bool,
    fill_back: bool,
    near: float,
    far: float,
    clip: bool,
    eps: float = 1e-4,
) -> Scene:
    how = image_size, anti_aliasing, fill_back, near, far, clip, eps
    return _transform_and_clip(*_check_arguments(vertices, faces, camera, *how))


def draw_silhouette(
    vertices: Meshes, faces: Meshes, camera: Camera | None, *how: Any, gradient: str
) -> Tensor:
    """alpha ``[B, h, w]``: by one operator, unless faces are cut or the camera is a user's.

    how: as in `make_scene`, from image_size to eps.
    """
    mesh, camera, settings, clip = _check_arguments(vertices, faces, camera, *how)
    if is_projecting(camera) and gradient != "none" and can_read():
        posed, batch = camera._arguments(mesh.vertices.dtype, mesh.batch, mesh.starts)
        faces = check_faces(mesh.faces, batch, mesh.vertices.device)
        alpha, _, _, _, cut = ops.silhouette(
            mesh.vertices, faces, mesh.starts, *posed, *settings[:-1], clip, gradient == "local"
        )
        if not cut.item():
            return alpha
    return _transform_and_clip(mesh, camera, settings, clip).silhouette(gradient)[0]


def _check_arguments(
    vertices: Meshes, faces: Meshes, camera: Camera | None, *how: Any
) -> tuple[MeshBatch, Camera | None, ops.RasterSettings, bool]:
    """The meshes in the world, the camera of this image, the settings, and whether to clip. Faces
    are not checked yet, as the number of images is not known.
    """
    if is_list(vertices) or is_list(faces):
        mesh = pack_meshes(vertices, faces)
    else:
        mesh = MeshBatch(check_vertices(vertices, ", or a list of [V_b, 3]"), faces)
    if camera is not None:
        check_camera(camera, mesh.starts is not None)
    plain = not torch.compiler.is_compiling() and _PLAIN.issuperset(map(type, how))
    check = _check_plain_settings if plain else _check_settings
    settings, clip = check(mesh.vertices.dtype, has_perspective(camera), *how)
    if isinstance(camera, ProjectingCamera):
        camera = camera.for_image(settings.height, settings.width)
    return mesh, camera, settings, clip


def _check_settings(
    dtype: torch.dtype,
    perspective: bool,
    image_size: int | tuple[int, int],
    anti_aliasing: bool,
    fill_back: bool,
    near: float,
    far: float,
    clip: bool,
    eps: float,
) -> tuple[ops.RasterSettings, bool]:
    height, width = check_image_size(image_size, LARGEST_IMAGE)
    check_depth_range(near, far, dtype)
    check_eps(eps, dtype)
    clip = check_flag(clip, "clip")
    how = (
        check_flag(anti_aliasing, "anti_aliasing"),
        check_flag(fill_back, "fill_back"),
        clip_plane(near, far) if clip else float(near),
        float(far),
        float(eps),
    )
    return ops.RasterSettings(height, width, *how, perspective), clip


# The checks of numbers take as long as the kernel of a small mesh.
_PLAIN = {int, float, bool}
_check_plain_settings = functools.lru_cache(maxsize=64, typed=True)(_check_settings)


def _transform_and_clip(
    mesh: MeshBatch, camera: Camera | None, settings: ops.RasterSettings, clip: bool
) -> Scene:
    world, nearest, near = mesh.vertices, None, settings.near
    if camera is not None:
        points, nearest = transform(camera, world, mesh.batch, mesh.starts)
        mesh = mesh._replace(vertices=points)
        check_transformed(points, world, mesh.starts is not None)
    mesh = mesh._replace(faces=check_faces(mesh.faces, mesh.batch, mesh.vertices.device))
    clipped = clip_near(world, mesh, camera, near, nearest) if clip else None
    if clipped is not None and mesh.vertices.dtype == torch.float32 and settings.perspective:
        depth = mesh.vertices.detach()[..., 2]
        if not holds_for_all(~depth.isfinite() | (depth * _NARROWEST < near)):
            warnings.warn(
                f"faces are cut at depth {near:g}, less than a thousandth of the scene: in float32 the edges between "
                "them may show single open pixels; take a larger near, or float64",
                stacklevel=callers_level(),
            )
    return Scene(world, mesh, camera, settings, clipped)


def shade(
    fragments: Fragments,
    colors: Colors | None,
    lights: Lights | None,
    background: float | Sequence[float] | Tensor,
    interpolation_gradient: bool,
) -> tuple[Tensor, Tensor]:
    """The shaded raster ``[B, H, W, C]``, undefined at pixels without a face, and the background
    ``[B | 1, C]``.

    With layers the raster is ``[B, H, W, K, C]``.
    """
    if not check_flag(interpolation_gradient, "interpolation_gradient"):
        fragments = replace(fragments, weights=fragments.weights.detach())
    shape = fragments.sided_face_index.shape
    if lights is not None and not isinstance(lights, Lights):
        raise TypeError(f"lights must be nmr.Lights, got {describe(lights)}")
    image = None  # white, for the lights
    if colors is None and lights is None:
        image = fragments.weights.new_ones(1).expand(*shape, 3)
    elif colors is not None:
        if not callable(getattr(colors, "sample", None)):
            remedy = (
                "; nmr.VertexColors(x) makes colours of a tensor x [V, C]"
                if isinstance(colors, Tensor)
                else ""
            )
            raise TypeError(
                "colors must be nmr.VertexColors, FaceColors, TextureCubes, UVTexture or have sample(fragments), "
                f"got {describe(colors)}{remedy}"
            )
        image = colors.sample(fragments)
        if not isinstance(image, Tensor) or image.shape[:-1] != shape or not image.shape[-1]:
            raise ValueError(
                f"colors.sample must return a tensor {[*shape, 'C']}, got {describe(image)}"
            )
    if lights is not None:
        if image is not None and image.shape[-1] not in (1, 3):
            raise ValueError(f"lights need colours of 3 channels (or 1), got {image.shape[-1]}")
        image = lights.shade(fragments, image)
    image = image.to(fragments.weights)
    return image, background_rows(background, image.shape[-1], shape[0], image)


def background_rows(background: object, channels: int, batch: int, like: Tensor) -> Tensor:
    """The background of ``batch`` images as ``[B | 1, channels]``, in the dtype and on the device
    of ``like``.
    """
    wanted = f"a number, [{channels}] or [{batch}, {channels}]"
    behind = as_floats(background, "background", wanted).to(like)
    if behind.ndim > 2 or any(
        n not in (1, m) for n, m in zip(behind.shape[::-1], (channels, batch), strict=False)
    ):
        raise ValueError(
            f"background must be {wanted}, got {describe(behind)}; for a picture behind the meshes render rgb and "
            "alpha with background 0, and add (1 - alpha)[..., None] * picture"
        )
    return behind.expand(channels).unsqueeze(0) if behind.ndim < 2 else behind.expand(-1, channels)


def without_empty_layers(face_index: Tensor) -> Tensor:
    """Layers ``[B, H, W, K]``, nearest first, without the last ones if they are empty at all
    pixels; at least one stays.
    """
    if not can_read():
        return face_index
    used = int((face_index >= 0).flatten(0, 2).any(0).sum())
    return face_index[..., : max(used, 1)].contiguous()


def average(image: Tensor, anti_aliasing: bool) -> Tensor:
    """Mean of 2x2 pixels, without the gradient of edges."""
    if not anti_aliasing:
        return image
    batch, height, width, channels = image.shape
    return image.view(batch, height // 2, 2, width // 2, 2, channels).mean((2, 4))
