"""The definition of the renderer in plain torch, for tests and for reading: slow, clear, one image at a time.

Every face is tested at every pixel, every sweep visits every pixel of its line, and ``fill_back`` appends the reversed
faces, as the published kernels do. Works in the dtype of its input.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def with_back_faces(faces: Tensor, fill_back: bool) -> Tensor:
    """``[F, 3]``, followed by all faces in reversed vertex order if ``fill_back``."""
    return torch.cat([faces, faces.flip(1)]) if fill_back else faces


def _cross(p: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Two products; the larger one shows on which side of the line a -> b the points p are."""
    return (p[..., 1] - a[1]) * (b[0] - a[0]), (p[..., 0] - a[0]) * (b[1] - a[1])


def face_index(
    vertices: Tensor,
    faces: Tensor,
    raster_size: int | tuple[int, int],
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
    perspective: bool = True,
) -> Tensor:
    """Index map ``[H, W]`` of one mesh: row 0 = bottom, -1 = background, F + f = back copy of face f."""
    H, W = (raster_size, raster_size) if isinstance(raster_size, int) else raster_size
    column, row = torch.arange(W), torch.arange(H)
    x_centre, y_centre = (2 * column + 1 - W).to(vertices) / W, (2 * row + 1 - H).to(vertices) / H
    points = torch.stack(torch.meshgrid(x_centre, y_centre, indexing="xy"), dim=-1)
    x_pixel, y_pixel = torch.meshgrid(column.to(vertices), row.to(vertices), indexing="xy")
    depth = torch.full((H, W), far, dtype=vertices.dtype)
    index = torch.full((H, W), -1)
    for f, corners in enumerate(vertices[with_back_faces(faces, fill_back)]):
        x, y, z = corners.unbind(1)
        p, q, r = vertices[faces[f % len(faces)], :2].double()  # both copies have the same area
        no_area = (q - p)[0] * (r - p)[1] == (q - p)[1] * (r - p)[0]
        if no_area or not corners[:, :2].isfinite().all() or z.isnan().any():
            continue
        left, right = _cross(corners[2], corners[0], corners[1])
        if left < right:
            continue  # clockwise
        inside = (points >= corners[:, :2].amin(0)).all(-1) & (
            points <= corners[:, :2].amax(0)
        ).all(-1)
        for a, b in ((0, 1), (1, 2), (2, 0)):
            left, right = _cross(points, corners[a], corners[b])
            inside &= ~(left < right)
        X, Y = (x * W + W - 1) / 2, (y * H + H - 1) / 2
        det = X[2] * (Y[0] - Y[1]) + X[0] * (Y[1] - Y[2]) + X[1] * (Y[2] - Y[0])
        weights = []
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            w = (
                (Y[a] - Y[b]) / det * x_pixel
                + (X[b] - X[a]) / det * y_pixel
                + (X[a] * Y[b] - X[b] * Y[a]) / det
            )
            weights.append(w.nan_to_num(0.0).clamp(0, 1))
        total = weights[0] + weights[1] + weights[2]
        w0, w1, w2 = (w / total for w in weights)
        zp = (
            1 / (w0 / z[0] + w1 / z[1] + w2 / z[2])
            if perspective
            else w0 * z[0] + w1 * z[1] + w2 * z[2]
        )
        nearest = inside & (zp > near) & (zp < depth)
        depth[nearest] = zp[nearest]
        index[nearest] = f
    return index


def silhouette(index: Tensor, anti_aliasing: bool, dtype: torch.dtype = torch.float32) -> Tensor:
    """Alpha ``[h, w]``, row 0 = top, of an index map ``[H, W]``."""
    alpha = (index >= 0).to(dtype).flip(0)
    return alpha.unfold(0, 2, 2).unfold(1, 2, 2).mean((-1, -2)) if anti_aliasing else alpha


