"""Closed parts of procedural shapes: boxes, slabs, posts, tubes, revolved profiles, sheets, wings.

All parts are lofts. A loft is watertight for any rings, so a shape made of lofts is a union of closed components. Axes:
x right, y up, z forward. Outlines are closed curves [N, 2], counter-clockwise, star-shaped about their mean.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import trimesh

Point = Sequence[float] | np.ndarray  # (x, y, z); in a profile (radius, y)

# Thin bars get extra rings: a voxelizer that casts rays on a 32^3 grid misses bars between two grid lines, but it also
# marks the cell of every vertex. Both lengths are in units of the longest side of the shape.
THIN, STEP = 0.06, 0.031  # diameter below which a bar is thin, and the largest distance of its rings


class Loft(NamedTuple):
    """A closed surface: a stack of rings of equal size, joined in order and closed at the ends."""

    rings: np.ndarray  # [R, N, 3] float64; neighbours in R and in N are joined
    ends: str  # "fan": about the mean of an end ring; "strip": from point i to N-1-i; "ring": last ring joins the first


@dataclass(frozen=True)
class Part:
    """A set of closed surfaces; `a + b` joins two parts."""

    lofts: tuple[Loft, ...] = ()

    def __add__(self, other: Part) -> Part:
        return Part(self.lofts + other.lofts)

    def _map(self, function: Callable[[np.ndarray], np.ndarray]) -> Part:
        return Part(tuple(Loft(function(rings), ends) for rings, ends in self.lofts))

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
        pairs = zip(self.lofts, self.scaled(x=-1.0).lofts, strict=True)
        return Part(tuple(loft for pair in pairs for loft in pair))

    def four_corners(self) -> Part:
        """The part and its mirror images in the planes x = 0, z = 0 and both."""
        return (self + self.scaled(z=-1.0)).both_sides()

    def around(self, angles_deg: Iterable[float]) -> Part:
        """A copy of the part turned about the y axis by each of the angles."""
        return join(self.rotated("y", angle) for angle in angles_deg)


def join(parts: Iterable[Part]) -> Part:
    """All the parts as one."""
    return Part(tuple(loft for part in parts for loft in part.lofts))


def loft(rings: np.ndarray | Sequence[np.ndarray], ends: str = "fan") -> Part:
    """The part with one surface, of the rings [R, N, 3]."""
    return Part((Loft(np.asarray(rings), ends),))


def ellipse(width: float, depth: float, count: int = 20, exponent: float = 2.0) -> np.ndarray:
    """A (super)ellipse outline [count, 2]; exponent 2 is an ellipse, larger ones approach a rectangle."""
    angle = np.arange(count) * (2.0 * np.pi / count)
    cosine, sine = np.cos(angle), np.sin(angle)
    power = 2.0 / exponent
    x, y = np.sign(cosine) * np.abs(cosine) ** power, np.sign(sine) * np.abs(sine) ** power
    return np.stack([0.5 * width * x, 0.5 * depth * y], 1)


def rectangle(width: float, depth: float, radius: float | None = None, segments: int = 2) -> np.ndarray:
    """A rectangle outline [4 (segments + 1), 2] with rounded corners; radius None: 12 % of the short side.

    With 0 segments the corners are sharp.
    """
    if segments == 0:
        return np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * np.array([width, depth]) / 2
    short = min(width, depth)
    radius = 0.12 * short if radius is None else min(max(radius, 0.01 * short), 0.49 * short)
    angle = np.concatenate([np.linspace(k, k + 1, segments + 1) for k in range(4)]) * (np.pi / 2)
    corner = np.repeat(np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]), segments + 1, 0)
    return corner * (np.array([width, depth]) / 2 - radius) + radius * np.stack([np.cos(angle), np.sin(angle)], 1)


def inset(outline: np.ndarray, distance: float) -> np.ndarray:
    """The outline moved inwards by `distance` along its mitred vertex normals."""
    edge = np.roll(outline, -1, 0) - outline
    normal = np.stack([edge[:, 1], -edge[:, 0]], 1) / np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-12)
    mitre = normal + np.roll(normal, 1, 0)
    return outline - mitre * (2.0 * distance / np.maximum((mitre**2).sum(1, keepdims=True), 0.5))


def _prism(outline: np.ndarray, rims: Sequence[tuple[float, float]], axes: tuple[int, int, int]) -> Part:
    """A loft along axes[2]: for each (distance, level) of `rims`, the outline, inset by the distance, at that level."""
    rings = np.empty((len(rims), len(outline), 3))
    for ring, (distance, level) in zip(rings, rims, strict=True):
        ring[:, axes[:2]] = inset(outline, distance)
        ring[:, axes[2]] = level
    return loft(rings)


def slab(outline: np.ndarray, thickness: float, bevel: float | None = None) -> Part:
    """A plate with the given outline in (x, z), from y = 0 to `thickness`, its rims bevelled."""
    bevel = 0.2 * thickness if bevel is None else min(bevel, 0.45 * thickness)
    return _prism(outline, [(bevel, 0.0), (0.0, bevel), (0.0, thickness - bevel), (bevel, thickness)], (0, 2, 1))


def box(size: Point, center: Point = (0.0, 0.0, 0.0), radius: float | None = None) -> Part:
    """A box of the given size [3] about `center`, its edges rounded (radius None: 12 % of the shortest side)."""
    shortest, axis = np.min(size), int(np.argmax(size))  # lofted along its longest side
    i, j = (axis + 1) % 3, (axis + 2) % 3
    radius = 0.12 * shortest if radius is None else min(radius, 0.45 * shortest)
    outline = rectangle(size[i], size[j], radius, 1 if radius < 0.2 * shortest else 3)
    half, rim = 0.5 * size[axis], 0.6 * radius
    rims = [(rim, -half), (0.0, rim - half), (0.0, half - rim), (rim, half)]
    return _prism(outline, rims, (i, j, axis)).moved(*center)


def between(lower: Point, upper: Point, radius: float | None = None) -> Part:
    """The rounded box between two opposite corners."""
    lower, upper = np.minimum(lower, upper), np.maximum(lower, upper)
    return box(upper - lower, (lower + upper) / 2, radius)


def post(foot: Point, head: Point, outline: np.ndarray, profile: Sequence[tuple[float, float]]) -> Part:
    """A post, perhaps slanted, with horizontal sections. profile: [(height from 0 at the foot to 1, outline scale)]."""
    foot, head = np.asarray(foot, dtype=float), np.asarray(head, dtype=float)
    section = np.stack([outline[:, 0], np.zeros(len(outline)), outline[:, 1]], 1)
    return loft(np.stack([foot + t * (head - foot) + scale * section for t, scale in profile]))


def revolve(profile: Sequence[Point], sides: int = 16, hollow: bool = False) -> Part:
    """The solid of revolution about the y axis of the profile [(radius > 0, y)].

    With `hollow` the profile is a closed loop that stays off the axis (a lamp shade, an engine nacelle).
    """
    profile = np.asarray(profile, dtype=float)
    angle = np.arange(sides) * (2.0 * np.pi / sides)
    radius, y = np.maximum(profile[:, :1], 1e-4), np.repeat(profile[:, 1:], sides, 1)
    return loft(np.stack([radius * np.cos(angle), y, radius * np.sin(angle)], 2), "ring" if hollow else "fan")


def ellipsoid(size: Point, center: Point = (0.0, 0.0, 0.0), sides: int = 14, stacks: int = 8) -> Part:
    """An ellipsoid of the given size [3] about `center`."""
    angle = np.linspace(-0.5, 0.5, stacks + 1) * np.pi
    profile = np.stack([np.maximum(np.cos(angle), 0.02), np.sin(angle)], 1) * 0.5
    return revolve(profile, sides).scaled(*size).moved(*center)


def rounded_path(points: Sequence[Point], radius: float, segments: int = 4, closed: bool = False) -> np.ndarray:
    """The polyline [P, 3] with each corner replaced by an arc-like curve that starts `radius` before the corner."""
    points = np.asarray(points, dtype=float)
    t = np.linspace(0.0, 1.0, segments + 1)[:, None]
    path = []
    for k, corner in enumerate(points):
        if not closed and k in (0, len(points) - 1):
            path.append(corner[None])
            continue
        ends = []
        for other in (points[k - 1], points[(k + 1) % len(points)]):
            length = np.linalg.norm(other - corner)
            ends.append(corner + (other - corner) * (min(radius, 0.45 * length) / length))
        path.append((1 - t) ** 2 * ends[0] + 2 * t * (1 - t) * corner + t**2 * ends[1])
    return np.concatenate(path)


def tube(
    path: Sequence[Point],
    radius: float | np.ndarray = 1.0,
    section: np.ndarray | None = None,
    closed: bool = False,
    side: Point = (0.0, 0.0, 1.0),
) -> Part:
    """A tube along a path [P, 3], with mitred bends. section: outline [N, 2] (default: a circle); radius scales it.

    The first axis of the section points towards `side` as far as the path allows. radius is a number or [P].
    """
    path = np.asarray(path, dtype=float)
    section = ellipse(2.0, 2.0, 8) if section is None else section
    if closed:
        ahead, behind = np.roll(path, -1, 0) - path, path - np.roll(path, 1, 0)
    else:
        step = np.diff(path, axis=0)
        ahead, behind = np.concatenate([step, step[-1:]]), np.concatenate([step[:1], step])
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    behind = behind / np.linalg.norm(behind, axis=1, keepdims=True)
    tangent = ahead + behind
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    normal = np.asarray(side, dtype=float)
    if abs(normal @ tangent[0]) > 0.95 * np.linalg.norm(normal):
        normal = np.array([1.0, 0.0, 0.0]) if abs(tangent[0, 0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    radius = np.broadcast_to(np.asarray(radius, dtype=float), len(path))
    rings = []
    for k in range(len(path)):
        normal = normal - (normal @ tangent[k]) * tangent[k]
        normal = normal / np.linalg.norm(normal)
        ring = radius[k] * (section[:, :1] * normal + section[:, 1:] * np.cross(tangent[k], normal))
        bend = ahead[k] - behind[k]
        size = np.linalg.norm(bend)
        if size > 1e-6:  # mitre: stretch towards the bend by 1 / cos(half the bend)
            bend = bend / size
            ring = ring + (ring @ bend)[:, None] * bend * (1.0 / max(ahead[k] @ tangent[k], 0.4) - 1.0)
        rings.append(path[k] + ring)
    return loft(np.stack(rings), "ring" if closed else "fan")


def bar(start: Point, end: Point, width: float, height: float | None = None, side: Point = (0.0, 0.0, 1.0)) -> Part:
    """A straight bar: round with diameter `width`, or rectangular, width (along `side`) by height."""
    if height is None:
        return tube([start, end], 1.0, ellipse(width, width, 6), side=side)
    return tube([start, end], 1.0, rectangle(width, height, segments=int(max(width, height) > 0.04)), side=side)


def sheet(surface: np.ndarray, thickness: float) -> Part:
    """A curved plate: the surface grid [U, V, 3] thickened by `thickness` along its normals (to both sides)."""
    along = np.gradient(surface, axis=0)
    across = np.gradient(surface, axis=1)
    normal = np.cross(along, across)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-12)
    front, back = surface + 0.5 * thickness * normal, surface - 0.5 * thickness * normal
    return loft(np.concatenate([front, back[:, ::-1]], 1), "strip")


def wing(sections: list[Sequence[float]], points: int = 7, upright: bool = False, whole: bool = False) -> Part:
    """A wing through airfoil sections (span, rise, leading edge z, chord, thickness / chord), nose towards +z.

    The span is along x and the rise along y; `upright` swaps them, for a fin. `whole` adds the mirrored sections; the
    first section is then in the middle. The airfoil is a symmetric four-digit NACA profile with a blunt trailing edge.
    """
    if whole:
        sections = [(-x, *rest) for x, *rest in sections[:0:-1]] + sections
    angle = np.linspace(0.0, np.pi, points)
    c = 0.5 * (1.0 - np.cos(angle))  # dense at the leading edge (0) and the trailing edge (1)
    half = 5.0 * (0.2969 * np.sqrt(c) - 0.1260 * c - 0.3516 * c**2 + 0.2843 * c**3 - 0.1015 * c**4) + 0.02
    chordwise, thickness = np.concatenate([c, c[::-1]]), np.concatenate([half, -half[::-1]])
    rings = []
    for span, rise, z, chord, ratio in sections:
        x, y = np.full(2 * points, span), rise + thickness * chord * ratio
        rings.append(np.stack([y, x, z - chordwise * chord] if upright else [x, y, z - chordwise * chord], 1))
    return loft(np.stack(rings), "strip")


@lru_cache(maxsize=1024)
def _loft_faces(rings: int, size: int, ends: str) -> np.ndarray:
    """Faces int64 [F, 3] of a loft of `rings` rings of `size` points each, then the two centre points of a fan."""
    r = np.arange(rings if ends == "ring" else rings - 1)[:, None] * size
    n = np.arange(size)[None]
    after = (n + 1) % size
    up = (r + size) % (rings * size)
    a, b, c, d = r + n, r + after, up + n, up + after
    faces = [np.stack([a, b, d], 2).reshape(-1, 3), np.stack([a, d, c], 2).reshape(-1, 3)]
    last = (rings - 1) * size
    if ends == "fan":
        a, b, center = n[0], after[0], np.full(size, rings * size)
        faces += [np.stack([center, b, a], 1), np.stack([center + 1, last + a, last + b], 1)]
    elif ends == "strip":
        i = np.arange(size // 2 - 1)
        cap = np.concatenate([np.stack([i + 1, i, size - 1 - i], 1), np.stack([i + 1, size - 1 - i, size - 2 - i], 1)])
        faces += [cap, last + cap[:, ::-1]]
    return np.concatenate(faces)


def _refine(rings: np.ndarray, ends: str) -> np.ndarray:
    """Interpolate rings of a thin bar so that they are at most STEP apart; other rings are returned unchanged."""
    if np.linalg.norm(np.ptp(rings, axis=1), axis=1).max() > THIN:
        return rings
    closed = ends == "ring"
    track = np.concatenate([rings, rings[:1]]) if closed else rings
    gap = np.linalg.norm(np.diff(track, axis=0), axis=2).max(1)
    counts = np.maximum(np.ceil(gap / STEP).astype(int), 1)
    if counts.max() == 1:
        return rings
    t = np.concatenate([k + np.arange(c) / c for k, c in enumerate(counts)] + ([] if closed else [[len(counts)]]))
    k = np.minimum(t.astype(int), len(track) - 2)
    w = (t - k)[:, None, None]
    return (1 - w) * track[k] + w * track[k + 1]


def assemble(part: Part) -> trimesh.Trimesh:
    """The mesh of a part: closed components, oriented outwards; box centred at the origin, longest side 1."""
    lower = np.min([rings.min((0, 1)) for rings, _ in part.lofts], 0)
    upper = np.max([rings.max((0, 1)) for rings, _ in part.lofts], 0)
    vertices, faces, offset = [], [], 0
    for rings, ends in part.lofts:
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
