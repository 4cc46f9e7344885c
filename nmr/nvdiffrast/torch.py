"""nvdiffrast's torch module on the CPU. Images are ``[B, H, W, C]`` with row 0 at the bottom.

float32 and float64, any integer dtype and device are accepted. Every run gives the same bits. The
conventions are those of https://nvlabs.github.io/nvdiffrast/.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from nmr import ops
from nmr._clip import cut_edges
from nmr._validate import (
    cast_under_autocast,
    check_choice,
    check_faces,
    check_image_size,
    check_indices,
    describe,
)
from nmr.nvdiffrast import _cube
from nmr.textures import level_grids, sample_places

__all__ = [
    "DepthPeeler",
    "RasterizeCudaContext",
    "RasterizeGLContext",
    "antialias",
    "antialias_construct_topology_hash",
    "get_log_level",
    "interpolate",
    "rasterize",
    "set_log_level",
    "texture",
    "texture_construct_mip",
]

_LARGEST = 16384  # pixels per side
# Faces are cut at this part of the largest |w|: nearer points have no finite image in float32.
_NEAREST = 1e-6


def get_log_level() -> int:
    """1, whatever was set."""
    return 1


def set_log_level(level: int) -> None:
    """Accepted, without effect: nothing is printed at any level."""


class RasterizeCudaContext:
    """Accepted in place of a context; its arguments have no effect. It knows the depth peeler
    that is active.
    """

    def __init__(self, *args: object, **kwargs: object) -> None:
        self.active_depth_peeler = None


class RasterizeGLContext(RasterizeCudaContext):
    """The same under its older name."""

    set_context = release_context = lambda self: None


# --- rasterize


def rasterize(
    glctx: RasterizeCudaContext,
    pos: Tensor,
    tri: Tensor,
    resolution: tuple[int, int],
    ranges: Tensor | None = None,
    grad_db: bool = True,
) -> tuple[Tensor, Tensor]:
    """The nearest face at each pixel centre: rast and rast_db, both ``[B, H, W, 4]``, 0 on
    background.

    ``pos [B, V, 4]`` (or ``[V, 4]`` with integer ``ranges [B, 2]``: first face and number of
    faces of each image) are clip-space positions, ``tri`` integers ``[F, 3]``, ``resolution`` is
    (height, width). Points with z / w outside [-1, 1] are not drawn. rast is (u, v, z / w,
    face + 1); u and v are the weights of the face's vertices 0 and 1; rast_db is (du/dX, du/dY,
    dv/dX, dv/dY) per pixel. u, v and (with ``grad_db``) rast_db are differentiable in pos at
    fixed faces per pixel. Raises TypeError and ValueError for wrong types and shapes, and
    RuntimeError inside of a :class:`DepthPeeler` of the same context.

    >>> pos = torch.tensor([[[-0.8, -0.8, 0, 1], [0.8, -0.8, 0, 1], [-0.8, 0.8, 0, 1]]])
    >>> rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos, torch.tensor([[0, 1, 2]]), (8, 8))
    """
    if _context(glctx).active_depth_peeler is not None:
        raise RuntimeError(
            "rasterize cannot be called inside of a DepthPeeler; call rasterize_next_layer()"
        )
    scene = _Scene.checked(pos, tri, resolution, ranges)
    return scene.weights(scene.face_index(None), grad_db)


class DepthPeeler:
    """One surface after the other at each pixel: ``with DepthPeeler(...) as peeler:
    peeler.rasterize_next_layer()``.

    The arguments are those of :func:`rasterize`.
    """

    def __init__(
        self,
        glctx: RasterizeCudaContext,
        pos: Tensor,
        tri: Tensor,
        resolution: tuple[int, int],
        ranges: Tensor | None = None,
        grad_db: bool = True,
    ) -> None:
        self.raster_ctx = _context(glctx)
        self._scene = _Scene.checked(pos, tri, resolution, ranges)
        self._grad_db = grad_db
        self._next, self._layers = None, None

    def __enter__(self) -> DepthPeeler:
        if self.raster_ctx is None or self.raster_ctx.active_depth_peeler is not None:
            raise RuntimeError(
                "a DepthPeeler is entered once, and one at a time in each context; create another"
            )
        self.raster_ctx.active_depth_peeler = self
        self._next = 0
        return self

    def __exit__(self, *args: object) -> None:
        self.raster_ctx.active_depth_peeler = None
        self.raster_ctx = self._scene = self._next = self._layers = None

    def rasterize_next_layer(self) -> tuple[Tensor, Tensor]:
        """As :func:`rasterize`, without the surfaces of the calls before."""
        if self._next is None:
            raise RuntimeError(
                "rasterize_next_layer is called inside of `with DepthPeeler(...) as peeler:`"
            )
        if self._layers is None or self._next == self._layers.shape[-1]:
            self._layers = self._scene.face_index(max(4, 2 * self._next))
        self._next += 1
        return self._scene.weights(self._layers[..., self._next - 1].contiguous(), self._grad_db)


class _Scene(NamedTuple):
    """Checked arguments of :func:`rasterize`."""

    pos: Tensor  # [B or 1, V, 4]
    tri: Tensor  # int64 [F, 3]
    size: tuple[int, int]
    ranges: list[list[int]] | None  # first face and number of faces of each image

    @staticmethod
    def checked(pos: object, tri: object, resolution: object, ranges: object) -> _Scene:
        pos = _positions(pos)
        tri = _faces(tri, pos, pos)
        size = check_image_size(
            list(resolution) if hasattr(resolution, "__iter__") else resolution, _LARGEST
        )
        if pos.ndim == 3:
            return _Scene(pos, tri, size, None)
        if (
            not isinstance(ranges, Tensor)
            or ranges.ndim != 2
            or ranges.shape[1] != 2
            or ranges.is_floating_point()
        ):
            raise ValueError(
                f"pos [V, 4] needs ranges, an integer tensor [B, 2], got {describe(ranges)}"
            )
        ranges = ranges.tolist()
        if any(first < 0 or count < 0 or first + count > len(tri) for first, count in ranges):
            raise ValueError(f"ranges must lie within the {len(tri)} faces of tri, got {ranges}")
        return _Scene(pos.unsqueeze(0), tri, size, ranges)

    def face_index(self, layers: int | None) -> Tensor:
        """Face index maps ``[B, H, W]``, or the nearest ``[B, H, W, layers]``; reversed copies
        count as the face.
        """
        if self.ranges is None:
            return _face_index(self.pos.detach(), self.tri, self.size, layers)
        images = []
        for first, count in self.ranges:
            image = _face_index(
                self.pos.detach(), self.tri[first : first + count], self.size, layers
            )
            images.append(torch.where(image < 0, image, image + first))
        shape = (0, *self.size) if layers is None else (0, *self.size, layers)
        return (
            torch.cat(images)
            if images
            else torch.empty(shape, dtype=torch.int32, device=self.pos.device)
        )

    def weights(self, face_index: Tensor, grad_db: bool) -> tuple[Tensor, Tensor]:
        rast, rast_db = ops.clip_weights(self.pos, self.tri, face_index)
        return rast, rast_db if grad_db else rast_db.detach()


def _face_index(pos: Tensor, tri: Tensor, size: tuple[int, int], layers: int | None) -> Tensor:
    dtype = pos.dtype
    pos, tri, source = _in_front(pos, tri)
    starts = None if source is None else source[1]
    w = pos[..., 3:]
    # z / w is linear on the screen, also in perspective. The kernels have row 0 at y = 1.
    points = pos[..., :3].double() / torch.where(w > 0, w, float("nan")).double()
    points = (points * points.new_tensor([1.0, -1.0, 1.0])).to(
        dtype if source is None else torch.float64
    )
    near, far = (math.copysign(1 + torch.finfo(points.dtype).eps, side) for side in (-1, 1))
    if layers is None:
        index = ops.rasterize(points, tri, starts, *size, True, near, far, False)
    else:
        index = ops.rasterize_layers(points, tri, starts, *size, layers, True, near, far, False)
    one = (-1, *(1,) * (index.ndim - 1))
    count = tri.shape[-2] if starts is None else starts[:, 1].diff().to(index.device).view(one)
    face = torch.where(index >= count, index - count, index)
    if source is not None:
        first = starts[:-1, 1].to(index.device).view(one)
        face = torch.where(face < 0, face, source[0][(face + first).clamp(min=0)])
    return face.int()


def _in_front(pos: Tensor, tri: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor] | None]:
    """Cuts the faces that cross the plane of the eye: packed positions and faces, the face each
    is part of, starts.
    """
    depths = pos[..., [0, 1, 3]].contiguous()
    w = depths[..., 2]
    largest = float(w[w.isfinite()].abs().max()) if bool(w.isfinite().any()) else 0.0
    plane = _NEAREST * largest
    counts = ops.clip_count(depths, tri, None, plane).cpu()
    if (counts[:, 0] <= 0).all():
        return pos, tri, None
    batch, vertices = pos.shape[:2]
    new_starts = F.pad(counts.cumsum(0), (0, 0, 1, 0))
    num_new, num_drawn = new_starts[-1].tolist()
    faces, source, _, ends = ops.clip_faces(
        depths, tri, None, plane, new_starts, num_new, num_drawn
    )
    both = pos.double().view(-1, 4)[ends[:, :2]]
    new = cut_edges(both, both[..., 3:], plane)[1]
    parts = zip(pos.double(), new.split(counts[:, 0].tolist()), strict=True)
    given = vertices * torch.arange(batch + 1, device="cpu")
    starts = new_starts + torch.stack([given, torch.zeros_like(given)], dim=1)
    return torch.cat([x for pair in parts for x in pair]), faces, (source, starts)


# --- interpolate


def interpolate(
    attr: Tensor,
    rast: Tensor,
    tri: Tensor,
    rast_db: Tensor | None = None,
    diff_attrs: str | list[int] | None = None,
) -> tuple[Tensor, Tensor]:
    """Attributes ``[B, H, W, C]`` at each pixel, and their derivatives on the screen,
    ``[B, H, W, 2 D]``.

    ``attr [B or 1, N, C]`` or ``[N, C]``, ``tri [F, 3]`` rows of attr at the corners of each
    face. ``diff_attrs`` are D channels or "all", and need ``rast_db``; the derivatives are
    (dA/dX, dA/dY) for each of them. 0 on background. Differentiable in attr, u and v of rast, and
    rast_db.
    """
    rast = _pixels(rast, "rast", 4)
    attr = _floats(attr, "attr", "[B, N, C] or [N, C]", (2, 3)).to(rast)
    attr = attr if attr.ndim == 3 else attr.unsqueeze(0)
    corners, face_index = _faces(tri, rast, attr, "attr"), _ids(rast)

    def at(values, u, v, w):
        return ops.interpolate(values, corners, face_index, torch.stack([u, v, w], dim=-1), None)

    u, v = rast[..., 0], rast[..., 1]
    values = at(attr, u, v, 1 - u - v)
    if diff_attrs is None or len(diff_attrs) == 0:
        return values, values.new_empty((*values.shape[:3], 0))
    if rast_db is None:
        raise ValueError("diff_attrs needs rast_db, the second result of rasterize")
    if isinstance(diff_attrs, str):
        check_choice(diff_attrs, "diff_attrs", ("all",))
    chosen = attr if isinstance(diff_attrs, str) else attr[..., [int(n) for n in diff_attrs]]
    slopes = _pixels(rast_db, "rast_db", 4).to(rast)
    by_x, by_y = (
        at(chosen, u, v, -u - v) for u, v in ((slopes[..., k], slopes[..., k + 2]) for k in (0, 1))
    )
    return values, torch.stack([by_x, by_y], dim=-1).flatten(-2)


# --- texture


class _Mip(NamedTuple):
    """A texture and its mipmaps: levels ``[B, h, w, C]``, those of a cube map
    ``[B, 6, h, h, C]``.
    """

    levels: list[Tensor]
    packed: tuple[Tensor, Tensor] | None  # all texels and grids, as nmr.ops has them

    def pack(self) -> tuple[Tensor, Tensor]:
        if self.packed is not None:
            return self.packed
        texels, grids, first = [], [], 0
        for level in self.levels:
            images, height, width, channels = level.shape
            grids.append([[first + n * height * width, height, width] for n in range(images)])
            first += images * height * width
            texels.append(level.reshape(-1, channels))
        return texels[0] if len(texels) == 1 else torch.cat(texels), torch.tensor(
            grids, device="cpu"
        ).transpose(0, 1).contiguous()


def texture_construct_mip(
    tex: Tensor, max_mip_level: int | None = None, cube_mode: bool = False
) -> _Mip:
    """The mipmaps of a texture for the argument ``mip`` of :func:`texture`.

    If tex requires a gradient, :func:`texture` makes them anew, so that the gradient passes
    through them.
    """
    tex = _texture_of(tex, cube_mode)
    sizes = tuple(tex.shape[-3:-1])
    most = max(sizes).bit_length() - 1
    if max_mip_level is not None:
        if int(max_mip_level) != max_mip_level or max_mip_level < 0:
            raise ValueError(
                f"max_mip_level must be an integer of at least 0, got {max_mip_level!r}"
            )
        most = min(most, int(max_mip_level))
    images = math.prod(tex.shape[:-3])
    grids, count = level_grids([sizes] * images, most + 1)
    texels = ops.mipmaps(tex.reshape(-1, tex.shape[-1]), grids, count)
    each = texels.view(images, count // images, tex.shape[-1])
    levels = [
        each[:, first : first + height * width].reshape(
            *tex.shape[:-3], height, width, tex.shape[-1]
        )
        for first, height, width in grids[0].tolist()
    ]
    return _Mip(levels, (texels, grids))


def texture(
    tex: Tensor,
    uv: Tensor,
    uv_da: Tensor | None = None,
    mip_level_bias: Tensor | None = None,
    mip: _Mip | list[Tensor] | None = None,
    filter_mode: str = "auto",
    boundary_mode: str = "wrap",
    max_mip_level: int | None = None,
) -> Tensor:
    """Colours ``[B, H, W, C]`` of a texture image or a cube map at coordinates of each pixel.

    ``tex [B or 1, h, w, C]`` has row 0 at v = 0. Cube maps are ``[B or 1, 6, h, h, C]`` with
    OpenGL's faces (+x, -x, +y, -y, +z, -z), sampled at directions ``uv [B, H, W, 3]`` and 0 if
    these are 0 or not finite. ``uv_da`` are the derivatives of uv from :func:`interpolate`: the
    mipmap level is log2 of the longer half axis of the ellipse of texels that a pixel covers.
    ``mip_level_bias [B, H, W]`` is added, or without uv_da is the level. ``mip`` is from
    :func:`texture_construct_mip`, or a list of tensors like tex, each with half the sides of the
    one before, rounded down, and with a gradient of its own. Differentiable in tex; in uv unless
    filter_mode is "nearest"; in uv_da and mip_level_bias if it is "linear-mipmap-linear".
    """
    modes = ("auto", "nearest", "linear", "linear-mipmap-nearest", "linear-mipmap-linear")
    check_choice(filter_mode, "filter_mode", modes)
    check_choice(boundary_mode, "boundary_mode", ("wrap", "clamp", "zero", "cube"))
    cube = boundary_mode == "cube"
    if filter_mode == "auto":
        filter_mode = (
            "linear" if uv_da is None and mip_level_bias is None else "linear-mipmap-linear"
        )
    tex = _texture_of(tex, cube)
    uv = _pixels(uv, "uv", 3 if cube else 2).to(tex)
    if tex.shape[0] not in (1, len(uv)):
        raise ValueError(
            f"tex must have batch size 1 or {len(uv)}, that of uv, got {describe(tex)}"
        )
    uv_da = None if uv_da is None else _pixels(uv_da, "uv_da", 6 if cube else 4).to(tex)
    place = _cube.places(uv, uv_da) if cube else _cube.Places(None, uv, uv_da, None)
    if filter_mode == "nearest":
        colors = _nearest(tex, place, boundary_mode)
    elif "mipmap" in filter_mode and max_mip_level != 0:
        if uv_da is None and mip_level_bias is None:
            raise ValueError(f"filter_mode={filter_mode!r} needs uv_da or mip_level_bias")
        levels = _mipmaps(tex, mip, max_mip_level, cube)
        last = min(
            [len(levels.levels) - 1]
            if max_mip_level is None
            else [len(levels.levels) - 1, int(max_mip_level)]
        )
        level = _level(place.derivatives, mip_level_bias, tex, last)
        colors = _filtered(
            levels, place, level if filter_mode.endswith("linear") else level.round(), boundary_mode
        )
    else:
        colors = _filtered(_Mip([tex], None), place, None, boundary_mode)
    return colors if place.valid is None else torch.where(place.valid.unsqueeze(-1), colors, 0)


def _mipmaps(tex: Tensor, mip: object, max_mip_level: int | None, cube: bool) -> _Mip:
    if isinstance(mip, (list, tuple)) and not isinstance(mip, _Mip):
        levels = [tex, *(_texture_of(level, cube).to(tex) for level in mip)]
        for fine, level in pairwise(levels):
            half = [max(side // 2, 1) for side in fine.shape[-3:-1]]
            wanted = torch.Size((*fine.shape[:-3], *half, fine.shape[-1]))
            if level.shape != wanted:
                raise ValueError(
                    f"each mipmap must have half the sides of the one before, {list(wanted)}, got {describe(level)}"
                )
        return _Mip(levels, None)
    if mip is not None and not isinstance(mip, _Mip):
        raise TypeError(
            f"mip must be made by texture_construct_mip, or a list of tensors, got {describe(mip)}"
        )
    if mip is None or (tex.requires_grad and torch.is_grad_enabled()):
        count = max_mip_level if mip is None else len(mip.levels) - 1
        return texture_construct_mip(tex, count, cube)
    if mip.levels[0].shape != tex.shape:
        raise ValueError(
            f"mip belongs to a texture {list(mip.levels[0].shape)}, tex is {describe(tex)}"
        )
    return mip


def _level(derivatives: Tensor | None, bias: Tensor | None, tex: Tensor, last: int) -> Tensor:
    """The mipmap level ``[B, H, W]`` of each pixel."""
    level = 0
    if derivatives is not None:
        height, width = tex.shape[-3:-1]
        s_x, s_y, t_x, t_y = (
            derivatives * derivatives.new_tensor([width, width, height, height])
        ).unbind(-1)
        # Half the trace of J J^T, and the distance of its eigenvalues from it.
        half = (s_x**2 + s_y**2 + t_x**2 + t_y**2) / 2
        apart = ((s_x**2 + s_y**2 - t_x**2 - t_y**2) / 2) ** 2 + (s_x * t_x + s_y * t_y) ** 2
        tiny = torch.finfo(half.dtype).tiny
        level = torch.log2((half + apart.clamp(min=tiny).sqrt()).clamp(min=tiny)) / 2
    if bias is not None:
        level = level + _floats(bias, "mip_level_bias", "[B, H, W]", (3,)).to(tex)
    return torch.where(level.isnan(), 0, level).clamp(0, last)


def _filtered(mip: _Mip, place: _cube.Places, level: Tensor | None, boundary_mode: str) -> Tensor:
    """Bilinear colours on level 0, or between the two levels around ``level``."""
    if boundary_mode in ("wrap", "clamp"):
        texels, grids = mip.pack()
        wrap = "repeat" if boundary_mode == "wrap" else "clamp"
        at = place.at if boundary_mode == "clamp" else place.at - place.at.detach().floor()
        # row 0 of the kernel is v = 1
        upright = torch.stack([at[..., 0], 1 - at[..., 1]], dim=-1)

        def sample(level: Tensor | None) -> Tensor:
            return sample_places(texels, grids, level, upright, wrap)

        if level is None or not level.requires_grad:
            return sample(level)
    else:
        sample = _with_borders(mip, place)
        if level is None:
            return sample(None)
    low = level.detach().floor()
    fine, coarse = sample(low), sample((low + 1).clamp(max=len(mip.levels) - 1))
    return fine + (level - low).unsqueeze(-1) * (coarse - fine)


def _with_borders(mip: _Mip, place: _cube.Places) -> Callable[[Tensor | None], Tensor]:
    """A function from whole levels ``[B, H, W]`` (None: 0) to bilinear colours.

    The border of an image is zero, that of a face of a cube map has the texels of its neighbours.
    """
    cube = place.face is not None
    padded = [
        _cube.with_borders(image) if cube else F.pad(image, (0, 0, 1, 1, 1, 1))
        for image in mip.levels
    ]
    texels, grids = _Mip(padded, None).pack()
    # [L, 2]: width, height
    sizes = place.at.new_tensor([image.shape[-3:-1][::-1] for image in mip.levels])

    def sample(level: Tensor | None) -> Tensor:
        size = sizes[0] if level is None else sizes[level.long()]
        column, row = ((place.at * size + 1) / (size + 2)).clamp(0, 1).unbind(-1)
        if cube:
            row = (row + place.face) / 6
        return sample_places(texels, grids, level, torch.stack([column, 1 - row], dim=-1), "clamp")

    return sample


def _nearest(tex: Tensor, place: _cube.Places, boundary_mode: str) -> Tensor:
    height, width = tex.shape[-3:-1]
    at = (place.at.detach() * place.at.new_tensor([width, height])).floor()
    size = at.new_tensor([width, height])
    inside = ((at >= 0) & (at < size)).all(-1, keepdim=True)
    at = at % size if boundary_mode == "wrap" else torch.minimum(at.clamp(min=0), size - 1)
    column, row = at.nan_to_num().long().unbind(-1)
    texel = row * width + column
    if place.face is not None:
        texel = texel + place.face * height * width
    flat = tex.reshape(tex.shape[0], -1, tex.shape[-1])
    batch = torch.arange(len(texel), device=tex.device).view(-1, 1, 1) if len(flat) > 1 else 0
    colors = flat[batch, texel]
    return torch.where(inside, colors, 0) if boundary_mode == "zero" else colors


# --- antialias


class _Topology(NamedTuple):
    """For each edge of each face the next of the mesh with the same two vertices."""

    twins: Tensor  # int64 [F, 3]


def antialias_construct_topology_hash(tri: Tensor) -> _Topology:
    """What :func:`antialias` needs to know of faces that stay the same, for its argument
    ``topology_hash``.
    """
    tri = check_faces(tri, 1, tri.device if isinstance(tri, Tensor) else torch.device("cpu"), "tri")
    ends = (
        torch.stack([tri.roll(-1, dims=1), tri.roll(-2, dims=1)], dim=-1)
        .view(-1, 2)
        .sort(dim=1)
        .values
    )
    key = ends[:, 0] * (int(tri.max()) + 1 if tri.numel() else 1) + ends[:, 1]
    key, order = key.sort(stable=True)
    starts = torch.ones_like(key, dtype=torch.bool)
    starts[1:] = key[1:] != key[:-1]
    first = torch.where(starts, torch.arange(len(key), device=key.device), 0).cummax(0).values
    last = starts.roll(-1)
    follower = torch.where(last, first, torch.arange(1, len(key) + 1, device=key.device))
    twins = torch.empty_like(order)
    twins[order] = order[follower]
    return _Topology(twins.view(-1, 3))


def antialias(
    color: Tensor,
    rast: Tensor,
    pos: Tensor,
    tri: Tensor,
    topology_hash: _Topology | None = None,
    pos_gradient_boost: float = 1.0,
) -> Tensor:
    """An image ``[B, H, W, C]`` with smooth silhouettes: neighbours are blended by the place of
    the edge between them.

    Two neighbours with different faces are blended if a silhouette edge of the nearer one's face
    crosses the line between their centres: an edge with one face, or with faces on one side of it
    on the screen. Mostly vertical edges count for neighbours in a row, the others for those in a
    column. With the edge at the distance d from the nearer one's centre, in pixels, the other
    gets the share d - 1/2 of its colour if d > 1/2, else it gets the share 1/2 - d of the other's
    (Laine et al. 2020). Faces that share an edge must name the same vertices there.
    Differentiable in color and pos at fixed faces per pixel; ``pos_gradient_boost`` multiplies
    the gradient in pos.
    """
    rast = _pixels(rast, "rast", 4).detach()
    color = _pixels(color, "color", None).to(rast)
    pos = _positions(pos).to(rast)
    tri = _faces(tri, pos, pos)
    if topology_hash is None:
        topology_hash = antialias_construct_topology_hash(tri)
    if not isinstance(topology_hash, _Topology):
        raise TypeError(
            f"topology_hash must be made by antialias_construct_topology_hash, got {describe(topology_hash)}"
        )
    if topology_hash.twins.shape != tri.shape:
        raise ValueError(
            f"topology_hash belongs to faces {list(topology_hash.twins.shape)}, tri is {describe(tri)}"
        )
    if pos_gradient_boost != 1:
        pos = pos_gradient_boost * pos - (pos_gradient_boost - 1) * pos.detach()
    pos = pos if pos.ndim == 3 else pos.unsqueeze(0)
    return ops.antialias(color, rast, pos, tri, _ids(rast), topology_hash.twins)


# --- checks


def _context(glctx: object) -> RasterizeCudaContext:
    if not isinstance(glctx, RasterizeCudaContext):
        raise TypeError(f"the first argument must be a RasterizeCudaContext, got {describe(glctx)}")
    return glctx


def _floats(value: object, name: str, wanted: str, ndims: tuple[int, ...]) -> Tensor:
    value = cast_under_autocast(value)
    if not isinstance(value, Tensor) or value.dtype not in (torch.float32, torch.float64):
        raise TypeError(
            f"{name} must be a float32 or float64 tensor {wanted}, got {describe(value)}"
        )
    if value.ndim not in ndims:
        raise ValueError(f"{name} must have shape {wanted}, got {describe(value)}")
    return value


def _pixels(value: object, name: str, channels: int | None) -> Tensor:
    wanted = f"[B, H, W, {'C' if channels is None else channels}]"
    value = _floats(value, name, wanted, (4,))
    if value.shape[-1] != channels if channels is not None else value.shape[-1] == 0:
        raise ValueError(f"{name} must have shape {wanted}, got {describe(value)}")
    return value


def _positions(pos: object) -> Tensor:
    pos = _floats(pos, "pos", "[B, V, 4], or [V, 4] with ranges", (2, 3))
    if pos.shape[-1] != 4:
        raise ValueError(f"pos must have four coordinates x, y, z, w, got {describe(pos)}")
    return pos


def _faces(tri: object, like: Tensor, rows: Tensor, name: str = "pos") -> Tensor:
    tri = check_faces(tri, 1, like.device, "tri")
    if tri.ndim != 2:
        raise ValueError(f"tri must have shape [F, 3], got {describe(tri)}")
    check_indices(tri, rows.shape[-2], "tri", "row", name, "rows")
    if like.dtype == torch.float32 and len(tri) >= 2**24:
        raise ValueError(
            f"rast in float32 numbers at most {2**24 - 1} faces, got {len(tri)}; use float64"
        )
    return tri


def _texture_of(tex: object, cube: bool) -> Tensor:
    wanted = "[B, 6, h, h, C]" if cube else "[B, h, w, C]"
    tex = _floats(tex, "tex", wanted, (5,) if cube else (4,))
    if 0 in tex.shape[1:] or (cube and (tex.shape[1] != 6 or tex.shape[2] != tex.shape[3])):
        raise ValueError(f"tex must have shape {wanted}, got {describe(tex)}")
    return tex


def _ids(rast: Tensor) -> Tensor:
    return rast[..., 3].detach().int() - 1
