"""Closed parts of procedural shapes: boxes, slabs, posts, tubes, revolved profiles, sheets, wings.

All parts are lofts, which are watertight for any rings: a shape is a union of closed components.
Axes: x right, y up, z forward.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from .draw import Point, ellipse, inset, points, rectangle

CIRCLE = ellipse(2.0, 2.0, 8)
X, Y, Z = np.eye(3)

# Thin bars get extra rings: a voxelizer that casts rays on a 32^3 grid misses bars between two
# grid lines, but it also marks the cell of every vertex. Both lengths are in units of the longest
# side of the shape.
THIN = 0.06  # diameter below which a bar is thin
STEP = 0.031  # largest distance of its rings


class Part(tuple):
    """Closed surfaces, each with rings [R, N, 3] and ends (see `loft`); `a + b` joins two parts."""

    def __add__(self, other: Part) -> Part:
        return join([self, other])

    def _map(self, function: Callable[[np.ndarray], np.ndarray]) -> Part:
        return Part((function(rings), ends) for rings, ends in self)

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Part:
        """The part shifted by (x, y, z)."""
        return self._map(lambda rings: rings + np.array([x, y, z]))

    def scaled(self, x: float = 1.0, y: float = 1.0, z: float = 1.0) -> Part:
        """The part scaled about the origin; a negative factor mirrors it."""
        return self._map(lambda rings: rings * np.array([x, y, z]))

    def rotated(self, axis: str, angle_deg: float, about: Point = (0.0, 0.0, 0.0)) -> Part:
        """The part turned right-handedly about the x, y or z axis through the point `about`."""
        i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
        cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
        matrix = np.eye(3)
        matrix[[i, i, j, j], [i, j, i, j]] = cosine, -sine, sine, cosine
        return self._map(lambda rings: (rings - np.asarray(about)) @ matrix.T + np.asarray(about))

    def both_sides(self) -> Part:
        """The part and its mirror image in the plane x = 0."""
        return join(map(Part, zip(self, self.scaled(x=-1.0), strict=True)))

    def four_corners(self) -> Part:
        """The part and its mirror images in the planes x = 0, z = 0 and both."""
        return (self + self.scaled(z=-1.0)).both_sides()

    def around(self, angles_deg: Iterable[float]) -> Part:
        """A copy of the part turned about the y axis by each of the angles."""
        return join(self.rotated("y", angle) for angle in angles_deg)


def join(parts: Iterable[Part]) -> Part:
    """All the parts as one."""
    return Part(surface for part in parts for surface in part)


def loft(rings: np.ndarray | Sequence[np.ndarray], ends: str = "fan") -> Part:
    """The part with one surface: rings [R, N, 3], joined in order.

    ends: "fan" closes each end about its mean, "strip" from point i to N-1-i, "ring" joins the
    last ring to the first.
    """
    return Part([(np.ascontiguousarray(rings), ends)])


def _bevelled(outline: np.ndarray, low: float, high: float, bevel: float) -> np.ndarray:
    """Rings [4, N, 3] of a prism from z = low to high, its rims bevelled."""
    inner = inset(outline, bevel)
    rims = (inner, low), (outline, low + bevel), (outline, high - bevel), (inner, high)
    return np.stack([points(*rim.T, z) for rim, z in rims])


def slab(outline: np.ndarray, thickness: float, bevel: float | None = None, y: float = 0.0) -> Part:
    """A plate with the given outline in (x, z), from y to y + `thickness`, its rims bevelled."""
    bevel = 0.2 * thickness if bevel is None else min(bevel, 0.45 * thickness)
    return loft(_bevelled(outline, 0.0, thickness, bevel)[..., [0, 2, 1]]).moved(y=y)


def box(size: Point, center: Point = (0.0, 0.0, 0.0), radius: float | None = None) -> Part:
    """A box of this size [3] about `center` with rounded edges.

    Their default radius is 12 % of the shortest side.
    """
    shortest, axis = np.min(size), int(np.argmax(size))  # lofted along its longest side
    radius = 0.12 * shortest if radius is None else min(radius, 0.45 * shortest)
    outline = rectangle(size[axis - 2], size[axis - 1], radius, 1 if radius < 0.2 * shortest else 3)
    half = 0.5 * size[axis]
    return loft(np.roll(_bevelled(outline, -half, half, 0.6 * radius), axis + 1, -1)).moved(*center)


def between(lower: Point, upper: Point, radius: float | None = None) -> Part:
    """The rounded box between two opposite corners."""
    lower, upper = np.minimum(lower, upper), np.maximum(lower, upper)
    return box(upper - lower, (lower + upper) / 2, radius)


def post(
    foot: Point, head: Point, outline: np.ndarray, profile: Sequence[tuple[float, float]]
) -> Part:
    """A post, perhaps slanted, with horizontal sections.

    profile: [(height from 0 at the foot to 1, outline scale)].
    """
    foot, section = np.asarray(foot), points(outline[:, 0], 0.0, outline[:, 1])
    return loft([foot + t * (head - foot) + scale * section for t, scale in profile])


def revolve(profile: Sequence[Point], sides: int = 16, hollow: bool = False) -> Part:
    """The solid of revolution about the y axis of the profile [(radius > 0, y)].

    With `hollow` the profile is a closed loop that stays off the axis (a lamp shade, an engine
    nacelle).
    """
    profile = np.asarray(profile, dtype=float)
    angle = np.arange(sides) * (2.0 * np.pi / sides)
    radius = np.maximum(profile[:, :1], 1e-4)
    return loft(
        points(radius * np.cos(angle), profile[:, 1:], radius * np.sin(angle)),
        "ring" if hollow else "fan",
    )


def ellipsoid(
    size: Point, center: Point = (0.0, 0.0, 0.0), sides: int = 14, stacks: int = 8
) -> Part:
    """An ellipsoid of the given size [3] about `center`."""
    angle = np.linspace(-0.5, 0.5, stacks + 1) * np.pi
    profile = np.c_[np.maximum(np.cos(angle), 0.02), np.sin(angle)] * 0.5
    return revolve(profile, sides).scaled(*size).moved(*center)


def tube(
    path: ArrayLike,
    radius: ArrayLike = 1.0,
    section: np.ndarray = CIRCLE,
    closed: bool = False,
    side: Point = Z,
) -> Part:
    """A tube along a path [P, 3], with mitred bends.

    section: outline [N, 2]; radius scales it, a number or [P].

    The first axis of the section points towards `side` as far as the path allows.
    """
    path = np.asarray(path, dtype=float)
    step = np.diff([path[-1], *path, path[0]] if closed else path, axis=0)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    if not closed:
        step = step[[0, *range(len(step)), -1]]
    behind, ahead = step[:-1], step[1:]
    tangent = ahead + behind
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.asarray(side, dtype=float)
    if abs(normal @ tangent[0]) > 0.95 * np.linalg.norm(normal):
        normal = np.eye(3)[int(abs(tangent[0, 0]) >= 0.9)]
    radius = np.broadcast_to(radius, len(path))
    rings = []
    for k in range(len(path)):
        normal = normal - (normal @ tangent[k]) * tangent[k]
        normal = normal / np.linalg.norm(normal)
        ring = radius[k] * (section[:, :1] * normal + section[:, 1:] * np.cross(tangent[k], normal))
        bend = ahead[k] - behind[k]
        size = np.linalg.norm(bend)
        if size > 1e-6:  # mitre: stretch towards the bend by 1 / cos(half the bend)
            bend = bend / size
            ring = ring + (ring @ bend)[:, None] * bend * (
                1.0 / max(ahead[k] @ tangent[k], 0.4) - 1.0
            )
        rings.append(path[k] + ring)
    return loft(rings, "ring" if closed else "fan")


def bar(
    start: Point, end: Point, width: float, height: float | None = None, side: Point = Z
) -> Part:
    """A straight bar: round of diameter `width`, or `width` (along `side`) by `height`."""
    if height is None:
        section = ellipse(width, width, 6)
    else:
        section = rectangle(width, height, segments=int(max(width, height) > 0.04))
    return tube([start, end], 1.0, section, side=side)


def strip(
    path: ArrayLike, width: float, height: float, scale: ArrayLike = 1.0, side: Point = Z
) -> Part:
    """A flat bar along a path: `width` (along `side`) by `height`, times `scale` ([P])."""
    return tube(path, scale, rectangle(width, height, segments=1), side=side)


def pole(low: float, high: float, width: float) -> Part:
    """A round bar on the y axis."""
    return bar((0, low, 0), (0, high, 0), width)


def board(
    half: float, y: tuple[float, float], z: tuple[float, float], radius: float | None = None
) -> Part:
    """The rounded box from x = -half to half between two heights and two depths."""
    return between((-half, y[0], z[0]), (half, y[1], z[1]), radius)


def crossbar(start: Point, width: float, height: float | None = None) -> Part:
    """The straight bar from a point to its mirror image in the plane x = 0."""
    return bar(start, np.asarray(start) * [-1, 1, 1], width, height)


def sheet(surface: np.ndarray, thickness: float) -> Part:
    """A curved plate: the surface grid [U, V, 3] thickened to both sides."""
    normal = np.cross(*np.gradient(surface, axis=(0, 1)))
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-12)
    half = 0.5 * thickness * normal
    return loft(np.concatenate([surface + half, (surface - half)[:, ::-1]], 1), "strip")


def wing(sections: Sequence[Sequence[float]], upright: bool = False) -> Part:
    """A wing through airfoil sections (span, rise, z of the front, chord, thickness / chord).

    The span is along x and the rise along y; `upright` swaps them, for a fin. The airfoil is a
    symmetric four-digit NACA profile with a blunt trailing edge.
    """
    # dense at the leading edge (0) and the trailing edge (1)
    c = 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, 7)))
    half = (
        5.0 * (0.2969 * np.sqrt(c) - 0.1260 * c - 0.3516 * c**2 + 0.2843 * c**3 - 0.1015 * c**4)
        + 0.02
    )
    span, rise, front, chord, ratio = np.array(sections, dtype=float).T[:, :, None]
    y = rise + np.append(half, -half[::-1]) * chord * ratio
    z = front - np.append(c, c[::-1]) * chord
    return loft(points(*((y, span, z) if upright else (span, y, z))), "strip")


@lru_cache(maxsize=1024)
def _loft_faces(rings: int, size: int, ends: str) -> np.ndarray:
    """Faces int64 [F, 3] of a loft: `rings` rings of `size` points, then two centres of a fan."""
    a = np.arange(rings * size).reshape(rings, size)
    b = np.roll(a, -1, 1)  # the next point of the same ring
    c, d = np.roll(a, -1, 0), np.roll(b, -1, 0)  # the same points of the next ring
    bands = rings if ends == "ring" else rings - 1  # the last ring may have no next one
    halves = (a, b, d), (a, d, c)  # of the quadrilaterals between two rings
    faces = [np.stack(corners, -1)[:bands].reshape(-1, 3) for corners in halves]
    if ends == "fan":
        center = np.full(size, rings * size)
        faces += [np.c_[center, b[0], a[0]], np.c_[center + 1, a[-1], b[-1]]]
    elif ends == "strip":
        i, j = np.arange(size // 2 - 1), size - 1 - np.arange(size // 2 - 1)
        cap = np.r_[np.c_[i + 1, i, j], np.c_[i + 1, j, j - 1]]
        faces += [cap, a[-1, 0] + cap[:, ::-1]]
    return np.concatenate(faces)


def _refine(rings: np.ndarray, ends: str) -> np.ndarray:
    """Interpolate rings of a thin bar so that they are at most STEP apart; keep other rings."""
    if np.linalg.norm(np.ptp(rings, axis=1), axis=1).max() > THIN:
        return rings
    track = np.concatenate([rings, rings[:1]]) if ends == "ring" else rings
    gap = np.linalg.norm(np.diff(track, axis=0), axis=2).max(1)
    counts = np.maximum(np.ceil(gap / STEP).astype(int), 1)
    t = np.concatenate([k + np.arange(count) / count for k, count in enumerate(counts)])
    k = t.astype(int)
    w = (t - k)[:, None, None]
    refined = (1 - w) * track[k] + w * track[k + 1]
    return refined if ends == "ring" else np.concatenate([refined, rings[-1:]])


def assemble(part: Part) -> trimesh.Trimesh:
    """The mesh of a part: closed components, oriented outwards; box centred, longest side 1."""
    lower = np.min([rings.min((0, 1)) for rings, _ in part], 0)
    upper = np.max([rings.max((0, 1)) for rings, _ in part], 0)
    vertices, faces, offset = [], [], 0
    for rings, ends in part:
        rings = _refine((rings - (lower + upper) / 2) / (upper - lower).max(), ends)
        triangles = _loft_faces(len(rings), rings.shape[1], ends)
        points = rings.reshape(-1, 3)
        if ends == "fan":
            points = np.concatenate([points, rings[[0, -1]].mean(1)])
        p, q, r = (points[triangles[:, k]] - points[0] for k in range(3))
        if np.einsum("ij,ij->", p, np.cross(q, r)) < 0.0:  # six times the signed volume
            triangles = triangles[:, ::-1]
        vertices.append(points)
        faces.append(triangles + offset)
        offset += len(points)
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
