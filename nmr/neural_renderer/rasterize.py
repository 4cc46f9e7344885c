"""Faces in renderer space to images: colour, coverage, depth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nmr import ops
from nmr._validate import describe
from nmr.fragments import Fragments
from nmr.neural_renderer._convert import Numbers, check_textures, height_and_width, like
from nmr.render import render

DEFAULT_IMAGE_SIZE = 256
DEFAULT_ANTI_ALIASING = True
DEFAULT_NEAR = 0.1
DEFAULT_FAR = 100
DEFAULT_EPS = 1e-4
DEFAULT_BACKGROUND_COLOR = (0, 0, 0)


@dataclass(frozen=True, eq=False)
class _Cubes:
    """Colours of texture cubes, times the light on the faces."""

    textures: Tensor | None  # [B or 1, F, ts, ts, ts, C]
    # [B or 1, F, 3]; [B or 1, 2F, 3] has another value for each face seen from behind
    light: Tensor | None

    def sample(self, fragments: Fragments) -> Tensor:
        if self.textures is None:
            raise ValueError("RGB images need textures [B, F, ts, ts, ts, 3], got None")
        face_index = fragments.sided_face_index
        weights = fragments.weights
        batch = fragments.mesh.batch
        textures = check_textures(self.textures, batch, fragments.faces.shape[-2]).to(weights)
        colors = ops.texture_cubes(textures, face_index, weights, None, fragments.eps)
        if self.light is None:
            return colors
        if self.light.shape[0] not in (1, batch):
            raise ValueError(
                f"light for {self.light.shape[0]} images, but {batch} are drawn; give [3] or [{batch}, 3]"
            )
        if colors.shape[-1] not in (1, 3):
            raise ValueError(
                f"light has three colours: textures must have 1 or 3 channels, got {colors.shape[-1]}"
            )
        # Faces seen from behind have numbers and lights of their own. For this operator they are
        # further faces; the three corners of a face have the same value.
        corners = torch.arange(self.light.shape[1], device=face_index.device)[:, None].expand(-1, 3)
        return colors * ops.interpolate(self.light, corners, face_index, weights, None)


def draw(
    vertices: Tensor,
    faces: Tensor,
    textures: Tensor | None,
    image_size: object,
    anti_aliasing: bool,
    near: float,
    far: float,
    eps: float,
    background_color: Numbers | None,
    outputs: tuple[str, ...],
    *,
    fill_back: bool = False,
    light: Tensor | None = None,
) -> dict[str, Tensor | None]:
    """Draws ``outputs`` out of "rgb", "alpha", "depth" of meshes in renderer space; the others
    are None.
    """
    images = render(
        vertices,
        faces,
        outputs=outputs,
        colors=_Cubes(textures, light),
        background=like(background_color, "background_color", vertices)
        if "rgb" in outputs
        else 0.0,
        image_size=height_and_width(image_size),
        anti_aliasing=anti_aliasing,
        fill_back=fill_back,
        near=near,
        far=far,
        clip=False,  # as published
        eps=eps,
    )
    drawn: dict[str, Tensor | None] = dict.fromkeys(("rgb", "alpha", "depth")) | dict(
        zip(outputs, images, strict=True)
    )
    if "rgb" in outputs:
        drawn["rgb"] = drawn["rgb"].permute(0, 3, 1, 2).contiguous()
    return drawn


def _soup(faces: object) -> tuple[Tensor, Tensor]:
    """Corners ``[B, F, 3, 3]`` as vertices ``[B, 3F, 3]`` and faces."""
    if not isinstance(faces, Tensor) or faces.ndim != 4 or faces.shape[2:] != (3, 3):
        raise ValueError(
            f"faces must be corners [B, F, 3, 3] (see vertices_to_faces), got {describe(faces)}"
        )
    if faces.dtype not in (torch.float32, torch.float64):
        raise TypeError(
            f"faces must be float32 or float64, got {describe(faces)}; call faces.float()"
        )
    return faces.flatten(1, 2), torch.arange(3 * faces.shape[1], device=faces.device).view(-1, 3)


def rasterize_rgbad(
    faces: Tensor,
    textures: Tensor | None = None,
    image_size: int | tuple[int, int] = DEFAULT_IMAGE_SIZE,
    anti_aliasing: bool = DEFAULT_ANTI_ALIASING,
    near: float = DEFAULT_NEAR,
    far: float = DEFAULT_FAR,
    eps: float = DEFAULT_EPS,
    background_color: object = DEFAULT_BACKGROUND_COLOR,
    return_rgb: bool = True,
    return_alpha: bool = True,
    return_depth: bool = True,
) -> dict[str, Tensor | None]:
    """Colour, coverage and depth images of faces in renderer space, with NMR's gradients.

    Parameters
    ----------
    faces : Tensor [B, F, 3, 3], float32 or float64
        Corners (see :func:`vertices_to_faces`): x right, y up, both in [-1, 1] across the image;
        z = depth. Only faces that are counter-clockwise on the screen are drawn.
    textures : Tensor [B, F, ts, ts, ts, 3]
        Axis k of a cube belongs to corner k; [1, F, ...] serves all images. Needed for RGB.
    image_size : int or (height, width)
        Pixels, h and w; one number means a square.
    anti_aliasing : bool
        Average 2x2 pixels of a raster of 2h x 2w.
    near, far : float
        A pixel is covered only if near < depth < far; depth is ``far`` elsewhere.
    eps : float
        Added to distances in the gradient; texture coordinates are clamped to at most
        ts - 1 - eps.
    background_color : [3] or [B, 3]
        List, tuple, array or tensor.
    return_rgb, return_alpha, return_depth : bool

    Returns
    -------
    dict
        "rgb" ``[B, 3, h, w]``, "alpha" ``[B, h, w]``, "depth" ``[B, h, w]``, row 0 = top, or None
        if not requested.

    Notes
    -----
    rgb and alpha have NMR's gradient in x and y of the corners, summed over the returned
    channels. depth has its true derivative in x, y and z at fixed coverage. Textures (and a
    background that is a tensor) have true derivatives.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges.

    >>> images = nr.rasterize_rgbad(nr.vertices_to_faces(vertices, faces), textures, image_size=64)
    """
    wanted = (("rgb", return_rgb), ("alpha", return_alpha), ("depth", return_depth))
    outputs = tuple(name for name, is_wanted in wanted if is_wanted)
    if not outputs:
        return dict.fromkeys(("rgb", "alpha", "depth"))
    settings = (image_size, anti_aliasing, near, far, eps, background_color)
    return draw(*_soup(faces), textures, *settings, outputs)


def rasterize(
    faces: Tensor,
    textures: Tensor,
    image_size: int | tuple[int, int] = DEFAULT_IMAGE_SIZE,
    anti_aliasing: bool = DEFAULT_ANTI_ALIASING,
    near: float = DEFAULT_NEAR,
    far: float = DEFAULT_FAR,
    eps: float = DEFAULT_EPS,
    background_color: object = DEFAULT_BACKGROUND_COLOR,
) -> Tensor:
    """RGB images ``[B, 3, h, w]``: see :func:`rasterize_rgbad`."""
    settings = (image_size, anti_aliasing, near, far, eps, background_color)
    return rasterize_rgbad(faces, textures, *settings, True, False, False)["rgb"]


def rasterize_silhouettes(
    faces: Tensor,
    image_size: int | tuple[int, int] = DEFAULT_IMAGE_SIZE,
    anti_aliasing: bool = DEFAULT_ANTI_ALIASING,
    near: float = DEFAULT_NEAR,
    far: float = DEFAULT_FAR,
    eps: float = DEFAULT_EPS,
) -> Tensor:
    """Coverage ``[B, h, w]``: see :func:`rasterize_rgbad`."""
    settings = (image_size, anti_aliasing, near, far, eps, None)
    return rasterize_rgbad(faces, None, *settings, False, True, False)["alpha"]


def rasterize_depth(
    faces: Tensor,
    image_size: int | tuple[int, int] = DEFAULT_IMAGE_SIZE,
    anti_aliasing: bool = DEFAULT_ANTI_ALIASING,
    near: float = DEFAULT_NEAR,
    far: float = DEFAULT_FAR,
    eps: float = DEFAULT_EPS,
) -> Tensor:
    """Depth images ``[B, h, w]``: see :func:`rasterize_rgbad`."""
    settings = (image_size, anti_aliasing, near, far, eps, None)
    return rasterize_rgbad(faces, None, *settings, False, False, True)["depth"]


class Rasterize(torch.nn.Module):
    """:func:`rasterize_rgbad` as a module, one level lower: no averaging, channels last, row
    0 = bottom.

    ``forward(faces, textures)`` returns ``(rgb [B, h, w, 3], alpha [B, h, w], depth [B, h, w])``;
    an image that is not wanted is an empty tensor.
    """

    def __init__(
        self,
        image_size: int | tuple[int, int],
        near: float,
        far: float,
        eps: float,
        background_color: object,
        return_rgb: bool = False,
        return_alpha: bool = False,
        return_depth: bool = False,
    ) -> None:
        super().__init__()
        self.image_size = image_size
        self.near = near
        self.far = far
        self.eps = eps
        self.background_color = background_color
        self.return_rgb = return_rgb
        self.return_alpha = return_alpha
        self.return_depth = return_depth

    def forward(
        self, faces: Tensor, textures: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        settings = (self.image_size, False, self.near, self.far, self.eps, self.background_color)
        wanted = (self.return_rgb, self.return_alpha, self.return_depth)
        images = rasterize_rgbad(faces, textures, *settings, *wanted)
        rgb, alpha, depth = (
            faces.new_empty(0) if image is None else image.flip(-2) for image in images.values()
        )
        return (rgb.permute(0, 2, 3, 1) if self.return_rgb else rgb), alpha, depth
