"""Backs of chairs, in metres, upright in the plane z = 0 from y = 0: frames and their fillings, plates, pads, hoops."""

from __future__ import annotations

import numpy as np

from .draw import Draw
from .parts import Part, bar, between, ellipse, post, rectangle, rounded_path, sheet, tube

_KINDS = {"ladder": 2, "slats": 2, "spindles": 1, "splat": 1.2, "cross": 0.8, "open": 1.0, "lattice": 0.7, "band": 1.0}
_KINDS |= {"panel": 1.2, "hoop": 1.2, "solid": 2.0}


def make_back(draw: Draw, family: str, half: float, height: float, curve: float) -> tuple[Part, float]:
    """A back of the given height between stiles at x = -half and half, and the distance of its front from z = 0."""
    top = height + 0.02
    if draw.maybe({"office": 0.8, "lounge": 0.5}.get(family, 0.12)):
        thickness = draw(0.05, 0.11)
        return _padded_back(draw, half, top, curve, thickness, detached=family == "office"), thickness / 2
    kind = draw.pick(_KINDS)
    if kind == "solid":
        return _plate(draw, half, top, curve, draw(0.02, 0.045)), 0.0
    if kind == "hoop":
        return _hoop(draw, half, top, curve), 0.0
    return _framed_back(draw, half, height, curve, kind), 0.0


def _framed_back(draw: Draw, half: float, height: float, curve: float, kind: str) -> Part:
    """Two stiles and a rail on top, filled with boards, slats, spindles, a splat, a cross, a lattice, or open."""
    top, high = height + 0.02, height > 0.3
    stile, board = draw(0.022, 0.045), draw(0.015, 0.028)
    outline = ellipse(stile, stile, 8) if draw.maybe(0.4) else rectangle(stile, stile, segments=1)
    part = post((half, -0.02, curve), (half, top, curve), outline, [(0, 1), (1, draw(0.7, 1))]).both_sides()
    rail = draw(0.04, 0.12) if high else draw(0.03, 0.06)
    arch = draw(0.01, 0.07) if draw.maybe(0.4) else 0.0
    part += _rail(half, top - 0.45 * rail, rail, board, curve, arch)
    if kind == "open":
        return part
    low = draw(0.06, 0.3) * height
    if kind == "ladder":
        count = draw.count(1, 4) if high else 1
        pitch = (top - rail - low) / (count + 0.5)
        each = min(draw(0.25, 0.6) * pitch, 0.08)
        for k in range(count):
            part += _rail(half, low + (k + 0.5) * pitch, each, board, curve, 0.6 * arch)
        return part
    if kind in ("panel", "band"):
        bottom = low if kind == "panel" else 0.55 * height
        x, y = np.meshgrid(np.linspace(-half, half, 9), [bottom, top - 0.5 * rail])
        return part + sheet(np.stack([x, y, _bow(x, half, curve)], 2), board)
    bottom, upper = -0.01, top - 0.6 * rail
    if draw.maybe(0.5) or kind == "lattice":
        bottom = low
        part += _rail(half, low, draw(0.025, 0.05), board, curve)
    if kind == "splat":
        return part + _splat(draw, bottom, upper + arch * 0.8, board, half * draw(0.25, 0.5))
    if kind == "cross":
        for side in (-1, 1):
            x = side * np.linspace(-half, half, 7)
            path = np.stack([x, np.linspace(bottom + 0.01, upper, 7), _bow(x, half, curve)], 1)
            part += tube(path, 1.0, rectangle(board, draw(0.02, 0.04), segments=1))
        return part
    count = {"slats": draw.count(2, 7), "spindles": draw.count(4, 8), "lattice": draw.count(2, 4)}[kind]
    wide = draw(0.25, 0.6) * 2 * half / (count + 1)
    size = (0.018, None) if kind == "spindles" else (0.8 * board, min(wide, 0.07))
    for x in np.linspace(-half, half, count + 2)[1:-1]:
        z = _bow(x, half, curve)
        part += bar((x, bottom, z), (x, upper + arch * (1 - (x / half) ** 2), z), *size)
    if kind == "lattice":
        for y in np.linspace(bottom, upper, draw.count(1, 3) + 2)[1:-1]:
            part += _rail(half, y, draw(0.015, 0.03), 0.7 * board, curve)
    return part