def _screen_weights(corners: Tensor) -> Tensor:
    """Clamped, normalised weights ``[H, W, 3]`` at the pixel centres of corners ``[H, W, 3, 3]``; row 0 = bottom."""
    H, W = corners.shape[:2]
    x, y, _ = corners.unbind(-1)
    X, Y = (x * W + W - 1) / 2, (y * H + H - 1) / 2
    x_pixel, y_pixel = torch.meshgrid(
        torch.arange(W).to(corners), torch.arange(H).to(corners), indexing="xy"
    )
    a, b = [1, 2, 0], [2, 0, 1]
    dx, dy = X[..., b] - X[..., a], Y[..., a] - Y[..., b]
    linear = (
        dy * x_pixel[..., None]
        + dx * y_pixel[..., None]
        + X[..., a] * Y[..., b]
        - X[..., b] * Y[..., a]
    )
    screen = (linear / (X * dy).sum(-1, keepdim=True)).clamp(0, 1)
    return screen / screen.sum(-1, keepdim=True)


def fragments(
    vertices: Tensor, faces: Tensor, index: Tensor, far: float = 100.0, perspective: bool = True
) -> tuple[Tensor, Tensor]:
    """Weights in space ``[H, W, 3]`` and depth ``[H, W]`` of an index map; autograd differentiates both."""
    drawn = index >= 0
    corners = vertices[with_back_faces(faces, True)[index.clamp_min(0)]]
    screen, z = _screen_weights(corners), corners[..., 2]
    depth = 1 / (screen / z).sum(-1) if perspective else (screen * z).sum(-1)
    weights = screen / z * depth[..., None] if perspective else screen
    weights = torch.where((index >= len(faces))[..., None], weights.flip(-1), weights)
    return (
        torch.where(drawn[..., None], weights, torch.zeros_like(weights)),
        torch.where(drawn, depth, torch.full_like(depth, far)),
    )


def resolve(image: Tensor, anti_aliasing: bool) -> Tensor:
    """The image ``[h, w, C]``, row 0 = top, of raster pixels ``[H, W, C]``, row 0 = bottom."""
    image = image.flip(0)
    return image.unfold(0, 2, 2).unfold(1, 2, 2).mean((-1, -2)) if anti_aliasing else image


def _raster_gradient(grad_resolved: Tensor, anti_aliasing: bool) -> Tensor:
    """Gradient ``[H, W, ...]`` of the raster, row 0 = bottom, from that ``[h, w, ...]`` of the image, row 0 = top."""
    if anti_aliasing:
        grad_resolved = (grad_resolved / 4).repeat_interleave(2, 0).repeat_interleave(2, 1)
    return grad_resolved.flip(0)


def silhouette_gradient(
    vertices: Tensor,
    faces: Tensor,
    index: Tensor,
    grad_alpha: Tensor,
    anti_aliasing: bool,
    fill_back: bool = True,
    eps: float = 1e-4,
) -> Tensor:
    """NMR's gradient ``[V, 3]`` of one image, from its index map ``[H, W]`` and the gradient ``[h, w]`` of alpha."""
    image = (index >= 0).to(vertices)[..., None]
    return edge_gradient(
        vertices, faces, index, image, grad_alpha[..., None], anti_aliasing, fill_back, eps
    )


def edge_gradient(
    vertices: Tensor,
    faces: Tensor,
    index: Tensor,
    image: Tensor,
    grad_resolved: Tensor,
    anti_aliasing: bool,
    fill_back: bool = True,
    eps: float = 1e-4,
) -> Tensor:
    """NMR's gradient ``[V, 3]`` of one image ``[H, W, C]``, from the gradient ``[h, w, C]`` of the resolved image.

    Index map and image have row 0 = bottom, the gradient has row 0 = top.
    """
    H, W = index.shape
    size = vertices.new_tensor([W, H])
    grad = _raster_gradient(grad_resolved, anti_aliasing)
    result = torch.zeros_like(vertices)
    for f, face in enumerate(with_back_faces(faces, fill_back)):
        if not (index == f).any():
            continue
        pixel = (vertices[face, :2] * size + size - 1) / 2
        for p in range(3):
            q, o = (p + 1) % 3, (p + 2) % 3
            for axis in (
                0,
                1,
            ):  # 0: lines of constant x, swept along y, which moves y; 1: the other way round
                lines, line_image, line_grad = (
                    t.transpose(0, 1) if axis == 0 else t for t in (index, image, grad)
                )
                corners = pixel if axis == 0 else pixel.flip(1)
                pull_p, pull_q = _sweep_edge(
                    corners[p], corners[q], corners[o], axis, f, lines, line_image, line_grad, eps
                )
                result[face[p], 1 - axis] += pull_p
                result[face[q], 1 - axis] += pull_q
    return result


