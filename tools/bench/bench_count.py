"""The work in a silhouette workload, counted by slow re-derivation and from owner maps."""

from __future__ import annotations

import numpy as np
from bench_work import Workload

import nmr
from nmr import ops

LANES, BLOCK, NEAR, FAR = 8, 8, 0.1, 100.0
Counts = dict[str, float]


def depths(corners: np.ndarray, faces: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Depths of faces at pixels (x, y), arrays of one length; corners ``[F, 3, 3]`` in pixels and depths."""
    (x0, y0, z0), (x1, y1, z1), (x2, y2, z2) = corners[faces].transpose(1, 2, 0)
    w0, w1 = (x1 - x) * (y2 - y) - (x2 - x) * (y1 - y), (x2 - x) * (y0 - y) - (x0 - x) * (y2 - y)
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    return area / (w0 / z0 + w1 / z1 + (area - w0 - w1) / z2)


def count_fill(corners: np.ndarray, R: int) -> tuple[Counts, np.ndarray]:
    """Forward: counts, and the owner map ``[R, R]`` (row 0 = bottom; F + f for the reversed copy of f)."""
    F, column, (x, y, z) = len(corners), np.arange(R), corners.transpose(2, 0, 1)
    n = dict.fromkeys(("faces hidden", "faces filled", "rows of eight tested", "pixels inside", "exact depths"), 0)
    first = np.maximum(np.ceil(corners[..., :2].min(1)), 0).astype(int)
    last = np.minimum(np.floor(corners[..., :2].max(1)), R - 1).astype(int)
    nearest, farthest, drawn = z.min(1), z.max(1), (first <= last).all(1)
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])
    passes = [(np.flatnonzero(drawn & (area >= 0)), 0), (np.flatnonzero(drawn & (area <= 0)), F)]
    passes.sort(key=lambda p: nearest[p[0]].mean() if len(p[0]) else np.inf)  # the nearer side first
    owner, bound, pad = np.full((R, R), -1), np.full((R, R), np.inf), -R % BLOCK
    for number, (faces, offset) in enumerate(passes):
        blocks = np.pad(bound, (0, pad)).reshape((R + pad) // BLOCK, BLOCK, -1, BLOCK).max((1, 3))
        for f in faces:
            (i0, j0), (i1, j1) = first[f], last[f]
            over = blocks[j0 // BLOCK : j1 // BLOCK + 1, i0 // BLOCK : i1 // BLOCK + 1]
            if number and nearest[f] > over.max():
                n["faces hidden"] += 1
                continue
            n["faces filled"] += 1
            n["rows of eight tested"] += int((j1 - j0 + 1) * -(-(i1 - i0 + 1) // LANES))
            px, py, inside = column[i0 : i1 + 1], column[j0 : j1 + 1, None], True
            for a, b in ((0, 1), (1, 2), (2, 0)):
                side = (py - y[f, a]) * (x[f, b] - x[f, a]) - (px - x[f, a]) * (y[f, b] - y[f, a])
                inside = inside & (side <= 0 if offset else side >= 0)
            n["pixels inside"] += int(inside.sum())
            own, far = owner[j0 : j1 + 1, i0 : i1 + 1], bound[j0 : j1 + 1, i0 : i1 + 1]
            unsettled = inside & (far >= nearest[f])
            nearer = unsettled & ((own < 0) | (farthest[f] < nearest[own % F]))
            at = np.nonzero(unsettled & ~nearer)  # only the exact depths tell
            n["exact depths"] += 2 * len(at[0])
            own[nearer], far[nearer] = f + offset, farthest[f]
            mine, theirs = (depths(corners, k, at[1] + i0, at[0] + j0) for k in (np.full_like(own[at], f), own[at] % F))
            own[at] = np.where((mine < theirs) | ((mine == theirs) & (f + offset < own[at])), f + offset, own[at])
            far[at] = np.minimum(mine, theirs)
    return {"faces set up": F, **n, "pixels covered": int((owner >= 0).sum())}, owner


def count_sweeps(corners: np.ndarray, owner: np.ndarray, grad: np.ndarray) -> Counts:
    """Backward: of the owner map and the raster's gradient ``[R, R]``, row 0 = bottom."""
    F, R, ids = len(corners), len(owner), np.unique(owner[owner >= 0])
    names = ("crossings prepared", "sweeps outside", "sweeps inside", "pulls outside", "pulls inside")
    n = {"faces visible": len(ids), **dict.fromkeys(names + tuple(f"{k}, by eight" for k in (names[0], names[3])), 0)}
    points = np.where((ids >= F)[:, None, None], corners[ids % F, ::-1], corners[ids % F])
    for axis in (0, 1):  # lines of constant x, then of constant y
        lines, gradient = (owner.T, grad.T) if axis == 0 else (owner, grad)
        s, t = points[..., axis], points[..., 1 - axis]
        ps, pt, qs, qt = s.ravel(), t.ravel(), np.roll(s, -1, 1).ravel(), np.roll(t, -1, 1).ravel()
        low = np.ceil(np.maximum(np.minimum(ps, qs), 0)).astype(int)
        high = np.trunc(np.minimum(np.maximum(ps, qs), R - 1)).astype(int)
        length = np.where(ps == qs, 0, np.maximum(high - low + 1, 0))
        edge = np.repeat(np.arange(len(ps)), length)
        line = low[edge] + np.arange(len(edge)) - np.repeat(length.cumsum() - length, length)
        crossing = (qt - pt)[edge] / (qs - ps)[edge] * (line - ps[edge]) + pt[edge]
        d = np.where((ps < qs)[edge] == (axis == 0), -1, 1)  # outward
        inner = np.where(d > 0, np.floor(crossing), np.ceil(crossing)).astype(int)
        ok = (np.minimum(inner, inner + d) >= 0) & (np.maximum(inner, inner + d) < R)
        line, d, inner, outer, face = line[ok], d[ok], inner[ok], (inner + d)[ok], ids[edge[ok] // 3]
        before = np.pad(((lines < 0) & (gradient < 0)).cumsum(1), ((0, 0), (1, 0)))  # [line, m]: pixels < m that pull
        first, last = np.where(d > 0, before[line, outer], 0), before[line, np.where(d > 0, R, outer + 1)]
        outside = np.where(lines[line, inner] == face, last - first, 0)
        inside, m = np.zeros_like(line), inner
        for _ in range(int(np.ptp(t, axis=1).max(initial=0)) + 2):  # own pixels lie within the face's extent
            here = np.clip(m, 0, R - 1)
            inside += (m == here) & (lines[line, here] == face) & (gradient[line, here] > 0) & (lines[line, outer] < 0)
            m = m - d
        vectors = np.where(outside > 0, -(-last // LANES) - first // LANES, 0)
        counted = length, outside > 0, inside > 0, outside, inside, -(-length // LANES), vectors
        for name, values in zip(list(n)[1:], counted, strict=True):
            n[name] += int(values.sum())
    return n


def count(workload: Workload) -> Counts:
    """Means per image; ``disagreement`` is the share of pixels that our kernel gives to another face."""
    R, scale, floats = workload.raster_size, workload.raster_size // workload.size, 4
    vertices = workload.camera.transform(workload.vertices)
    owners = ops.rasterize(vertices, workload.faces, None, R, True, NEAR, FAR).flip(1).numpy()
    alpha = workload.images(workload.vertices)[0].requires_grad_()
    nmr.losses.soft_iou_loss(alpha, workload.targets()[0]).backward()
    grad = alpha.grad.flip(1).repeat_interleave(scale, 1).repeat_interleave(scale, 2).numpy()
    corners = vertices[:, workload.faces].double().numpy()
    corners[..., :2] = (corners[..., :2] * R + R - 1) / 2
    images = []
    for mesh, kernel_owner, kernel_grad in zip(corners, owners, grad, strict=True):
        fill, owner = count_fill(mesh, R)
        images.append({**fill, **count_sweeps(mesh, kernel_owner, kernel_grad)})
        images[-1]["disagreement"] = float((owner != kernel_owner).mean())
    n = {name: float(np.mean([image[name] for image in images])) for name in images[0]}
    n["raster pixels, by eight"] = R * R / LANES
    n["divisions forward"] = 16 * n["exact depths"]  # nine by the determinant, three of weights, three by z, one
    n["divisions backward"] = 6 * n["faces visible"] + 2 * n["crossings prepared"] + n["sweeps inside"]
    n["divisions backward"] += n["pulls outside"] + 2 * n["pulls inside"]  # outside, the ends share one
    points, faces, alphas = floats * vertices[0].numel(), 8 * workload.faces.numel(), floats * workload.size**2
    n["bytes forward"] = 3 * points + faces + 8 * R * R + alphas  # camera in, out; the map written, read
    n["bytes backward"] = 4 * points + faces + 4 * R * R + alphas  # sweeps in, out; camera in, out
    return n
