"""Colour images of several surfaces in each pixel: the soft colours of SoftRas, and transparency."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from itertools import accumulate

import torch
from torch import Tensor

from ._scene import Meshes, average, make_scene, shade, without_empty_layers
from ._validate import as_floats, as_positive, check_number, check_size, describe, holds_for_all
from .cameras import Camera
from .fragments import Fragments
from .images import Images
from .lights import Lights
from .render import check_dist_eps
from .textures import Colors


def render_soft(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    colors: Colors | None = None,
    lights: Lights | None = None,
    background: float | Sequence[float] | Tensor = 0.0,
    sigma: float | Tensor = 1e-5,
    gamma: float | Tensor = 1e-4,
    faces_per_pixel: int = 16,
    dist_eps: float = 1e-4,
    background_eps: float = 1e-3,
    image_size: int | tuple[int, int] = 256,
    anti_aliasing: bool = False,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    clip: bool = True,
) -> Images:
    """The soft colours of SoftRas (Liu et al. 2019), as PyTorch3D's softmax_rgb_blend blends
    them, and their alpha.

    Parameters
    ----------
    vertices : float32 or float64 Tensor [B, V, 3] or [V, 3], or a list of [V_b, 3]
        World space; without a camera renderer space.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
    camera : Camera, optional
        Such as :class:`nmr.LookAt`.
    colors : Colors, optional
        As in :func:`render`.
    lights : Lights, optional
        They multiply colours; without, these are drawn unchanged.
    background : number, [C], or Tensor [B, C]
        Colour of pixels without a face.
    sigma : float or Tensor []
        As in :func:`render_soft_silhouette`: ``D = sigmoid(+-d^2 / sigma)``, + inside.
    gamma : float or Tensor []
        How sharply nearer faces hide others.
    faces_per_pixel : int
        K in 1..1024: the nearest K faces of a pixel are blended (SoftRas: all).
    dist_eps : float
        In (0, 0.5): faces with a smaller D at a pixel outside are left out there.
    background_eps : float
        Closeness e of the background: 1e-3 in SoftRas, 1e-10 in PyTorch3D.
    image_size : int or (height, width)
        Pixels h, w; an int is a square.
    anti_aliasing : bool
        Average 2x2 of 2h x 2w pixels.
    fill_back : bool
        Also draw faces from behind.
    near, far : float
        Limits of the depth, exclusive.
    clip : bool
        As in :func:`render_silhouette`.

    Returns
    -------
    Images
        ``rgb [B, h, w, C], alpha [B, h, w]``. With C_j the lit colour of face j at the pixel, and
        ``c_j = (far - z_j) / (far - near)`` the closeness of its depth::

            rgb = (sum_j w_j C_j + w_b background) / (sum_j w_j + w_b)
            w_j = D_j exp(c_j / gamma),    w_b = exp(e / gamma),    alpha = 1 - product_j (1 - D_j)

        Outside of a face, C_j and z_j belong to its weights, clamped to [0, 1] and divided by their
        sum.

    Notes
    -----
    Liu et al. 2019, equations 2 and 3, and the published code, in which ``near`` is 1 by default.
    There colours are interpolated on the screen, here in space. PyTorch3D also keeps ``w_b`` above
    1e-10 of the nearest ``exp(c_j / gamma)``.

    The true derivative in vertices, colours, lights, background, sigma and gamma, up to the jumps
    where faces come within reach or leave the K nearest. The memory is that of B h w K faces, about
    100 bytes each with gradients in float32; layers that no pixel needs take none. There is no
    second derivative.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges: sigma and gamma are positive, dist_eps in (0, 0.5),
        faces_per_pixel an integer in 1..1024; and for colours, lights and backgrounds that do not
        fit.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(2)
    >>> camera, colors = nmr.LookAt([0.0, 0.0, -3.0]), nmr.VertexColors((vertices + 1) / 2)
    >>> rgb, alpha = nmr.render_soft(vertices, faces, camera, colors=colors, sigma=1e-3, image_size=32)
    """
    scene = make_scene(
        vertices, faces, camera, image_size, anti_aliasing, fill_back, near, far, clip
    )
    dtype, layers = scene.mesh.vertices.dtype, check_size(faces_per_pixel, "faces_per_pixel", 1024)
    sigma, gamma = as_positive(sigma, "sigma", dtype), as_positive(gamma, "gamma", dtype)
    reach = math.log(1 / check_dist_eps(dist_eps) - 1)
    least = check_number(background_eps, "background_eps")
    if not 0 <= least < math.inf:
        raise ValueError(f"background_eps must be finite and 0 or more, got {background_eps}")
    fragments = scene.soft_fragments(layers, sigma, reach)
    image, behind = shade(fragments, colors, lights, background, True)
    rgb, alpha = _blend(fragments, image, behind, sigma, gamma, least, float(near), float(far))
    both = average(torch.cat([rgb, alpha.unsqueeze(-1)], dim=-1), scene.settings.anti_aliasing)
    return Images({"rgb": both[..., :-1], "alpha": both[..., -1]})


def _blend(
    fragments: Fragments,
    colors: Tensor,
    background: Tensor,
    sigma: Tensor,
    gamma: Tensor,
    least: float,
    near: float,
    far: float,
) -> tuple[Tensor, Tensor]:
    """The formula of :func:`render_soft` for colours ``[B, H, W, K, C]`` on a background
    ``[B | 1, C]``.
    """
    sigma, gamma, zero = sigma.to(colors), gamma.to(colors), colors.new_zeros(())
    covers = torch.where(fragments.covered, torch.sigmoid(-fragments.distances / sigma), zero)
    closeness = (far - fragments.depth) / (far - near)
    # the result does not depend on it
    nearest = closeness.detach().amax(-1, keepdim=True).clamp_min(least)
    share = covers * torch.exp((closeness - nearest) / gamma)
    behind = torch.exp((least - nearest) / gamma)
    colors = torch.where(fragments.covered.unsqueeze(-1), colors, zero)
    rgb = _sum(share.unsqueeze(-1) * colors, -2) + behind * background[:, None, None]
    weight = _sum(share, -1).unsqueeze(-1) + behind
    return rgb / weight, 1 - _running_products(1 - covers)[..., -1]


def render_transparent(
    vertices: Meshes,
    faces: Meshes,
    camera: Camera | None = None,
    *,
    opacity: float | Tensor | Colors = 0.5,
    colors: Colors | None = None,
    lights: Lights | None = None,
    background: float | Sequence[float] | Tensor = 0.0,
    faces_per_pixel: int = 8,
    image_size: int | tuple[int, int] = 256,
    anti_aliasing: bool = True,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    clip: bool = True,
    eps: float = 1e-4,
    interpolation_gradient: bool = False,
) -> Images:
    """Colour images of transparent surfaces: the K nearest of each pixel are shaded and
    composited front to back.

    Parameters
    ----------
    vertices : float32 or float64 Tensor [B, V, 3] or [V, 3], or a list of [V_b, 3]
        World space; without a camera renderer space.
    faces : integer Tensor [F, 3] or [B, F, 3], or a list of [F_b, 3]
    camera : Camera, optional
        Such as :class:`nmr.LookAt`.
    colors : Colors, optional
        As in :func:`render`.
    lights : Lights, optional
        They multiply colours; without, these are drawn unchanged.
    background : number, [C], or Tensor [B, C]
        Colour of pixels without a face.
    opacity : number in [0, 1], Tensor [] or [B], or colours of one channel
        The share of the light from behind that is held back; for instance ``nmr.FaceColors`` of
        ``[F, 1]``.
    faces_per_pixel : int
        K in 1..1024. Surfaces behind the K nearest are left out.
    image_size : int or (height, width)
        Pixels h, w; an int is a square.
    anti_aliasing : bool
        Average 2x2 of 2h x 2w pixels.
    fill_back : bool
        Also draw faces from behind.
    near, far : float
        Limits of the depth, exclusive.
    clip : bool
        As in :func:`render_silhouette`.
    eps : float
        As in :func:`render_silhouette`.
    interpolation_gradient : bool
        As in :func:`render`.

    Returns
    -------
    Images
        ``rgb [B, h, w, C], alpha [B, h, w]``. With o_k the opacity and C_k the lit colour of the
        k-th nearest surface and ``T_k = product over j < k of (1 - o_j)``::

            rgb = sum_k T_k o_k C_k + T_K background,    alpha = 1 - T_K

    Notes
    -----
    The "over" operator (Porter and Duff 1984). Colours, opacity, lights and background have true
    derivatives, x and y of the vertices NMR's edge gradient at the edges that are seen; hidden
    edges have none.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and ranges (opacity in [0, 1], of one channel; faces_per_pixel an
        integer in 1..1024), and for colours, lights and backgrounds that do not fit.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(2)
    >>> camera = nmr.LookAt([0.0, 0.0, -3.0])
    >>> rgb, alpha = nmr.render_transparent(vertices, faces, camera, opacity=0.3, lights=nmr.Lights(), image_size=64)
    """
    scene = make_scene(
        vertices, faces, camera, image_size, anti_aliasing, fill_back, near, far, clip, eps
    )
    layers = scene.rasterize_layers(check_size(faces_per_pixel, "faces_per_pixel", 1024))
    fragments = scene.fragments(without_empty_layers(layers))
    image, behind = shade(fragments, colors, lights, background, interpolation_gradient)
    opacity = torch.where(fragments.covered, _opacity_at(fragments, opacity), image.new_zeros(()))
    transmittance = _running_products(1 - opacity)
    before = torch.cat([torch.ones_like(transmittance[..., :1]), transmittance[..., :-1]], dim=-1)
    image = torch.where(fragments.covered.unsqueeze(-1), image, image.new_zeros(()))
    rgb = _sum((before * opacity).unsqueeze(-1) * image, -2)
    rgb = rgb + transmittance[..., -1:] * behind[:, None, None]
    both = fragments.layer(0)._resolve(
        torch.cat([rgb, 1 - transmittance[..., -1:]], dim=-1), None, "nmr"
    )
    return Images({"rgb": both[..., :-1], "alpha": both[..., -1]})


def _sum(terms: Tensor, axis: int) -> Tensor:
    """As torch.sum, one after the other: further layers that are empty change no bit."""
    return reduce(torch.add, terms.unbind(axis))


def _running_products(factors: Tensor) -> Tensor:
    """As torch.cumprod along the last axis, whose gradient rounds otherwise if one factor of the
    batch is 0.
    """
    return torch.stack([*accumulate(factors.unbind(-1), torch.mul)], dim=-1)


def _opacity_at(fragments: Fragments, opacity: float | Tensor | Colors) -> Tensor:
    """``[B, H, W, K]``, or what expands to it."""
    shape = fragments.sided_face_index.shape
    if callable(getattr(opacity, "sample", None)):
        values = opacity.sample(fragments)
        if not isinstance(values, Tensor) or values.shape != (*shape, 1):
            raise ValueError(
                f"opacity must have one channel and give {[*shape, 1]}, got {describe(values)}"
            )
        values = values.squeeze(-1).to(fragments.weights)
        seen = torch.where(fragments.covered, values, values.new_zeros(()))
        _check_opacity(seen, "colours")
        return values
    values = as_floats(opacity, "opacity", "a number, [] or [B], or colours of one channel").to(
        fragments.weights
    )
    if values.ndim > 1 or values.numel() not in (1, shape[0]):
        raise ValueError(f"opacity must be a number, [] or [{shape[0]}], got {describe(values)}")
    _check_opacity(values, opacity)
    return values.view(-1, 1, 1, 1)


def _check_opacity(values: Tensor, given: object) -> None:
    if not holds_for_all((values >= 0) & (values <= 1)):
        raise ValueError(f"opacity must lie in [0, 1], got {given}")