def _sweep_edge(
    p: Tensor,
    q: Tensor,
    o: Tensor,
    axis: int,
    f: int,
    lines: Tensor,
    image: Tensor,
    grad: Tensor,
    eps: float,
) -> tuple[float, float]:
    """Gradients of the sweep coordinates of p and q; points are (scan, sweep), ``lines[n]`` is the line at scan n."""
    num_lines, length = lines.shape
    pull_p = pull_q = 0.0
    direction = (-1 if p[0] < q[0] else 1) * (1 if axis == 0 else -1)
    low, high = sorted((float(p[0]), float(q[0])))
    first = math.ceil(max(low, 0))
    last = math.trunc(min(high, num_lines - 1))  # towards zero, as published: not floor
    for n in range(first, last + 1):
        if p[0] == q[0]:
            continue
        crossing = (q[1] - p[1]) / (q[0] - p[0]) * (n - p[0]) + p[1]
        if not crossing.isfinite():
            continue
        inner = math.floor(crossing) if direction > 0 else math.ceil(crossing)
        outer = inner + direction
        if min(inner, outer) < 0 or max(inner, outer) > length - 1:
            continue
        m = torch.arange(length)
        # Outside: change of the loss if a pixel gets the value of the inner pixel.
        beyond = m >= outer if direction > 0 else m <= outer
        outside = ((image[n] - image[n, inner]) * grad[n]).sum(-1)
        outside = torch.where(beyond & (lines[n, inner] == f), outside, torch.zeros_like(outside))
        # Inside: change of the loss if a pixel of this face gets the value of the outer pixel.
        limit = _height(p, o, n) if (n - p[0]) * (n - o[0]) < 0 else _height(q, o, n)
        limit = 0 if math.isnan(limit) else max(min(limit, length), -1)
        limit = math.ceil(limit) if direction > 0 else math.floor(limit)
        between = (m >= min(inner, limit)) & (m <= max(inner, limit))
        inside = ((image[n] - image[n, outer]) * grad[n]).sum(-1)
        inside = torch.where(between & (lines[n] == f), inside, torch.zeros_like(inside))
        gain = outside.clamp_min(0) + inside.clamp_min(0)
        for end, other in ((p, q), (q, p)):
            if other[0] == n:
                continue
            travel = (
                (q[0] - p[0])
                / ((q[0] - n) if end is p else (n - p[0]))
                * (m - crossing)
                * 2
                / length
            )
            travel = torch.where(travel > 0, travel + eps, travel - eps)
            pull = float((gain / travel).sum())
            if end is p:
                pull_p -= pull
            else:
                pull_q -= pull
    return pull_p, pull_q


def _height(a: Tensor, b: Tensor, n: int) -> float:
    return float((b[1] - a[1]) / (b[0] - a[0]) * (n - a[0]) + a[1])


def local_gradient(
    vertices: Tensor,
    faces: Tensor,
    index: Tensor,
    grad: Tensor,
    anti_aliasing: bool,
    eps: float = 1e-4,
    image: Tensor | None = None,
    perspective: bool = True,
) -> Tensor:
    """The local gradient ``[V, 3]`` of one image, of Kato and Harada 2019 (:func:`nmr.render`).

    From the index map ``[H, W]``, row 0 = bottom, and the gradient ``[h, w]`` of alpha, row 0 = top. With colours
    ``image`` ``[H, W, C]``, row 0 = bottom, their gradient is ``[h, w, C]``.
    """
    corners = vertices[with_back_faces(faces, True)[index.clamp_min(0)]]
    pulls = [
        _one_pixel_moves(x, grad, ends, eps)
        for x, grad, ends in _along_both_axes(
            index, corners, grad, anti_aliasing, image, perspective
        )
    ]
    at_pixels = torch.stack([pulls[0], pulls[1].T, torch.zeros_like(pulls[0])], dim=-1)
    drawn = index >= 0
    shares = _screen_weights(corners)[drawn][:, :, None] * at_pixels[drawn][:, None, :]
    vertex = with_back_faces(faces, True)[index[drawn]]
    return torch.zeros_like(vertices).index_add(0, vertex.flatten(), shares.flatten(0, 1))