def _bow(x: np.ndarray, half: float, curve: float) -> np.ndarray:
    """z of a back that is bent towards the sitter: `curve` at the stiles (x = half), zero in the middle."""
    return curve * (np.abs(x) / half) ** 2


def _rail(half: float, y: float, height: float, thickness: float, curve: float, arch: float = 0.0) -> Part:
    """A horizontal board between the stiles, following the bow of the back, its middle lifted by `arch`."""
    x = np.linspace(-half, half, 9)
    path = np.stack([x, y + arch * (1 - (x / half) ** 2), _bow(x, half, curve)], 1)
    return tube(path, 1.0, rectangle(thickness, height, segments=1))


def _plate(draw: Draw, half: float, top: float, curve: float, thickness: float) -> Part:
    """A one-piece back: straight or flared, its upper corners rounded, bowed and with a lumbar bulge."""
    flare, power, wave = draw(-0.25, 0.2), draw.pick((2.0, 3.0, 6.0, 12.0)), draw(-0.02, 0.03)
    t = np.concatenate([np.linspace(0, 0.7, 4), 1 - 0.3 * np.linspace(0.75, 0, 5) ** 1.8])[:, None]
    v = np.linspace(-1, 1, 11)[None]
    rounding = (1 - np.clip((t - 0.4) / 0.605, 0, 1) ** power) ** (1 / power)
    x = v * half * (1 + flare * t) * np.maximum(rounding, 0.12)
    y = -0.01 + t * (top + 0.01) + 0 * v
    return sheet(np.stack([x, y, _bow(x, half, curve) + wave * np.sin(np.pi * t)], 2), thickness)


def _padded_back(draw: Draw, half: float, top: float, curve: float, thickness: float, detached: bool) -> Part:
    """An upholstered back; most `detached` ones float above the seat on a spine."""
    if not detached or draw.maybe(0.3):
        if draw.maybe(0.5):
            return _plate(draw, 1.05 * half, top, curve, thickness)
        return between((-half - 0.03, -0.02, -thickness / 2), (half + 0.03, top, thickness / 2), 0.03)
    gap = draw(0.12, 0.35) * top
    pad = _plate(draw, draw(0.8, 1.1) * half, top - gap, max(curve, 0.03), thickness).moved(y=gap)
    path = rounded_path([(0, -0.06, 0.12), (0, -0.06, -0.07), (0, gap + 0.3 * (top - gap), -0.4 * thickness)], 0.06)
    return pad + tube(path, 1.0, rectangle(0.06, 0.02, segments=1), side=(1, 0, 0))


def _hoop(draw: Draw, half: float, top: float, curve: float) -> Part:
    """A bent hoop, empty or filled with spindles (Windsor)."""
    angle = np.linspace(0, np.pi, 17)
    straight = draw(0.2, 0.6) * top
    x = np.concatenate([[half], half * np.cos(angle), [-half]])
    y = np.concatenate([[-0.02], straight + (top - straight) * np.sin(angle) ** 0.9, [-0.02]])
    part = tube(np.stack([x, y, _bow(x, half, curve)], 1), draw(0.018, 0.035) / 2)
    count = draw.count(3, 8) if draw.maybe(0.85) else 0
    for x in np.linspace(-half, half, count + 2)[1:-1]:
        end = straight + (top - straight) * (1 - (x / half) ** 2) ** 0.45
        part += bar((0.75 * x, -0.01, _bow(0.75 * x, half, curve)), (x, end, _bow(x, half, curve)), 0.016)
    return part


def _splat(draw: Draw, bottom: float, top: float, thickness: float, half: float) -> Part:
    """A vase-shaped centre board."""
    t = np.linspace(0, 1, 9)[:, None]
    width = half * (1 + draw(0.1, 0.5) * np.sin(2 * np.pi * (draw(0.6, 1.4) * t + draw(0, 1))))
    x = np.array([[-1.0, -0.5, 0.0, 0.5, 1.0]]) * np.minimum(width, 1.8 * half)
    return sheet(np.stack([x, bottom + t * (top - bottom) + 0 * x, 0 * x], 2), thickness)