def _along_both_axes(index, corners, grad, anti_aliasing, image, perspective):
    """Image, gradient and ends of surfaces along the rows, and the same of the transposed raster."""
    H, W = index.shape
    x, y = torch.meshgrid(
        (2 * torch.arange(W) + 1 - W) / W, (2 * torch.arange(H) + 1 - H) / H, indexing="xy"
    )
    points = torch.stack([x, y, torch.ones_like(x)], dim=-1).double()
    grad = _raster_gradient(grad, anti_aliasing)
    if image is None:
        image, grad = (index >= 0).to(grad)[..., None], grad[..., None]
        corners = torch.zeros_like(corners)  # all faces are one surface
    for t in (lambda x: x, lambda x: x.transpose(0, 1)):
        yield t(image), t(grad), _ends(t(index), t(corners).double(), t(points), perspective)


def _ends(
    index: Tensor, corners: Tensor, points: Tensor, perspective: bool
) -> tuple[Tensor, Tensor]:
    """Whether the surface in a pixel ends before its right neighbour ``[H, W - 1]``, and that in the right one."""
    planes = torch.linalg.pinv(
        torch.cat([corners[..., :2], torch.ones_like(corners[..., :1])], dim=-1)
    )
    z = corners[..., 2:]
    planes = (planes @ (1 / z if perspective else -z)).squeeze(-1)  # nearness = planes . (x, y, 1)
    left, right = (slice(None), slice(None, -1)), (slice(None), slice(1, None))
    one_surface = (
        (corners[left][:, :, :, None] == corners[right][:, :, None]).all(-1).any(-1).any(-1)
    )
    ends = []
    for own, other in ((left, right), (right, left)):
        nearer = [
            (planes[own] * points[at]).sum(-1) - (planes[other] * points[at]).sum(-1)
            > 1e-4 * (planes[own] * points[at]).sum(-1).abs()
            for at in (own, other)
        ]
        behind = (index[other] < 0) | (nearer[0] & nearer[1] & ~one_surface)
        ends.append((index[own] >= 0) & behind)
    return ends[0], ends[1]


def _one_pixel_moves(
    image: Tensor, grad: Tensor, ends: tuple[Tensor, Tensor], eps: float
) -> Tensor:
    """d loss / d (coordinate along the rows) of the point seen in each pixel, ``[H, W]``."""
    per_pixel = image.shape[1] / 2
    step = image[:, 1:] - image[:, :-1]
    right = (step * grad[:, 1:]).sum(-1) * per_pixel
    left = -(step * grad[:, :-1]).sum(-1) * per_pixel
    none = torch.zeros_like(image[:, :1, 0])
    # sums over both pairs of a pixel
    right, left = (
        torch.cat([none, x * ends[1]], 1) + torch.cat([x * ends[0], none], 1) for x in (right, left)
    )
    moves = torch.where(right > left, -right, left)
    still = (torch.maximum(right, left) <= 0) | ((right - left).abs() < eps)
    return torch.where(still, torch.zeros_like(moves), moves)


def soft_silhouette(
    vertices: Tensor,
    faces: Tensor,
    raster_size: int | tuple[int, int],
    sigma: float = 1e-5,
    dist_eps: float = 1e-4,
    fill_back: bool = True,
    near: float = 0.1,
    far: float = 100.0,
) -> Tensor:
    """The soft silhouette ``[H, W]``, row 0 = top, of one mesh (:func:`nmr.render_soft_silhouette`).

    Autograd differentiates it.
    """
    height, width = (raster_size, raster_size) if isinstance(raster_size, int) else raster_size
    shorter = min(height, width)
    x = (2 * torch.arange(width) + 1 - width).to(vertices) / shorter
    y = (height - 1 - 2 * torch.arange(height)).to(vertices) / shorter
    points = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    units = torch.tensor([width / shorter, height / shorter], dtype=vertices.dtype)
    clear = torch.ones(height, width).to(vertices)
    for face in faces:
        corners = vertices[face]
        if len(face.unique()) == 1:
            continue
        z, corners = corners[:, 2], corners[:, :2] * units
        if not corners.isfinite().all() or (z <= near).all() or (z >= far).all():
            continue
        sides = corners.roll(-1, 0) - corners
        area = sides[0, 0] * sides[1, 1] - sides[0, 1] * sides[1, 0]
        if area < 0 and not fill_back:
            continue
        away = points[:, :, None] - corners  # [H, W, 3, 2]
        left_of = sides[:, 0] * away[..., 1] - sides[:, 1] * away[..., 0]
        inside = (left_of * area.sign() > 0).all(-1)
        t = ((away * sides).sum(-1) / (sides * sides).sum(-1).clamp_min(1e-30)).clamp(0, 1)
        square = (away - t[..., None] * sides).square().sum(-1).amin(-1)
        covers = torch.sigmoid(torch.where(inside, square, -square) / sigma)
        counts = inside | (square < sigma * math.log(1 / dist_eps - 1))
        clear = clear * torch.where(counts, 1 - covers, torch.ones_like(covers))
    return 1 - clear


def soft_colors(
    vertices: Tensor,
    faces: Tensor,
    colors: Tensor,
    background: Tensor,
    raster_size: tuple[int, int],
    sigma: Tensor,
    gamma: Tensor,
    layers: int,
    near: float,
    far: float,
    background_eps: float = 1e-3,
    dist_eps: float = 1e-4,
    perspective: bool = True,
) -> tuple[Tensor, Tensor]:
    """Soft colours ``[H, W, C]`` of vertex colours ``[V, C]`` and alpha ``[H, W]`` (:func:`nmr.render_soft`)."""
    height, width = raster_size
    units = torch.tensor([width, height], dtype=vertices.dtype) / min(height, width)
    x, y = torch.arange(width).to(vertices), torch.arange(height).to(vertices)
    x, y = (2 * x + 1 - width) / width, (height - 1 - 2 * y) / height
    pixel = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1) * units
    covers, depths, values = [], [], []
    for face in faces:
        corners, z = vertices[face, :2] * units, vertices[face, 2]
        a, b, c = corners
        matrix = torch.stack([a - c, b - c], dim=1)
        first = (pixel - c) @ torch.linalg.inv(matrix).T
        weights = torch.cat([first, 1 - first.sum(-1, keepdim=True)], dim=-1)
        inside = (weights > 0).all(-1)
        sides = corners.roll(-1, 0) - corners
        along = ((pixel[:, :, None] - corners) * sides).sum(-1) / sides.square().sum(-1)
        border = corners + along.clamp(0, 1)[..., None] * sides
        square = (pixel[:, :, None] - border).square().sum(-1).amin(-1)
        weights = weights.clamp(0, 1)
        weights = weights / weights.sum(-1, keepdim=True)
        weights = weights / z if perspective else weights
        depth = 1 / weights.sum(-1) if perspective else weights @ z
        weights = weights * depth[..., None] if perspective else weights
        counts = (
            (inside | (square < sigma * math.log(1 / dist_eps - 1)))
            & (depth > near)
            & (depth < far)
        )
        covers.append(
            torch.where(counts, torch.sigmoid(torch.where(inside, square, -square) / sigma), 0.0)
        )
        depths.append(torch.where(counts, depth, far))
        values.append(weights @ colors[face])
    depth, order = torch.stack(depths, -1).sort(dim=-1, stable=True)
    covers, depth = torch.stack(covers, -1).gather(-1, order)[..., :layers], depth[..., :layers]
    values = torch.stack(values, -2).gather(
        -2, order[..., None].expand(*order.shape, colors.shape[1])
    )[..., :layers, :]
    closeness = torch.cat(
        [(far - depth) / (far - near), torch.full_like(depth[..., :1], background_eps)], dim=-1
    )
    covers = torch.cat([covers, torch.ones_like(covers[..., :1])], dim=-1)
    share = torch.softmax(covers.log() + closeness / gamma, dim=-1).unsqueeze(-1)
    values = torch.cat([values, background.expand(height, width, 1, -1)], dim=-2)
    return (share * values).sum(-2), 1 - (1 - covers[..., :-1]).prod(-1)
